"""How Sphinx builds these pages: ``make docs``, or ``python -m sphinx -W -b html docs docs/_build/html``."""

import re
from importlib.metadata import version as installed_version

project = "phytofit"
author = "The phytofit developers"
project_copyright = author
version = release = installed_version("phytofit")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
extensions += ["sphinx-mathjax-offline"]  # equations show without a network
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"phytofit {release}"

myst_enable_extensions = ["amsmath", "dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
napoleon_google_docstring = False
napoleon_use_rtype = False

UNDERLINE = re.compile(r" *-{3,}$")
ONE_LINE = re.compile(r"(\w+(?:, \w+)*) : (.+)")
LONG_TYPES = {  # what autodoc makes of the aliases; the docstrings give shapes
    re.compile(r"~?(numpy\.)?ndarray\[tuple\[~?(typing\.)?Any, \.\.\.\], ~?(numpy\.)?dtype\[[^]]*\]\]"): "ndarray",
    re.compile(r"~?[\w.]*_Buffer \|.*?_NestedSequence\[complex \| bytes \| str\]"): "ArrayLike",
    re.compile(r"<factory>"): "...",
}


def docstring_for_napoleon(app, what, name, obj, options, lines):
    """Parameters may be told in one line, ``name : what it is``, and text may follow on a section."""
    if what == "property":
        lines[0] = lines[0].replace(": ", " – ")  # what stands before a colon would become the type
    told, inside = [], False
    for i, line in enumerate(lines):
        inside = inside or bool(UNDERLINE.fullmatch(line))
        if inside and (one := ONE_LINE.fullmatch(line)):
            told += [one[1], f"    {one[2]}"]
            continue
        told.append(line)
        following, after = (*lines[i + 1 : i + 3], "", "")[:2]
        if inside and not line and following and not following.startswith(" ") and not UNDERLINE.fullmatch(after):
            told.append("")  # two blank lines end a section
    lines[:] = told


def short_signature(app, what, name, obj, options, signature, returns):
    """The signature with short names for long types."""
    for pattern, short in LONG_TYPES.items():
        signature = signature and pattern.sub(short, signature)
        returns = returns and pattern.sub(short, returns)
    return signature, returns


def setup(app):
    app.connect("autodoc-process-docstring", docstring_for_napoleon, priority=400)  # before napoleon's 500
    app.connect("autodoc-process-signature", short_signature)
