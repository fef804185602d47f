"""Errors of factors, at directions that they were not made of."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_sparse_prt.core.metrics import relative_l2_from_squares
from mi_sparse_prt.reflection.brdf_factors.diffuse_part import GlossyPart
from mi_sparse_prt.reflection.brdf_factors.direction_grid import Doubles, Floats
from mi_sparse_prt.reflection.brdf_factors.factorization import BrdfFactors

HELD_OUT = 1 << 17  # pairs of directions that no factor was made of
GRAZING = np.cos(np.radians(75))  # cosine of either direction
PEAK = 0.5  # of the largest value for similar outgoing directions: a pair that has more is at the peak
PEAK_HEIGHTS = 8  # groups of outgoing directions for that


@dataclass(frozen=True)
class FactorError:
    """Relative L2 errors for 1 to K terms, at directions that are not on the grid.

    Attributes
    ----------
    whole, grazing, peak : (K,) float64
        Over all pairs of directions; those of which one is more than 75 degrees off the normal; and those with more
        than half of the largest value that was found for a similar height of the outgoing direction.
    """

    whole: Doubles
    grazing: Doubles
    peak: Doubles

    def terms_for(self, target: float) -> int | None:
        """The fewest terms with no larger error over all pairs; None if there are none."""
        good = np.flatnonzero(self.whole <= target)
        return int(good[0]) + 1 if len(good) else None


def factor_error(factors: BrdfFactors, bsdf: mi.BSDF, name: str, seed: int = 1) -> FactorError:
    """Errors of the first terms, all numbers of them, at random pairs of directions.

    Half of the pairs are drawn evenly, half by the BSDF itself, which finds its peaks; weights undo that. Where the
    diffuse part varies over the surface, they are errors of the glossy part alone, which are larger.

    Parameters
    ----------
    factors : BrdfFactors
    bsdf : mi.BSDF
        That was factored.
    name : str
        For messages.
    seed : int
    """
    wi, wo, weights = _held_out(bsdf, seed)
    found = factors.diffuse_values(wi, wo)
    true = GlossyPart(bsdf, name).values(wi, wo) + found
    norms = weights * (true**2).sum(axis=1)
    grazing = np.minimum(wi[:, 2], wo[:, 2]) < GRAZING
    height = (wo[:, 2] * PEAK_HEIGHTS).astype(np.int64)
    largest = np.zeros(PEAK_HEIGHTS + 1)
    np.maximum.at(largest, height, true.sum(axis=1))
    peak = true.sum(axis=1) > PEAK * largest[height]
    errors = []
    f, g = factors.grid.interpolated(factors.incident, wi), factors.grid.interpolated(factors.outgoing, wo)
    for k in range(factors.terms):
        found += f[k, :, None] * g[k].T
        squares = weights * ((found - true) ** 2).sum(axis=1)
        sums = [(squares[some].sum(), norms[some].sum()) for some in (slice(None), grazing, peak)]
        errors.append([float(relative_l2_from_squares(*pair)) for pair in sums])
    return FactorError(*np.transpose(errors))


def _held_out(bsdf: mi.BSDF, seed: int) -> tuple[Floats, Floats, Doubles]:
    """Pairs of directions, and weights that make sums of them integrals over dw_i cos_o dw_o."""
    rng = np.random.default_rng(seed)
    wo = _cosine_distributed(rng.random((HELD_OUT, 2)))  # its density is cos_o / pi
    si = dr.zeros(mi.SurfaceInteraction3f, HELD_OUT)
    si.wi = mi.Vector3f(np.ascontiguousarray(wo.T))
    u = rng.random((3, HELD_OUT), np.float32)
    context = mi.BSDFContext()
    sample, _ = bsdf.sample(context, si, mi.Float(u[0]), mi.Point2f(u[1:]))
    even = rng.random(HELD_OUT) < 0.5
    z, phi = rng.random(HELD_OUT), 2 * np.pi * rng.random(HELD_OUT)
    r = np.sqrt(1 - z**2)
    spread = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    wi = np.where(even[:, None], spread, np.array(sample.wo).T).astype(np.float32)
    wi[~(wi[:, 2] > 0)] = (0, 0, 1)  # samples that fail: their weight is 0
    density = np.array(bsdf.pdf(context, si, mi.Vector3f(np.ascontiguousarray(wi.T))), np.float64)
    failed = ~even & ~(np.array(sample.pdf) > 0)
    weights = np.where(failed, 0.0, np.pi / (0.5 / (2 * np.pi) + 0.5 * density) / HELD_OUT)
    return wi, wo, weights


def _cosine_distributed(u: Doubles) -> Floats:
    """Directions (m, 3) from numbers (m, 2)."""
    r, phi = np.sqrt(u[:, 0]), 2 * np.pi * u[:, 1]
    z = np.sqrt(np.maximum(1 - u[:, 0], 1e-6))
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1).astype(np.float32)
