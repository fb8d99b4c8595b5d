"""Sphinx settings: ``pip install -e ".[docs]"``, then ``sphinx-build -W -b html docs docs/_build``."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))  # the extension "pages"

import kcs_torch

project = "kcs_torch"
author = "The kcs_torch contributors"
copyright = author
release = version = kcs_torch.__version__
language = "en"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "pages",
]
exclude_patterns = ["_build", "_generated", "_gallery"]

myst_enable_extensions = ["dollarmath", "deflist"]
myst_fence_as_directive = ["math"]  # as GitHub draws them
myst_heading_anchors = 3

autosummary_generate = False
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False  # those of torch say nothing of ours
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 90
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_custom_sections = [("Warns", "params_style")]

html_theme = "furo"
html_title = "kcs_torch"
html_math_renderer = "mathml"
html_show_sphinx = False
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_extra_path = ["_gallery/pages"]  # players, which stand alone
