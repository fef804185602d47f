"""Weights of representatives by which rows come out right that are known whole.

The rows that tell which columns are alike are known at all lights, and so are the sums of their elements. What the
representatives miss of these sums they miss at other samples as well; a little of each weight makes up for it. This is
calibration, as of surveys (Deville, Sarndal: Calibration Estimators in Survey Sampling, 1992): of the weights that
are best by ridge regression, those whose strength predicts rows best that it was not told.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.manylights.elements import Elements, Representatives, SeenRows

MOST_ROWS = 500  # that are looked at, of all evenly: beyond, what they cost grows as their number cubed
SURE = 2.0  # standard errors by which rows must be better
RIDGES = np.geomspace(1, 1e-4, 9)  # of the mean diagonal of the rows' products

Doubles = NDArray[np.float64]


class Calibrated(NamedTuple):
    """Representatives with other weights, and how much better they are.

    Attributes
    ----------
    representatives : Representatives
    left : float
        Of the squared error, by rows that each are left out in turn.
    """

    representatives: Representatives
    left: float


def calibrate(elements: Elements, seen: SeenRows, drawn: Representatives) -> Calibrated:
    """Change weights, channel by channel, so that the sums of rows come out better.

    Parameters
    ----------
    elements : Elements
    seen : SeenRows
        Of all lights that are represented.
    drawn : Representatives
        Sets, in turn for the samples of a pixel: it is their mean that is made right.

    Notes
    -----
    The weights are no longer without bias for each choice of rows: it is of the order of the squared error that is
    left, divided by the number of representatives. Where rows do not help, nothing is changed.
    """
    some = slice(None, None, -(-len(seen.ids) // MOST_ROWS))
    every, place = np.unique(drawn.ids, return_inverse=True)
    block, scale = elements.block(seen.ids[some], every), seen.weights[some, None] / len(drawn.ids)
    weights, before, after = drawn.weights.reshape(-1, 3).astype(np.float64), 0.0, 0.0
    for channel in range(3):
        own = block[:, place.ravel(), channel] * weights[:, channel]
        own *= scale  # what each adds to rows
        missing = seen.sums[0, some, channel] - own.sum(axis=1)
        change, left = _ridge(own, missing)
        weights[:, channel] *= 1 + change
        before, after = before + float(missing @ missing), after + left
    representatives = drawn._replace(weights=weights.reshape(drawn.weights.shape).astype(np.float32))
    return Calibrated(representatives, after / before if before > 0 else 1.0)


def _ridge(x: Doubles, y: Doubles) -> tuple[Doubles, float]:
    """Factors (k,) with x (r, k) @ factors about y (r,), and the squares of rows' errors, each left out in turn.

    None is below -1: dim places would be darker than black.
    """
    products = x @ x.T
    values, vectors = np.linalg.eigh(products)
    along, mean = vectors.T @ y, max(float(np.trace(products)) / len(products), 1e-300)
    best, least = np.zeros(x.shape[1]), float(y @ y)
    for ridge in RIDGES:
        inverse = 1 / (np.maximum(values, 0) + ridge * mean)
        dual = vectors @ (inverse * along)
        errors = dual / (np.square(vectors) @ inverse)
        squares, gain = float(errors @ errors), np.square(y) - np.square(errors)
        is_sure = gain.sum() > SURE * np.sqrt(len(y)) * gain.std()
        if is_sure and squares < least and (factors := x.T @ dual).min() >= -1:
            best, least = factors, squares
    return best, least
