"""How far off a picture is in its own light, by a few samples of Mitsuba's ``path``."""

from __future__ import annotations

import time

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.metrics import relative_l2_without_noise

OURS, THEIRS = 1 << 18, 1 << 20  # samples of each of two pictures in a round: ours have less noise
ROUNDS = 16  # at most
BLOCKS = (1, 2, 4, 8, 16)  # pixels across ...
ENOUGH = 64  # ... of which there are so many at least: their spread is known then
SMOOTH = 4  # of these: where means over them are right, the picture is
CERTAIN = 1.5  # times what two standard errors show, squared: three of them

Image = NDArray[np.float32]


def picture_error(
    ours: mi.Integrator,
    reference: mi.Integrator,
    scene: mi.Scene,
    sensor: mi.Sensor,
    target: float,
    seconds: float,
) -> float:
    """Relative L2 error of a picture, as far as it is certain: 0 where noise may be all.

    Parameters
    ----------
    ours, reference : mi.Integrator
    scene : mi.Scene
    sensor : mi.Sensor
        Left as it is; its film is not.
    target : float
        An error that is certainly below need not be known better.
    seconds : float
        After which no more samples are taken, but the first.

    Notes
    -----
    A matrix's own error is a mean over all light that may come. Where a few texels send most of it, noise of light by
    way of glass does not average out, and it may be most of what a camera sees.

    Two pictures by each integrator, all independent, tell the error without their noise. It is found of means over
    blocks of pixels, too: these have less noise, and no larger error than pixels have, as the root mean square of means
    is below that of what they are means of. So the largest that is certain is a bound from below.
    """
    end, means = time.perf_counter() + seconds, [np.zeros(1, np.float32)] * 4
    for done in range(ROUNDS):
        for k, (integrator, samples) in enumerate(
            ((ours, OURS), (ours, OURS), (reference, THEIRS), (reference, THEIRS))
        ):
            fresh = _picture(integrator, scene, sensor, 4 * done + k, samples)
            means[k] = means[k] + (fresh - means[k]) / np.float32(done + 1)
        some = [across for across in BLOCKS if across == 1 or means[0][..., 0].size >= ENOUGH * across**2]
        found = {across: _error_of_blocks(means, across) for across in some}
        certain = max(error if error**2 > CERTAIN * noise**2 else 0.0 for error, noise in found.values())
        right = np.hypot(*found[min(SMOOTH, some[-1])]) < target
        if certain > target or right or time.perf_counter() > end:
            break
    return certain


def _picture(integrator: mi.Integrator, scene: mi.Scene, sensor: mi.Sensor, seed: int, samples: int) -> Image:
    """A picture (height, width, 3) of about so many samples."""
    sampler, spp = sensor.sampler(), max(1, samples // int(np.prod(sensor.film().crop_size())))
    asked = sampler.sample_count()
    try:
        return np.array(integrator.render(scene, sensor, seed, spp))[..., :3]
    finally:
        sampler.set_sample_count(asked)


def _error_of_blocks(images: list[Image], across: int) -> tuple[float, float]:
    """Of means over blocks of pixels, see ``relative_l2_without_noise``; the rest of the film plays no part."""
    rows, columns = (max(size // across, 1) for size in images[0].shape[:2])

    def means(image: Image) -> Image:
        some = image[: rows * across, : columns * across]
        height, width = (n // m for n, m in zip(some.shape, (rows, columns), strict=False))
        return some.reshape(rows, height, columns, width, -1).mean(axis=(1, 3))

    a, b, x, y = map(means, images)
    return relative_l2_without_noise(a, x, y, other_estimate=b)
