"""Light from infinity on a cubemap of 6 x n x n texels: geometry, solid angles, projections onto it.

The one definition of the layout. Faces in the order +X, -X, +Y, -Y, +Z, -Z, world frame, oriented as OpenGL's cube
maps. Texel (row, col) of face f has index j = f n^2 + row n + col and covers the square of face coordinates
[2 col / n - 1, 2 (col + 1) / n - 1] (s) x [2 row / n - 1, 2 (row + 1) / n - 1] (t); the point (s, t) of a face lies in
the direction `centre + s * s_axis + t * t_axis` with the axes of `FACE_FRAMES`.

NumPy arrays are used where things are computed once; the functions on Dr.Jit arrays (`face_coordinates`,
`face_direction`, `texel_at`) are also what the `cubemap` emitter traces.
"""

from __future__ import annotations

import os
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.environment import Environment, load_environment
from mi_sparse_prt.emission.equirectangular import Potential

# [face, (s_axis, t_axis, centre), xyz]
FACE_FRAMES = np.array(
    [
        [[0, 0, -1], [0, -1, 0], [1, 0, 0]],  # +X
        [[0, 0, 1], [0, -1, 0], [-1, 0, 0]],  # -X
        [[1, 0, 0], [0, 0, 1], [0, 1, 0]],  # +Y
        [[1, 0, 0], [0, 0, -1], [0, -1, 0]],  # -Y
        [[1, 0, 0], [0, -1, 0], [0, 0, 1]],  # +Z
        [[-1, 0, 0], [0, -1, 0], [0, 0, -1]],  # -Z
    ],
    dtype=np.float64,
)


class CubemapLighting:
    """A finite basis of distant light: radiance that is constant over each of 6 n^2 texels of a world-space cubemap.

    Parameters
    ----------
    resolution : int
        n, texels along a face's edge; a power of two.

    Attributes
    ----------
    resolution, n_directions : int
        n and 6 n^2.
    directions : (6 n^2, 3) float32
        Unit directions TOWARDS the light, at texel centres, world frame.
    solid_angles : (6 n^2,) float32
        Exact solid angles in steradians; they sum to 4 pi.

    Raises
    ------
    PrtError
        If `resolution` is not a power of two.
    """

    kind: ClassVar[str] = "cubemap"

    def __init__(self, resolution: int = 32) -> None:
        if resolution != int(resolution) or resolution < 1 or int(resolution) & (int(resolution) - 1):
            raise PrtError(f"cubemap resolution {resolution} is not a power of two; use 8, 16, 32, 64, ...")
        self.resolution = int(resolution)
        self.n_directions = 6 * self.resolution**2
        directions, solid_angles = self.subdirections(1)
        self.directions: NDArray[np.float32] = directions[:, 0]
        self.solid_angles: NDArray[np.float32] = solid_angles[:, 0]

    @property
    def size(self) -> int:
        """Elements of the basis: ``n_directions``."""
        return self.n_directions

    @property
    def weights(self) -> NDArray[np.float32]:
        """Of texels in inner products: their solid angles."""
        return self.solid_angles

    @property
    def coordinates(self) -> dict[str, NDArray[Any]]:
        """Of texels: ``x``, ``y``, ``z`` of the direction (world), ``solid_angle`` (sr)."""
        return dict(zip("xyz", self.directions.T, strict=True)) | {"solid_angle": self.solid_angles}

    def neighbours(self, count: int) -> NDArray[np.int32]:
        """(6 n^2, count) nearest texels by their centres, each texel itself first; fewer if there are not so many."""
        nearest = min(count, self.n_directions)
        found = cKDTree(self.directions).query(self.directions, nearest)[1]
        return found.reshape(self.n_directions, nearest).astype(np.int32)

    def element_of(
        self, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Mask
    ) -> tuple[mi.Int32, mi.Color3f]:
        """The texel that rays leave the scene towards, -1 for none, and radiance 1."""
        leaves = active & ~si.is_valid()
        texel = mi.Int32(texel_at(*face_coordinates(ray.d), self.resolution))
        return dr.select(leaves, texel, -1), dr.select(leaves, mi.Color3f(1), 0)

    def attributes(self) -> dict[str, Any]:
        """What files keep of it; JSON as it is."""
        return {"resolution": self.resolution}

    def __repr__(self) -> str:
        return f"CubemapLighting({self.resolution})"

    def texel_of(self, directions: ArrayLike) -> NDArray[np.int32]:
        """Index (m,) of the texel that each of the (m, 3) directions (world, any length but 0) points at."""
        directions = np.asarray(directions, dtype=np.float32)
        if directions.ndim != 2 or directions.shape[1] != 3:
            raise PrtError(f"directions have shape {directions.shape}; give (m, 3)")
        d = mi.Vector3f(np.ascontiguousarray(directions.T))
        return texel_at(*face_coordinates(d), self.resolution).numpy().astype(np.int32)

    def subdirections(self, s: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Split every texel into s x s squares of face coordinates.

        Returns
        -------
        directions : (6 n^2, s^2, 3) float32
            Unit directions at the squares' centres, world frame, rows first.
        solid_angles : (6 n^2, s^2) float32
            Their exact solid angles in steradians; over s^2 they sum to `self.solid_angles`.
        """
        directions, solid_angles = _subtexels(np.arange(self.n_directions), self.resolution, s)
        return directions.astype(np.float32), solid_angles.astype(np.float32)

    def project(self, environment: object) -> NDArray[np.float32]:
        """Mean radiance of every texel under an environment.

        Parameters
        ----------
        environment : Environment, path, Mitsuba emitter, (6 n^2, 3) or (6, n, n, 3) array, number or RGB triple
            An image is taken as constant over each pixel and integrated by area: a constant image gives that
            constant, and `sum_j L_j * solid_angles_j` is the image's own sum of pixel x solid angle.
            An environment emitter (`constant`, `envmap`, `cubemap`, ...) is evaluated at sub-texel centres, so
            its scale and rotation count; a `cubemap` of this resolution is passed on unchanged. Texel values are
            passed on after a check. A number or a triple is the same radiance everywhere.

        Returns
        -------
        (6 n^2, 3) float32
            L_j, linear RGB radiance, world frame.

        Raises
        ------
        PrtError
            If an array has another shape or is not finite, an emitter is not an environment, or a file is bad.

        Notes
        -----
        `project(load_environment(file))` and `project` of an `envmap` of that file differ by what the latter's
        bilinear interpolation does (see `emission.environment`): a blur by one pixel and a shift of up to half
        a pixel towards the poles.
        """
        if isinstance(environment, (str, os.PathLike)):
            environment = load_environment(environment)
        if isinstance(environment, Environment):
            return _project_image(environment, self)
        if isinstance(environment, mi.Emitter):
            return _project_emitter(environment, self)
        return self._check_texels(environment)

    def _check_texels(self, values: object) -> NDArray[np.float32]:
        try:
            texels = np.array(values, dtype=np.float32)
        except (TypeError, ValueError) as error:
            raise PrtError(
                f"cannot light the scene with {type(values).__name__}: see CubemapLighting.project"
            ) from error
        n = self.resolution
        if texels.shape in ((), (1,), (3,)):  # one radiance for all directions
            texels = np.broadcast_to(texels, (self.n_directions, 3)).copy()
        if texels.shape not in ((self.n_directions, 3), (6, n, n, 3)):
            raise PrtError(
                f"lighting has shape {texels.shape}; {self!r} takes ({self.n_directions}, 3), (6, {n}, {n}, 3), "
                "a number or an RGB triple"
            )
        if not np.isfinite(texels).all():
            raise PrtError(
                f"lighting has {(~np.isfinite(texels)).sum()} values that are NaN or infinite; repair it"
            )
        return texels.reshape(-1, 3)


# ---------------------------------------------------------------------------------------------------------------------
# Geometry, Dr.Jit


def face_coordinates(d: mi.Vector3f) -> tuple[mi.UInt32, mi.Float, mi.Float]:
    """Face of each direction (any length) and its coordinates s, t in [-1, 1].

    On edges shared by faces the first face of the order wins.
    """
    largest = dr.max(dr.abs(d))
    face, s, t = mi.UInt32(0), mi.Float(0), mi.Float(0)
    for f in reversed(range(6)):
        s_axis, t_axis, centre = (mi.ScalarVector3f(axis) for axis in FACE_FRAMES[f])
        here = dr.dot(centre, d) == largest
        face = dr.select(here, f, face)
        s = dr.select(here, dr.dot(s_axis, d), s)
        t = dr.select(here, dr.dot(t_axis, d), t)
    return face, s / largest, t / largest


def face_direction(face: mi.UInt32, s: mi.Float, t: mi.Float) -> mi.Vector3f:
    """Unit direction of the point (s, t) of a face; the inverse of `face_coordinates`."""
    d = mi.Vector3f(0)
    for f in range(6):
        s_axis, t_axis, centre = (mi.ScalarVector3f(axis) for axis in FACE_FRAMES[f])
        d = dr.select(face == f, centre + s * s_axis + t * t_axis, d)
    return dr.normalize(d)


def texel_at(face: mi.UInt32, s: mi.Float, t: mi.Float, n: int) -> mi.UInt32:
    """Index j of the texel that the point (s, t) of a face of n x n texels lies in."""
    row, col = (dr.clip(mi.Int32(dr.floor((x + 1) * (n / 2))), 0, n - 1) for x in (t, s))
    return (face * n + mi.UInt32(row)) * n + mi.UInt32(col)


# ---------------------------------------------------------------------------------------------------------------------
# Geometry, NumPy


def _subtexels(texels: NDArray[np.int_], n: int, s: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (m, s^2, 3) and solid angles (m, s^2) of the s x s squares of m texels."""
    face, row, col = np.unravel_index(texels, (6, n, n))  # [m] each
    edges = 2 * np.arange(s + 1) / (n * s)
    s_edge, t_edge = 2 * col[:, None] / n - 1 + edges, 2 * row[:, None] / n - 1 + edges  # [m, s + 1]

    # Solid angle of [0, x] x [0, y] on a face; a rectangle's is the second difference over its corners
    x, y = s_edge[:, None, :], t_edge[:, :, None]
    corner = np.arctan2(x * y, np.sqrt(x * x + y * y + 1))  # [m, s + 1 (t), s + 1 (s)]
    solid_angles = np.diff(np.diff(corner, axis=1), axis=2)

    x, y = ((e[:, 1:] + e[:, :-1]) / 2 for e in (s_edge, t_edge))  # [m, s]
    s_axis, t_axis, centre = (FACE_FRAMES[face, i][:, None, None] for i in range(3))  # [m, 1, 1, xyz]
    d = centre + x[:, None, :, None] * s_axis + y[:, :, None, None] * t_axis  # [m, s (t), s (s), xyz]
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    return d.reshape(len(texels), s * s, 3), solid_angles.reshape(len(texels), s * s)


# ---------------------------------------------------------------------------------------------------------------------
# Projections


def _project_emitter(emitter: mi.Emitter, lighting: CubemapLighting) -> NDArray[np.float32]:
    """Mean of `emitter.eval` over each texel, by s x s samples weighted with their exact solid angles."""
    if not emitter.is_environment():
        raise PrtError(
            f"emitter {emitter.class_name()} is not an environment: it does not shine from infinity"
        )
    n = lighting.resolution
    s = _samples_per_edge(emitter, n)
    block = max(1, (1 << 20) // s**2)  # a million directions at once: about 100 MB
    radiance = np.empty((lighting.n_directions, 3))  # [texel, rgb]
    for start in range(0, lighting.n_directions, block):
        texels = np.arange(start, min(start + block, lighting.n_directions))
        directions, weights = _subtexels(texels, n, s)
        si = dr.zeros(mi.SurfaceInteraction3f, weights.size)
        si.wi = mi.Vector3f(np.ascontiguousarray(-directions.reshape(-1, 3).T, dtype=np.float32))
        values = np.array(emitter.eval(si), dtype=np.float64)  # [rgb, texel * sub], one column if constant
        values = np.broadcast_to(values, (3, weights.size)).reshape(3, *weights.shape)
        radiance[texels] = ((values * weights).sum(axis=2) / weights.sum(axis=1)).T
    return radiance.astype(np.float32)


def _samples_per_edge(emitter: mi.Emitter, n: int) -> int:
    """Samples along a texel's edge that resolve the emitter: its own texels, or a quarter of its pixels."""
    own_resolution = getattr(emitter, "resolution", None)
    if own_resolution is not None:  # our `cubemap`: one sample in each of its texels is exact
        return max(1, own_resolution // n)
    parameters = mi.traverse(emitter)
    shape: tuple[int, ...] = parameters["data"].shape if "data" in parameters else ()
    if len(shape) == 3:  # an image [row, col, rgb] with rows of pi / h radians; a texel is at most 2 / n wide
        return max(4, int(np.ceil(4 * (2 / n) / (np.pi / shape[0]))))
    return 16


def _project_image(environment: Environment, lighting: CubemapLighting) -> NDArray[np.float32]:
    """Area-weighted mean of the image's pixels over each texel: exact, face by face from the texels' borders."""
    n = lighting.resolution
    _, solid_angles = _subtexels(np.arange(lighting.n_directions), n, 1)
    potential = Potential(environment.pixels)
    excess = np.empty((6, n, n, 3))  # [face, row, col, rgb], integral of (image - mean)
    edges = 2 * np.arange(n + 1) / n - 1
    for face, (s_axis, t_axis, centre) in enumerate(FACE_FRAMES):
        # [row edge, col edge, xyz]
        corners = centre + edges[None, :, None] * s_axis + edges[:, None, None] * t_axis
        corners /= np.linalg.norm(corners, axis=-1, keepdims=True)
        corners = corners @ environment.rotation  # by its transpose, into the environment's frame
        along_s, along_t = (
            potential.along_arcs(start.reshape(-1, 3), end.reshape(-1, 3)).reshape(start.shape)
            for start, end in ((corners[:, :-1], corners[:, 1:]), (corners[:-1], corners[1:]))
        )
        excess[face] = np.diff(along_s, axis=0) - np.diff(along_t, axis=1)
    radiance = potential.mean + excess.reshape(-1, 3) / solid_angles
    return np.maximum(radiance, 0).astype(np.float32)  # rounding must not make black texels negative
