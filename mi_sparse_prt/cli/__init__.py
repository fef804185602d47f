"""The command line: ``mi-sparse-prt precompute | relight | validate | info | benchmark | pictures | many-lights``.

A command's own module has its options and its work. The names of ``prt`` are imported on first use, and what it needs
beside them when it runs, so that ``--help`` waits for neither Mitsuba nor numba.
"""

from mi_sparse_prt.cli.app import app

__all__ = ["app"]
