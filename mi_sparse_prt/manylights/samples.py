"""What a camera sees: places on surfaces whose light is asked for, and light that it sees without asking."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.morton import morton_order
from mi_sparse_prt.core.random_keys import random_generator
from mi_sparse_prt.manylights.particles import next_2d
from mi_sparse_prt.manylights.surfaces import BENT, Surfaces, diffuse_value
from mi_sparse_prt.measurement.pixels import jittered_places
from mi_sparse_prt.scene.instances import placed_shapes
from mi_sparse_prt.scene.materials import single_direction

LONGEST = 64  # surfaces that a ray meets, where ``max_depth`` sets no limit
_CAMERA, _COATS = 0x5A17, 0x5A18  # keys of random numbers

Floats = NDArray[np.float32]
Ids = NDArray[np.int64]


@dataclass
class Receivers:
    """Places on surfaces that light arrives at, an array for each attribute (Dr.Jit).

    Attributes
    ----------
    si : SurfaceInteraction3f
    weight : Color3f
        Share of the light that the camera sees by way of mirrors and glass; of diffuse surfaces times their BSDF.
    diffuse : Mask
    depth : UInt32
        Mirrors, panes and holes on the way.
    """

    si: Any
    weight: Any
    diffuse: Any
    depth: Any

    def take(self, ids: mi.UInt32, active: mi.Mask = True) -> Receivers:
        """Some of them."""
        return dr.gather(Receivers, self, ids, active)


class Samples:
    """Samples of a film's pixels: the rows of the matrix.

    Rays of the camera follow mirrors, glass and holes up to the first surface that also does something else; there the
    sample is. Those that leave the scene, or end on the way, have no row. Where that surface reflects into single
    directions as well (plastic, a coat), one sample of each pixel has a second row, of what is seen by way of these: it
    counts as if all had one.

    Parameters
    ----------
    scene : mi.Scene
    surfaces : Surfaces
        Of the scene.
    sensor : mi.Sensor
        Its film has the size (crop window) and the reconstruction filter.
    spp : int
        Samples per pixel, stratified: 4 are 2 x 2.
    max_depth : int
        As for ``path``.
    seed : int
    apart : bool
        Tell apart what is seen of each emitter.

    Attributes
    ----------
    shape : tuple of int
        (height, width) of the image.
    ids : (m,) int64
        The sample of each row, ascending, pixel by pixel.
    seen : (n_samples, 3) float32
        Radiance that each sees without reflection, of lamps and of the environment.
    seen_of : dict of int to (n_samples, 3) float32
        Of ``apart``: what ``seen`` is the sum of, by the numbers of the scene's emitters; of those that are seen.

    Raises
    ------
    PrtError
        If there is to be less than one sample per pixel.
    """

    def __init__(
        self,
        scene: mi.Scene,
        surfaces: Surfaces,
        sensor: mi.Sensor,
        spp: int,
        max_depth: int,
        seed: int,
        apart: bool = False,
    ) -> None:
        film = sensor.film()
        width, height = (int(n) for n in film.crop_size())
        self.shape, self.spp, self.max_depth = (height, width), spp, max_depth
        self._places, self._rfilter = jittered_places(width, height, spp, seed), film.rfilter()
        self._scene = scene
        ray, weight, rng = _camera_rays(sensor, self._places, seed)
        limit = dr.opaque(mi.UInt32, max_depth if 0 <= max_depth < LONGEST else LONGEST)
        sample, coats = _lanes(width * height, spp, seed, surfaces.coated)
        lane, by_coats = on_device(mi.UInt32, sample.astype(np.uint32)), on_device(mi.Bool, coats)
        ray, weight, rng = (dr.gather(type(x), x, lane) for x in (ray, weight, rng))
        weight *= dr.select(by_coats, mi.Float(spp), 1)
        sums = _SeenOf(scene, lane, width * height * spp) if apart else None
        note = sums.add if sums else lambda *_: None
        seen, ray, hit, weight, depth, found = _follow(scene, ray, weight, rng, limit, by_coats, note)
        dr.eval(seen, ray, hit, weight, depth, found)
        self.seen: Floats = seen.numpy().T[~coats]
        self.covered = found.numpy()[~coats] | (self.seen > 0).any(axis=1)
        self.seen[sample[coats]] += seen.numpy().T[coats]
        self.seen_of = sums.found() if sums else {}
        index = dr.compress(found)
        self.ids = sample[index.numpy()]
        if len(self.ids):
            ray, hit, weight, depth = (dr.gather(type(x), x, index) for x in (ray, hit, weight, depth))
            self._hit, self._ray, self._depth = hit, ray, depth
            si = hit.compute_surface_interaction(ray)
            self._diffuse = surfaces.lambertian(si)
            self._weight = weight * dr.select(self._diffuse, diffuse_value(si, self._diffuse), 1)
            dr.eval(self._hit, self._ray, self._depth, self._diffuse, self._weight)

    def __len__(self) -> int:
        return len(self.ids)

    def receivers(self, ids: mi.UInt32) -> Receivers:
        """Samples on the device, by their rows."""
        ray, hit = dr.gather(mi.Ray3f, self._ray, ids), dr.gather(type(self._hit), self._hit, ids)
        return Receivers(
            hit.compute_surface_interaction(ray),
            dr.gather(mi.Color3f, self._weight, ids),
            dr.gather(mi.Bool, self._diffuse, ids),
            dr.gather(mi.UInt32, self._depth, ids),
        )

    def name(self, row: int) -> str:
        """Where a sample is, for messages."""
        y, x = divmod(int(self.ids[row]) // self.spp, self.shape[1])
        met = dr.gather(mi.ShapePtr, self._hit.shape, mi.UInt32(row))
        found = (w.name for w in placed_shapes(self._scene) if dr.all(met == mi.ShapePtr(w.shape)))
        return f"shape '{next(found, 'of an instance')}' (pixel {x}, {y})"

    def image(self, values: Floats) -> Floats:
        """The image (height, width, 3) of the radiance (m, 3) of rows, and of what samples see besides."""
        return self._image(values, self.seen.copy())

    def image_of(self, number: int, values: Floats) -> Floats:
        """``image`` of one emitter alone."""
        seen = self.seen_of.get(number)
        return self._image(values, np.zeros_like(self.seen) if seen is None else seen.copy())

    def _image(self, values: Floats, every: Floats) -> Floats:
        np.add.at(every, self.ids, values)
        return self.filtered(every)

    def filtered(self, every: Floats) -> Floats:
        """Pixels (height, width, channels) of values (n_samples, channels), by the reconstruction filter."""
        height, width = self.shape
        reach = int(np.ceil(self._rfilter.radius() - 0.5))
        values = np.append(every, np.ones_like(every[:, :1]), axis=1)  # the last channel: sums of weights
        values = values.reshape(height, width, self.spp, -1)
        away = self._places.reshape(height, width, self.spp, 2) % 1 - np.float32(0.5)
        # filters are separable: of each offset along an axis, what it weighs
        x, y = ([self._rfilter_at(away[..., k], d) for d in range(-reach, reach + 1)] for k in range(2))
        total = np.zeros((height + 2 * reach, width + 2 * reach, values.shape[-1]), np.float32)
        for j, along_y in enumerate(y):
            for i, along_x in enumerate(x):
                weighted = np.einsum("yxs,yxsc->yxc", along_x * along_y, values)
                total[j : j + height, i : i + width] += weighted
        kept = total[reach : reach + height, reach : reach + width]
        scale = np.divide(1, kept[..., -1:], out=np.zeros_like(kept[..., -1:]), where=kept[..., -1:] != 0)
        return kept[..., :-1] * scale

    def _rfilter_at(self, away: Floats, offset: int) -> Floats:
        """The filter around the centre of another pixel of a row or column."""
        at = on_device(mi.Float, (away - np.float32(offset)).ravel())
        return np.asarray(self._rfilter.eval(at).numpy(), np.float32).reshape(away.shape)

    def pixel_means(self, values: Floats, rows: NDArray[np.integer]) -> Floats:
        """Means (..., pixels) of what rows add to their pixels, (..., r); rows ascend."""
        first = np.unique(self.ids[rows] // self.spp, return_index=True)[1]
        sums: Floats = np.add.reduceat(values, first, axis=-1, dtype=np.float32)
        return sums / np.float32(self.spp)

    def rows_of_pixels(self, count: int, rng: np.random.Generator) -> tuple[Ids, float]:
        """All rows of pixels at random, ascending, and of how many pixels each of these is one.

        Parameters
        ----------
        count : int
            Pixels, at most, of those that have rows.
        rng : np.random.Generator
        """
        pixel = self.ids // self.spp
        every = pixel[np.flatnonzero(np.diff(pixel, prepend=-1))]  # ascending, as rows are
        chosen = rng.choice(every, min(count, len(every)), replace=False)
        return np.flatnonzero(np.isin(pixel, chosen)), len(every) / max(len(chosen), 1)

    @cached_property
    def _along_curve(self) -> NDArray[np.int64]:
        y, x = np.divmod(self.ids // self.spp, self.shape[1])
        place = np.stack([x, y, np.zeros_like(x)], axis=1)
        return morton_order(place, np.arange(len(self), dtype=np.uint64))

    def stratified_rows(self, count: int, seed: int) -> NDArray[np.int64]:
        """Rows in blocks of the image, one at random in each ([HPB07] 4): as many pieces of a curve through the pixels.

        Parameters
        ----------
        count : int
        seed : int

        Returns
        -------
        (min(count, m),) int64
            Ascending along the curve.
        """
        order, count = self._along_curve, min(count, len(self))
        u = np.random.default_rng([seed, _CAMERA]).random(count)
        at = ((np.arange(count) + u) * (len(self) / max(count, 1))).astype(np.int64)
        return order[np.minimum(at, len(self) - 1)]


class _SeenOf:
    """Sums of the radiance that samples see of each emitter.

    Parameters
    ----------
    scene : mi.Scene
    sample : UInt32
        Of each ray.
    count : int
        Samples.
    """

    def __init__(self, scene: mi.Scene, sample: mi.UInt32, count: int) -> None:
        emitters, on_device = scene.emitters(), scene.emitters_dr()
        self._emitters = [
            k for k, e in enumerate(emitters) if not mi.has_flag(e.flags(), mi.EmitterFlags.Delta)
        ]
        self._sample, self._count, self._place = sample, count, mi.UInt32(0)
        if emitters:  # from what Dr.Jit calls an emitter to its place in the sums
            ids = dr.reinterpret_array(mi.UInt32, on_device).numpy()[self._emitters]
            place = np.zeros(ids.max(initial=0) + 1, np.uint32)
            place[ids] = np.arange(len(ids))
            self._place = mi.UInt32(place)
        self._sums = dr.zeros(mi.Float, 3 * count * max(len(self._emitters), 1))

    def add(self, emitter: mi.EmitterPtr, radiance: mi.Color3f, active: mi.Mask) -> None:
        """What some rays see of emitters."""
        active = active & (emitter != None)  # noqa: E711 (on the device)
        place = dr.gather(mi.UInt32, self._place, dr.reinterpret_array(mi.UInt32, emitter), active)
        dr.scatter_reduce(dr.ReduceOp.Add, self._sums, radiance, place * self._count + self._sample, active)

    def found(self) -> dict[int, Floats]:
        """Sums (samples, 3) by the numbers of emitters, without those that nobody sees."""
        sums = self._sums.numpy().reshape(-1, self._count, 3)
        return {number: own for number, own in zip(self._emitters, sums, strict=False) if own.any()}


def _camera_rays(sensor: mi.Sensor, places: Floats, seed: int) -> tuple[mi.Ray3f, mi.Color3f, mi.PCG32]:
    """A ray through each place (n, 2) of the crop window, in pixels; of the aperture and the shutter at random."""
    n, crop = len(places), sensor.film().crop_size()
    rng = random_generator(mi.UInt64(dr.arange(mi.UInt32, n)), mi.UInt32(_CAMERA), mi.UInt32(0), seed)
    at = mi.Point2f(*(np.ascontiguousarray(places[:, k] / crop[k]) for k in range(2)))
    time = sensor.shutter_open() + rng.next_float32() * sensor.shutter_open_time()
    ray, weight = sensor.sample_ray(time, rng.next_float32(), at, next_2d(rng))
    return mi.Ray3f(ray), mi.Color3f(weight), rng


def _lanes(pixels: int, spp: int, seed: int, coated: bool) -> tuple[Ids, NDArray[np.bool_]]:
    """The sample of each ray, pixel by pixel; of one at random of each pixel a second ray, by way of coats, if any."""
    if not coated:
        return np.arange(pixels * spp), np.zeros(pixels * spp, bool)
    every = np.arange(pixels * spp).reshape(pixels, spp)
    again = every[:, 0] + np.random.default_rng([seed, _COATS]).integers(spp, size=pixels)
    sample = np.append(every, again[:, None], axis=1)
    coats = np.broadcast_to(np.arange(spp + 1) == spp, sample.shape)
    order = np.argsort(sample, axis=1, kind="stable")
    return np.take_along_axis(sample, order, axis=1).ravel(), np.take_along_axis(coats, order, axis=1).ravel()


@dr.syntax
def _follow(
    scene: mi.Scene,
    ray: mi.Ray3f,
    weight: mi.Color3f,
    rng: mi.PCG32,
    limit: mi.UInt32,
    by_coats: mi.Mask,
    note: Callable[[mi.EmitterPtr, mi.Color3f, mi.Mask], object],
) -> tuple[mi.Color3f, mi.Ray3f, mi.PreliminaryIntersection3f, mi.Color3f, mi.UInt32, mi.Mask]:
    """Follow rays to surfaces that are not only specular; ``by_coats`` those of what is beyond the first coat.

    ``note`` is told what they see of emitters on the way.

    Returns
    -------
    seen : Color3f
        Radiance of what they saw on the way.
    ray, hit
        The last ray of each, and where it ends.
    weight : Color3f
    depth : UInt32
        Surfaces before that.
    found : Mask
        Whether there is such a surface.
    """
    ray, weight = mi.Ray3f(ray), mi.Color3f(weight)
    seen, depth, before = mi.Color3f(0), mi.UInt32(0), mi.Mask(by_coats)
    found, active = mi.Mask(False), limit > 0
    kept_ray, kept_hit = mi.Ray3f(ray), dr.zeros(mi.PreliminaryIntersection3f, dr.width(ray))
    active &= dr.max(weight) > 0
    while active:
        hit = scene.ray_intersect_preliminary(ray, active=active)
        si = hit.compute_surface_interaction(ray, active=active)
        shown = active & ~before
        emitter = si.emitter(scene, shown)
        radiance = dr.select(shown, weight * emitter.eval(si, shown), 0)
        seen += radiance
        note(emitter, radiance, shown)
        active &= si.is_valid() & (depth + 1 < limit)
        goes_on, reflected, out, factor = _specular(si, rng, active, before, by_coats)
        before &= ~reflected
        stays = active & ~goes_on & ~before
        kept_ray = dr.select(stays, ray, kept_ray)
        kept_hit = dr.select(stays, hit, kept_hit)
        found |= stays
        weight = dr.select(active, weight * factor, weight)
        ray = si.spawn_ray(out)
        active &= goes_on & (dr.max(weight) > 0)
        depth += dr.select(active, 1, 0)
    return seen, kept_ray, kept_hit, weight, depth, found & (dr.max(weight) > 0)


def _specular(
    si: mi.SurfaceInteraction3f, rng: mi.PCG32, active: mi.Mask, before: mi.Mask, by_coats: mi.Mask
) -> tuple[mi.Mask, mi.Mask, mi.Vector3f, mi.Color3f]:
    """Whether rays go on from surfaces, and by a coat, where to (world), and what either choice weighs.

    Rays that are not ``by_coats`` stay at these, and the others go on from the first one.

    Where there is nothing but mirrors and glass, they do, as Mitsuba's BSDF samples it. Otherwise they pass holes as
    often as light does; and go on by other single directions as often as these reflect, about, which is known from a
    sample of its own: the choice must not depend on the sample that is followed.
    """
    flags, bsdf = si.bsdf().flags(), si.bsdf()
    bent = (flags & BENT) != 0
    smooth, null = mi.has_flag(flags, mi.BSDFFlags.Smooth), mi.has_flag(flags, mi.BSDFFlags.Null)
    u, choice = rng.next_float32(), rng.next_float32()

    # holes, beside what is around them
    passed = mi.Color3f(bsdf.eval_null_transmission(si, active & smooth & null))
    p_hole = dr.clip(dr.sum(passed) / 3, 0, 1)
    hole = smooth & null & (u < p_hole)
    factor = dr.select(hole, passed / dr.maximum(p_hole, 1e-6), 1)
    factor = dr.select(smooth & null & ~hole, 1 / dr.maximum(1 - p_hole, 1e-6), factor)

    # a coat, or something else that reflects into single directions, beside what spreads light
    mixed = active & smooth & bent & ~hole
    _, guess = single_direction(si, rng.next_float32(), next_2d(rng), mixed & ~null, BENT)
    p_bent = dr.select(null, 0.5, dr.clip(dr.max(mi.Color3f(guess)), 0.02, 0.98))
    p_bent = dr.select(by_coats, dr.select(before, 1, p_bent), 0)
    follows = mixed & (choice < p_bent)
    some, its = single_direction(si, rng.next_float32(), next_2d(rng), follows & ~null, BENT)
    only = active & ~smooth
    lit = only | (follows & null)
    other, share = bsdf.sample(mi.BSDFContext(), si, rng.next_float32(), next_2d(rng), lit)
    is_bent = (mi.UInt32(other.sampled_type) & BENT) != 0
    its = dr.select(null, dr.select(is_bent, share, 0), its)
    factor = dr.select(follows, factor * its / p_bent, factor)
    factor = dr.select(mixed & ~follows, factor / (1 - p_bent), factor)
    factor = dr.select(only, share, factor)

    out = dr.select(only | null, si.to_world(other.wo), si.to_world(some.wo))
    out = dr.select(hole, si.to_world(-si.wi), out)
    return active & (only | hole | follows), follows, out, factor
