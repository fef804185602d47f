"""S_i by tracing importance: rows of interreflected light from paths that texels share ([Leh07] 2.6, eq. 15).

The adjoint solution (R S_i V)* m_i of a vertex lives on the sphere of directions: a path carries the vertex's
importance through the scene, and any texel may light it. Where path tracing per element starts anew for every texel,
here all texels of a row are dealt out to a few hundred paths, whose own rays cost little beside the shadow rays.
That is one sample of the row. Each element gets one path in each sample, as good as if it were its own, and its paths
over all samples are stratified by their first direction, two to a stratum, which also gives their variance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.random_keys import random_generator
from mi_sparse_prt.emission.cube_faces import face_coordinates, texel_at
from mi_sparse_prt.emission.texel_arrays import TexelArrays
from mi_sparse_prt.measurement.point_arrays import PointArrays, start_ray
from mi_sparse_prt.scene.materials import sample_weight
from mi_sparse_prt.solvers.paths import Estimate, has_mirrors
from mi_sparse_prt.solvers.problem import Problem

# Per sample of a row; a power of four. With 64 an element costs a quarter less, but the sum of a row, which is what
# broad lights see, is then known no better than by path tracing in the same time; with 256 three times better.
PATHS = 256
CELLS = 1 << 23  # elements of the samples that are traced together; 32 MB per channel
SURVIVAL = 0.95  # at most, in Russian roulette
# Uses of random numbers; beyond the ``sample`` of path tracing, so that none are the same
DEALS, DIRECTIONS, PLACES = (k << 29 for k in (5, 6, 7))


class AdjointSolver:
    """Indirect light at points of a scene, one row of elements per point.

    Parameters
    ----------
    problem : Problem
    spp : int
        Paths that every element is estimated from; an odd number counts as the next even one.
    seed : int

    Notes
    -----
    Rows are independent of each other. Two elements of a row share either all of their paths or none, the former with
    a probability of 1 / ``paths_per_sample`` drawn for each row: variances of elements do not simply add up to that
    of a row's sum.
    """

    def __init__(self, problem: Problem, spp: int = 16, seed: int = 0) -> None:
        self.problem, self.scene = problem, problem.scene.unsplit
        self.lighting, self.points = problem.emission, problem.points
        self.basis, self.max_depth, self.channels = problem.basis, problem.max_depth, problem.channels
        self.spp, self.seed = spp + spp % 2, seed
        self._points, self._texels = PointArrays(self.points), TexelArrays(self.lighting)
        self._sees_light = self.basis == "texel" and has_mirrors(self.scene)

    @property
    def block_size(self) -> int:
        """Rows that are traced together."""
        return max(1, CELLS // (2 * self.lighting.n_directions))

    @property
    def paths_per_sample(self) -> int:
        """Paths among which a sample of a row deals out the texels, the same number to each."""
        return min(PATHS, self.lighting.resolution**2)

    def rows(self, point_ids: NDArray[np.integer], seed: int | None = None) -> Estimate:
        """Unit-albedo indirect transport per solid angle of whole rows: the elements of ``PathSolver.rows``.

        Parameters
        ----------
        point_ids : (k,) integers
        seed : int, optional
            Another seed than the solver's gives independent estimates.

        Returns
        -------
        Estimate
            ``mean`` (k, n_directions, channels) in 1/sr, and the variance of that mean.

        Raises
        ------
        PrtError
            If a BSDF gives a value that is not finite, naming the first point and texel whose paths find it.
        """
        mean = np.zeros((len(point_ids), self.lighting.n_directions, self.channels), dtype=np.float32)
        variance = np.zeros_like(mean)
        seed = self.seed if seed is None else seed
        for a in range(0, len(point_ids), self.block_size):
            part = slice(a, a + self.block_size)
            block = self._estimate(np.asarray(point_ids[part], dtype=np.uint32), seed)
            mean[part], variance[part] = block.mean, block.variance
        return Estimate(mean, variance)

    def _estimate(self, point_ids: NDArray[np.uint32], seed: int) -> Estimate:
        shape = (len(point_ids), self.lighting.n_directions)
        size = shape[0] * shape[1]
        sums, squares = ([dr.zeros(mi.Float, size) for _ in range(self.channels)] for _ in range(2))
        n_strata = self.spp // 2
        at_once = max(1, self.block_size // shape[0])
        for a in range(0, n_strata, at_once):
            strata = range(a, min(a + at_once, n_strata))
            found = _Samples(self, point_ids, strata, seed).trace()
            for c in range(self.channels):
                for first, second in _pairs(found[c], len(strata)):
                    sums[c] += first + second
                    squares[c] += dr.square(first - second)
                    dr.eval(sums[c], squares[c])
        total, spread = (np.stack([x.numpy().reshape(shape) for x in xs], axis=-1) for xs in (sums, squares))
        self._check_finite(np.isfinite(total) & np.isfinite(spread), point_ids)
        # The mean of two has the variance (a - b)^2 / 4
        variance = spread / (4 * n_strata**2)
        return Estimate((total / self.spp).astype(np.float32), variance.astype(np.float32))

    def _check_finite(self, finite: NDArray[np.bool_], point_ids: NDArray[np.uint32]) -> None:
        """Refuse a block of rows (k, n_directions, channels) of which an element is not finite, naming the first."""
        bad = np.argwhere(~finite.all(axis=2))
        if not len(bad):
            return
        row, texel = bad[0]
        direction = np.round(self.lighting.directions[texel].astype(float), 4).tolist()
        raise PrtError(
            f"vertex {point_ids[row]} gets indirect light that is not finite from texel {texel}, direction "
            f"{direction} ({len(bad)} such elements): repair the BSDF or texture of a surface that it sees"
        )


@dataclass
class _Paths:
    """Paths under way: row and number of each in it, the ray that it is about to follow, and what it carries."""

    row: mi.UInt32
    number: mi.UInt32
    origin: mi.Point3f
    direction: mi.Vector3f
    throughput: mi.Color3f
    mirrored: mi.Mask  # by the last surface, into a single direction

    @property
    def ray(self) -> mi.Ray3f:
        return mi.Ray3f(self.origin, self.direction)

    def chosen(self, index: mi.UInt32) -> _Paths:
        """The paths of ``_indices``."""
        paths = _Paths(*(dr.gather(type(x), x, index) for x in vars(self).values()))
        extra = dr.arange(mi.UInt32, len(index)) == dr.opaque(mi.UInt32, len(index) - 1)
        paths.throughput = dr.select(extra, 0, paths.throughput)
        return paths


def _indices(mask: mi.Mask) -> mi.UInt32:
    """Where a mask is set, and one index more that does not count, as arrays of size one need other kernels.

    Empty if it is set nowhere.
    """
    index = dr.compress(mask)
    count = len(index)
    if count:
        lane = dr.arange(mi.UInt32, count + 1)
        index = dr.gather(mi.UInt32, index, lane, lane < dr.opaque(mi.UInt32, count))
        dr.eval(index)
    return index


def _pairs(found: mi.Float, n: int) -> Iterator[tuple[mi.Float, mi.Float]]:
    """The two samples of each of n strata."""
    size = len(found) // (2 * n)
    lane = dr.arange(mi.UInt32, size)
    for k in range(n):
        places = (lane + dr.opaque(mi.UInt32, (2 * k + half) * size) for half in range(2))
        first, second = (dr.gather(mi.Float, found, place) for place in places)
        yield first, second


class _Samples:
    """Samples of rows, two in each of some strata, to be traced together: [stratum, one or the other, point]."""

    def __init__(
        self, solver: AdjointSolver, point_ids: NDArray[np.uint32], strata: range, seed: int
    ) -> None:
        self.solver, self.seed = solver, seed
        ids = mi.UInt32(np.append(point_ids, point_ids[-1:]))  # never of size one
        row = dr.arange(mi.UInt32, 2 * len(strata) * len(point_ids))
        sample = row // dr.opaque(mi.UInt32, len(point_ids))
        self.number = sample + dr.opaque(mi.UInt32, 2 * strata.start)
        self.point = dr.gather(mi.UInt32, ids, row - sample * dr.opaque(mi.UInt32, len(point_ids)))
        # Texel (factor k + shift) mod 6 n^2 is the k-th of a row, and belongs to path k mod paths_per_sample: a
        # permutation, as 6 t + 1 has no divisor in common with 6 n^2 (n a power of two). A point's samples share it.
        n = solver.lighting.resolution**2
        rng = random_generator(solver._points.key(self.point), mi.UInt32(0), mi.UInt32(DEALS), seed)
        self.factor = 6 * mi.UInt32(rng.next_float32() * n) + 1
        self.shift = mi.UInt32(rng.next_float32() * (6 * n))
        dr.eval(self.point, self.number, self.factor, self.shift)

    def trace(self) -> list[mi.Float]:
        """What one path per element finds: for each channel (rows * n_directions,), in 1/sr."""
        solver = self.solver
        size = len(self.point) * solver.lighting.n_directions
        found = [dr.zeros(mi.Float, size) for _ in range(solver.channels)]
        bounces = solver.max_depth - 2 if solver.max_depth >= 0 else 1 << 28
        paths, depth = self._start(), 0
        while depth < bounces + solver._sees_light:
            hit = solver.scene.ray_intersect_preliminary(paths.ray)
            dr.eval(hit, vars(paths))
            if solver._sees_light:
                self._collect(found, paths, paths.mirrored & ~hit.is_valid())
            index = _indices(hit.is_valid())
            if depth == bounces or len(index) == 0:
                break
            paths, hit = paths.chosen(index), dr.gather(mi.PreliminaryIntersection3f, hit, index)
            self._light(found, paths, hit, self._random(paths.row, paths.number, PLACES + depth))
            depth += 1
            if depth == bounces and not solver._sees_light:
                break
            self._reflect(paths, hit, self._random(paths.row, paths.number, DIRECTIONS + depth))
            alive = ~dr.all(paths.throughput == 0)  # and not any(... != 0), which is false for NaN here
            alive &= dr.opaque(mi.Mask, depth < bounces) | paths.mirrored
            dr.eval(alive, vars(paths))
            index = _indices(alive)
            if len(index) == 0:
                break
            paths = paths.chosen(index)
        return found

    def _random(self, row: mi.UInt32, number: mi.UInt32, use: int) -> mi.PCG32:
        """Random numbers for one use, whatever the lane and the order of rows."""
        key = self.solver._points.key(dr.gather(mi.UInt32, self.point, row))
        unique = dr.gather(mi.UInt32, self.number, row) * PATHS + number
        return random_generator(key, unique, dr.opaque(mi.UInt32, use), self.seed)

    def _start(self) -> _Paths:
        """First rays, cosine-distributed about the shading normal.

        Every path has another one of the spp / 2 strata in each pair of samples. Among the paths that share one,
        it is split further, and its parts are assigned anew in each sample.
        """
        solver, n = self.solver, self.solver.paths_per_sample
        lane = dr.arange(mi.UInt32, len(self.point) * n)
        row = lane // n
        number = lane - row * n
        strata = dr.opaque(mi.UInt32, solver.spp // 2)
        stratum = (number + dr.gather(mi.UInt32, self.number, row) // 2) % strata
        parts = (n + strata - 1) // strata
        turn = self._random(row, mi.UInt32(0), DEALS + 1).next_float32()
        part = (number // strata + mi.UInt32(turn * parts)) % parts
        rng = self._random(row, number, DIRECTIONS)
        along = (mi.Float(stratum * parts + part) + rng.next_float32()) / mi.Float(strata * parts)
        local = mi.warp.square_to_cosine_hemisphere(_on_square(along, rng))
        point = dr.gather(mi.UInt32, self.point, row)
        ray = start_ray(solver._points, point, mi.Frame3f(solver._points.normal(point)).to_world(local))
        return _Paths(
            row, number, ray.o, ray.d, dr.full(mi.Color3f, 1, len(lane)), dr.zeros(mi.Mask, len(lane))
        )

    @dr.syntax
    def _light(
        self, found: list[mi.Float], paths: _Paths, hit: mi.PreliminaryIntersection3f, rng: mi.PCG32
    ) -> None:
        """Light the surfaces that paths have met from all their texels, by one shadow ray each."""
        solver, texels = self.solver, self.solver._texels
        n, n_paths = solver.lighting.n_directions, solver.paths_per_sample
        si = solver.scene.interaction(hit, paths.ray)
        bsdf, context = si.bsdf(), mi.BSDFContext()
        factor = mi.UInt64(dr.gather(mi.UInt32, self.factor, paths.row))
        step = mi.UInt32(factor * n_paths % n)
        texel = mi.UInt32((factor * paths.number + dr.gather(mi.UInt32, self.shift, paths.row)) % n)
        left = mi.UInt32(n // n_paths)
        # Every element has one lane. It is stored and then added, for dr.scatter_add leaves out NaN
        here = [dr.zeros(mi.Float, len(x)) for x in found]
        while left > 0:
            direction, irradiance = texels.centre(texel), mi.Float(1)
            if dr.hint(solver.basis == "texel", mode="scalar"):
                direction, solid_angle = texels.inside(texel, rng.next_float32(), rng.next_float32())
                irradiance = solid_angle / texels.solid_angle(texel)
            value = paths.throughput * bsdf.eval(context, si, si.to_local(direction)) * irradiance
            lit = ~dr.all(
                value == 0
            )  # NaN is lit, so that it is noticed, and what factored BSDFs make negative
            lit &= ~solver.scene.ray_test(si.spawn_ray(direction), lit)
            for c in range(solver.channels):
                dr.scatter(here[c], value[c], paths.row * n + texel, lit, dr.ReduceMode.NoConflicts)
            texel += step
            texel = dr.select(texel >= n, texel - n, texel)
            left -= 1
        for c in range(solver.channels):
            found[c] += here[c]
        dr.eval(found)

    def _reflect(self, paths: _Paths, hit: mi.PreliminaryIntersection3f, rng: mi.PCG32) -> None:
        """Send paths on from the surfaces that they have met; those that end carry nothing.

        Russian roulette begins at the first surface: shadow rays then go where they count.
        """
        si = self.solver.scene.interaction(hit, paths.ray)
        sample, weight = si.bsdf().sample(
            mi.BSDFContext(), si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        )
        throughput = paths.throughput * sample_weight(sample, weight)
        survival = dr.minimum(dr.max(dr.abs(throughput)), SURVIVAL)
        ends = rng.next_float32() >= survival  # never for NaN, so that it is noticed
        paths.throughput = dr.select(ends, 0, throughput / survival)
        ray = si.spawn_ray(si.to_world(sample.wo))
        paths.origin, paths.direction = ray.o, ray.d
        paths.mirrored = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)

    def _collect(self, found: list[mi.Float], paths: _Paths, escaped: mi.Mask) -> None:
        """Light that paths run into: no shadow ray finds it through a mirror. Here all paths serve all texels."""
        solver, lighting = self.solver, self.solver.lighting
        index = _indices(escaped)
        if len(index) == 0:
            return
        paths = paths.chosen(index)
        texel = texel_at(*face_coordinates(paths.direction), lighting.resolution)
        radiance = paths.throughput / (solver._texels.solid_angle(texel) * solver.paths_per_sample)
        element = (paths.row * lighting.n_directions + texel).numpy()
        for c in range(solver.channels):  # on the host, where sums are always taken in the same order
            sums = np.bincount(element, radiance[c].numpy(), minlength=len(found[c]))
            found[c] += on_device(mi.Float, sums.astype(np.float32))


def _on_square(along: mi.Float, rng: mi.PCG32) -> mi.Point2f:
    """Point of the unit square at a place in [0, 1] of the Z-order curve, which keeps intervals compact."""
    bits = mi.UInt32(dr.minimum(along, dr.one_minus_epsilon(mi.Float)) * (1 << 24))
    u, v = (mi.Float(_every_second_bit(b)) + rng.next_float32() for b in (bits, bits >> 1))
    return mi.Point2f(u, v) / (1 << 12)


def _every_second_bit(x: mi.UInt32) -> mi.UInt32:
    """Bits 0, 2, 4, ... of a word side by side."""
    x &= 0x55555555
    for shift, mask in ((1, 0x33333333), (2, 0x0F0F0F0F), (4, 0x00FF00FF), (8, 0x0000FFFF)):
        x = (x | (x >> shift)) & mask
    return x
