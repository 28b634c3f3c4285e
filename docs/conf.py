"""How Sphinx builds these pages; a warning is an error, and nothing is fetched from the network."""

import re
import sys
import tomllib
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import generated_parts  # noqa: E402  (it stands beside this file)

project = "nlcwfs"
author = "The nlcwfs developers"
copyright = author
release = version = tomllib.loads((HERE.parent / "pyproject.toml").read_text())["project"]["version"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["_build", "_generated"]
html_theme = "furo"
html_title = f"nlcwfs {release}"
html_static_path = ["_static"]
templates_path = []

myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 3

default_role = "code"  # a single backtick in a docstring is code
nitpicky = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True}
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
toc_object_entries_show_parents = "hide"
napoleon_use_ivar = True


def _short(text):
    """`Float[Array, 'y x']` reads better than the modules that its parts live in."""
    return (
        re.sub(r"~?\b(?:jaxtyping|jaxlib\._jax|jaxlib\._|jax|numpy|typing)\.?(?=[A-Z]|ndarray)", "", text)
        if text
        else text
    )


def _short_signatures(app, what, name, obj, options, signature, returns):
    """The same for functions and classes."""
    return _short(signature), _short(returns)


def _literal_shapes(app, what, name, obj, options, lines):
    """The types of attributes as code: the star of `*frame` is no emphasis."""
    for number, line in enumerate(lines):
        field, _, text = line.rpartition(": ") if line.startswith(":vartype ") else ("", "", "")
        if field:
            lines[number] = f"{field}: ``{_short(text)}``"


def setup(app):
    """Called by Sphinx."""
    generated_parts.write_pages(HERE)
    generated_parts.write_settings(HERE)
    generated_parts.write_command_line(HERE)
    app.connect("autodoc-process-docstring", _literal_shapes, priority=900)  # after napoleon
    app.connect("autodoc-process-signature", _short_signatures)
