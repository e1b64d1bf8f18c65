"""Sphinx settings. `make docs` builds with warnings as errors and without a network."""

import os
import sys
from pathlib import Path

os.environ["MPLBACKEND"] = "Agg"
os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(Path(__file__).parent / "_ext"))

import robins

project = "robins"
author = "The robins developers"
copyright = "The robins developers, Apache-2.0"
release = version = robins.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "room_pages",
    "budget_table",
    "finding_tables",
    "format_tables",
    "plain_docstrings",
    "rings",
    "role_table",
]
exclude_patterns = ["_build", "certified.md", "mutants.md"]
default_role = "py:obj"  # `name` in a docstring links to the name where there is one
highlight_language = "text"
myst_enable_extensions = ["deflist"]
myst_heading_anchors = 3

html_theme = "furo"
html_title = f"robins {release}"
html_show_sourcelink = False
html_copy_source = False

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False  # the signature shows them
smartquotes = False
