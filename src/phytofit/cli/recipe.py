"""The command that prints every setting."""

import json

from phytofit.cli.console import app, out

__all__ = ["recipe_command"]


@app.command("recipe")
def recipe_command() -> None:
    """Print every setting with its default, as JSON; each result's fit.json stores its own under "settings"."""
    from phytofit.recipe import recipe

    out.print_json(json.dumps(recipe()))
