"""``python -m phytofit``."""

from phytofit.cli import main

__all__: list[str] = []

main()
