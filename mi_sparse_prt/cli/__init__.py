"""The command line: ``mi-sparse-prt precompute | relight | validate | info | benchmark``."""

from mi_sparse_prt.cli.commands import app

__all__ = ["app"]
