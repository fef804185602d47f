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


def measure_factor_error(
    factors: BrdfFactors, bsdf: mi.BSDF, name: str, seed: int = 1, pairs: int = 1 << 17
) -> FactorError:
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
    pairs : int
        Of directions, none of which a factor was made of.
    """
    wi, wo, weights = sample_pairs(bsdf, pairs, seed)
    found = factors.diffuse_values(wi, wo)
    true = GlossyPart(bsdf, name).values(wi, wo) + found
    norms = weights * (true**2).sum(axis=1)
    grazing = np.minimum(wi[:, 2], wo[:, 2]) < np.cos(np.radians(75))
    heights = 8  # groups of outgoing directions, each with a peak of its own
    height = (wo[:, 2] * heights).astype(np.int64)
    largest = np.zeros(heights + 1)
    np.maximum.at(largest, height, true.sum(axis=1))
    peak = true.sum(axis=1) > 0.5 * largest[height]
    errors = []
    f, g = factors.grid.interpolate(factors.incident, wi), factors.grid.interpolate(factors.outgoing, wo)
    for k in range(factors.terms):
        found += f[k, :, None] * g[k].T
        squares = weights * ((found - true) ** 2).sum(axis=1)
        sums = [(squares[some].sum(), norms[some].sum()) for some in (slice(None), grazing, peak)]
        errors.append([float(relative_l2_from_squares(*pair)) for pair in sums])
    return FactorError(*np.transpose(errors))


def sample_pairs(bsdf: mi.BSDF, pairs: int, seed: int) -> tuple[Floats, Floats, Doubles]:
    """Pairs of directions, and weights that make sums of them integrals over dw_i cos_o dw_o."""
    rng = np.random.default_rng(seed)
    wo = _cosine_directions(rng.random((pairs, 2)))  # its density is cos_o / pi
    si = dr.zeros(mi.SurfaceInteraction3f, pairs)
    si.wi = mi.Vector3f(np.ascontiguousarray(wo.T))
    u = rng.random((3, pairs), np.float32)
    context = mi.BSDFContext()
    sample, _ = bsdf.sample(context, si, mi.Float(u[0]), mi.Point2f(u[1:]))
    even = rng.random(pairs) < 0.5
    z, phi = rng.random(pairs), 2 * np.pi * rng.random(pairs)
    r = np.sqrt(1 - z**2)
    spread = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    wi = np.where(even[:, None], spread, np.array(sample.wo).T).astype(np.float32)
    wi[~(wi[:, 2] > 0)] = (0, 0, 1)  # samples that fail: their weight is 0
    density = np.array(bsdf.pdf(context, si, mi.Vector3f(np.ascontiguousarray(wi.T))), np.float64)
    failed = ~even & ~(np.array(sample.pdf) > 0)
    weights = np.where(failed, 0.0, np.pi / (0.5 / (2 * np.pi) + 0.5 * density) / pairs)
    return wi, wo, weights


def _cosine_directions(u: Doubles) -> Floats:
    """Directions (m, 3) from numbers (m, 2)."""
    r, phi = np.sqrt(u[:, 0]), 2 * np.pi * u[:, 1]
    z = np.sqrt(np.maximum(1 - u[:, 0], 1e-6))
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1).astype(np.float32)
