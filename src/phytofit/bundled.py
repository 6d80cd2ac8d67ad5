"""What comes with phytofit as data: species, a TOML file each."""

from importlib import resources

__all__ = ["species_folder", "species_names"]


def species_folder() -> "resources.abc.Traversable":
    return resources.files("phytofit") / "species"


def species_names() -> list[str]:
    """Names of the species that come with phytofit."""
    return sorted(p.name.removesuffix(".toml") for p in species_folder().iterdir() if p.name.endswith(".toml"))
