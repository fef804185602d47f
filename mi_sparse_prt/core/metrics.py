"""Error norms: relative L2 of arrays, of sums of squares, of noisy references, of samples; FLIP of images.

No error of nothing is 0 (0 / 0), any error of nothing is 1 (x / 0); a squared error below zero, which a product of
independent references may give, is noise about zero and counts as 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Doubles = NDArray[np.float64]

DARK = (
    1e-3  # norms of rows in the dark count as this share of the mean: they have no relative error to speak of
)


def relative_l2_from_squares(squares: ArrayLike, norms: ArrayLike) -> Doubles:
    """``sqrt(squares / norms)`` of squared errors and squared norms, elementwise; a scalar of two scalars."""
    error, norm = np.broadcast_arrays(np.maximum(np.asarray(squares, np.float64), 0), norms)
    return np.sqrt(np.divide(error, norm, out=np.where(error > 0, 1.0, 0.0), where=norm > 0))


def relative_l2(
    estimate: ArrayLike, reference: ArrayLike, axis: int | tuple[int, ...] | None = None
) -> Doubles:
    """``||estimate - reference|| / ||reference||``.

    Parameters
    ----------
    estimate, reference : (...) float
    axis : int or tuple of int, optional
        Over which norms are taken: all axes if not given.

    Returns
    -------
    () or (...) float64
        Without the axes that norms were taken over.
    """
    truth = np.asarray(reference, np.float64)
    squares = (np.asarray(estimate, np.float64) - truth) ** 2
    return relative_l2_from_squares(squares.sum(axis=axis), (truth**2).sum(axis=axis))


def relative_l2_by_name(sums: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """Relative L2 of each part, and of all parts together as ``total``, from its squared error and squared norm."""
    every = {**sums, "total": tuple(np.sum(list(sums.values()), axis=0))}
    return {name: float(relative_l2_from_squares(*pair)) for name, pair in every.items()}


def relative_l2_of_rows(squares: ArrayLike, norms: ArrayLike) -> Doubles:
    """Relative L2 (n,) of rows from squared errors and squared norms (n,); rows in the dark count as dim ones."""
    norm = np.asarray(norms, np.float64)
    return relative_l2_from_squares(squares, np.maximum(norm, DARK * norm.mean()))


def worst_rows(errors: Doubles, ids: NDArray[np.integer], name: str) -> dict[str, Any]:
    """``95th_percentile`` and ``max`` of the errors (n,) of rows, and under ``name`` which of ``ids`` (n,) that is."""
    return {
        "95th_percentile": float(np.percentile(errors, 95)),
        "max": float(errors.max()),
        name: int(ids[errors.argmax()]),
    }


def relative_l2_of_sample(squares: ArrayLike, norms: ArrayLike) -> tuple[float, float]:
    """Relative L2 of all rows from the squared errors and squared norms (n,) of some, and its standard error.

    The square of the error is a ratio of means; its variance is that of the numerator less the ratio times the
    denominator, to first order (Cochran 1977, "Sampling Techniques", 6.11).
    """
    square, norm = np.asarray(squares, np.float64), np.asarray(norms, np.float64)
    error = float(relative_l2_from_squares(square.sum(), norm.sum()))
    if not error > 0 or not norm.sum() > 0:
        return error, 0.0
    spread = np.sqrt(((square - error**2 * norm) ** 2).sum()) / norm.sum()
    return error, float(spread / (2 * error))


def relative_l2_without_noise(
    estimate: ArrayLike,
    first_half: ArrayLike,
    second_half: ArrayLike,
    other_estimate: ArrayLike | None = None,
) -> tuple[float, float]:
    """Relative L2 against a noisy reference in two independent halves X and Y: root of (T - X)(T - Y) / (X Y).

    Parameters
    ----------
    estimate, first_half, second_half : (..., channels) float
    other_estimate : (..., channels) float, optional
        Where the estimate is noisy as well, another, independent one: (T - X)(T' - Y).

    Returns
    -------
    error : float
    uncertainty : float
        What noise alone may show as an error: its square is two standard errors of the squared error.
    """
    first, second, t = (np.asarray(a, np.float64) for a in (first_half, second_half, estimate))
    a, b = t - first, (t if other_estimate is None else np.asarray(other_estimate, np.float64)) - second
    square, norm = float((a * b).sum()), float((first * second).sum())
    error = float(relative_l2_from_squares(square, norm))
    if not norm > 0:
        return error, 0.0
    # a * b is |mean|^2 - |half the difference|^2. Of noise alone, both are alike and independent, and if it is
    # Gaussian and the same in all channels, the variance of each is two thirds of its second moment.
    noise = ((a - b) ** 2).sum(axis=-1) / 4
    return error, float(np.sqrt(2 * np.sqrt(4 / 3 * (noise**2).sum()) / norm))


def relative_noise(first_half: ArrayLike, second_half: ArrayLike) -> float:
    """Relative L2 noise of the mean of two independent halves, from how far they differ."""
    x, y = np.asarray(first_half, np.float64), np.asarray(second_half, np.float64)
    return float(relative_l2_from_squares(((x - y) ** 2).sum(), ((x + y) ** 2).sum()))


def flip_map(reference: ArrayLike, image: ArrayLike) -> NDArray[np.float32]:
    """FLIP for high dynamic range (height, width), 0 to 1, of linear images (height, width, 3); negative is black.

    Andersson et al.: Visualizing Errors in Rendered High Dynamic Range Images, Eurographics 2021. Its mean is the FLIP
    of an image.
    """
    import flip_evaluator  # half a second, and matplotlib with it

    pair = (np.ascontiguousarray(np.maximum(i, 0), np.float32) for i in (reference, image))
    found, _, _ = flip_evaluator.evaluate(*pair, "HDR", applyMagma=False)
    return np.asarray(found, np.float32)[..., 0]
