"""The documentation as a site: `make docs` writes out/docs/index.html, offline."""

from __future__ import annotations

import importlib.metadata
import importlib.util

project = "softmode"
author = "the softmode authors"
copyright = "the softmode authors, Apache-2.0"
release = importlib.metadata.version("softmode")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
suppress_warnings = []

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 3
myst_links_external_new_tab = False

autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
# The site builds without the extras; what is installed is read as it is.
autodoc_mock_imports = [
    name
    for name in ("torch", "stable_baselines3", "rsl_rl", "skrl", "tensordict", "pyarrow", "rerun", "viser", "matplotlib")
    if importlib.util.find_spec(name) is None
]
napoleon_numpy_docstring = False
napoleon_use_rtype = False

html_theme = "furo"
html_title = "softmode"
html_show_sphinx = False
html_copy_source = False
html_theme_options = {"navigation_with_keys": True}
