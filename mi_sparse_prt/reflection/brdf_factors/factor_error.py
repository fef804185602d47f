"""Errors of factors, at directions that they were not made of."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_sparse_prt.core.metrics import relative_l2_from_squares
from mi_sparse_prt.reflection.brdf_factors.diffuse_part import GlossyPart
from mi_sparse_prt.reflection.brdf_factors.direction_grid import Doubles, Floats
from mi_sparse_prt.reflection.brdf_factors.factorization import LIGHT_FALL, BrdfFactors


@dataclass(frozen=True)
class FactorError:
    """Relative L2 errors for 1 to K terms, at directions that are not on the grid.

    Attributes
    ----------
    whole, grazing, peak : (K,) float64
        Over all pairs of directions; those of which one is more than 75 degrees off the normal; and those with more
        than half of the largest value that was found for a similar height of the outgoing direction.
    lit : (K,) float64
        Of radiance over all outgoing directions, under random light as smooth as that of environments: what an image
        shows. Smaller than the others, which ask for every direction of the light by itself.
    """

    whole: Doubles
    grazing: Doubles
    peak: Doubles
    lit: Doubles

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
    whole, at_grazing, at_peak = np.transpose(errors)
    return FactorError(whole, at_grazing, at_peak, _errors_in_light(factors, bsdf, name, seed, pairs))


def _errors_in_light(factors: BrdfFactors, bsdf: mi.BSDF, name: str, seed: int, pairs: int) -> Doubles:
    """Errors (K,) of radiance under random light, see ``FactorError.lit``.

    For each of some outgoing directions, two independent sets of incident ones integrate an error. The mean product of
    the two integrals is the squared error, without the noise of either; so it is with the radiance itself. An error is
    no smaller than what noise there is lets know.
    """
    half = 128  # incident directions in a set
    rng = np.random.default_rng([seed, 1])
    views = max(1, pairs // (2 * half))
    wo = np.repeat(_cosine_directions(rng.random((views, 2))), 2 * half, axis=0)
    wi, weights = _incident_directions(bsdf, wo, rng)
    diffuse = factors.diffuse_values(wi, wo)
    true = GlossyPart(bsdf, name).values(wi, wo) + diffuse
    f, g = factors.grid.interpolate(factors.incident, wi), factors.grid.interpolate(factors.outgoing, wo)
    found = diffuse + np.cumsum(f[:, :, None] * np.swapaxes(g, 1, 2), axis=0)  # [term, pair, channel]
    values = np.concatenate([true[None], found - true]) * weights[:, None]
    a, b = np.moveaxis(values.reshape(len(values), views, 2, half, -1), 2, 0)
    angles = np.swapaxes(wi.astype(np.float64).reshape(views, 2, half, 3), 0, 1)
    light = _light_at_angle(angles[0] @ np.swapaxes(angles[1], 1, 2))  # [view, first, second]
    of_views = np.einsum("kvac,vab,kvbc->kv", a, light, b, optimize=True)
    # where few of the directions find a narrow lobe, the sum says next to nothing, and may be below 0
    noise = np.sqrt(views) * of_views.std(axis=1)
    squares = np.maximum(of_views.sum(axis=1), noise)
    return np.array([relative_l2_from_squares(square, squares[0]) for square in squares[1:]])


def _light_at_angle(cosine: Doubles) -> Doubles:
    """The mean product of light from two directions, by the cosine between them; power per degree as in environments
    (see ``factorization``), as far as texels can tell.
    """
    degrees = 48
    power = (np.arange(degrees) + 1.0) ** -LIGHT_FALL
    weights = power * (2 * np.arange(degrees) + 1)
    half = 1 << 15  # entries on each side of 0, so fine that the nearest one will do
    table = np.polynomial.legendre.legval(np.arange(-half, half + 1) / half, weights)
    return table[np.rint(half * cosine).astype(np.int32) + half]


def sample_pairs(bsdf: mi.BSDF, pairs: int, seed: int) -> tuple[Floats, Floats, Doubles]:
    """Pairs of directions, and weights that make sums of them integrals over dw_i cos_o dw_o."""
    rng = np.random.default_rng(seed)
    wo = _cosine_directions(rng.random((pairs, 2)))  # its density is cos_o / pi
    wi, weights = _incident_directions(bsdf, wo, rng)
    return wi, wo, weights * (np.pi / pairs)


def _incident_directions(bsdf: mi.BSDF, wo: Floats, rng: np.random.Generator) -> tuple[Floats, Doubles]:
    """An incident direction for each outgoing one, and one over its density: half even, half by the BSDF itself."""
    pairs = len(wo)
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
    return wi, np.where(failed, 0.0, 1 / (0.5 / (2 * np.pi) + 0.5 * density))


def _cosine_directions(u: Doubles) -> Floats:
    """Directions (m, 3) from numbers (m, 2)."""
    r, phi = np.sqrt(u[:, 0]), 2 * np.pi * u[:, 1]
    z = np.sqrt(np.maximum(1 - u[:, 0], 1e-6))
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1).astype(np.float32)
