"""How good a matrix is, from elements that it was not made of: no reference render is needed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.matrix import LightTransport
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.scene import Scene
from mi_sparse_prt.transport.direct import DirectTransport
from mi_sparse_prt.transport.path import PathTransport

VERTICES = 256  # per mesh
TEXELS = 32  # per vertex
SPP = 64
STRATA = 4  # shadow rays per axis of a texel


def held_out_error(scene: Scene, transport: LightTransport, max_depth: int, seed: int) -> dict[str, Any]:
    """Estimate the relative L2 error of a matrix, per mesh and in total.

    Random elements are evaluated twice, independently of each other and of the matrix: with those values X and Y,
    the mean of (T - X)(T - Y) estimates the squared error of T without the noise of X and Y, and that of X Y the
    squared norm.

    Parameters
    ----------
    scene : Scene
    transport : LightTransport
        With rows in the scene's vertex order.
    max_depth : int
        As for ``precompute``.
    seed : int
        Of the matrix; the elements are drawn with others.

    Returns
    -------
    dict
        ``total`` (relative L2), ``meshes`` (name -> relative L2), ``standard_error`` (``total`` and ``meshes`` again,
        from the spread between vertices), ``elements`` (how many were evaluated).
    """
    rng = np.random.default_rng([seed, 1])
    n_directions = transport.lighting.n_directions
    squares, norms, spreads, count = {}, {}, {}, 0
    for mesh in scene.meshes:
        n = mesh.vertices.stop - mesh.vertices.start
        vertices = np.sort(rng.choice(n, min(n, VERTICES), replace=False)) + mesh.vertices.start
        texels = np.stack(
            [rng.choice(n_directions, min(n_directions, TEXELS), replace=False) for _ in vertices]
        )
        error, norm = _products(
            scene, transport, max_depth, seed, vertices, texels
        )  # [vertex], means over texels
        count += texels.size
        squares[mesh.name], norms[mesh.name] = n * error.mean(), n * norm.mean()
        spreads[mesh.name] = n * error.std(ddof=1) / np.sqrt(len(error)) if len(error) > 1 else 0.0
    meshes = {name: _relative(squares[name], norms[name], spreads[name]) for name in squares}
    spread = float(np.sqrt(sum(s**2 for s in spreads.values())))
    total = _relative(sum(squares.values()), sum(norms.values()), spread)
    return {
        "total": total[0],
        "meshes": {name: value for name, (value, _) in meshes.items()},
        "standard_error": {"total": total[1], "meshes": {name: error for name, (_, error) in meshes.items()}},
        "elements": count,
    }


def _products(
    scene: Scene,
    transport: LightTransport,
    max_depth: int,
    seed: int,
    vertices: NDArray[np.int64],
    texels: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean over each vertex's texels (and sum over channels) of (T - X)(T - Y) and of X Y."""
    flat = np.repeat(vertices, texels.shape[1]), texels.ravel()
    rows = transport.rows(vertices)  # [vertex, direction, rgb]
    ours = np.take_along_axis(rows, texels[..., None], axis=1).reshape(-1, 3).astype(np.float64)
    x, y = (
        transport.albedo[flat[0]] * _white_elements(scene, transport, max_depth, *flat, seed=(seed << 2) + k)
        for k in (2, 3)
    )
    shape = (*texels.shape, 3)
    error = ((ours - x) * (ours - y)).reshape(shape).sum(axis=2).mean(axis=1)
    norm = (x * y).reshape(shape).sum(axis=2).mean(axis=1)
    return error, norm


def _white_elements(
    scene: Scene,
    transport: LightTransport,
    max_depth: int,
    vertices: NDArray[np.int64],
    texels: NDArray[np.int64],
    seed: int,
) -> NDArray[np.float64]:
    """White elements (n, 3) at the full resolution of the lighting."""
    lighting, points = transport.lighting, vertex_points(scene)
    direct = DirectTransport(scene.normalised, lighting, points, transport.basis, STRATA, seed)
    white = np.repeat(direct.elements(vertices, texels)[:, None].astype(np.float64), 3, axis=1)
    if transport.indirect is not None:
        channels = transport.indirect.density.shape[2]
        path = PathTransport(
            scene.normalised, lighting, points, transport.basis, max_depth, SPP, channels, seed
        )
        white += path.elements(vertices, texels).mean * lighting.solid_angles[texels][:, None]
    return white


def _relative(square: float, norm: float, spread: float) -> tuple[float, float]:
    """Relative L2 and its standard error from a squared error (and the spread of that) and a squared norm."""
    if norm <= 0:  # a black mesh
        return (0.0 if square <= 0 else 1.0), 0.0
    relative = float(np.sqrt(max(square, 0.0) / norm))  # below zero is noise about zero
    # d sqrt(e) = de / (2 sqrt(e)); near zero the bound is that of sqrt(spread)
    error = spread / norm / (2 * relative) if square > spread else np.sqrt(spread / norm)
    return relative, float(error)
