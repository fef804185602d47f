"""Random elements of T on which ways to compute a matrix are tried before there is one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.scene import Scene
from mi_sparse_prt.transport.direct import DirectTransport
from mi_sparse_prt.transport.path import PathTransport

SPP = 64
STRATA = 4  # shadow rays per axis of a texel


class PilotElements:
    """Random elements of T, evaluated twice, independently of each other and of any matrix.

    With the two values X and Y, the mean of (T - X)(T - Y) estimates the squared error of a matrix T without the
    noise of X and Y, and that of X Y the squared norm.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    basis : {"direction", "texel"}
    max_depth : int
        As for ``precompute``.
    indirect : bool
        Whether there is indirect light.
    seed : int
        Elements and their random numbers are drawn from it, and differ from those of a matrix of the same seed.
    vertices_per_mesh, texels_per_vertex : int

    Attributes
    ----------
    vertices : (k,) integers
        Sorted; of all meshes.
    texels : (k, t) integers
        Texels held out at each vertex.
    """

    def __init__(
        self,
        scene: Scene,
        lighting: CubemapLighting,
        basis: str,
        max_depth: int,
        indirect: bool,
        seed: int,
        vertices_per_mesh: int = 256,
        texels_per_vertex: int = 32,
    ) -> None:
        rng = np.random.default_rng([seed, 1])
        self._sizes = {m.name: m.vertices.stop - m.vertices.start for m in scene.meshes}
        self._inside: dict[str, slice] = {}
        chosen: list[NDArray[np.int64]] = []
        for mesh in scene.meshes:
            count = min(self._sizes[mesh.name], vertices_per_mesh)
            start = sum(len(c) for c in chosen)
            self._inside[mesh.name] = slice(start, start + count)
            chosen.append(
                mesh.vertices.start + np.sort(rng.choice(self._sizes[mesh.name], count, replace=False))
            )
        self.vertices = np.concatenate(chosen)
        n, t = lighting.n_directions, min(lighting.n_directions, texels_per_vertex)
        self.texels = np.stack([rng.choice(n, t, replace=False) for _ in self.vertices])
        depth = max_depth if indirect else 2
        self._x, self._y = (
            _elements(scene, lighting, basis, depth, self.vertices, self.texels, (seed << 2) + k)
            for k in (2, 3)
        )

    def relative_square(self, values: NDArray[np.floating]) -> float:
        """Sum over the whole matrix of a quantity known at the held-out elements, (k, t), over its squared norm."""
        sums, norms = (self._total(v) for v in (values, self._squared_norm()))
        return sums / max(norms, 1e-300)

    def squared_error(self, elements: NDArray[np.floating]) -> NDArray[np.float64]:
        """Unbiased squared errors (k, t) of single elements (k, t, 3), summed over channels."""
        return ((elements - self._x) * (elements - self._y)).sum(axis=2)

    def _squared_norm(self) -> NDArray[np.float64]:
        """Unbiased squared norms (k, t) of single elements, summed over channels."""
        return (self._x * self._y).sum(axis=2)

    def _total(self, values: NDArray[np.floating]) -> float:
        """Of a quantity known at the held-out elements, (k, t), the sum over all vertices of its mean over texels."""
        return sum(self._sizes[name] * float(values[inside].mean()) for name, inside in self._inside.items())


def _elements(
    scene: Scene,
    lighting: CubemapLighting,
    basis: str,
    max_depth: int,
    vertices: NDArray[np.int64],
    texels: NDArray[np.int64],
    seed: int,
) -> NDArray[np.float64]:
    """Elements of T, (k, t, 3), at the full resolution of the lighting."""
    points, flat = vertex_points(scene), (np.repeat(vertices, texels.shape[1]), texels.ravel())
    direct = DirectTransport(scene.normalised, lighting, points, basis, STRATA, seed)
    white = np.repeat(direct.elements(*flat)[:, None].astype(np.float64), 3, axis=1)
    if max_depth != 2:
        path = PathTransport(
            scene.normalised, lighting, points, basis, max_depth, SPP, 1 if scene.grey else 3, seed
        )
        white += path.elements(*flat).mean * lighting.solid_angles[texels.ravel()][:, None]
    return scene.albedo[vertices][:, None] * white.reshape(*texels.shape, 3)
