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
from mi_sparse_prt.emission.environment import Environment
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
        if transport.measurement.kind != "vertices" or transport.emission.kind != "cubemap":
            raise PrtError("a fixed camera needs a matrix of vertices and a cubemap: use render")
        relit = relit_scene(scene, self._transport, np.zeros((transport.emission.size, 3), np.float32))
        if relit.goes_on:
            raise PrtError(
                "rays go on from mirrors, glass, masks or surfaces without in-out factors: use render"
            )
        width, height = (int(n) for n in camera.film().crop_size())
        self.size = height, width
        rows = _rows(self._transport)
        strata = int(np.ceil(np.sqrt(spp)))
        offsets = _Filter(camera.film().rfilter(), strata)
        step = max(1, SAMPLES_PER_BLOCK // strata**2)
        blocks = range(0, height * width, step)
        parts = [
            _block(relit, camera, offsets, np.arange(first, min(first + step, height * width)), rows, seed)
            for first in tqdm(blocks, desc="pixels", unit=" blocks", disable=not progress)
        ]
        self._pixels = _Sums.joined([part[0] for part in parts])
        self._directions = np.concatenate([part[2] for part in parts])
        each = np.arange(len(self._directions), dtype=np.int32)
        self._beyond = replace(_Sums.joined([part[1] for part in parts]), places=each)

    @property
    def nbytes(self) -> int:
        return self._pixels.nbytes + self._beyond.nbytes + self._directions.nbytes

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
        if environment is not None and len(self._directions):
            image += self._beyond @ self._background(environment)
        return image.reshape(*self.size, 3)

    def _background(self, environment: Any) -> Floats:
        """Radiance (k, 3) in the directions in which samples leave the scene."""
        emitter = background_emitter(environment, self._transport.lighting)
        si = dr.zeros(mi.SurfaceInteraction3f, len(self._directions))
        si.wi = -mi.Vector3f(np.ascontiguousarray(self._directions.T))
        return np.ascontiguousarray(np.array(emitter.eval(si)).T)


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


class _Filter:
    """Places of samples around the centre of a pixel, as many where a reconstruction filter is twice as large, twice.

    Parameters
    ----------
    rfilter : mi.ReconstructionFilter
        Separable; where it is negative, so are samples.
    strata : int
        Samples of each axis.
    """

    def __init__(self, rfilter: mi.ReconstructionFilter, strata: int) -> None:
        radius = rfilter.radius()
        ends = np.linspace(-radius, radius, STEPS + 1)
        heights = np.array(rfilter.eval(mi.Float(((ends[1:] + ends[:-1]) / 2).astype(np.float32))))
        self._ends, self._signs = ends, np.sign(heights)
        self._cdf = np.concatenate([[0], np.cumsum(np.abs(heights), dtype=np.float64)])
        self.strata = strata

    def samples(self, pixels: int, random: np.random.Generator) -> tuple[Floats, Floats]:
        """Offsets (pixels, spp, 2), in pixels, and weights (pixels, spp) whose sum is 1 for each pixel."""
        k, n = self.strata, self.strata**2
        jitter = random.random((pixels, n, 2))
        cell = np.stack(np.divmod(np.arange(n), k), axis=1)
        shares = (cell + jitter) / k * self._cdf[-1]
        offsets = np.interp(shares, self._cdf, self._ends)
        step = np.clip(np.searchsorted(self._ends, offsets, "right") - 1, 0, STEPS - 1)
        signs = self._signs[step].prod(axis=2)
        total = signs.sum(axis=1, keepdims=True)
        weights = np.divide(signs, total, out=np.full_like(signs, 1 / n), where=total > 0)
        return offsets.astype(np.float32), weights.astype(np.float32)


def _rows(transport: LightTransport) -> Ints:
    """Rows (1 + K, n_v) of vertices, and of their terms; -1 where they have none."""
    n, terms = len(transport.measurement), transport.terms
    rows = np.full((1 + terms, n), -1)
    rows[0] = np.arange(n)
    if terms:
        glossy = np.flatnonzero(transport.reflection.glossy)
        rows[1:, glossy] = n + np.arange(len(glossy) * terms).reshape(-1, terms).T
    return rows


def _block(
    relit: RelitScene, camera: mi.Sensor, offsets: _Filter, pixels: Ints, rows: Ints, seed: int
) -> tuple[_Sums, _Sums, Floats]:
    """Sums over vertices and over rays that leave, for some pixels, and the directions of these rays."""
    random = np.random.default_rng((seed, int(pixels[0])))
    spp = offsets.strata**2
    places, weights = offsets.samples(len(pixels), random)
    size = np.array(camera.film().crop_size())  # a camera's positions are those in its crop window
    corner = np.stack([pixels % size[0], pixels // size[0]], axis=1)[:, None]
    position = ((corner + 0.5 + places) / size).reshape(-1, 2).astype(np.float32)
    moment = np.float32(camera.shutter_open()) + random.random(len(position), np.float32) * np.float32(
        camera.shutter_open_time()
    )
    lens, u = random.random((2, 2, len(position)), np.float32)
    ray, brightness = camera.sample_ray(
        mi.Float(moment), mi.Float(0.5), mi.Point2f(np.ascontiguousarray(position.T)), mi.Point2f(lens)
    )
    shares, lit, leaves = relit.footprint(mi.Ray3f(ray), mi.Point2f(u))
    dr.eval(shares, lit, leaves, brightness)
    own = np.repeat(np.arange(len(pixels)), spp)
    scale = weights.reshape(-1, 1) * np.array(brightness + dr.zeros(mi.Color3f, len(own))).T
    sums = _collected(shares, np.array(lit), own, scale, rows, len(pixels))
    away = np.flatnonzero(np.array(leaves))
    starts = np.concatenate([[0], np.cumsum(np.bincount(own[away], minlength=len(pixels)))])
    beyond = _Sums(starts, np.arange(len(away), dtype=np.int32), scale[away])
    return sums, beyond, np.array(ray.d).T[away]


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
