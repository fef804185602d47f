"""Arguments and options that several commands have, and what their values mean."""

from __future__ import annotations

import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

import mi_sparse_prt as prt
from mi_sparse_prt.core.variant import VARIANTS

DEFAULT_RESOLUTION = 32  # texels along an edge of a face


class Method(StrEnum):
    """Which elements are evaluated."""

    auto = "auto"
    brute_force = "brute_force"
    sparse = "sparse"
    huang2010 = "huang2010"
    gather = "gather"


def _start_in_variant(name: str | None) -> str | None:
    """Make the package choose this Mitsuba variant, by starting again where Mitsuba already runs in another one."""
    if name is None or name == os.environ.get("MI_SPARSE_PRT_VARIANT"):
        return name
    if name not in VARIANTS:
        raise typer.BadParameter(f"{name!r}; choose one of: {', '.join(VARIANTS)}")
    os.environ["MI_SPARSE_PRT_VARIANT"] = name
    if "mitsuba" in sys.modules and prt.variant() != name:
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    return name


def definitions(pairs: list[str] | None, option: str = "-D", form: str = "NAME=VALUE") -> dict[str, str]:
    """NAME=VALUE pairs as ``load_scene`` takes them.

    Raises
    ------
    typer.BadParameter
        If a pair is something else, or names a parameter of ``load_scene`` itself.
    """
    split = [pair.partition("=") for pair in pairs or []]
    for pair, (name, equals, _) in zip(pairs or [], split, strict=True):
        if not equals or not name.isidentifier() or name in ("path", "edge_length"):
            raise typer.BadParameter(
                f"{pair!r} is not {form} with the NAME of a <default> in the scene", param_hint=option
            )
    return {name: value for name, _, value in split}


FILM = ".mp4"
FrameCount = Annotated[
    int | None, typer.Option("--frames", help="Make a film of so many frames.", show_default=False)
]
FrameRate = Annotated[float, typer.Option("--fps", help="Frames of a film per second.")]


def is_film(output: Path) -> bool:
    """Whether frames are to be a film file, and no folder of pictures."""
    return output.suffix.lower() == FILM and not output.is_dir()


def check_film(output: Path, frames: int, fps: float) -> None:
    """Refuse a film that cannot be made (typer.BadParameter)."""
    if frames < 1:
        raise typer.BadParameter(f"{frames} frames: give 1 or more", param_hint="--frames")
    if not 0.1 <= fps <= 1000:
        raise typer.BadParameter(f"{fps} frames per second: give 0.1 to 1000", param_hint="--fps")
    if not (is_film(output) or output.is_dir() or output.suffix == ""):
        raise typer.BadParameter(
            f"{output}: give a name that ends in {FILM}, or a folder without a dot in its name",
            param_hint="-o",
        )


def file_argument(metavar: str, help: str) -> Any:
    """A file that a command is about."""
    return typer.Argument(metavar=metavar, help=help, show_default=False)


def file_option(*names: str, help: str, metavar: str = "FILE") -> Any:
    """An option whose value is a file or folder; without it there is none."""
    return typer.Option(*names, metavar=metavar, help=help, show_default=False)


SceneFile = Annotated[Path, file_argument("SCENE", "Mitsuba scene, an XML file.")]
MatrixFile = Annotated[Path, file_argument("MATRIX", "Matrix file that `precompute` wrote.")]
Define = Annotated[
    list[str] | None,
    typer.Option(
        "-D", "--define", metavar="NAME=VALUE", help="Value for a <default> of the scene; may be repeated."
    ),
]
Resolution = Annotated[
    int, typer.Option(help="Texels along an edge of the lighting's cubemap, a power of two.")
]
EdgeLength = Annotated[
    float | None,
    typer.Option(
        help="Longest edge of a triangle, world units; inf leaves meshes as they are.",
        show_default="diagonal of the scene / 64",
    ),
]
JsonFile = Annotated[
    str | None,
    typer.Option(
        "--json",
        metavar="FILE",
        help="Also write the report as JSON; - is standard output, and then alone there.",
    ),
]
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="No progress and no tables; warnings and errors stay.")
]
Variant = Annotated[
    str | None,
    typer.Option(
        envvar="MI_SPARSE_PRT_VARIANT",
        callback=_start_in_variant,
        is_eager=True,
        metavar="NAME",
        help="Mitsuba variant, " + " or ".join(VARIANTS) + ".",
        show_default="cuda_ad_rgb where there is a GPU, else llvm_ad_rgb",
    ),
]
