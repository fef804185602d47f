"""Pages that relight a scene in a browser."""

from mi_sparse_prt.relighting.viewer.export import KEPT, Page, make_page

__all__ = ["KEPT", "Page", "make_page"]
