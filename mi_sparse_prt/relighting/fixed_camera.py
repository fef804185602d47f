"""M R of a camera that stands still, made once: its pixels are sums over vertices, whatever the light ([Leh07] 2.4).

A picture is then one sparse product with the light of vertices and of glossy terms, and a look at the background where
pixels see any: what is dear in a picture, rays and BRDFs, does not depend on the light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.threads import run_overlapped
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
        bar = tqdm(range(0, height, lines), desc="pixels", unit=" blocks", disable=not progress)
        blocks = (_block(relit, samples, np.arange(a, min(a + lines, height)), rows) for a in bar)
        parts = list(run_overlapped(blocks))
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
        steps = (cell.astype(np.float32) + random) * np.float32(STEPS / self._strata)
        low = np.minimum(steps.astype(np.int32), STEPS - 1)
        offsets = self._places[low] + (steps - low) * (self._places[low + 1] - self._places[low])
        if (self._signs > 0).all():
            return offsets.astype(np.float32), np.full(offsets.shape[:-1], 1 / self.spp, np.float32)
        inside = (offsets / np.float32(self._radius) + 1) * np.float32(STEPS / 2)
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


def _block(
    relit: RelitScene, samples: _Samples, lines: Ints, rows: Ints
) -> Callable[[], tuple[_Sums, _Sums, Floats]]:
    """Sums over vertices and over rays that leave, for some lines, and the directions (3, k) of these rays.

    What is left to do is a call, which needs no Dr.Jit.
    """
    ray, u, weights = samples.rays(lines)
    shares, lit, leaves = relit.footprint(ray, u)
    dr.eval(shares, lit, leaves)
    away = np.flatnonzero(np.array(leaves))
    directions = np.array(ray.d)[:, away]
    corners = list({id(vertex): vertex for _, vertex, _ in shares}.values())
    known = np.stack([np.array(vertex) for vertex in corners]), np.array(lit)
    values = np.empty((len(corners), len(rows), 3, len(weights)), np.float32)
    for term, vertex, weight in shares:
        corner = next(k for k, some in enumerate(corners) if some is vertex)
        values[corner, term] = np.array(weight)

    def collect() -> tuple[_Sums, _Sums, Floats]:
        n_pixels = len(weights) // samples.spp
        sums = _Sums(*_collected(*known, values, weights, rows, samples.spp))
        starts = np.concatenate([[0], np.cumsum(np.bincount(away // samples.spp, minlength=n_pixels))])
        return sums, _Sums(starts, np.arange(len(away), dtype=np.int32), weights[away]), directions

    return collect


@numba.njit(nogil=True, cache=True)
def _collected(
    vertices: NDArray[np.uint32], lit: NDArray[np.bool_], values: Floats, scale: Floats, rows: Ints, spp: int
) -> tuple[Ints, NDArray[np.int32], Floats]:
    """Shares of samples, summed for each pixel and row of the matrix: starts, places and values of ``_Sums``.

    Parameters
    ----------
    vertices : (corners, samples) uint32
    lit : (samples,) bool
    values : (corners, 1 + K, 3, samples) float32
    scale : (samples, 3) float32
    rows : (1 + K, n_v) int64
        -1 where a vertex has no such row.
    spp : int
    """
    corners, terms = values.shape[0], values.shape[1]
    n_pixels = len(lit) // spp
    starts, size = np.zeros(n_pixels + 1, np.int64), 0
    places, found = np.empty(16 * n_pixels, np.int32), np.empty((16 * n_pixels, 3), np.float32)
    known, sums = np.empty(corners * spp, np.int64), np.empty((corners * spp, terms, 3), np.float32)
    for pixel in range(n_pixels):
        count = 0
        for i in range(pixel * spp, (pixel + 1) * spp):
            if not lit[i]:
                continue
            for corner in range(corners):
                vertex = np.int64(vertices[corner, i])
                at = count - 1
                while at >= 0 and known[at] != vertex:  # few, and the last ones are likely
                    at -= 1
                if at < 0:
                    at, count = count, count + 1
                    known[at], sums[at] = vertex, 0
                for term in range(terms):
                    for c in range(3):
                        sums[at, term, c] += values[corner, term, c, i] * scale[i, c]
        if size + count * terms > len(places):
            more = len(places) + count * terms
            places = np.concatenate((places, np.empty(more, np.int32)))
            found = np.concatenate((found, np.empty((more, 3), np.float32)))
        for at in range(count):
            for term in range(terms):
                row, value = rows[term, known[at]], sums[at, term]
                if row >= 0 and (value[0] != 0 or value[1] != 0 or value[2] != 0):
                    places[size], found[size] = row, value
                    size += 1
        starts[pixel + 1] = size
    return starts, places[:size].copy(), found[:size].copy()


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
