"""M R of a camera that stands still, made once: its pixels are sums over vertices, whatever the light ([Leh07] 2.4).

A picture is then one sparse product with the light of vertices and of glossy terms, and a look at the background where
pixels see any: what is dear in a picture, rays and BRDFs, does not depend on the light.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix
from tqdm.auto import tqdm

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.environment import Environment
from mi_sparse_prt.relighting.followed_rays import surfaces_to_follow
from mi_sparse_prt.relighting.image import RelitScene, background_emitter, relit_scene
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

SAMPLES_PER_BLOCK = 1 << 19
STEPS = 2048  # of a reconstruction filter's distribution

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


class FixedCamera:
    """What pixels of a camera see, as a sparse matrix over vertices; pictures under any light then take milliseconds.

    Parameters
    ----------
    scene : Scene
        The scene of the matrix, without mirrors, glass and masks.
    transport : LightTransport
        Of vertices and a cubemap.
    sensor : int or mi.Sensor
    spp : int
        Samples per pixel, rounded up to a square; they are spread as the film's reconstruction filter weights them.
    seed : int
    progress : bool
        Show a progress bar.

    Attributes
    ----------
    size : (int, int)
        Height and width of the pictures: the film's crop window.
    nbytes : int

    Raises
    ------
    PrtError
        If the scene has no such sensor, the matrix belongs to another scene or has no vertices, or rays go on from what
        the camera sees.
    """

    def __init__(
        self,
        scene: Scene,
        transport: LightTransport,
        sensor: int | mi.Sensor = 0,
        spp: int = 16,
        seed: int = 0,
        progress: bool = False,
    ) -> None:
        if spp < 1:
            raise PrtError(f"{spp} samples per pixel: give 1 or more")
        camera, self._transport = scene.sensor(sensor), transport.for_scene(scene)
        if not stands_for_pictures(scene, self._transport):
            raise PrtError(
                "a fixed camera needs a matrix of vertices and a cubemap, and no mirrors, glass, masks or surfaces "
                "without in-out factors, from which rays go on: use render"
            )
        relit = relit_scene(scene, self._transport, np.zeros((transport.emission.size, 3), np.float32))
        width, height = (int(n) for n in camera.film().crop_size())
        self.size = height, width
        rows = _rows(self._transport)
        samples = _Samples(camera, int(np.ceil(np.sqrt(spp))), seed)
        lines = max(1, SAMPLES_PER_BLOCK // (width * samples.spp))
        parts = [
            _block(relit, samples, np.arange(first, min(first + lines, height)), rows)
            for first in tqdm(range(0, height, lines), desc="pixels", unit=" blocks", disable=not progress)
        ]
        self._pixels = _Sums.joined([part[0] for part in parts])
        directions = np.concatenate([part[2] for part in parts], axis=1)
        self._directions = mi.Vector3f(directions)
        each = np.arange(directions.shape[1], dtype=np.int32)
        self._beyond = replace(_Sums.joined([part[1] for part in parts]), places=each)

    @property
    def nbytes(self) -> int:
        return self._pixels.nbytes + self._beyond.nbytes + 12 * len(self._beyond.places)

    def image(
        self, incident: Floats, environment: Environment | mi.Emitter | ArrayLike | None = None
    ) -> Floats:
        """A picture.

        Parameters
        ----------
        incident : (rows, 3) float32
            Light of vertices, and of terms: ``Relighter.incident``, or ``transport.incident.relight(L)``.
        environment : Environment, emitter or (n_directions, 3) float, optional
            The background; black if not given.

        Returns
        -------
        (height, width, 3) float32, linear RGB

        Raises
        ------
        PrtError
            If the light has another number of rows.
        """
        incident = np.ascontiguousarray(incident, np.float32)
        if incident.shape != (self._transport.incident.shape[0], 3):
            raise PrtError(
                f"light has the shape {incident.shape}, this matrix has {self._transport.incident.shape[0]} rows"
            )
        image = self._pixels @ incident
        if environment is not None and len(self._beyond.places):
            image += self._beyond @ self._background(environment)
        return image.reshape(*self.size, 3)

    def _background(self, environment: Any) -> Floats:
        """Radiance (k, 3) where samples leave the scene."""
        emitter = background_emitter(environment, self._transport.lighting)
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = -self._directions
        return np.array(dr.ravel(emitter.eval(si))).reshape(-1, 3)


def stands_for_pictures(scene: Scene, transport: LightTransport) -> bool:
    """Whether pixels are sums over vertices: not for matrices of pixels and lamps, nor where rays go on."""
    if transport.measurement.kind != "vertices" or transport.emission.kind != CubemapLighting.kind:
        return False
    return not (scene.specular or surfaces_to_follow(scene, transport.reflection))


@dataclass(frozen=True)
class _Sums:
    """A sparse matrix by rows, with a value for each channel or one for all.

    Attributes
    ----------
    starts : (n + 1,) int64
    places : (k,) int32
    values : (k, 1 or 3) float32
    """

    starts: Ints
    places: NDArray[np.int32]
    values: Floats

    @staticmethod
    def joined(parts: list[_Sums]) -> _Sums:
        """Rows of all; channels are told apart only if they differ."""
        counts = np.concatenate([np.diff(part.starts) for part in parts])
        values = np.concatenate([part.values for part in parts])
        if (values == values[:, :1]).all():
            values = np.ascontiguousarray(values[:, :1])
        starts = np.concatenate([[0], np.cumsum(counts)])
        return _Sums(starts, np.concatenate([part.places for part in parts]), values)

    @property
    def nbytes(self) -> int:
        return self.starts.nbytes + self.places.nbytes + self.values.nbytes

    def __matmul__(self, colours: Floats) -> Floats:
        return _sums(self.starts, self.places, self.values, colours)


class _Samples:
    """Rays of a camera: around the centre of a pixel, as many where the reconstruction filter is twice as large, twice.

    Parameters
    ----------
    camera : mi.Sensor
        Its film's filter is separable; where it is negative, so are samples.
    strata : int
        Samples of each axis of a pixel.
    seed : int
    """

    def __init__(self, camera: mi.Sensor, strata: int, seed: int) -> None:
        self._camera, self._strata, self._seed, self.spp = camera, strata, seed, strata**2
        rfilter = camera.film().rfilter()
        self._radius = rfilter.radius()
        ends = np.linspace(-self._radius, self._radius, STEPS + 1)
        heights = np.array(rfilter.eval(mi.Float(((ends[1:] + ends[:-1]) / 2).astype(np.float32))))
        self._signs = np.sign(heights).astype(np.float32)
        below = np.concatenate([[0], np.cumsum(np.abs(heights), dtype=np.float64)])
        shares = np.linspace(0, below[-1], STEPS + 1)
        self._places = np.interp(shares, below, ends).astype(np.float32)  # below which such shares lie

    def rays(self, lines: Ints) -> tuple[mi.Ray3f, mi.Point2f, Floats]:
        """Of all pixels of some lines of the picture: rays, random numbers, and weights (rays, rgb)."""
        size, start = np.array(self._camera.film().crop_size()), self._camera.shutter_open()
        random = np.stack(
            [
                np.random.default_rng((self._seed, int(y))).random((size[0], self.spp, 7), np.float32)
                for y in lines
            ]
        )
        offsets, weights = self._places_in_pixels(random[..., :2])
        centre = np.stack(np.meshgrid(np.arange(size[0]), lines), axis=-1) + np.float32(0.5)
        position = ((centre[:, :, None] + offsets) / size).astype(np.float32)  # in the crop window
        moment, *others = np.moveaxis(random[..., 2:].reshape(-1, 5), 1, 0)
        ray, brightness = self._camera.sample_ray(
            mi.Float(start + moment * np.float32(self._camera.shutter_open_time())),
            mi.Float(0.5),
            mi.Point2f(np.ascontiguousarray(position.reshape(-1, 2).T)),
            mi.Point2f(np.ascontiguousarray(others[:2])),
        )
        colour = np.array(brightness + dr.zeros(mi.Color3f, len(moment))).T
        return mi.Ray3f(ray), mi.Point2f(np.ascontiguousarray(others[2:])), weights.reshape(-1, 1) * colour

    def _places_in_pixels(self, random: Floats) -> tuple[Floats, Floats]:
        """Offsets (..., spp, 2), in pixels, and weights (..., spp) whose sum is 1 for each pixel."""
        cell = np.stack(np.divmod(np.arange(self.spp), self._strata), axis=1)
        steps = (cell + random) * np.float32(STEPS / self._strata)
        low = np.minimum(steps.astype(np.int32), STEPS - 1)
        offsets = self._places[low] + (steps - low) * (self._places[low + 1] - self._places[low])
        inside = (offsets / self._radius + 1) * (STEPS / 2)
        signs = self._signs[np.clip(inside.astype(np.int32), 0, STEPS - 1)].prod(axis=-1)
        total = signs.sum(axis=-1, keepdims=True)
        weights = np.divide(signs, total, out=np.full_like(signs, 1 / self.spp), where=total > 0)
        return offsets.astype(np.float32), weights


def _rows(transport: LightTransport) -> Ints:
    """Rows (1 + K, n_v) of vertices, and of their terms; -1 where they have none."""
    n, terms = len(transport.measurement), transport.terms
    rows = np.full((1 + terms, n), -1)
    rows[0] = np.arange(n)
    if terms:
        glossy = transport.reflection.glossy  # their numbers
        rows[1:, glossy] = n + np.arange(len(glossy) * terms).reshape(-1, terms).T
    return rows


def _block(relit: RelitScene, samples: _Samples, lines: Ints, rows: Ints) -> tuple[_Sums, _Sums, Floats]:
    """Sums over vertices and over rays that leave, for some lines, and the directions (3, k) of these rays."""
    ray, u, weights = samples.rays(lines)
    shares, lit, leaves = relit.footprint(ray, u)
    dr.eval(shares, lit, leaves)
    own = np.arange(len(weights)) // samples.spp
    n_pixels = len(weights) // samples.spp
    sums = _collected(shares, np.array(lit), own, weights, rows, n_pixels)
    away = np.flatnonzero(np.array(leaves))
    starts = np.concatenate([[0], np.cumsum(np.bincount(own[away], minlength=n_pixels))])
    beyond = _Sums(starts, np.arange(len(away), dtype=np.int32), weights[away])
    return sums, beyond, np.array(ray.d)[:, away]


def _collected(
    shares: list[Any], lit: NDArray[np.bool_], own: Ints, scale: Floats, rows: Ints, n_pixels: int
) -> _Sums:
    """Shares of samples, summed for each pixel and row of the matrix."""
    at, vertices, values = [], [], []
    seen = np.flatnonzero(lit)
    for term, vertex, weight in shares:
        row, value = rows[term][np.array(vertex)[seen]], np.array(weight).T[seen] * scale[seen]
        kept = (row >= 0) & (value != 0).any(axis=1)
        at.append(own[seen[kept]])
        vertices.append(row[kept])
        values.append(value[kept])
    place = np.concatenate(at), np.concatenate(vertices)
    value = np.concatenate(values)
    channels = [csr_matrix((value[:, c], place), (n_pixels, int(rows.max()) + 1)) for c in range(3)]
    return _Sums(
        channels[0].indptr.astype(np.int64),
        channels[0].indices.astype(np.int32),
        np.stack([channel.data for channel in channels], axis=1).astype(np.float32),
    )


@numba.njit(parallel=True, fastmath=True, cache=True)
def _sums(starts: Ints, places: NDArray[np.int32], values: Floats, colours: Floats) -> Floats:
    """Sparse product with (m, 3)."""
    n, channels = len(starts) - 1, values.shape[1]
    result = np.zeros((n, 3), np.float32)
    for i in numba.prange(n):
        for k in range(starts[i], starts[i + 1]):
            for c in range(3):
                result[i, c] += values[k, c % channels] * colours[places[k], c]
    return result
