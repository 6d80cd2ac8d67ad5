"""The command that prints every setting."""

import json

from phytofit.cli.console import command, out

__all__ = ["recipe_command"]


@command("recipe")
def recipe_command() -> None:
    """Print every setting with its default, as JSON.

    Each result stores its own in fit.json, under "settings".
    """
    from phytofit.recipe import recipe

    out.print_json(json.dumps(recipe()))
