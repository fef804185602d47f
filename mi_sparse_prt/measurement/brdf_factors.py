"""In-out factors of a BRDF: rho(w_i, w_o) cos(w_i) as a short sum of products ([HR10] eq. 2 and 3).

All directions are in the local frame of a surface, +Z along its normal. The factors are singular vectors of the BRDF on
a grid of directions, freed of its diffuse part first. Incident directions weigh by their solid angle, outgoing ones by
that and by their cosine, as a picture does; values between grid points are bilinear.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.errors import PrtError

MOST_TERMS = 16
HEIGHTS, AZIMUTHS = 64, 128  # of incident and of outgoing directions
LEFT_OVER = 16  # vectors more than terms that a basis begins with
ITERATIONS = 2  # of it, multiplied with the matrix and its transpose
LANES = 1 << 21  # values of the BRDF at a time
HELD_OUT = 1 << 17  # pairs of directions that no factor was made of
GRAZING = np.cos(np.radians(75))  # cosine of either direction
PEAK = 0.5  # of the largest value for similar outgoing directions: a pair that has more is at the peak
PEAK_HEIGHTS = 8  # groups of outgoing directions for that
DARKEST = 0.05  # cosine of directions that tell the diffuse part: below, Fresnel terms have their say
PLACES = 256  # texture coordinates at which a BSDF is looked at

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class DirectionGrid:
    """Directions of the upper hemisphere, (heights x azimuths), midpoints of equal steps of both angles.

    Parameters
    ----------
    heights, azimuths : int
    """

    heights: int = HEIGHTS
    azimuths: int = AZIMUTHS

    @property
    def directions(self) -> Floats:
        """(heights * azimuths, 3), by height first."""
        theta = (np.arange(self.heights) + 0.5) * (np.pi / 2 / self.heights)
        phi = (np.arange(self.azimuths) + 0.5) * (2 * np.pi / self.azimuths)
        sine, cosine = np.sin(theta)[:, None], np.cos(theta)[:, None] + 0 * phi
        grid = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=-1)
        return grid.reshape(-1, 3).astype(np.float32)

    @property
    def solid_angles(self) -> Doubles:
        """(heights * azimuths,)."""
        edges = np.cos(np.arange(self.heights + 1) * (np.pi / 2 / self.heights))
        return np.repeat(-np.diff(edges) * (2 * np.pi / self.azimuths), self.azimuths)

    def interpolated(self, values: NDArray[np.floating], directions: Floats) -> NDArray[np.floating]:
        """Values (..., heights * azimuths) at directions (m, 3): (..., m); 0 below the horizon."""
        theta = np.arccos(np.clip(directions[:, 2], 0, 1)) * (self.heights / (np.pi / 2)) - 0.5
        phi = np.arctan2(directions[:, 1], directions[:, 0]) * (self.azimuths / (2 * np.pi)) - 0.5
        row, column = np.floor(theta).astype(np.int64), np.floor(phi).astype(np.int64)
        a, b = (theta - row).astype(np.float32), (phi - column).astype(np.float32)
        total: NDArray[np.floating] = np.zeros((*values.shape[:-1], len(directions)), values.dtype)
        for down, across, weight in (
            (0, 0, (1 - a) * (1 - b)),
            (0, 1, (1 - a) * b),
            (1, 0, a * (1 - b)),
            (1, 1, a * b),
        ):
            place = np.clip(row + down, 0, self.heights - 1) * self.azimuths
            total += values[..., place + (column + across) % self.azimuths] * weight
        return total * (directions[:, 2] > 0)


@dataclass(frozen=True)
class BrdfFactors:
    """rho(w_i, w_o) cos(w_i) ~ diffuse / pi cos(w_i) + sum_k f_k(w_i) g_k(w_o).

    Attributes
    ----------
    grid : DirectionGrid
    diffuse : (channels,) float64
        Reflectance of the diffuse part.
    incident : (K, grid) float32
        f_k, the cosine included; of either sign.
    outgoing : (K, channels, grid) float32
        g_k.
    """

    grid: DirectionGrid
    diffuse: Doubles
    incident: Floats
    outgoing: Floats

    @property
    def terms(self) -> int:
        """K, without the diffuse part."""
        return len(self.incident)

    def first(self, terms: int) -> BrdfFactors:
        """With fewer terms."""
        return BrdfFactors(self.grid, self.diffuse, self.incident[:terms], self.outgoing[:terms])

    def values(self, incident: Floats, outgoing: Floats) -> Doubles:
        """(m, channels) at pairs of directions (m, 3), local frame."""
        f = self.grid.interpolated(self.incident, incident)  # [term, pair]
        g = self.grid.interpolated(self.outgoing, outgoing)  # [term, channel, pair]
        cosine = np.maximum(incident[:, 2], 0)
        dull = np.where(outgoing[:, 2] > 0, cosine, 0)[:, None] * self.diffuse / np.pi
        found: Doubles = np.einsum("km,kcm->mc", f, g).astype(np.float64) + dull
        return found


def factor_brdf(
    bsdf: mi.BSDF, name: str, terms: int = MOST_TERMS, grid: DirectionGrid | None = None, seed: int = 0
) -> BrdfFactors:
    """Factor a reflective BSDF.

    Parameters
    ----------
    bsdf : mi.BSDF
        Its front is factored.
    name : str
        For messages.
    terms : int
        K.
    grid : DirectionGrid, optional
        Of incident and of outgoing directions, 64 x 128 if not given.
    seed : int

    Returns
    -------
    BrdfFactors

    Raises
    ------
    PrtError
        If the BSDF transmits, mirrors, varies over the surface, or has values that are no numbers.
    """
    _check(bsdf, name)
    grid = grid or DirectionGrid()
    diffuse = _diffuse(bsdf, name)
    into, out = _weights(grid)
    left, right = _singular(_weighted(bsdf, name, grid, diffuse), terms, seed)
    f, g = left.T / into, right.reshape(len(right), len(diffuse), -1) / out
    return BrdfFactors(grid, diffuse, f.astype(np.float32), g.astype(np.float32))


def _weights(grid: DirectionGrid) -> tuple[Doubles, Doubles]:
    """Roots of what incident and outgoing directions count in squares."""
    areas = grid.solid_angles
    return np.sqrt(areas), np.sqrt(areas * grid.directions[:, 2])


def _weighted(bsdf: mi.BSDF, name: str, grid: DirectionGrid, diffuse: Doubles) -> Floats:
    """The matrix (incident, channels * outgoing) without the diffuse part; 270 MB for a grey BSDF."""
    every, channels = grid.directions, len(diffuse)
    into, out = (x.astype(np.float32) for x in _weights(grid))
    dull = (every[:, 2:] * diffuse / np.pi).astype(np.float32)  # [incident, channel]
    matrix = np.empty((len(every), channels, len(every)), np.float32)
    step = max(1, LANES // len(every))
    for a in range(0, len(every), step):
        part = slice(a, min(a + step, len(every)))
        w = every[part]
        pairs = np.repeat(w, len(every), axis=0), np.tile(every, (len(w), 1))
        values = evaluated(bsdf, name, *pairs)[:, :channels].reshape(len(w), len(every), channels)
        matrix[part] = (np.moveaxis(values, 2, 1) - dull[part, :, None]) * into[part, None, None] * out
    return matrix.reshape(len(every), -1)


def evaluated(bsdf: mi.BSDF, name: str, incident: Floats, outgoing: Floats) -> Floats:
    """BRDF times the incident cosine, (m, 3), at pairs of directions (m, 3) in the local frame.

    Raises
    ------
    PrtError
        If a value is NaN or infinite.
    """
    si = dr.zeros(mi.SurfaceInteraction3f, len(incident))
    si.wi = mi.Vector3f(np.ascontiguousarray(outgoing.T))  # Mitsuba's wi is where the light leaves for
    light = mi.Vector3f(np.ascontiguousarray(incident.T))
    value = np.array(dr.zeros(mi.Color3f, len(incident)) + bsdf.eval(mi.BSDFContext(), si, light)).T
    bad = np.flatnonzero(~np.isfinite(value).all(axis=1))
    if bad.size:
        raise PrtError(
            f"shape '{name}': its BSDF is {value[bad[0]].tolist()} for light from {incident[bad[0]].tolist()}"
        )
    found: Floats = value.astype(np.float32)
    return found


def _check(bsdf: mi.BSDF, name: str) -> None:
    flags = int(bsdf.flags())
    for has, problem in (
        (flags & int(mi.BSDFFlags.Transmission | mi.BSDFFlags.Null), "transmits light"),
        (flags & int(mi.BSDFFlags.Delta | mi.BSDFFlags.Delta1D), "mirrors"),
        (_varies(bsdf), "varies over the surface"),
    ):
        if has:
            raise PrtError(
                f"shape '{name}': BSDF {bsdf.class_name()} {problem}, which factors of a BRDF cannot; "
                "use path tracing instead"
            )


def _varies(bsdf: mi.BSDF) -> bool:
    """Whether texture coordinates make a difference, which flags do not always tell; attributes of meshes do."""
    rng = np.random.default_rng(0)
    si = dr.zeros(mi.SurfaceInteraction3f, PLACES)
    si.uv = mi.Point2f(rng.random((2, PLACES), np.float32))
    si.wi = mi.Vector3f(0.1, 0.2, 0.97)
    value = np.array(dr.zeros(mi.Color3f, PLACES) + bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1)))
    alike = np.isclose(value, value[:, :1], rtol=1e-5, atol=1e-7, equal_nan=True).all()
    return "MeshAttribute" in str(bsdf) or not alike


def _diffuse(bsdf: mi.BSDF, name: str) -> Doubles:
    """Reflectance (channels,) of what is alike for all directions: the least value there is; grey is one channel."""
    w = DirectionGrid(HEIGHTS // 4, AZIMUTHS // 4).directions
    w = w[w[:, 2] > DARKEST]
    value = evaluated(bsdf, name, np.repeat(w, len(w), axis=0), np.tile(w, (len(w), 1)))
    least = np.pi * (value / np.repeat(w[:, 2:], len(w), axis=0)).min(axis=0)
    grey = np.ptp(value, axis=1).max() <= 1e-6 * max(float(value.max()), 1e-30)
    return least[:1] if grey else least


def _singular(matrix: Floats, terms: int, seed: int) -> tuple[Floats, Floats]:
    """Left (n, k) and right (k, m) factors of the best approximation of that rank, both with the roots of its values.

    By a randomized range finder with power iterations (Halko, Martinsson and Tropp 2011, algorithms 4.4 and 5.1).
    """
    width = min(terms + LEFT_OVER, *matrix.shape)
    basis = np.random.default_rng(seed).standard_normal((matrix.shape[1], width)).astype(np.float32)
    for _ in range(ITERATIONS):
        found = np.linalg.qr(matrix @ basis)[0]
        basis = np.linalg.qr(matrix.T @ found)[0]
    u, values, vt = np.linalg.svd(matrix @ basis, full_matrices=False)
    roots = np.sqrt(values[:terms])
    return u[:, :terms] * roots, roots[:, None] * (vt[:terms] @ basis.T)


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

    Half of the pairs are drawn evenly, half by the BSDF itself, which finds its peaks; weights undo that.

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
    true = evaluated(bsdf, name, wi, wo)[:, : len(factors.diffuse)].astype(np.float64)
    norms = weights * (true**2).sum(axis=1)
    grazing = np.minimum(wi[:, 2], wo[:, 2]) < GRAZING
    height = (wo[:, 2] * PEAK_HEIGHTS).astype(np.int64)
    largest = np.zeros(PEAK_HEIGHTS + 1)
    np.maximum.at(largest, height, true.sum(axis=1))
    peak = true.sum(axis=1) > PEAK * largest[height]
    found = []
    for terms in range(1, factors.terms + 1):
        squares = weights * ((factors.first(terms).values(wi, wo) - true) ** 2).sum(axis=1)
        found.append(
            [np.sqrt(squares[some].sum() / norms[some].sum()) for some in (slice(None), grazing, peak)]
        )
    return FactorError(*np.transpose(found))


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
