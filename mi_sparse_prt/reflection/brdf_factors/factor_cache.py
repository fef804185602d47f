"""As many factors as asked for, found again on disk."""

from __future__ import annotations

import hashlib
import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.io.atomic import write_atomically
from mi_sparse_prt.io.cache_folder import cache_folder
from mi_sparse_prt.reflection.brdf_factors.diffuse_part import evaluate_brdf, probe_directions
from mi_sparse_prt.reflection.brdf_factors.direction_grid import DirectionGrid
from mi_sparse_prt.reflection.brdf_factors.factor_error import FactorError, measure_factor_error
from mi_sparse_prt.reflection.brdf_factors.factorization import MOST_TERMS, BrdfFactors, factor_brdf
from mi_sparse_prt.scene.materials import Material
from mi_sparse_prt.scene.notes import Notes

FORMAT = 4  # of the files; another one whenever factors of the same BSDF would be others

ERRORS = ("whole", "grazing", "peak", "lit")


@dataclass(frozen=True)
class FactorOptions:
    """What factors are made of, and how their errors are measured.

    Attributes
    ----------
    grid : DirectionGrid
        Of incident and of outgoing directions.
    pairs : int
        Of directions at which the error is measured.
    """

    grid: DirectionGrid = DirectionGrid()
    pairs: int = 1 << 17


def factors_of(
    bsdf: mi.BSDF,
    name: str,
    terms: int = 4,
    target_error: float | None = None,
    folder: Path | None = None,
    options: FactorOptions | None = None,
) -> BrdfFactors:
    """Factor a reflective BSDF, or find the factors that an earlier call left in a folder.

    Parameters
    ----------
    bsdf : mi.BSDF
        Its front is factored. A diffuse part that varies over the surface is left to the caller, see `BrdfFactors`.
    name : str
        For messages.
    terms : int
        K, 1 to 16; [HR10] takes 4. Fewer if one would be without its partner (``BrdfFactors.complete``).
    target_error : float, optional
        Relative L2 error over all pairs of directions, see ``measure_factor_error``: the fewest terms that meet it,
        instead of ``terms``. If 16 do not, they are taken, and a `PrtWarning` says how far they are.
    folder : Path, optional
        Made if it does not exist; the default is ``brdf`` in ``io.cache_folder()``. Files in it, 1 or 2 MB each,
        may be deleted at any time; one is found by all that the BSDF shows of itself, whatever its shape's name.
    options : FactorOptions, optional

    Returns
    -------
    BrdfFactors

    Raises
    ------
    PrtError
        If ``terms`` is out of range, and as ``factor_brdf``.
    """
    if not 1 <= terms <= MOST_TERMS:
        raise PrtError(f"shape '{name}': {terms} factors of its BRDF; give 1 to {MOST_TERMS}")
    factors, error = _find_or_make(bsdf, name, folder or cache_folder() / "brdf", options or FactorOptions())
    if target_error is None:
        return factors.complete(terms)
    enough = error.terms_for(target_error)
    if enough is None:
        warnings.warn(
            f"shape '{name}': {MOST_TERMS} factors of its BRDF have an error of {error.whole[-1]:.1%}, more than "
            f"{target_error:.1%}; all are taken, ask for a larger error or use path tracing",
            PrtWarning,
            stacklevel=2,
        )
    return factors.first(enough or MOST_TERMS)


def factors_for_images(
    bsdf: mi.BSDF,
    name: str,
    bound: float,
    folder: Path | None = None,
    options: FactorOptions | None = None,
) -> tuple[BrdfFactors, float]:
    """The fewest factors that meet an error of images, or 16; none without its partner.

    Parameters
    ----------
    bsdf, name, folder, options
        As for ``factors_of``.
    bound : float
        Relative L2 error of the radiance that the surface reflects, ``FactorError.lit``.

    Returns
    -------
    factors : BrdfFactors
    error : float
        The error that they have; it may be above the bound.

    Raises
    ------
    PrtError
        As ``factor_brdf``.
    """
    factors, error = _find_or_make(bsdf, name, folder or cache_folder() / "brdf", options or FactorOptions())
    good = np.flatnonzero(error.lit <= bound)
    enough = int(good[0]) + 1 if len(good) else MOST_TERMS
    whole = (factors.complete(terms) for terms in range(enough, MOST_TERMS))
    found = next((some for some in whole if some.terms >= enough), factors.complete(MOST_TERMS))
    return found, float(error.lit[found.terms - 1])


def _find_or_make(
    bsdf: mi.BSDF, name: str, folder: Path, options: FactorOptions
) -> tuple[BrdfFactors, FactorError]:
    """All terms and their errors."""
    grid = options.grid
    path = folder / f"{_key(bsdf, name, options)}.npz"
    found = _read(path, grid)
    if found:
        return found
    factors = factor_brdf(bsdf, name, MOST_TERMS, grid)
    error = measure_factor_error(factors, bsdf, name, pairs=options.pairs)
    try:
        _write(path, factors, error)
    except OSError as problem:  # the result is good, only not kept
        warnings.warn(f"cache of BRDF factors: {problem}", PrtWarning, stacklevel=3)
    return factors, error


def _key(bsdf: mi.BSDF, name: str, options: FactorOptions) -> str:
    """Of all that the BSDF shows, and of some values, as plugins may show too little of themselves."""
    carrier = mi.load_dict({"type": "rectangle", "bsdf": bsdf})  # what materials are read from
    shown = Material(carrier, name, Notes()).digest()
    made_with = [FORMAT, MOST_TERMS, options.grid.heights, options.grid.azimuths, options.pairs]
    state = hashlib.sha256(json.dumps(made_with).encode())
    state.update(shown + evaluate_brdf(bsdf, name, *probe_directions()).tobytes())
    return state.hexdigest()[:32]


def _read(path: Path, grid: DirectionGrid) -> tuple[BrdfFactors, FactorError] | None:
    """None if the file is missing or damaged."""
    try:
        with np.load(path) as file:  # a zip archive: each array has its checksum
            kept: dict[str, NDArray[Any]] = {name: file[name] for name in file.files}
        factors = BrdfFactors(
            grid, kept["diffuse"], kept["incident"], kept["outgoing"], bool(kept["varying_diffuse"])
        )
        return factors, FactorError(*(kept[name] for name in ERRORS))
    except Exception:  # damage raises whatever the damaged bytes lead to; what is not found is made again
        return None


def _write(path: Path, factors: BrdfFactors, error: FactorError) -> None:
    """Nothing is left under the name if it fails."""
    arrays: dict[str, Any] = {
        "diffuse": factors.diffuse,
        "incident": factors.incident,
        "outgoing": factors.outgoing,
        "varying_diffuse": np.array(factors.varying_diffuse),
    } | {name: getattr(error, name) for name in ERRORS}

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:  # a path would be given another suffix
            np.savez(file, **arrays)

    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, write)
