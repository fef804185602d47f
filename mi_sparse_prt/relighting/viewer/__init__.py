"""Pages that relight a scene, or a picture, in a browser."""

from mi_sparse_prt.relighting.viewer.export import KEPT, Page, make_page
from mi_sparse_prt.relighting.viewer.live import LivePage, make_live_page
from mi_sparse_prt.relighting.viewer.mixer import make_mixer
from mi_sparse_prt.relighting.viewer.page_file import PageFile

__all__ = ["KEPT", "LivePage", "Page", "PageFile", "make_live_page", "make_mixer", "make_page"]
