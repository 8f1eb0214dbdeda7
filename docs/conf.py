"""How the documentation is built as a site: `scripts/docs`.

The source directory is the root of the checkout, so that README.md, ARCHITECTURE.md, SAFETY.md and the others at the top are pages as they
are, and a link that works between the files works on the site.
"""

from __future__ import annotations

from importlib.metadata import version as _installed_version

project = "void-companion"
author = "The void-companion developers"
project_copyright = author
version = release = _installed_version("void-companion")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "docs/index"
include_patterns = ["*.md", "docs/**"]
exclude_patterns = [".venv", "out", "dist", "build", "tests", "docs/conf.py"]

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]

napoleon_google_docstring = False
napoleon_use_ivar = True  # attributes within their class: as members they would be listed twice
autodoc_typehints = "none"  # types stand in the signatures
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "undoc-members": False}
autodoc_class_signature = "mixed"

html_theme = "furo"
html_title = "void-companion"
html_show_sourcelink = False
html_copy_source = False
