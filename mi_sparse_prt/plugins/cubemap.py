"""The `cubemap` emitter: distant light on the texels of a cubemap, as Mitsuba's integrators see it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cube_faces import face_coordinates, face_direction, texel_at
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.environment import load_environment


class CubemapEmitter(mi.Emitter):
    r"""Cubemap environment emitter (:monosp:`cubemap`)
    -------------------------------------------------

    Light from infinitely far away that is constant over each of the 6 x n x n texels of a cubemap. It shows Mitsuba
    exactly the light that a transport matrix is multiplied with (`CubemapLighting`, same faces, orientation and texel
    order, world frame, +Y up for images), so that a render with `path` is the matrix's reference. With `texel` only
    one texel shines: a column of the matrix in the texel basis.

    Directions are sampled in proportion to texel power (largest channel of the radiance times solid angle) and
    uniformly over the texel's square on its face. `mi.traverse` exposes `data` and `texel`; a change of either
    rebuilds the sampling tables and compiles no kernel. Works with every integrator that starts paths at the camera
    (`direct`, `path`, `volpath`, ...), not with `ptracer`, which starts them at lights.

    One source of radiance is given: `filename`, `data` or `radiance`; with `texel` alone the radiance is 1.

    .. list-table::
       :header-rows: 1

       * - Parameter
         - Type
         - Meaning (default)
       * - filename
         - string
         - Equirectangular image (.exr, .hdr, .pfm), oriented as for `envmap` and projected by area
       * - to_world
         - transform
         - Rotation of the image of `filename` (none)
       * - data
         - tensor
         - Texel radiance, (6, n, n, 3) or (6 n\ :sup:`2`, 3), `mi.TensorXf`. From Python only. |exposed|
       * - radiance
         - rgb, float or |spectrum|
         - The same radiance from everywhere
       * - resolution
         - integer
         - n, texels along a face's edge, a power of two; follows from `data` where that is given (32)
       * - scale
         - float
         - Factor on the radiance, not part of the exposed `data` (1)
       * - texel
         - integer
         - Index of the only texel that shines, or -1: all do (-1). |exposed|
       * - sampling_weight
         - float
         - As for every Mitsuba emitter: share of samples among several emitters (1)

    .. tabs::
        .. code-tab:: xml

            <emitter type="cubemap">
                <string name="filename" value="envmaps/city.exr"/>
                <integer name="resolution" value="32"/>
            </emitter>

        .. code-tab:: python

            'type': 'cubemap',
            'data': mi.TensorXf(lighting.project('envmaps/city.exr'))

    Raises `PrtError` (which Mitsuba wraps in its own message) if none or several sources are given, an image or tensor
    is unfit, or `texel` is out of range.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.m_flags = mi.EmitterFlags.Infinite | mi.EmitterFlags.SpatiallyVarying
        texels = _texels_from(props)  # [6, n, n, rgb]
        self.resolution = texels.shape[1]
        self.scale = float(props.get("scale", 1.0))
        self.data = mi.TensorXf(texels)
        self.texel = mi.Int32(props.get("texel", -1))
        self._solid_angles = CubemapLighting(self.resolution).solid_angles
        self._rebuild()

    def _rebuild(self) -> None:
        """Radiance of the texels that are lit, and the distribution by which they are sampled.

        Texels are sampled row by row: first one of the 6 n rows of all faces by `u.y`, then one of its n texels by
        `u.x`. What is left of the two numbers places the point in the texel, with far more bits left than one
        table of 6 n^2 entries would leave. All probabilities are differences of the float32 tables that are searched.
        """
        n = self.resolution
        if self.data.shape not in ((6, n, n, 3), (6 * n * n, 3)):
            raise PrtError(
                f"cubemap emitter: data changed its shape to {self.data.shape}, not (6, {n}, {n}, 3)"
            )
        texel = int(self.texel[0])
        if not -1 <= texel < 6 * n * n:
            raise PrtError(
                f"cubemap emitter: texel {texel} is not one of 0 ... {6 * n * n - 1} (or -1, all of them)"
            )
        radiance = self.scale * self.data.numpy().reshape(6 * n * n, 3)
        if texel >= 0:
            radiance[np.arange(6 * n * n) != texel] = 0
        if not np.isfinite(radiance).all():
            raise PrtError("cubemap emitter: data has values that are NaN or infinite; repair it")
        power = np.abs(radiance).max(axis=1) * self._solid_angles.astype(np.float64)  # [texel]
        if not power.any():
            power += self._solid_angles  # no light at all: any direction will do
        rows = _cumulative(power.reshape(1, 6 * n, n).sum(axis=2))  # [1, 6 n + 1]
        columns = _cumulative(power.reshape(6 * n, n))  # [6 n, n + 1]
        density = np.diff(rows).T * np.diff(columns) * (n / 2) ** 2  # [6 n, n], per area of face coordinates

        self._radiance = mi.Float(radiance.astype(np.float32).ravel())  # [texel * rgb]
        self._rows, self._columns, self._density = (mi.Float(a.ravel()) for a in (rows, columns, density))

    def traverse(self, callback: mi.TraversalCallback) -> None:
        super().traverse(callback)
        callback.put("data", self.data, mi.ParamFlags.NonDifferentiable)
        callback.put("texel", self.texel, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        super().parameters_changed(keys)
        self._rebuild()

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Color3f:
        # There is no surface behind escaped rays: their direction is -wi
        return self._radiance_of(texel_at(*face_coordinates(-si.wi), self.resolution), active)

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Color3f]:
        n = self.resolution
        u = dr.minimum(sample, dr.one_minus_epsilon(mi.Float))
        row, v = _invert_cumulative(self._rows, mi.UInt32(0), 6 * n, u.y, active)
        col, w = _invert_cumulative(self._columns, row * (n + 1), n, u.x, active)
        face = row // n
        s = (mi.Float(col) + w) * (2 / n) - 1
        t = (mi.Float(row - face * n) + v) * (2 / n) - 1
        texel = row * n + col

        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = face_direction(face, s, t)
        ds.n = -ds.d
        # The scene's extent is not known here, so the distance comes from the point's: far behind any ceiling, and
        # near enough for float32
        ds.dist = 1e6 * (1 + dr.max(dr.abs(it.p)))
        ds.p = it.p + ds.d * ds.dist
        ds.time = it.time
        ds.delta = False
        ds.emitter = mi.EmitterPtr(self)
        ds.pdf = dr.gather(mi.Float, self._density, texel, active) * _area_per_solid_angle(s, t)
        weight = self._radiance_of(texel, active) / ds.pdf
        return ds, dr.select(active & (ds.pdf > 0), weight, 0)

    def pdf_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True
    ) -> mi.Float:
        face, s, t = face_coordinates(ds.d)
        density = dr.gather(mi.Float, self._density, texel_at(face, s, t, self.resolution), active)
        return density * _area_per_solid_angle(s, t)

    def eval_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True
    ) -> mi.Color3f:
        return self._radiance_of(texel_at(*face_coordinates(ds.d), self.resolution), active)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        return mi.ScalarBoundingBox3f()  # empty: at no place in the scene

    def to_string(self) -> str:
        return f"CubemapEmitter[resolution={self.resolution}, texel={self.texel[0]}, scale={self.scale}]"

    def _radiance_of(self, texel: mi.UInt32, active: mi.Bool) -> mi.Color3f:
        return dr.gather(mi.Color3f, self._radiance, texel, active)


def _texels_from(props: mi.Properties) -> NDArray[np.float32]:
    """Unscaled radiance (6, n, n, 3) from the one source among the parameters."""
    given = [name for name in ("filename", "data", "radiance") if name in props]
    if len(given) > 1 or not (given or "texel" in props):
        raise PrtError(
            "cubemap emitter: give exactly one of filename, data and radiance "
            f"(or only texel, for radiance 1), not {' and '.join(given) or 'none'}"
        )
    source = given[0] if given else "texel"
    if source != "filename" and not np.allclose(_matrix(props), np.eye(4)):
        raise PrtError(
            f"cubemap emitter: to_world turns the image of filename; with {source} it is not supported"
        )

    if source == "data":
        texels = np.array(props["data"], dtype=np.float32)
        n = int(props.get("resolution", int(np.sqrt(texels.size // 18))))
        return CubemapLighting(n).project(texels).reshape(6, n, n, 3)
    n = int(props.get("resolution", 32))
    lighting = CubemapLighting(n)
    if source == "filename":
        environment = load_environment(str(mi.file_resolver().resolve(props["filename"])))
        return lighting.project(environment.rotated(_matrix(props)[:3, :3])).reshape(6, n, n, 3)
    return lighting.project(_constant(props)).reshape(6, n, n, 3)


def _constant(props: mi.Properties) -> NDArray[np.float64]:
    """RGB (3,) of `radiance`, in whatever way Mitsuba lets a user write it."""
    texture = props.get_emissive_texture("radiance", 1.0)
    if texture.is_spatially_varying():
        raise PrtError("cubemap emitter: radiance is a texture; give an rgb value, or an image as filename")
    return np.array(texture.eval(dr.zeros(mi.SurfaceInteraction3f)), dtype=np.float64).reshape(3)


def _matrix(props: mi.Properties) -> NDArray[np.float64]:
    transform = props.get("to_world", mi.ScalarTransform4f())
    return np.array(transform.matrix, dtype=np.float64).reshape(4, 4)


def _cumulative(power: NDArray[np.float64]) -> NDArray[np.float32]:
    """Normalised running sums along the last axis, from 0 to exactly 1; uniform where there is no power."""
    total = power.sum(axis=1, keepdims=True)
    sums = np.cumsum(np.where(total > 0, power, 1), axis=1)
    return np.pad(sums / sums[:, -1:], ((0, 0), (1, 0))).astype(np.float32)


def _invert_cumulative(
    cumulative: mi.Float, first: mi.UInt32, size: int, u: mi.Float, active: mi.Bool
) -> tuple[mi.UInt32, mi.Float]:
    """Invert the running sums at `first`, ..., `first + size`: the entry u falls into, and where in it (0 to 1)."""
    entry = dr.binary_search(
        0, size - 1, lambda i: dr.gather(mi.Float, cumulative, first + i + 1, active) <= u
    )
    low, high = (dr.gather(mi.Float, cumulative, first + entry + i, active) for i in (0, 1))
    return entry, dr.clip((u - low) / (high - low), 0, 1)


def _area_per_solid_angle(s: mi.Float, t: mi.Float) -> mi.Float:
    """Area of face coordinates per steradian."""
    squared = dr.fma(s, s, dr.fma(t, t, 1))
    return squared * dr.sqrt(squared)
