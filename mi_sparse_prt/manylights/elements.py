"""The matrix of samples and lights, whose elements are computed when they are asked for ([HPB07] 3.1)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import sgemm

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.manylights.clamping import kept, receiving
from mi_sparse_prt.manylights.light_arrays import DIRECTION, LightArrays, arriving
from mi_sparse_prt.manylights.lights import Lights
from mi_sparse_prt.manylights.samples import Receivers, Samples
from mi_sparse_prt.manylights.surfaces import Surfaces
from mi_sparse_prt.solvers.direct_rays import arriving_share

LANES = 1 << 23  # elements of a kernel: about a fifth of a second
ROWS = 16  # whose projections are added up at a time: sums are the same however many rows a kernel has

Floats = NDArray[np.float32]
Ids = NDArray[np.integer]
Done = Callable[[int], object]  # is told how many rows or columns more are done


class SeenRows(NamedTuple):
    """Rows that are known whole.

    Attributes
    ----------
    ids : (r,) int64
    weights : (r,) float64
        By which elements of each are multiplied.
    sums : (parts, r, 3) float64
        Of the elements of each row and each part of the lights, multiplied.
    """

    ids: NDArray[np.int64]
    weights: NDArray[np.float64]
    sums: NDArray[np.float64]

    def and_others(self, more: SeenRows) -> SeenRows:
        """These, and then those."""
        ids, weights = np.append(self.ids, more.ids), np.append(self.weights, more.weights)
        return SeenRows(ids, weights, np.concatenate([self.sums, more.sums], axis=1))


class ReducedColumns(NamedTuple):
    """Columns of some rows ([HPB07] 3.2), one for each light.

    Attributes
    ----------
    projected : (n, r') float32
        2-norms of RGB, projected; in C's or Fortran's order.
    norms : (n,) float64
        Of the columns before that.
    channel_norms : (n, 3) float64
        Of each channel; (n, 0) where nobody asks for them.
    seen : SeenRows, optional
        The rows; none where they are those of several views.
    """

    projected: Floats
    norms: NDArray[np.float64]
    channel_norms: NDArray[np.float64]
    seen: SeenRows | None = None

    def of_lights(self, ids: Ids) -> ReducedColumns:
        """The columns of some lights."""
        return ReducedColumns(self.projected[ids], self.norms[ids], self.channel_norms[ids])

    def of_part(self, part: int) -> ReducedColumns:
        """Rows as one part of the lights is seen by them."""
        seen = self.seen
        return self._replace(seen=seen and seen._replace(sums=seen.sums[part : part + 1]))


class Representatives(NamedTuple):
    """A column of each cluster: (c,) int64, and what it is multiplied with: (c, 3) float32.

    Or several sets of them, (sets, c) and (sets, c, 3): see ``Elements.sum_columns``.
    """

    ids: NDArray[np.int64]
    weights: Floats


class _Chosen(NamedTuple):
    """Columns and weights on the device, set after set; samples of lanes, and where the columns of each begin."""

    columns: mi.UInt32
    weights: mi.Color3f
    samples: mi.UInt32
    starts: mi.UInt32


class Elements:
    """A[i, j]: the radiance that sample i reflects of light j towards the camera, linear RGB.

    Occlusion rays decide whether there is any, so there is no bias of shadow maps. Light passes masks, thin panes and
    ``null`` surfaces, each of which counts as a bounce.

    Parameters
    ----------
    scene : mi.Scene
    surfaces : Surfaces
        Of the scene.
    samples : Samples
    lights : Lights
    """

    def __init__(self, scene: mi.Scene, surfaces: Surfaces, samples: Samples, lights: Lights) -> None:
        self.scene, self.surfaces, self.samples, self.lights = scene, surfaces, samples, lights
        depth = samples.max_depth
        self.max_depth = depth if depth >= 0 else 1 << 30
        self.clamp = min(lights.clamp, 1e30)
        self.evaluated = 0

    def with_lights(self, lights: Lights) -> Elements:
        """The same samples, and other lights."""
        return Elements(self.scene, self.surfaces, self.samples, lights)

    @property
    def shape(self) -> tuple[int, int]:
        """Samples and lights."""
        return len(self.samples), len(self.lights)

    def block(self, rows: Ids, columns: Ids) -> Floats:
        """Elements (len(rows), len(columns), 3).

        Raises
        ------
        PrtError
            One is not finite.
        """
        rows, columns, k = np.asarray(rows), np.asarray(columns), len(columns)
        found = np.zeros((3, len(rows), k), np.float32)
        i, j = (on_device(mi.UInt32, ids.astype(np.uint32)) for ids in (rows, columns))
        step, width = max(1, LANES // max(k, 1)), dr.opaque(mi.UInt32, max(k, 1))
        for a in range(0, len(rows) if k else 0, step):
            part = rows[a : a + step]
            lane = dr.arange(mi.UInt32, len(part) * k)
            row = dr.gather(mi.UInt32, i, lane // width + dr.opaque(mi.UInt32, a))
            value = self._values(row, dr.gather(mi.UInt32, j, lane % width))
            found[:, a : a + step] = value.numpy().reshape(3, len(part), k)
        values = np.moveaxis(found, 0, 2)
        self._check(values, rows[:, None], columns)
        return values

    def pairs(self, rows: Ids, columns: Ids) -> Floats:
        """Elements (k, 3), one for each pair of a row and a column.

        Raises
        ------
        PrtError
            One is not finite.
        """
        i, j = (on_device(mi.UInt32, np.asarray(ids, np.uint32)) for ids in (rows, columns))
        found = np.ascontiguousarray(self._values(i, j).numpy().T)
        self._check(found, np.asarray(rows), np.asarray(columns))
        return found

    def _values(self, rows: mi.UInt32, columns: mi.UInt32) -> mi.Color3f:
        self.evaluated += dr.width(rows)
        light = self.lights.arrays.take(columns)
        return self.element(self.samples.receivers(rows), light, mi.Mask(True))

    def rows(self, ids: Ids) -> Floats:
        """Whole rows (len(ids), n, 3)."""
        return self.block(ids, np.arange(self.shape[1]))

    def columns(self, ids: Ids) -> Floats:
        """Whole columns (m, len(ids), 3)."""
        return self.block(np.arange(self.shape[0]), ids)

    def sum_columns(self, ids: Ids, weights: Floats, done: Done = lambda _: None) -> Floats:
        """Sums (m, 3) of columns, each times its colour, without keeping any.

        Parameters
        ----------
        ids : (k,) or (sets, k) integers
            Columns; where there are several sets of them, those of a pixel's samples in turn.
        weights : (k, 3) or (sets, k, 3) float32
        done : callable

        Raises
        ------
        PrtError
            An element is not finite: sample and light are named.
        """
        m, count = len(self.samples), np.shape(ids)[-1]
        if not m or not count:
            return np.zeros((m, 3), np.float32)
        chosen, total = self._chosen(ids, weights), dr.zeros(mi.Color3f, m)
        for first, size in _pieces(count, max(1, LANES // m)):
            total = self._accumulated(total, chosen, first, size)
            dr.eval(total)
            dr.sync_thread()  # so that progress is that of rays
            done(size)
        self.evaluated += m * count
        return self._by_sample(total, chosen, np.unique(ids))

    def sum_of_rows(self, ids: Ids) -> Floats:
        """Sums (len(ids), 3) of all elements of rows, in double precision."""
        n, count = len(self.lights), len(ids)
        chosen = _on_device(np.arange(n), np.ones((n, 3), np.float32), np.asarray(ids))
        found = np.zeros((count, 3))
        for start, size in _pieces(n, max(1, LANES // max(count, 1))):
            part = self._accumulated(dr.zeros(mi.Color3f, count), chosen, start, size)
            found += part.numpy().T
        self.evaluated += n * count
        self._check_sum(found.astype(np.float32), np.arange(n), np.asarray(ids))
        return found.astype(np.float32)

    def each_column(self, ids: Ids, weights: Floats, done: Done = lambda _: None) -> Iterator[Floats]:
        """The columns (m, 3) that ``sum_columns`` adds up, one after the other."""
        m, total = len(self.samples), np.shape(ids)[-1]
        chosen = self._chosen(ids, weights)
        for first, count in _pieces(total, max(1, LANES // max(m, 1))):
            found = self._kept(chosen, first, count).numpy().reshape(3, count, m)
            self.evaluated += m * count
            done(count)
            for k in range(count):
                values = np.ascontiguousarray(found[:, k].T)
                self._check_sum(values, np.unique(ids))
                yield values

    def squared_differences(self, ids: Ids, weights: Floats, rows: Ids) -> NDArray[np.float64]:
        """How far apart pairs of columns are: squares (k,) of differences, of the means of some pixels, all channels.

        Parameters
        ----------
        ids : (sets, 2 k) integers
            Both columns of a pair follow each other.
        weights : (sets, 2 k, 3) float32
        rows : (r,) integers
            All of each of these pixels, ascending.
        """
        sets, total = ids.shape
        own = self.samples.ids[rows] % sets
        order = np.argsort(own, kind="stable")
        chosen = _on_device(ids, weights, rows[order], own[order] * total)
        place, squares = on_device(mi.UInt32, order.astype(np.uint32)), np.zeros(total // 2)
        dr.eval(place)
        for a in range(0, len(squares), step := max(1, LANES // len(rows))):
            count = min(step, len(squares) - a)
            found = self._differences(chosen, place, a, count).numpy().reshape(3, count, len(rows))
            means = self.samples.pixel_means(found, rows)
            squares[a : a + count] = np.square(means, dtype=np.float64).sum(axis=(0, 2))
        self.evaluated += len(rows) * total
        return squares

    def reduce_columns(
        self,
        rows: Ids,
        projection: Floats,
        done: Done = lambda _: None,
        weights: NDArray[np.float64] | None = None,
        parts: Ids | None = None,
    ) -> ReducedColumns:
        """All columns at some rows, projected as soon as they are known ([HPB07] 4).

        Parameters
        ----------
        rows : (r,) integers
        projection : (r, r') float32
        done : callable
        weights : (r,) float64, optional
            By which elements of each row are multiplied; 1 if not given.
        parts : (n,) integers, optional
            From 0, of each light: sums of rows are those of each part. All are in one if not given.

        Raises
        ------
        PrtError
            An element is not finite: sample and light are named.
        """
        n, weights = len(self.lights), np.ones(len(rows)) if weights is None else weights
        projected = np.zeros((n, projection.shape[1]), np.float32, order="F")  # so that BLAS adds to it
        sums = _PartSums(parts, n, len(rows))
        squares = [dr.zeros(mi.Float, n) for _ in range(3)]
        if n and len(rows):
            receivers = self.samples.receivers(on_device(mi.UInt32, np.asarray(rows, np.uint32)))
            receivers.weight *= on_device(mi.Float, weights.astype(np.float32))
            dr.eval(receivers)
        step = max(1, LANES // max(n, 1) // ROWS) * ROWS
        for a in range(0, len(rows) if n else 0, step):
            count = min(step, len(rows) - a)
            values, norms, squares = self._norms(receivers, a, count, squares)
            block = norms.numpy().reshape(count, n)
            self._check_rows(block, np.asarray(rows)[a : a + count])
            sums.add(a, values.numpy().reshape(3, count, n))
            for b in range(0, count, ROWS):
                own = slice(b, min(b + ROWS, count))
                add_product(block[own].T, projection[a + own.start : a + own.stop], projected)
            done(count)
        self.evaluated += n * len(rows)
        channels = np.stack([square.numpy() for square in squares], axis=1).astype(np.float64)
        seen = SeenRows(np.asarray(rows, np.int64), weights, sums.found)
        return ReducedColumns(projected, np.sqrt(channels.sum(axis=1)), np.sqrt(channels), seen)

    def element(self, at: Receivers, light: LightArrays, active: mi.Mask) -> mi.Color3f:
        """Radiance of one light at one sample in each lane."""
        value, direction, active = self.unshadowed(at, light, active)
        return self.shadowed(at, light, value, direction, active)

    def unshadowed(
        self, at: Receivers, light: LightArrays, active: mi.Mask
    ) -> tuple[mi.Color3f, mi.Vector3f, mi.Mask]:
        """As if nothing was between; the direction towards the light, and in which lanes there is any.

        The geometry term of indirect lights is at most ``lights.clamp``, times what either BSDF has more than a white
        diffuse one.
        """
        active = active & (light.depth + at.depth <= dr.opaque(mi.UInt32, self.max_depth))
        found = arriving(light, at.si.p, self.lights.kinds, active)
        out = at.si.to_local(found.direction)
        cosine = mi.Frame3f.cos_theta(out)
        above = cosine * mi.Frame3f.cos_theta(at.si.wi) > 0
        value, largest = dr.select(at.diffuse & above, dr.abs(cosine), 0) * at.weight, dr.abs(cosine)
        if not self.surfaces.all_lambertian:
            own = active & ~at.diffuse & ~dr.all(found.irradiance == 0)
            bsdf = at.si.bsdf().eval(mi.BSDFContext(), at.si, out, own)
            value = dr.select(at.diffuse, value, bsdf * at.weight)
            largest = receiving(largest, dr.select(own, bsdf, 0))
        clamp = dr.opaque(mi.Float, self.clamp)
        scale = dr.select(light.depth > 2, kept(largest, found.cosine, clamp), 1)
        value *= found.irradiance * scale
        return value, found.direction, active & ~dr.all(value == 0)  # NaN is lit, so that it is noticed

    def shadowed(
        self,
        at: Receivers,
        light: LightArrays,
        value: mi.Color3f,
        direction: mi.Vector3f,
        active: mi.Mask,
    ) -> mi.Color3f:
        """What of a light's radiance nothing is in the way of."""

        def towards(si: mi.SurfaceInteraction3f) -> mi.Ray3f:
            ray, near = si.spawn_ray(direction), si.spawn_ray_to(light.place)
            far = light.kind == DIRECTION
            return mi.Ray3f(
                ray.o,
                dr.select(far, ray.d, near.d),
                dr.select(far, ray.maxt, near.maxt),
                ray.time,
                ray.wavelengths,
            )

        most = dr.opaque(mi.UInt32, self.max_depth) - light.depth - at.depth
        passes = self.surfaces.passes_straight
        share, _ = arriving_share(self.scene, towards(at.si), active, passes, most, towards)
        return dr.select(active & (dr.max(share) > 0), value * share, 0)

    @dr.syntax
    def _accumulated(self, total: mi.Color3f, chosen: _Chosen, first: mi.UInt32, count: int) -> mi.Color3f:
        """A lane for each sample; the lights are a loop inside of the kernel."""
        at = self.samples.receivers(chosen.samples)
        total, k, last = mi.Color3f(total), mi.UInt32(first), first + dr.opaque(mi.UInt32, count)
        while k < last:
            light = self.lights.arrays.take(dr.gather(mi.UInt32, chosen.columns, chosen.starts + k))
            factor = dr.gather(mi.Color3f, chosen.weights, chosen.starts + k)
            total += factor * self.element(at, light, mi.Mask(True))
            k += 1
        return total

    @dr.syntax
    def _kept(self, chosen: _Chosen, first: mi.UInt32, count: int) -> mi.Color3f:
        """The same, each light's values after those of the one before: (count * m)."""
        m = len(self.samples)
        at, start = self.samples.receivers(chosen.samples), chosen.starts + first
        found, rows = dr.zeros(mi.Color3f, m * count), dr.opaque(mi.UInt32, m)
        k, last = dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, count)
        while k < last:
            light = self.lights.arrays.take(dr.gather(mi.UInt32, chosen.columns, start + k))
            factor = dr.gather(mi.Color3f, chosen.weights, start + k)
            dr.scatter(found, factor * self.element(at, light, mi.Mask(True)), k * rows + chosen.samples)
            k += 1
        dr.eval(found)
        return found

    @dr.syntax
    def _differences(self, chosen: _Chosen, place: mi.UInt32, first: int, count: int) -> mi.Color3f:
        """Of pairs of columns, each pair's after those of the one before (count * rows), rows at their places."""
        at, start = self.samples.receivers(chosen.samples), chosen.starts + dr.opaque(mi.UInt32, 2 * first)
        apart, rows = dr.zeros(mi.Color3f, dr.width(place) * count), dr.opaque(mi.UInt32, dr.width(place))
        k, last, before = dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, 2 * count), mi.Color3f(0)
        while k < last:
            light = self.lights.arrays.take(dr.gather(mi.UInt32, chosen.columns, start + k))
            value = dr.gather(mi.Color3f, chosen.weights, start + k) * self.element(at, light, mi.Mask(True))
            dr.scatter(apart, before - value, (k >> 1) * rows + place, (k & 1) == 1)
            before = mi.Color3f(value)
            k += 1
        dr.eval(apart)
        return apart

    @dr.syntax
    def _norms(
        self, receivers: Receivers, first: int, count: int, squares: list[mi.Float]
    ) -> tuple[mi.Color3f, mi.Float, list[mi.Float]]:
        """A lane for each light, some samples one after the other: elements and norms (count * n), squares (n,)."""
        n = len(self.lights)
        lane = dr.arange(mi.UInt32, n)
        light = self.lights.arrays.take(lane)
        values, norms = dr.zeros(mi.Color3f, n * count), dr.zeros(mi.Float, n * count)
        columns = dr.opaque(mi.UInt32, n)
        x, y, z = (mi.Float(square) for square in squares)
        k, row = dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, first)
        last = dr.opaque(mi.UInt32, count)
        while k < last:
            value = self.element(receivers.take(row + k), light, mi.Mask(True))
            dr.scatter(values, value, k * columns + lane)
            dr.scatter(norms, dr.norm(value), k * columns + lane)
            x += dr.square(value.x)
            y += dr.square(value.y)
            z += dr.square(value.z)
            k += 1
        dr.eval(values, norms, x, y, z)
        return values, norms, [x, y, z]

    def _chosen(self, ids: Ids, weights: Floats) -> _Chosen:
        """For all samples, those of a set after each other, so that neighbours ask for the same light."""
        sets, count = np.shape(np.atleast_2d(ids))
        own = self.samples.ids % sets
        samples = np.argsort(own, kind="stable")
        return _on_device(ids, weights, samples, own[samples] * count)

    def _by_sample(self, total: mi.Color3f, chosen: _Chosen, columns: Ids) -> Floats:
        """Sums (m, 3) in the order of samples."""
        found = np.empty((len(self.samples), 3), np.float32)
        found[chosen.samples.numpy()] = total.numpy().T
        self._check_sum(found, columns)
        return found

    def _check_sum(self, found: Floats, columns: Ids, rows: Ids | None = None) -> None:
        if not np.isfinite(found).all():
            bad = np.flatnonzero(~np.isfinite(found).all(axis=1))
            self.block(bad[:1] if rows is None else rows[bad[:1]], columns)  # names it

    def _check_rows(self, norms: Floats, rows: Ids) -> None:
        bad = np.flatnonzero(~np.isfinite(norms).all(axis=1))
        if len(bad):
            self.block(rows[bad[:1]], np.flatnonzero(~np.isfinite(norms[bad[0]])))

    def _check(self, values: Floats, rows: Ids, columns: Ids) -> None:
        if np.isfinite(values).all():
            return
        bad = tuple(np.argwhere(~np.isfinite(values).all(axis=-1))[0])
        i, j = (int(np.broadcast_to(ids, values.shape[:-1])[bad]) for ids in (rows, columns))
        raise PrtError(
            f"{self.samples.name(i)} reflects light that is not finite of {self.lights.name(j)}: repair its BSDF"
        )


def add_product(a: Floats, b: Floats, total: Floats) -> None:
    """Add a @ b to an array in Fortran's order, without copies."""
    if total.size:
        sgemm(1.0, a, b, beta=1.0, c=total, overwrite_c=True)


class _PartSums:
    """Sums of rows (parts, rows, 3), block by block; lights are in parts, or all in one."""

    def __init__(self, parts: Ids | None, n: int, rows: int) -> None:
        self._order = None if parts is None else np.argsort(parts, kind="stable")
        sizes = np.array([n]) if parts is None else np.bincount(parts)
        self._own = np.flatnonzero(sizes)
        self._starts = (np.cumsum(sizes) - sizes)[self._own]
        self.found = np.zeros((len(sizes), rows, 3))

    def add(self, first: int, values: Floats) -> None:
        """Of a block of rows (3, count, n)."""
        channels, count, n = values.shape
        if self._order is None:
            sums = values.sum(axis=2)
        else:
            sums = np.add.reduceat(values[..., self._order], self._starts, axis=2)
        found = sums.reshape(channels, count, len(self._own)).transpose(2, 1, 0)
        self.found[self._own, first : first + count] = found


def _pieces(count: int, size: int) -> Iterator[tuple[mi.UInt32, int]]:
    """First numbers and lengths of pieces; kernels are the same for all."""
    for first in range(0, count, size):
        yield dr.opaque(mi.UInt32, first), min(size, count - first)


def _on_device(ids: Ids, weights: Floats, samples: Ids, starts: Ids | None = None) -> _Chosen:
    colours = np.ascontiguousarray(np.asarray(weights, np.float32).reshape(-1, 3).T)
    first = np.zeros(len(samples)) if starts is None else starts
    columns, lanes, places = (
        on_device(mi.UInt32, np.ravel(x).astype(np.uint32)) for x in (ids, samples, first)
    )
    factors = mi.Color3f(colours)
    dr.eval(columns, factors, lanes, places)  # or kernels know how many there are, and serve nothing else
    return _Chosen(columns, factors, lanes, places)
