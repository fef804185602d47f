"""Light that the matrix of samples and lights does not have, by paths from the samples.

Two kinds are left out there: what is cut off where a light is near to a sample (``clamping``), and light that reaches
the sample by way of mirrors or glass, through which no connection goes. Paths find both; the first kind as Kollig and
Keller have it (Illumination in the Presence of Weak Singularities, 2004): where a path meets a surface, the share of
its light is added that a point of light there would have lost. That is none where the surface is not near; the path
ends there, which makes it cheap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.random_keys import random_generator
from mi_sparse_prt.manylights.clamping import kept, receiving, sending
from mi_sparse_prt.manylights.elements import Done, Elements, Floats
from mi_sparse_prt.manylights.light_arrays import facing, reflected
from mi_sparse_prt.manylights.particles import next_2d
from mi_sparse_prt.manylights.samples import Receivers, Samples
from mi_sparse_prt.manylights.surfaces import BENT
from mi_sparse_prt.scene.materials import sample_weight
from mi_sparse_prt.solvers.direct_rays import arriving_share
from mi_sparse_prt.solvers.paths import ROULETTE_DEPTH

PATHS = 16  # of each sample
LANES = 1 << 20  # paths of a kernel
SURVEY = 1 << 16  # samples with a path each, which tell how much is left out
_PATHS = 0x5A19  # key of random numbers


@dataclass(frozen=True)
class LeftOut:
    """Light that elements do not have, of some samples: means of their paths, and what is known of these means.

    Attributes
    ----------
    rows : (k,) int64
        Of the matrix.
    clamped, specular : (k, 3) float32
        Radiance that is lost to the clamp, and that comes by way of mirrors and glass.
    variances : (k, 3) float64
        Of the means, ``clamped``, ``specular`` and their sum, channels added up; 0 if there is one path.
    """

    rows: NDArray[np.int64]
    clamped: Floats
    specular: Floats
    variances: NDArray[np.float64]

    @property
    def values(self) -> Floats:
        """Both kinds together (k, 3)."""
        return self.clamped + self.specular

    def of_image(self, samples: Samples) -> dict[str, tuple[float, float]]:
        """What each kind adds to the mean radiance of the image, and the standard error (at most) of that.

        It is that of the paths of all samples, or of these samples among all.
        """
        count, found = max(len(self.rows), 1), {}
        share = len(samples) / max(len(samples.seen), 1)
        for k, (name, values) in enumerate((("clamped", self.clamped), ("specular", self.specular))):
            means = values.mean(axis=1, dtype=np.float64)
            mean = float(means.sum()) / count
            variance = float(self.variances[:, k].sum()) / 3 / count**2  # as if channels were equal
            if not variance or len(means) < len(samples):
                variance = float(np.square(means - mean).sum()) / count**2
            found[name] = (share * mean, share * float(np.sqrt(variance)))
        return found


def joined(parts: Sequence[LeftOut]) -> LeftOut:
    """The sum of what independent paths from the same samples found."""
    return LeftOut(
        parts[0].rows,
        sum((part.clamped for part in parts[1:]), parts[0].clamped),
        sum((part.specular for part in parts[1:]), parts[0].specular),
        sum((part.variances for part in parts[1:]), parts[0].variances),
    )


def trace_left_out(
    elements: Elements,
    rows: NDArray[np.integer],
    paths: int,
    seed: int,
    done: Done = lambda _: None,
    emitter: int | None = None,
) -> LeftOut:
    """Trace some paths from samples; which ones does not depend on what other samples are asked for.

    Parameters
    ----------
    elements : Elements
        Of the lights, their clamp counts.
    rows : (k,) integers
    paths : int
        From each sample.
    seed : int
    done : callable
        Is told how many rows more are done.
    emitter : int, optional
        Light of this one alone, by other paths than those of others.

    Raises
    ------
    PrtError
        Light is not finite: the sample is named.
    """
    means = np.zeros((2, len(rows), 3), np.float32)
    variances = np.zeros((len(rows), 3))
    if elements.max_depth < 3:  # direct light, of which nothing is left out
        return LeftOut(np.asarray(rows, np.int64), means[0], means[1], variances)
    tracer, step = _Tracer(elements, emitter), max(1, LANES // paths)
    for a in range(0, len(rows), step):
        part = slice(a, min(a + step, len(rows)))
        means[:, part], variances[part] = _block(tracer, np.asarray(rows[part], np.uint32), paths, seed)
        done(part.stop - a)
    bad = np.flatnonzero(~np.isfinite(means).all(axis=(0, 2)))
    if len(bad):
        name = elements.samples.name(int(rows[bad[0]]))
        raise PrtError(f"{name} is lit by paths whose light is not finite: repair the BSDFs that it sees")
    return LeftOut(np.asarray(rows, np.int64), means[0], means[1], variances)


def _block(
    tracer: _Tracer, rows: NDArray[np.uint32], paths: int, seed: int
) -> tuple[Floats, NDArray[np.float64]]:
    """Means (2, k, 3) of paths from samples, and their variances (k, 3)."""
    lane, count = dr.arange(mi.UInt32, len(rows) * paths), dr.opaque(mi.UInt32, paths)
    row = dr.gather(mi.UInt32, mi.UInt32(rows), lane // count)
    number = lane - lane // count * count
    rng = random_generator(mi.UInt64(row), dr.opaque(mi.UInt32, tracer.key), number, seed)
    found = tracer.trace(tracer.elements.samples.receivers(row), rng)
    kinds = [*found, found[0] + found[1]]
    squares = [dr.squared_norm(kind) for kind in kinds]
    dr.eval(kinds, squares)  # in one kernel
    sums = [dr.block_reduce(dr.ReduceOp.Add, kind, paths).numpy().T.astype(np.float64) for kind in kinds]
    second = [
        dr.block_reduce(dr.ReduceOp.Add, square, paths).numpy().astype(np.float64) for square in squares
    ]
    means = np.stack(sums) / paths
    if paths == 1:
        return means[:2].astype(np.float32), np.zeros((len(rows), 3))
    around = np.stack(second) / paths - np.square(means).sum(axis=2)
    return means[:2].astype(np.float32), np.maximum(around, 0).T / (paths - 1)


@dataclass
class _Start:
    """Where paths leave samples (Dr.Jit): world, what they carry, and the sample's factor of the clamp."""

    ray: Any
    throughput: Any
    receives: Any


class _Tracer:
    """Paths that add up what the elements of a matrix do not have, as Mitsuba's ``path`` finds light.

    A path is linked as long as it went straight on since it left its sample: an element connects these two places.
    """

    def __init__(self, elements: Elements, emitter: int | None = None) -> None:
        self.elements, self.scene, self.surfaces = elements, elements.scene, elements.surfaces
        self.key = _PATHS + (0 if emitter is None else 1 + emitter)
        self._only = None
        if emitter is not None:
            index = dr.opaque(mi.UInt32, emitter)
            self._only = dr.gather(mi.EmitterPtr, self.scene.emitters_dr(), index)

    @dr.syntax
    def trace(self, at: Receivers, rng: mi.PCG32) -> tuple[mi.Color3f, mi.Color3f]:
        """What paths find, a path in each lane: what is clamped, and what comes by way of mirrors and glass."""
        start = self._start(at, rng)
        ray, throughput, depth = mi.Ray3f(start.ray), mi.Color3f(start.throughput), at.depth + 1
        most = dr.opaque(mi.UInt32, self.elements.max_depth)
        linked, specular = mi.Mask(True), mi.Mask(False)
        before, density = (
            mi.Point3f(at.si.p),
            mi.Float(0),
        )  # of the last surface that did not pass it straight on
        clamped, bent = mi.Color3f(0), mi.Color3f(0)
        active = ~dr.all(throughput == 0) & (depth < most)
        while active:
            si = self.scene.ray_intersect(ray, active)
            met = throughput * self._met(si, before, density, active & ~linked)
            active &= si.is_valid() & (depth + 1 < most)

            # lamps, by one shadow ray
            light, towards = self._sampled_lamp(si, rng, active)
            bsdf = si.bsdf(ray)
            value, chance, sample, weight = bsdf.eval_pdf_sample(
                mi.BSDFContext(), si, si.to_local(towards.d), rng.next_float32(), next_2d(rng), active
            )
            share, through = self._left(at, start, si, towards.d, linked, active)
            value *= light * (share * dr.select(towards.delta, 1, _mis(towards.pdf, chance)))
            lit = throughput * self._passed(si, towards, value, most - depth - 2, active)
            clamped += dr.select(specular, 0, met + dr.select(through, 0, lit))
            bent += dr.select(specular, met + lit, dr.select(through, lit, 0))

            # next surface
            out, kind = si.to_world(sample.wo), mi.UInt32(sample.sampled_type)
            turns, straight = (kind & BENT) != 0, mi.has_flag(kind, mi.BSDFFlags.Null)
            share, through = self._left(at, start, si, out, linked & ~straight & ~turns, active)
            specular |= linked & ~straight & (turns | through)
            throughput *= sample_weight(sample, weight) * share
            linked &= straight
            density = dr.select(straight, density, dr.select(turns, 0, sample.pdf))
            before = dr.select(straight, before, si.p)
            ray = si.spawn_ray(out)
            depth += 1

            # Russian roulette
            brightest = dr.max(dr.abs(throughput))
            survival = dr.select(depth >= ROULETTE_DEPTH, dr.minimum(brightest, 0.95), 1)
            active &= ~dr.all(throughput == 0) & (rng.next_float32() < survival)
            throughput /= survival
        return clamped, bent

    def _start(self, at: Receivers, rng: mi.PCG32) -> _Start:
        """Rays of the BSDFs of samples; of single directions none, as these are followed where samples are placed."""
        local = mi.warp.square_to_cosine_hemisphere(next_2d(rng))
        local = mi.Vector3f(local.x, local.y, dr.mulsign(local.z, mi.Frame3f.cos_theta(at.si.wi)))
        throughput, receives = at.weight * dr.pi, dr.abs(local.z)
        if not self.surfaces.all_lambertian:
            bsdf, context, own = at.si.bsdf(), mi.BSDFContext(), ~at.diffuse
            sample, weight = bsdf.sample(context, at.si, rng.next_float32(), next_2d(rng), own)
            local = dr.select(own, sample.wo, local)
            single = mi.has_flag(mi.UInt32(sample.sampled_type), mi.BSDFFlags.Delta)
            weight = sample_weight(sample, weight)
            throughput = dr.select(own, dr.select(single, 0, at.weight * weight), throughput)
            value = bsdf.eval(context, at.si, local, own)
            receives = receiving(mi.Frame3f.cos_theta(local), dr.select(own, value, 0))
        ray = at.si.spawn_ray(at.si.to_world(local))
        if self.surfaces.all_lambertian:  # nothing is left out of what is farther away
            ray.maxt = dr.sqrt(receives / dr.opaque(mi.Float, self.elements.clamp)) * 1.001
        return _Start(ray, throughput, receives)

    def _left(
        self,
        at: Receivers,
        start: _Start,
        si: mi.SurfaceInteraction3f,
        towards: mi.Vector3f,
        linked: mi.Mask,
        active: mi.Mask,
    ) -> tuple[mi.Float, mi.Mask]:
        """Share of light from a direction that elements do not have; and whether that is as it goes through a surface.

        Points of light are on one side of theirs. Of paths that are not linked it is the whole.
        """
        line = si.p - at.si.p
        square = dr.maximum(dr.squared_norm(line), 1e-30)
        direction = line * dr.rsqrt(square)
        normal = dr.mulsign(mi.Vector3f(si.n), dr.dot(si.n, towards))
        cosine = facing(normal, direction) / square
        sends, through = mi.Float(cosine), mi.Mask(False)
        if not self.surfaces.all_lambertian:
            glossy = active & linked & ~self.surfaces.lambertian(si)
            own, through = glossy & (cosine > 0), glossy & (cosine <= 0)
            turned = mi.SurfaceInteraction3f(si)
            turned.wi = si.to_local(towards)
            value, scale = reflected(turned, normal, direction, square, own)
            sends = sending(cosine, dr.select(own, value, 0), scale)
        share = 1 - kept(start.receives, sends, dr.opaque(mi.Float, self.elements.clamp))
        return dr.select(linked & (cosine > 0), share, 1), through

    def _met(
        self, si: mi.SurfaceInteraction3f, before: mi.Point3f, density: mi.Float, active: mi.Mask
    ) -> mi.Color3f:
        """Radiance of lamps and the environment that rays meet; ``density`` is 0 of single directions."""
        emitter = si.emitter(self.scene, active)
        origin = dr.zeros(mi.Interaction3f, dr.width(si))
        origin.p = before
        there = mi.DirectionSample3f(self.scene, si, origin)
        chance = self.scene.pdf_emitter_direction(origin, there, active & (density > 0))
        weight = dr.select(density > 0, _mis(density, chance), 1)
        return dr.select(active & self._counts(emitter), emitter.eval(si, active) * weight, 0)

    def _sampled_lamp(
        self, si: mi.SurfaceInteraction3f, rng: mi.PCG32, active: mi.Mask
    ) -> tuple[mi.Color3f, mi.DirectionSample3f]:
        """Radiance over its density from a direction towards a lamp, as if nothing was in the way."""
        lit = active & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth)
        found, value = self.scene.sample_emitter_direction(si, next_2d(rng), False, lit)
        lit &= (found.pdf > 0) & self._counts(found.emitter)
        return dr.select(lit, mi.Color3f(value), 0), found

    def _counts(self, emitter: mi.EmitterPtr) -> mi.Mask:
        """Whether light of emitters is asked for."""
        return mi.Mask(True) if self._only is None else emitter == self._only

    def _passed(
        self,
        si: mi.SurfaceInteraction3f,
        towards: mi.DirectionSample3f,
        value: mi.Color3f,
        most: mi.UInt32,
        active: mi.Mask,
    ) -> mi.Color3f:
        """What nothing is in the way of; masks and panes let a part through, as they do for elements."""
        active = active & ~dr.all(value == 0)  # NaN is lit, so that it is noticed
        ray = si.spawn_ray_to(towards.p)
        onwards = lambda there: there.spawn_ray_to(towards.p)  # noqa: E731
        share, _ = arriving_share(self.scene, ray, active, self.surfaces.passes_straight, most, onwards)
        return dr.select(active & (dr.max(share) > 0), value * share, 0)


def _mis(a: mi.Float, b: mi.Float) -> mi.Float:
    """Power heuristic."""
    square = dr.square(a)
    weight = square / (square + dr.square(b))
    return dr.select(dr.isfinite(weight), weight, 0)
