"""The documentation site: `make docs` builds it into build/docs, and a warning is an error."""

from importlib import metadata

project = "stickslip"
author = "The stickslip authors"
release = metadata.version("stickslip")
extensions = ["myst_parser", "sphinx.ext.autodoc"]
exclude_patterns = ["README.md"]
html_theme = "furo"
html_title = "stickslip"
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
