"""Which texels of a cubemap meet: pairs along sides, four (at the cube's corners three) around each corner.

A *pair* is two texels with a side in common. Pairs are numbered so that most are compared as words of bits: pair j is
texel j and the next one in its row, pair ``padded + j`` is texel j and the one below it, both inside of a face
(``padded`` is the number of texels, rounded up to whole words); pairs across edges of the cube follow.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS, Bits, bit_of, pack
from mi_sparse_prt.core.read_only import read_only
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.emission.cube_faces import cube_points, face_places, texels_beside

# steps (columns, rows) across the sides of a texel, and across the corner between each side and the next one
_SIDES = ((1, 0), (0, 1), (-1, 0), (0, -1))
_CORNERS = ((1, 1), (-1, 1), (-1, -1), (1, -1))

Ints = NDArray[np.int32]


class Sides(NamedTuple):
    """Neighbours and pairs of a cubemap's texels; -1 stands for what is not there.

    Attributes
    ----------
    beside, across : (n_directions, 4) int32
        Texels beyond the sides, in the order right, below, left, above as seen on the texel's own face; and beyond
        the corner between each side and the next one, -1 at the corners of the cube.
    first, second : (n_pairs,) int32
        Texels of each pair; both 0 where no pair has this number.
    around : (n_pairs, 6) int32
        The texels of each pair, and those beside them at both ends of the common side.
    quadrants : (n_directions, 4, 4) int32
        Four pairs around the corner between side k and the next one: with A the texel, B and C the texels beyond
        these sides and D beyond the corner, the pairs AB, AC, BD, CD as ``2 pair + (1 if it runs from second to
        first)``. At a corner of the cube B stands for D: BD is -1 and CD is CB.
    """

    beside: Ints
    across: Ints
    first: Ints
    second: Ints
    around: Ints
    quadrants: Ints


class TexelSides:
    """The sides of a cubemap's texels.

    Parameters
    ----------
    resolution : int
        n, texels along a face's edge.

    Attributes
    ----------
    tables : Sides
    paths : (n_pairs, 3, 3) float32
        On the cube [-1, 1]^3: centre of the first texel, middle of the common side, centre of the second.
    """

    def __init__(self, resolution: int) -> None:
        m, self._resolution = 6 * resolution**2, resolution
        beside, across = (
            np.stack([texels_beside(resolution, *step) for step in steps], axis=1)
            for steps in (_SIDES, _CORNERS)
        )
        texel, side = np.divmod(np.arange(4 * m), 4)  # every side of every texel
        other = beside[texel, side]
        back = np.argmax(beside[other] == texel[:, None], axis=1)  # the other's side towards this one
        number = _numbers(texel, side, other, resolution)
        named = np.flatnonzero(number >= 0)  # each pair by one of its two texels
        pair, texel, side, other, back = number[named], texel[named], side[named], other[named], back[named]
        ways = np.empty((m, 4), np.int32)
        ways[texel, side], ways[other, back] = 2 * pair, 2 * pair + 1

        n_pairs = number.max() + 1
        first, second = np.zeros((2, n_pairs), np.int32)
        first[pair], second[pair] = texel, other
        around = np.full((n_pairs, 6), -1, np.int32)
        lateral = [beside[t, (k + turn) % 4] for t, k in ((texel, side), (other, back)) for turn in (1, 3)]
        around[pair] = np.stack([texel, other, *lateral], axis=1)
        self.tables = Sides(beside, across, first, second, around, _quadrants(beside, across, ways))

        self.paths = np.zeros((n_pairs, 3, 3), np.float32)
        centres = _points(resolution, 0, 0)
        middles = np.stack([_points(resolution, *step) for step in _SIDES], axis=1)
        self.paths[pair] = np.stack([centres[texel], middles[texel, side], centres[other]], axis=1)

        padded = -(-m // BITS) * BITS
        self._right, self._below = (pack(np.isin(np.arange(padded), pair - k * padded)) for k in range(2))
        self._outer = slice(2 * padded, None)

    def find_crossed(self, seen: Bits, known: Bits) -> Bits:
        """Pairs of which one texel is seen and the other is not.

        Parameters
        ----------
        seen, known : (n, ceil(n_directions / 32)) uint32 bits
            Visibility, and where it is known.

        Returns
        -------
        (n, ceil(n_pairs / 32)) uint32 bits
        """
        result = np.zeros((len(seen), -(-len(self.paths) // BITS)), np.uint32)
        first, second = self.tables.first[self._outer], self.tables.second[self._outer]
        seen, known = read_only(seen), read_only(known)
        sides = self._right, self._below, self._resolution, first, second
        run_in_parts(_mark_differing, len(seen), seen, known, *sides, result)
        return result


def _points(n: int, dx: float, dy: float) -> NDArray[np.float64]:
    """Points (6 n^2, 3) so many half texels from each centre, on the plane of its face."""
    face, s, t = face_places(n)
    return cube_points(face, s + dx / n, t + dy / n)


def _numbers(
    texel: NDArray[np.int64], side: NDArray[np.int64], other: Ints, resolution: int
) -> NDArray[np.int64]:
    """Numbers of pairs, each at the side of one of its texels; -1 at the other's."""
    per_face = resolution**2
    padded = -(-6 * per_face // BITS) * BITS
    inside = texel // per_face == other // per_face
    outer = ~inside & (texel < other)
    number = np.where(inside & (side < 2), padded * side + texel, -1)
    number[outer] = 2 * padded + np.arange(outer.sum())
    return number


def _quadrants(beside: Ints, across: Ints, ways: Ints) -> Ints:
    """See ``Sides``; ``ways`` (n_directions, 4) are the pairs of each texel and its neighbours, with directions."""

    def between(start: Ints, end: Ints) -> Ints:
        match = beside[start] == end[:, None]
        return np.where(match.any(axis=1), ways[start, np.argmax(match, axis=1)], -1)

    corners = []
    for k in range(4):
        after = (k + 1) % 4
        b, c = beside[:, k], beside[:, after]
        d = np.where(across[:, k] < 0, b, across[:, k])
        corners.append(np.stack([ways[:, k], ways[:, after], between(b, d), between(c, d)], axis=1))
    return np.stack(corners, axis=1).astype(np.int32)  # [texel, corner, pair]


@numba.njit(nogil=True, cache=True)
def _mark_differing(
    start: int,
    end: int,
    seen: Bits,
    known: Bits,
    right: Bits,
    below: Bits,
    resolution: int,
    first: Ints,
    second: Ints,
    result: Bits,
) -> None:
    """Mark pairs of bits that are known and differ.

    ``right`` and ``below`` are bits of the pairs inside of faces that there are, ``first`` and ``second`` the texels
    of the others.
    """
    words = seen.shape[1]
    for i in range(start, end):
        for w in range(words):
            both = known[i, w] & right[w] & _word_ahead(known[i], w, 1)
            result[i, w] = both & (seen[i, w] ^ _word_ahead(seen[i], w, 1))
            both = known[i, w] & below[w] & _word_ahead(known[i], w, resolution)
            result[i, words + w] = both & (seen[i, w] ^ _word_ahead(seen[i], w, resolution))
        for p in range(len(first)):
            a, b = first[p], second[p]
            differ = (bit_of(seen[i], a) ^ bit_of(seen[i], b)) & bit_of(known[i], a) & bit_of(known[i], b)
            result[i, 2 * words + p // BITS] |= differ << np.uint32(p % BITS)


@numba.njit
def _word_ahead(bits: Bits, word: int, step: int) -> np.uint32:
    """The word of bits that begins ``step`` bits after a word."""
    word, shift = word + step // BITS, np.uint32(step % BITS)
    low = bits[word] if word < len(bits) else np.uint32(0)
    if shift == 0:
        return low
    high = bits[word + 1] if word + 1 < len(bits) else np.uint32(0)
    return (low >> shift) | (high << (np.uint32(BITS) - shift))
