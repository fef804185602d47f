"""Pages that relight a scene in a browser."""

from mi_sparse_prt.relighting.viewer.export import KEPT, Page, make_page
from mi_sparse_prt.relighting.viewer.live import LivePage, make_live_page

__all__ = ["KEPT", "LivePage", "Page", "make_live_page", "make_page"]
