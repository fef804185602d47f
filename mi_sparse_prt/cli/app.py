"""The program: its commands under one name."""

import typer

from mi_sparse_prt.cli.benchmark import benchmark
from mi_sparse_prt.cli.info import info
from mi_sparse_prt.cli.many_lights import many_lights
from mi_sparse_prt.cli.pictures import pictures
from mi_sparse_prt.cli.precompute import precompute
from mi_sparse_prt.cli.relight import relight
from mi_sparse_prt.cli.validate import validate
from mi_sparse_prt.cli.view import view

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
    help="Precomputed light transport for Mitsuba 3 scenes: compute a matrix once, relight the scene at once.",
    epilog="Start with: mi-sparse-prt precompute SCENE.xml -o SCENE.prt",
)
for command in (precompute, relight, view, validate, info, benchmark, pictures, many_lights):
    app.command()(command)
