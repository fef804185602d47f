"""The best factors of their number, for one BRDF.

Best is what pictures need. A pixel at w_o errs by the light times the BRDF's error, over all w_i, so

* outgoing directions weigh by solid angle and cosine, the area that a surface shows;
* incident ones weigh by solid angle and by how light from two of them goes together: alike for all rotations, but light
  is no white noise, neighbouring directions have about the same. Power per spherical harmonic of degree l falls as
  (l + 1)^-2; in scenes_xml/envmaps the geometric mean is 0.256, 0.104, 0.056, .. 0.014 (l = 1, 2, 3, .. 6) of that of
  l = 0, this model says 0.25, 0.111, 0.062, .. 0.020.

For white noise the factors would be singular vectors, and weak but wide parts of a BRDF would be lost. Four terms of
a Phong lobe of exponent 20 (reflectance 0.4, over 0.3 that is diffuse) would err by 57.0% over all pairs of directions
instead of 58.5%, but by 10% instead of 1.6% under even light, and by 19% instead of 14% under smooth random light
(eight terms: 13% instead of 7.5%). One more cosine of w_i harms pictures of all BRDFs that were tried;
weights relative to each outgoing direction's norm help Phong's and harm others.

A half-vector parametrization needs fewer terms for such lobes, but its factors are of w_i and w_o together; transport
T_k that is precomputed needs an f_k of w_i alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.reflection.brdf_factors.diffuse_part import GlossyPart
from mi_sparse_prt.reflection.brdf_factors.direction_grid import DirectionGrid, Doubles, Floats
from mi_sparse_prt.reflection.brdf_factors.isotropic import factor_waves, values_by_turn

MOST_TERMS = 16
WHOLE = 0.1  # of a term's norm may be missing where frames turn: half of a pair misses all of it
LIGHT_ORDER = 16  # of harmonics by which light is not white noise
LIGHT_FALL = 2.0  # power of light per harmonic of degree l is (l + 1)^-LIGHT_FALL, see above


class Turning(NamedTuple):
    """f_k where the azimuth is larger by d: ``cos(m_k d) f_k + sin(m_k d) sum_l P_kl f_l``.

    Attributes
    ----------
    waves : (K,) int64
        m.
    partners : (K, K) float64
        P.
    """

    waves: NDArray[np.int64]
    partners: Doubles


@dataclass(frozen=True)
class BrdfFactors:
    """rho(w_i, w_o) cos(w_i) ~ diffuse / pi cos(w_i) + sum_k f_k(w_i) g_k(w_o).

    Attributes
    ----------
    grid : DirectionGrid
    diffuse : (channels,) float64
        Reflectance of the diffuse part; 0 if that varies over the surface.
    incident : (K, grid) float32
        f_k, the cosine included; of either sign.
    outgoing : (K, channels, grid) float32
        g_k.
    varying_diffuse : bool
        The diffuse part varies over the surface and is not in here: ``diffuse_reflectance`` tells it for places, in
        three channels, also where these factors have one.
    followed : bool
        They serve light between surfaces alone; what cameras see takes more of them than there are, and rays go on.
    """

    grid: DirectionGrid
    diffuse: Doubles
    incident: Floats
    outgoing: Floats
    varying_diffuse: bool = False
    followed: bool = False

    @property
    def terms(self) -> int:
        """K, without the diffuse part."""
        return len(self.incident)

    def first(self, terms: int) -> BrdfFactors:
        """With fewer terms."""
        return replace(self, incident=self.incident[:terms], outgoing=self.outgoing[:terms])

    def complete(self, terms: int) -> BrdfFactors:
        """At most so many terms, none without its partner.

        Those of an isotropic BRDF vary as cos(m phi) or sin(m phi) around the normal, and come in pairs but for m = 0.
        With one of a pair alone the sum would be anisotropic, and images would show where tangents turn: the next ones
        that are whole are taken instead. Other BRDFs have their first terms.
        """
        waves = self._waves()
        if waves is None:
            return self.first(terms)
        chosen: list[int] = []
        k = 0
        while k < len(waves):
            group = 1 if waves[k] == 0 else 2
            if len(chosen) + group <= terms and waves[k : k + group] == group * [waves[k]]:
                chosen += range(k, k + group)
            k += group
        if not chosen:
            return self.first(terms)
        return replace(self, incident=self.incident[chosen], outgoing=self.outgoing[chosen])

    @cached_property
    def turning(self) -> Turning | None:
        """What terms become in a frame turned about its normal; None of anisotropic BRDFs, and of half pairs."""
        waves = self._waves()
        if waves is None:
            return None
        m, grid = np.array(waves), (self.terms, self.grid.heights, self.grid.azimuths)
        spectra = np.fft.rfft(self.incident.astype(np.float64).reshape(grid), axis=2)
        quarters = np.zeros_like(spectra)  # turned by a quarter of each one's wave
        each = np.arange(self.terms)
        quarters[each, :, m] = np.where(m[:, None] > 0, 1j, 0) * spectra[each, :, m]
        turned = np.fft.irfft(quarters, grid[2], axis=2).reshape(self.terms, -1)
        partners = np.zeros((self.terms, self.terms))
        for wave in set(waves) - {0}:
            own = m == wave
            partners[np.ix_(own, own)] = np.linalg.lstsq(self.incident[own].T, turned[own].T, rcond=1e-3)[0].T
        missing = np.linalg.norm(turned - partners @ self.incident, axis=1)
        if (missing > WHOLE * np.linalg.norm(self.incident, axis=1)).any():
            return None
        return Turning(m, partners)

    def _waves(self) -> list[int] | None:
        """How often each term goes around, m; None if one has several waves."""
        found = []
        for f, g in zip(self.incident, self.outgoing, strict=True):
            parts = np.concatenate([f[None], g]).reshape(-1, self.grid.heights, self.grid.azimuths)
            weights = self.grid.solid_angles.reshape(self.grid.heights, -1)[:, :1]
            power = (np.abs(np.fft.rfft(parts, axis=2)) ** 2 * weights).sum(axis=1)  # [part, m]
            share = power / np.maximum(power.sum(axis=1, keepdims=True), 1e-30)
            m = int(share[0].argmax())
            if share[:, m].min() < 0.98:  # the rest is rounding
                return None
            found.append(m)
        return found

    def values(self, incident: Floats, outgoing: Floats) -> Doubles:
        """(m, channels) at pairs of directions (m, 3), local frame."""
        f = self.grid.interpolate(self.incident, incident)  # [term, pair]
        g = self.grid.interpolate(self.outgoing, outgoing)  # [term, channel, pair]
        found: Doubles = np.einsum("km,kcm->mc", f, g) + self.diffuse_values(incident, outgoing)
        return found

    def diffuse_values(self, incident: Floats, outgoing: Floats) -> Doubles:
        """As ``values``, of the diffuse part alone."""
        cosine = np.where(outgoing[:, 2] > 0, np.maximum(incident[:, 2], 0), 0)
        found: Doubles = cosine[:, None] * self.diffuse / np.pi
        return found


def factor_brdf(
    bsdf: mi.BSDF, name: str, terms: int = MOST_TERMS, grid: DirectionGrid | None = None, seed: int = 0
) -> BrdfFactors:
    """Factor a reflective BSDF.

    Parameters
    ----------
    bsdf : mi.BSDF
        Its front is factored. A diffuse part that varies over the surface is left to the caller, see `BrdfFactors`.
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
        If the BSDF transmits, mirrors, varies over the surface in more than a Lambertian reflectance, or has values
        that are no numbers.
    """
    part = GlossyPart(bsdf, name)
    grid = grid or DirectionGrid()
    into, out = _weights(grid)
    alike = values_by_turn(part, grid)
    left: NDArray[np.floating]
    right: NDArray[np.floating]
    if alike is None:
        left, right = _factorise(_weighted_matrix(part, grid), _light(grid), terms, seed)
    else:
        left, right = factor_waves(alike, grid, (into, out), _light_by_waves(grid), terms)
    return join_factors(part, grid, left.T / into, right.reshape(len(right), part.channels, -1) / out)


def join_factors(
    part: GlossyPart, grid: DirectionGrid, incident: NDArray[np.floating], outgoing: NDArray[np.floating]
) -> BrdfFactors:
    """Factors (K, grid) and (K, channels, grid) of a glossy part, with the diffuse one unless that varies."""
    diffuse = part.diffuse[: part.channels] * (not part.varying_diffuse)
    f, g = incident.astype(np.float32), outgoing.astype(np.float32)
    return BrdfFactors(grid, diffuse, f, g, part.varying_diffuse)


def glossy_rows(
    part: GlossyPart, grid: DirectionGrid, lanes: int = 1 << 21
) -> Iterator[tuple[slice, Floats]]:
    """Glossy BRDF times the incident cosine, (b, channels, outgoing), for some incident directions at a time.

    As many as make ``lanes`` values of the BRDF.
    """
    n = len(grid.directions)
    step = max(1, lanes // n)
    for a in range(0, n, step):
        some = slice(a, min(a + step, n))
        yield some, part.rows(grid, some)


def _weights(grid: DirectionGrid) -> tuple[Doubles, Doubles]:
    """Roots of what incident and outgoing directions count in squares."""
    areas = grid.solid_angles
    return np.sqrt(areas), np.sqrt(areas * grid.directions[:, 2])


def _weighted_matrix(part: GlossyPart, grid: DirectionGrid) -> Floats:
    """The matrix (incident, channels * outgoing); 270 MB for a grey BSDF."""
    into, out = (x.astype(np.float32) for x in _weights(grid))
    n = len(into)
    matrix = np.empty((n, part.channels, n), np.float32)
    for some, values in glossy_rows(part, grid):
        matrix[some] = values * into[some, None, None] * out
    return matrix.reshape(n, -1)


def _light(grid: DirectionGrid) -> tuple[Floats, float]:
    """The mean product of light from two incident directions, times roots of their solid angles: (r, grid) whose
    product with itself, transposed, and with this much of the identity added, is that matrix.
    """
    amplitude, rest = _amplitudes()
    degree = np.repeat(np.arange(LIGHT_ORDER + 1), 2 * np.arange(LIGHT_ORDER + 1) + 1)
    smooth = amplitude[degree, None] * grid.harmonics(LIGHT_ORDER) * np.sqrt(grid.solid_angles)
    return smooth.astype(np.float32), rest


def _light_by_waves(grid: DirectionGrid) -> tuple[Doubles, float]:
    """The same, (degree, wave, heights), for functions of the azimuth of norm 1."""
    amplitude, rest = _amplitudes()
    roots = np.sqrt(grid.solid_angles[:: grid.azimuths])
    around = np.sqrt(grid.azimuths / np.where(np.arange(LIGHT_ORDER + 1) > 0, 2.0, 1.0))  # norms of cosines
    smooth = amplitude[:, None, None] * grid.harmonics_by_height(LIGHT_ORDER) * around[:, None] * roots
    return smooth, rest


def _amplitudes() -> tuple[Doubles, float]:
    """Roots of power per degree, without that of all higher ones, which white noise stands for; and this."""
    rest = (LIGHT_ORDER + 2.0) ** -LIGHT_FALL
    return np.sqrt((np.arange(LIGHT_ORDER + 1) + 1.0) ** -LIGHT_FALL - rest), rest


def _factorise(matrix: Floats, light: tuple[Floats, float], terms: int, seed: int) -> tuple[Floats, Floats]:
    """Left (n, k) and right (k, m) factors of the best approximation A of that rank, both of the same norms.

    Best is the least ||root(C) (matrix - A)||, where C (n, n) is what ``_light`` says: columns of the right factor are
    eigenvectors of matrix^T C matrix, and the left one is the matrix times them. They are found by subspace iteration
    from random vectors (Halko, Martinsson and Tropp 2011, algorithms 4.4 and 5.3).
    """
    smooth, rest = light
    oversampling, iterations = 16, 2

    def lit(x: Floats) -> Floats:
        found: Floats = smooth.T @ (smooth @ x) + np.float32(rest) * x
        return found

    width = min(terms + oversampling, *matrix.shape)
    basis = np.random.default_rng(seed).standard_normal((matrix.shape[1], width)).astype(np.float32)
    basis = np.linalg.qr(basis)[0]
    for _ in range(iterations):
        basis = np.linalg.qr(matrix.T @ lit(matrix @ basis))[0]
    left = matrix @ basis
    turn = np.linalg.eigh(left.T.astype(np.float64) @ lit(left))[1][:, : -terms - 1 : -1].astype(np.float32)
    left, right = left @ turn, (basis @ turn).T
    roots = np.sqrt(np.maximum(np.linalg.norm(left, axis=0), np.finfo(np.float32).tiny))
    return left / roots, roots[:, None] * right
