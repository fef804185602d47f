"""Factors of a BRDF that is alike for all turns about the normal: wave by wave around it, each exactly.

Such a BRDF is a function of both heights and of the angle between the azimuths, even in it. Its Fourier series in that
angle takes the matrix of all pairs of directions apart into one of pairs of heights for each wave, which belongs to a
cosine and to a sine. One azimuth of incident light tells all of it.
"""

from __future__ import annotations

import numpy as np

from mi_sparse_prt.reflection.brdf_factors.diffuse_part import GlossyPart
from mi_sparse_prt.reflection.brdf_factors.direction_grid import DirectionGrid, Doubles

ALIKE = 1e-3  # relative L2: more than tables and rounding make


def values_by_turn(part: GlossyPart, grid: DirectionGrid) -> Doubles | None:
    """Glossy BRDF times the incident cosine, (heights, channels, heights, azimuths), from one azimuth to all others.

    None if it is not the same from another azimuth, or not even.
    """
    n, other = grid.azimuths, grid.azimuths // 3

    def seen_from(azimuth: int) -> Doubles:
        rows = part.rows(grid, slice(azimuth, None, n)).astype(np.float64)
        return np.roll(rows.reshape(*rows.shape[:2], grid.heights, n), -azimuth, axis=3)

    values, turned = seen_from(0), seen_from(other)
    mirrored = np.roll(values[..., ::-1], 1, axis=3)
    unlike = max(np.linalg.norm(values - turned), np.linalg.norm(values - mirrored))
    return (values + mirrored) / 2 if unlike <= ALIKE * np.linalg.norm(values) else None


def factor_waves(
    values: Doubles,
    grid: DirectionGrid,
    weights: tuple[Doubles, Doubles],
    light: tuple[Doubles, float],
    terms: int,
) -> tuple[Doubles, Doubles]:
    """The best factors, left (n, k) and right (k, channels * n), of both the same norms: see ``factor_brdf``.

    Parameters
    ----------
    values : (heights, channels, heights, azimuths) float64
        See ``values_by_turn``.
    grid : DirectionGrid
    weights : two (n,) float64
        Roots of what incident and outgoing directions count.
    light : (order + 1, order + 1, heights) float64 and float
        Amplitudes of light per degree and wave, and how much of the identity there is beside their products.
    terms : int
    """
    into, out = (w.reshape(grid.heights, -1)[:, 0] for w in weights)
    smooth, rest = light
    blocks = np.fft.rfft(values, axis=3).real * into[:, None, None, None] * out[:, None]
    found: list[
        tuple[float, int, Doubles, Doubles]
    ] = []  # what it is worth, its wave, left and right heights
    for wave in range(blocks.shape[3]):
        block = blocks[..., wave].reshape(grid.heights, -1)
        lit = np.sqrt(rest) * block
        if wave < smooth.shape[1]:
            lit = np.concatenate([lit, smooth[:, wave] @ block])
        _, worth, right = np.linalg.svd(lit, full_matrices=False)
        found += [(w, wave, block @ r, r) for w, r in zip(worth[:terms], right, strict=False)]
    found.sort(key=lambda each: -each[0])
    lefts, rights = list[Doubles](), list[Doubles]()
    for _, wave, a, b in found[:terms]:
        for around in _waves(wave, grid.azimuths):
            lefts.append(np.multiply.outer(a, around).ravel())
            rights.append(np.multiply.outer(b, around).ravel())
    left = np.array(lefts[:terms]).T
    roots = np.sqrt(np.maximum(np.linalg.norm(left, axis=0), np.finfo(np.float32).tiny))
    return left / roots, roots[:, None] * np.array(rights[:terms])


def _waves(wave: int, azimuths: int) -> list[Doubles]:
    """Functions (azimuths,) of one wave, of norm 1: its cosine and its sine, or one alone."""
    angle = (np.arange(azimuths) + 0.5) * (2 * np.pi * wave / azimuths)
    both = np.cos(angle), np.sin(angle)
    return [x / np.linalg.norm(x) for x in both if np.linalg.norm(x) > 0.1]
