"""Points in the order of a space-filling curve: those that follow each other are near each other (Morton 1966)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# how the bits of a number are moved apart, two empty places between them
_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_order(positions: NDArray[np.floating], keys: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Order (n,) of positions along Morton's curve through their box.

    Parameters
    ----------
    positions : (n, 3) float, any frame
    keys : (n,) uint64
        They decide where positions are equal: the same order in whatever order positions come.
    """
    p = np.asarray(positions, np.float64)
    if not len(p):
        return np.zeros(0, np.int64)
    largest = (1 << 21) - 1  # 21 bits of a coordinate
    cells = (p - p.min(axis=0)) / max(float(np.ptp(p, axis=0).max()), 1e-30) * largest
    place = np.zeros(len(p), np.uint64)
    for axis, x in enumerate(cells.astype(np.uint64).T):
        for shift, mask in _SPREAD:
            x = (x | x << np.uint64(shift)) & np.uint64(mask)
        place |= x << np.uint64(axis)
    return np.lexsort((keys, place))
