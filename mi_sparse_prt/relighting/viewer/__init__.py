"""Pages that relight a scene in a browser."""

from mi_sparse_prt.relighting.viewer.export import Page, make_page

__all__ = ["Page", "make_page"]
