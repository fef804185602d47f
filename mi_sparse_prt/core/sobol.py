"""Sobol's low-discrepancy points in three dimensions, as 32-bit fractions.

Those of `scipy.stats.qmc`, with the direction numbers of Joe and Kuo, "Constructing Sobol sequences with better
two-dimensional projections", 2008; to import that module takes longer than to trace the rays of a small scene.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BITS = 32
# per dimension: a primitive polynomial over the integers mod 2 without its first and last coefficient, most
# significant first, and the odd numbers m_1, m_2, ... that start its recurrence; the first dimension has none
POLYNOMIALS: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...] = (((), (1,)), ((1,), (1, 3)))


def sobol_points(n: int) -> NDArray[np.uint32]:
    """The first n points (n, 3) of Sobol's sequence, in units of 2^-32, in the order of Gray's code.

    The first point is the origin.
    """
    index = np.arange(n, dtype=np.uint32)
    gray = index ^ index >> 1
    points = np.zeros((n, 1 + len(POLYNOMIALS)), np.uint32)
    for j, directions in enumerate(_direction_numbers().T):
        points ^= (gray >> j & 1)[:, None] * directions
    return points


def _direction_numbers() -> NDArray[np.uint32]:
    """What bit j of the Gray code adds to a point, in units of 2^-32, (3, BITS)."""
    rows = [[1] * BITS]
    for coefficients, start in POLYNOMIALS:
        m, degree = list(start), len(start)
        while len(m) < BITS:
            new = m[-degree] ^ m[-degree] << degree
            for k, coefficient in enumerate(coefficients, 1):
                new ^= coefficient * m[-k] << k
            m.append(new)
        rows.append(m)
    return np.array([[m << (BITS - 1 - j) for j, m in enumerate(row)] for row in rows], np.uint32)
