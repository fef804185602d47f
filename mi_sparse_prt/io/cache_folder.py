"""Where results are kept between runs."""

from pathlib import Path

import platformdirs


def cache_folder() -> Path:
    """``mi_sparse_prt`` in the user's cache folder (``XDG_CACHE_HOME`` on Linux)."""
    return platformdirs.user_cache_path("mi_sparse_prt", appauthor=False)
