"""E as light from infinity, constant over each texel of a cubemap (laid out by ``cube_faces``)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property, lru_cache
from itertools import product
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cube_faces import (
    FACE_FRAMES,
    face_coordinates,
    subtexels,
    texel_at,
    texels_beside,
    texels_towards,
)
from mi_sparse_prt.emission.environment import Environment, load_environment
from mi_sparse_prt.emission.equirectangular import Potential
from mi_sparse_prt.emission.texel_adjacency import TexelSides
from mi_sparse_prt.emission.upsampling import upsampling
from mi_sparse_prt.scene.mitsuba_meshes import lit_scene
from mi_sparse_prt.scene.scene import Scene


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
        return _nearest_texels(self.resolution, min(count, self.n_directions))

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
        return texels_towards(directions, self.resolution)

    def coarser(self, factor: int) -> CubemapLighting:
        """The cubemap whose texels have so many times the side; PrtError if there is none."""
        return CubemapLighting(self.resolution // factor)

    def upsampling(self, coarse: CubemapLighting) -> scipy.sparse.csr_array:
        """(6 n^2, 6 n_coarse^2): interpolates values at the centres of a coarser cubemap's texels, bilinearly."""
        return upsampling(coarse.resolution, self.resolution)

    def beside(self, dx: int, dy: int) -> NDArray[np.int32]:
        """(6 n^2,) texels some columns and rows from each; -1 beyond a corner of the cube."""
        return texels_beside(self.resolution, dx, dy)

    @cached_property
    def sides(self) -> TexelSides:
        """Which texels meet, for edges of visibility between them."""
        return TexelSides(self.resolution)

    @contextmanager
    def scene_lit_by(self, light: Any, scene: Scene) -> Iterator[mi.Scene]:
        """A Mitsuba scene of the same surfaces under a light, constant over each texel, and no other; world space."""
        n, texels = self.resolution, self.project(light)
        sky = {"type": "cubemap", "resolution": n, "data": mi.TensorXf(texels.reshape(6, n, n, 3))}
        yield lit_scene(scene.unlit_shapes(), sky)

    def subdirections(self, s: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Split every texel into s x s squares of face coordinates.

        Returns
        -------
        directions : (6 n^2, s^2, 3) float32
            Unit directions at the squares' centres, world frame, rows first.
        solid_angles : (6 n^2, s^2) float32
            Their exact solid angles in steradians; over s^2 they sum to `self.solid_angles`.
        """
        directions, solid_angles = subtexels(np.arange(self.n_directions), self.resolution, s)
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
# Projections


def _project_emitter(emitter: mi.Emitter, lighting: CubemapLighting) -> NDArray[np.float32]:
    """Mean of `emitter.eval` over each texel, by s x s samples weighted with their exact solid angles."""
    if not emitter.is_environment():
        raise PrtError(
            f"emitter {emitter.class_name()} is not an environment: it does not shine from infinity"
        )
    n, texels = lighting.resolution, np.arange(lighting.n_directions)
    if emitter.class_name() == "ConstantBackgroundEmitter":  # the same in all directions
        return np.repeat(_sampled(emitter, texels[:1], n, 1)[0], len(texels), axis=0).astype(np.float32)
    if (s := _samples_per_edge(emitter, n)) is not None:
        return _sampled(emitter, texels, n, s)[0].astype(np.float32)
    return _project_formula(emitter, lighting).astype(np.float32)


def _project_formula(emitter: mi.Emitter, lighting: CubemapLighting) -> NDArray[np.float64]:
    """Mean radiance of texels of an emitter that may have a sun of half a degree in it.

    At least two samples per degree and axis meet such a sun. Where one does, texels of at most 1.4 degrees get more,
    also those beside it, of which the sun may cover too little for a sample.
    """
    n, m = lighting.resolution, max(lighting.resolution, 64)
    small = CubemapLighting(m)
    samples = -(-max(16 * n, 384) // m)
    radiance, peaks = _sampled(emitter, np.arange(small.n_directions), m, samples)
    sharp = peaks > 2 * radiance.max(axis=1)
    found = np.flatnonzero(sharp)
    for dx, dy in product((-1, 0, 1), repeat=2):
        beside = small.beside(dx, dy)[found]
        sharp[beside[beside >= 0]] = True
    radiance[sharp] = _sampled(emitter, np.flatnonzero(sharp), m, max(samples, 12288 // m))[0]
    power = (radiance * small.solid_angles[:, None]).reshape(6, n, m // n, n, m // n, 3).sum(axis=(2, 4))
    return power.reshape(-1, 3) / lighting.solid_angles[:, None]


def _sampled(
    emitter: mi.Emitter, texels: NDArray[np.intp], n: int, s: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means (k, 3) and largest values (k,) of texels from s x s samples each."""
    block = max(1, (1 << 20) // s**2)  # a million directions at once: about 100 MB
    radiance, peaks = np.empty((len(texels), 3)), np.empty(len(texels))
    for start in range(0, len(texels), block):
        own = slice(start, start + block)
        directions, weights = subtexels(texels[own], n, s)
        si = dr.zeros(mi.SurfaceInteraction3f, weights.size)
        si.wi = mi.Vector3f(np.ascontiguousarray(-directions.reshape(-1, 3).T, dtype=np.float32))
        values = np.array(emitter.eval(si), dtype=np.float64)  # [rgb, texel * sub], one column if constant
        values = np.broadcast_to(values, (3, weights.size)).reshape(3, *weights.shape)
        radiance[own] = ((values * weights).sum(axis=2) / weights.sum(axis=1)).T
        peaks[own] = values.max(axis=(0, 2))
    return radiance, peaks


def _samples_per_edge(emitter: mi.Emitter, n: int) -> int | None:
    """Samples along a texel's edge that resolve an image: its own texels, or a quarter of its pixels; else None."""
    own_resolution = getattr(emitter, "resolution", None)
    if own_resolution is not None:  # our `cubemap`: one sample in each of its texels is exact
        return max(1, own_resolution // n)
    parameters = mi.traverse(emitter)
    shape: tuple[int, ...] = parameters["data"].shape if "data" in parameters else ()
    if len(shape) == 3:  # an image [row, col, rgb] with rows of pi / h radians; a texel is at most 2 / n wide
        return max(4, int(np.ceil(4 * (2 / n) / (np.pi / shape[0]))))
    return None


def _project_image(environment: Environment, lighting: CubemapLighting) -> NDArray[np.float32]:
    """Area-weighted mean of the image's pixels over each texel: exact, face by face from the texels' borders."""
    n = lighting.resolution
    _, solid_angles = subtexels(np.arange(lighting.n_directions), n, 1)
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


@lru_cache(maxsize=16)
def _nearest_texels(resolution: int, count: int) -> NDArray[np.int32]:
    """``CubemapLighting.neighbours``: asked for again and again, and a tenth of a second at 6144 texels."""
    directions = CubemapLighting(resolution).directions
    found = cKDTree(directions).query(directions, count)[1]
    return found.reshape(len(directions), count).astype(np.int32)
