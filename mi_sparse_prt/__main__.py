"""``python -m mi_sparse_prt`` is the command line."""

from mi_sparse_prt.cli import app

app(prog_name="mi-sparse-prt")
