"""How Sphinx builds these pages: ``bash .ci/docs``. Nothing is executed; notebooks are shown as they were stored."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]  # the checkout's own package, installed or not

import mi_sparse_prt  # noqa: E402
from mi_sparse_prt.relighting.viewer.export import SCRIPTS  # noqa: E402
from mi_sparse_prt.relighting.viewer.page_file import page_text  # noqa: E402

project = "mi-sparse-prt"
author = "the authors of mi-sparse-prt"
project_copyright = "the mi-sparse-prt authors, BSD-3-Clause"
version = release = mi_sparse_prt.__version__

extensions = [
    "sphinx.ext.autodoc",
    "numpydoc",
    "myst_nb",
    "sphinx_tabs.tabs",
    "from_the_package",
]
exclude_patterns = ["_ext", "Thumbs.db", "**/.ipynb_checkpoints"]
nb_execution_mode = "off"
nb_merge_streams = True
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
smartquotes = False  # --options stay what they are
default_role = "literal"  # docstrings write names between single backticks

autodoc_typehints = "none"  # types are in the tables of parameters, with shapes and units
autodoc_member_order = "bysource"
numpydoc_show_class_members = False  # autodoc lists them
numpydoc_class_members_toctree = False
sphinx_tabs_disable_tab_closing = True

html_theme = "furo"
html_title = "mi-sparse-prt"
EXTRA = HERE.parent / "build" / "extra"  # pages of other kinds, copied as they are
(EXTRA / "live").mkdir(parents=True, exist_ok=True)
(EXTRA / "live" / "terrace.html").write_text(
    page_text("index", SCRIPTS, "terrace", (HERE / "live" / "terrace.txt").read_text())
)
html_extra_path = [str(EXTRA)]
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_theme_options = {"navigation_with_keys": True, "top_of_page_buttons": []}
pygments_style = "friendly"
pygments_dark_style = "native"
templates_path: list[str] = []
