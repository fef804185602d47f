"""Noise averaged out along surfaces, at each vertex over as wide a neighbourhood as is worth it.

Steps of smoothing are taken one after another, 1, 2, 4, ... of them. What n vertices with noise of variance s^2 are off
by after that is not known, but Stein's unbiased estimate of it is: |S x - x|^2 - s^2 + 2 S_ii s^2, if S is what the
steps do (Stein 1981; Li, Wu and Chuang 2012, "SURE-based Optimization for Adaptive Sampling and Reconstruction"). The
neighbourhood is that for which it is least.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.measurement.neighbours import surface_neighbours
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.reconstruction.interpolation_weights import linear_weights
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.walls import Walls

NEAR = 12  # vertices of a neighbourhood; 8 leave up to twice the noise after as many steps
STEPS = (1, 2, 4, 8, 16)  # 32 were hardly ever better than 16
OWN = 0.25  # of its own variance a vertex has at least: the mean of neighbours would not know that it is an outlier

Floats = NDArray[np.float32]


def smoothing_step(scene: Scene, points: Points) -> scipy.sparse.csr_array:
    """One step: each vertex of a mesh takes the value at it of the linear function that fits its neighbours best.

    Parameters
    ----------
    scene : Scene
    points : Points
        Of all vertices.

    Returns
    -------
    (n_v, n_v) sparse float32
        Rows sum to 1. Neighbours face the same way, and no wall is between them.
    """
    p, n, walls = scene.normalised_positions, scene.normals, Walls(scene, points)
    blocks = []
    for mesh in scene.meshes:
        inside, ids = mesh.vertices, np.arange(mesh.vertices.start, mesh.vertices.stop)
        near = surface_neighbours(p[inside], n[inside], p[inside], n[inside], NEAR)
        near = walls.without_hidden(ids, near, ids)
        weights = linear_weights(near, p[inside], n[inside], p[inside], n[inside])
        row, place = np.nonzero(near.ids >= 0)
        entries = weights[row, place], (row, near.ids[row, place])
        blocks.append(scipy.sparse.coo_array(entries, shape=(len(ids), len(ids))))
    return scipy.sparse.block_diag(blocks, format="csr", dtype=np.float32)


def smooth_light(light: Floats, variance: Floats, step: scipy.sparse.csr_array) -> Floats:
    """Estimates of light at vertices, with less noise.

    Parameters
    ----------
    light : (n_v, m, channels) float32
        Independent, unbiased estimates of m lights, of which none is negative.
    variance : (n_v, m, channels) float32
        Of each estimate.
    step : (n_v, n_v) sparse float32
        As of ``smoothing_step``.

    Returns
    -------
    (n_v, m, channels) float32
    """
    if not variance.any():  # nothing to average out, or one path per element: the noise is unknown
        return light
    pool = scipy.sparse.csr_array((np.ones_like(step.data), step.indices, step.indptr), shape=step.shape)
    pool.data /= np.repeat(pool.sum(axis=1), np.diff(pool.indptr))
    chosen = _least_risk(light, variance, step, pool)
    result, smooth = np.zeros_like(light), light.reshape(len(light), -1)
    done = 0
    for number, steps in enumerate((0, *STEPS)):
        for _ in range(done, steps):
            smooth = step @ smooth
        done = steps
        share = pool @ (chosen == number).astype(np.float32)  # no seams where neighbours differ
        result += share[..., None] * smooth.reshape(light.shape)
    return np.maximum(result, 0)


def _least_risk(
    light: Floats, variance: Floats, step: scipy.sparse.csr_array, pool: scipy.sparse.csr_array
) -> NDArray[np.int8]:
    """Which of 0, 1, 2, ... steps leave the least error (n_v, m), about, of all channels together."""
    shape = light.shape
    flat = light.reshape(shape[0], -1)
    noise = np.maximum(pool @ variance.reshape(flat.shape), np.float32(OWN) * variance.reshape(flat.shape))
    smooth, done = flat, 0
    chosen, least = np.zeros(shape[:2], np.int8), noise.reshape(shape).sum(axis=2)
    once, twice = step.diagonal(), step.multiply(step.T).sum(axis=1)  # the diagonals of S and S^2
    for number, steps in enumerate(STEPS, 1):
        for _ in range(done, steps):
            smooth = step @ smooth
        done = steps
        # of S^4, S^8, ...: twice as many steps reach twice as many vertices
        own = once if steps == 1 else twice * (2 / steps)
        risk = (smooth - flat) ** 2 + (2 * own[:, None].astype(np.float32) - 1) * noise
        risk = pool @ risk.reshape(shape).sum(axis=2)
        better = risk < least
        chosen[better], least[better] = number, risk[better]
    return chosen
