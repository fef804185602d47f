"""What glossy surfaces send to each other, by terms that are known at fewer vertices than a matrix has rows for.

What others see of a surface is blurred on them, and light that arrives from other surfaces is smooth: terms of both are
known at senders. Between these, terms are interpolated in the frame of each vertex. Those of an isotropic BRDF vary as
cos(m phi) or sin(m phi) about the normal, so that a turned frame mixes the two of a pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.reflection.frames import frames
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Floats, Reflection

LEAST = 1e-3  # of a partner's weight, which rounding leaves


@dataclass(frozen=True)
class SentLight:
    """R of vertices as other surfaces see them.

    Attributes
    ----------
    reflection : InOutFactors
        With terms at senders alone; also of surfaces that cameras' rays go on from, which a matrix has none of.
    every : InOutFactors
        The same with terms at glossy vertices of the matrix as well.
    senders : (n,) int64
        Of each vertex the one whose terms are sent in place of its own; itself, if it is a sender or diffuse.
    near : (n_g, k) int64
        Senders between which light of a glossy vertex of the matrix is interpolated that other surfaces send; -1: none.
    weights, angles : (n_g, k) float32
        Of these; azimuths of their tangents in the frame of the vertex (``azimuths``).
    """

    reflection: InOutFactors
    every: InOutFactors
    senders: NDArray[np.int64]
    near: NDArray[np.int64]
    weights: Floats
    angles: Floats

    def interpolated(self, light: Floats, seen: Reflection) -> Floats:
        """Light (rows, m) of the rows of a matrix whose reflection is ``seen``, from that of the rows here."""
        n = len(seen.albedo)
        if not isinstance(seen, InOutFactors):
            return light[:n]
        number = np.where(self.near < 0, -1, np.searchsorted(self.reflection.glossy, self.near))
        waves, partners = _turnings(seen)
        terms = light[n:].reshape(len(self.reflection.glossy), self.reflection.terms, light.shape[1])
        result = np.empty((seen.row_count, light.shape[1]), np.float32)
        result[:n] = light[:n]
        own = result[n:].reshape(len(seen.glossy), seen.terms, light.shape[1])
        turned = number, self.weights, self.angles, seen.material[seen.glossy], waves, partners
        run_in_parts(_interpolated, len(own), turned, terms, own)
        return result


def azimuths(reflection: InOutFactors, vertices: NDArray[np.int64], near: NDArray[np.int64]) -> Floats:
    """Azimuths (n, k) of the tangents of near vertices (n, k) in the frames of vertices (n,); any for -1."""
    here, there = (frames(reflection.tangents[v], reflection.normals[v]) for v in (vertices[:, None], near))
    tangent, normal = there[:, :, 0], there[:, :, 2]
    axis = np.cross(normal, here[:, :, 2])  # carried from normal to normal by the least turn
    cosine = (normal * here[:, :, 2]).sum(axis=2, keepdims=True)
    along = (axis * tangent).sum(axis=2, keepdims=True) / np.maximum(1 + cosine, 1e-3)
    carried = cosine * tangent + np.cross(axis, tangent) + along * axis
    x, y = ((carried * here[:, :, k]).sum(axis=2) for k in range(2))
    return np.arctan2(y, x).astype(np.float32)


def rows_among(some: Reflection, every: Reflection) -> NDArray[np.int64]:
    """Where incident rows are among those of a reflection that has terms at the same vertices, and others."""
    n = len(some.albedo)
    number = np.searchsorted(every.glossy, some.glossy)
    terms = n + number[:, None] * every.terms + np.arange(some.terms)
    return np.concatenate([np.arange(n), terms.ravel()])


def _turnings(seen: InOutFactors) -> tuple[Floats, Floats]:
    """Waves m (BRDFs, K) and partners P (BRDFs, K, K), 0 where terms do not turn; those have senders of their own."""
    waves = np.zeros((len(seen.factors), seen.terms), np.float32)
    partners = np.zeros((*waves.shape, seen.terms), np.float32)
    for number, factors in enumerate(seen.factors):
        if factors.turning is not None:
            waves[number, : factors.terms] = factors.turning.waves
            partners[number, : factors.terms, : factors.terms] = factors.turning.partners
    partners[np.abs(partners) < LEAST] = 0
    return waves, partners


@numba.njit(nogil=True, cache=True)
def _interpolated(
    first: int,
    last: int,
    turned: tuple[NDArray[np.int64], Floats, Floats, NDArray[np.int64], Floats, Floats],
    terms: Floats,
    result: Floats,
) -> None:
    """Terms (n, K, m) from those of senders, their numbers, weights, and angles being (n, k)."""
    number, weights, angles, material, waves, partners = turned
    for i in range(first, last):
        result[i] = 0
        own = material[i]
        for j in range(number.shape[1]):
            if number[i, j] < 0:
                continue
            there = terms[number[i, j]]
            for k in range(result.shape[1]):
                angle = waves[own, k] * angles[i, j]
                cosine, sine = weights[i, j] * np.cos(angle), weights[i, j] * np.sin(angle)
                for c in range(result.shape[2]):
                    result[i, k, c] += cosine * there[k, c]
                for p in range(result.shape[1]):
                    part = sine * partners[own, k, p]
                    if part != 0:
                        for c in range(result.shape[2]):
                            result[i, k, c] += part * there[p, c]
