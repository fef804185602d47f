"""Numbers at vertices as pictures: ranks, errors, and dense vertices as white dots ([HR10] Figures 2 and 13)."""

from __future__ import annotations

import drjit as dr
import matplotlib
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.scene.scene import Scene

COLORMAP = "viridis"
SUBPIXELS = 3  # rays per pixel and axis
DOT = 1.3  # radius in pixels
DOTS_NEAR = 4  # of the dots nearest to what a ray meets, those that may cover it
AMBIENT = 0.55  # brightness of a surface seen edge on; 1 where it faces the camera


def vertex_picture(
    scene: Scene,
    values: ArrayLike,
    sensor: int = 0,
    width: int = 480,
    dots: ArrayLike | None = None,
    vmin: float | None = None,
    vmax: float | None = None,
) -> NDArray[np.float32]:
    """Colour the scene by a number at each vertex, interpolated over its triangles.

    Parameters
    ----------
    scene : Scene
    values : (n_v,) float
        NaN is shown in grey.
    sensor : int
        One of ``scene.mitsuba.sensors()``; the picture has the shape of its film.
    width : int
        Pixels; the height follows.
    dots : (n,) int, optional
        Vertices drawn as white dots, where they are not hidden.
    vmin, vmax : float, optional
        Values of the first and last colour of viridis; the smallest and largest value if not given.

    Returns
    -------
    (height, width, 3) float32
        sRGB in [0, 1], ready to be shown; white where there is nothing. Surfaces are a little darker where they turn
        away from the camera.

    Raises
    ------
    PrtError
        If there is not one value per vertex, the scene has no such sensor, or a dot is no vertex.
    """
    v = np.asarray(values, np.float64)
    n = len(scene.positions)
    if v.shape != (n,):
        raise PrtError(f"values have the shape {v.shape}: give one for each of the {n} vertices, ({n},)")
    camera = scene.sensor(sensor)
    chosen = np.asarray([] if dots is None else dots, np.int64).reshape(-1)
    if len(chosen) and not (0 <= chosen.min() and chosen.max() < n):
        raise PrtError(
            f"dots reach from {chosen.min()} to {chosen.max()}: vertices are numbered 0 to {n - 1}"
        )
    if width < 1:
        raise PrtError(f"width is {width}: give 1 pixel or more")

    film = camera.film().size()
    height = max(1, round(width * int(film.y) / int(film.x)))
    rays = _rays(camera, width, height)
    hit = _Hits(scene, rays, int(film.x) / width)

    colours = np.ones((len(hit.valid), 3))  # [sample, rgb]
    colours[hit.valid] = _coloured(hit.interpolated(v), *_range(v, vmin, vmax)) * hit.shade[:, None]
    if len(chosen):
        colours[np.flatnonzero(hit.valid)[hit.covered(scene.positions[chosen].astype(np.float64))]] = 1
    picture = colours.reshape(height, SUBPIXELS, width, SUBPIXELS, 3).mean(axis=(1, 3))
    return picture.astype(np.float32)


class _Hits:
    """What the samples of a picture meet.

    Attributes
    ----------
    valid : (n_samples,) bool
        Whether a sample meets a surface; all other arrays have only these.
    shade : (n,) float
        Brightness by the angle between the surface and the ray.
    """

    def __init__(self, scene: Scene, ray: mi.RayDifferential3f, film_pixels: float) -> None:
        triangles = np.concatenate([mesh.triangles + mesh.vertices.start for mesh in scene.fronts])
        hit = scene.world.ray_intersect_preliminary(mi.Ray3f(ray))
        si = scene.world.interaction(hit, mi.Ray3f(ray))
        self.valid = hit.is_valid().numpy()
        triangle = scene.world.triangle(hit, hit.is_valid())
        self._corners = triangles[triangle.numpy()[self.valid]]  # [hit, corner]
        u, v = hit.prim_uv.numpy()[:, self.valid].astype(np.float64)
        self._barycentric = np.stack([1 - u - v, u, v], axis=1)
        self._origins, self._directions, self._points = (
            np.asarray(vectors).T[self.valid].astype(np.float64) for vectors in (ray.o, ray.d, si.p)
        )
        beside = ray.o_x + hit.t * ray.d_x - ray(hit.t)  # one pixel of the film to the right
        self._pixel = dr.norm(beside).numpy()[self.valid] * film_pixels
        facing = dr.abs(dr.dot(si.n, ray.d)).numpy()[self.valid].astype(np.float64)
        self.shade = AMBIENT + (1 - AMBIENT) * facing

    def interpolated(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values (n_v,) of vertices at the hits, (n,)."""
        return np.einsum("ik,ik->i", self._barycentric, values[self._corners])

    def covered(self, dots: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Hits (n,) whose ray passes a dot (n_dots, 3) near the surface that it meets."""
        _, near = cKDTree(dots).query(self._points, k=range(1, min(DOTS_NEAR, len(dots)) + 1), workers=-1)
        beside = dots[near] - self._origins[:, None]  # [hit, dot, xyz]
        along = np.einsum("ikx,ix->ik", beside, self._directions)
        aside = np.linalg.norm(beside - along[..., None] * self._directions[:, None], axis=2)
        # a dot behind another part of the surface is further away than a few of its own radii
        apart = np.linalg.norm(dots[near] - self._points[:, None], axis=2)
        size = DOT * self._pixel[:, None]
        return ((aside < size) & (apart < 4 * size)).any(axis=1)


def _rays(sensor: mi.Sensor, width: int, height: int) -> mi.RayDifferential3f:
    """Rays through a regular grid of places in every pixel, row after row."""
    columns, rows = width * SUBPIXELS, height * SUBPIXELS
    index = dr.arange(mi.UInt32, columns * rows)
    y = index // columns
    place = mi.Point2f(mi.Float(index - y * columns) + 0.5, mi.Float(y) + 0.5)
    ray, _ = sensor.sample_ray_differential(0, 0.5, place / mi.Point2f(columns, rows), mi.Point2f(0.5))
    return ray


def _range(values: NDArray[np.float64], vmin: float | None, vmax: float | None) -> tuple[float, float]:
    """First and last value of the colours."""
    finite = values[np.isfinite(values)]
    low = float(finite.min(initial=np.inf)) if vmin is None else vmin
    high = float(finite.max(initial=-np.inf)) if vmax is None else vmax
    return (low, high) if len(finite) or None not in (vmin, vmax) else (0.0, 1.0)


def _coloured(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    """Colours (n, 3) of values (n,)."""
    colormap = matplotlib.colormaps[COLORMAP].with_extremes(bad="0.7")
    scaled = (values - low) / (high - low) if high > low else np.where(np.isfinite(values), 0.5, np.nan)
    return np.asarray(colormap(np.ma.masked_invalid(scaled)))[:, :3]
