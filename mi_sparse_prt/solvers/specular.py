"""Light that arrives by way of mirrors, glass and masks: rays go on until they meet no more of it.

What scatters light into single directions keeps no rows: Mitsuba's own BSDF samples say where a ray goes on, and with
which weight. Where it meets a surface that reflects diffusely as well, that is an entry of the form-factor matrix;
where it leaves the scene, it is light of the texel that it leaves to. Light of the second kind is sharp and noisy: it
is an operator of its own, with few elements, found by as many rays as its noise asks for.

Light that goes straight through (masks, thin panes, ``null``) needs no random rays: see ``passed_light``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.ndimage
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.random_keys import element_seeds, random_generator, random_stream
from mi_sparse_prt.emission.cube_faces import face_coordinates, texel_at
from mi_sparse_prt.measurement.point_arrays import PointArrays, start_ray
from mi_sparse_prt.operators.operator import Ids
from mi_sparse_prt.operators.sparse_rows import SparseRows
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.form_factors import NOTHING, Surfaces, cosine_rays, sobol
from mi_sparse_prt.solvers.problem import Problem

LANES = 1 << 22  # rays per wavefront
FIXED_POINT = float(1 << 29)  # of light of a texel, which glass makes 8 at the most
PARTS = 16  # of a hemisphere, per axis
DIRECT = 1 / 3  # of the squared norm of light that nothing blocks: a guess of what direct light has
MOST = 16  # surfaces on the way, where ``max_depth`` sets no limit
SPECULAR = 7  # spawn key

Sparse: TypeAlias = scipy.sparse.csr_array


@dataclass(frozen=True)
class SpecularOptions:
    """How many rays look for specular light.

    Attributes
    ----------
    first : int
        Strata per axis of a part of the hemisphere, each with a ray, in each of two independent halves.
    last : int
        At most; there are more each time, until the noise is small enough.
    error : float
        Noise that is small enough: relative L2, of direct and specular light together.
    strata : int
        Texel basis: rays per axis of a texel, at first, for light that goes straight on and of which a part is lost.
    """

    first: int = 2
    last: int = 16
    error: float = 0.0
    strata: int = 2


class SpecularLight(NamedTuple):
    """Light from the sky by way of specular surfaces alone.

    Attributes
    ----------
    operator : SparseRows
        Unit-albedo transport.
    noise : float
        Its relative L2 error, as estimated from two halves.
    rays : int
        That were traced.
    """

    operator: SparseRows
    noise: float
    rays: int


class _Found(NamedTuple):
    """Ends of rays: which row each belongs to, a column, and its weight per channel (n, 3)."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    weights: NDArray[np.float32]


class _Ends(NamedTuple):
    """Ends of rays on the device: rows, columns and weights, as far as they are valid."""

    row: Any
    column: Any
    weight: Any
    valid: Any


class SpecularRays:
    """Rays from points that go on where they meet specular surfaces.

    Parameters
    ----------
    problem : Problem
        Light of a cubemap.
    """

    def __init__(self, problem: Problem) -> None:
        self._scene, self._surfaces = problem.scene.normalised, Surfaces(problem.scene)
        self._points = PointArrays(problem.points)
        self._resolution, self._texels = problem.emission.resolution, problem.emission.size
        self._most = most_on_the_way(problem.max_depth)

    def parts_that_see(self, ids: Ids, seed: int) -> tuple[Ids, Ids]:
        """Parts of the hemispheres of points in which, or next to which, a ray meets a specular surface.

        There are PARTS x PARTS of a hemisphere, all of the same cosine-weighted solid angle; a ray goes into each.

        Returns
        -------
        rows, parts : (m,) int64
            ``rows`` count ``ids``.
        """
        found = []
        for a in range(0, len(ids), LANES // PARTS**2):
            some = ids[a : a + LANES // PARTS**2]
            rows, parts = (x.ravel() for x in np.indices((len(some), PARTS**2)))
            ray, _, _ = self._rays(some, rows, parts, 1, seed)
            seen = self._specular_hits(ray)[1].numpy().reshape(-1, PARTS, PARTS)
            grown = scipy.ndimage.maximum_filter(seen, (1, 3, 3))
            row, part = np.nonzero(grown.reshape(len(some), -1))
            found.append((a + row, part))
        rows, parts = (np.concatenate(x) for x in zip(*found, strict=True))
        return rows, parts

    def sky(self, ids: Ids, rows: Ids, parts: Ids, strata: int, seed: int) -> NDArray[np.float32]:
        """Light of texels to which rays from points leave the scene, but for those that went straight all the way.

        Parameters
        ----------
        ids : (n,) integers
            Points.
        rows, parts : (m,) int64
            Of ``parts_that_see``.
        strata : int
            Per axis of a part, each with a ray.
        seed : int

        Returns
        -------
        (3, n, n_directions) float32
            Unit-albedo transport.
        """
        ray, row, rng = self._rays(ids, rows, parts, strata, seed)
        size = len(ids) * self._texels
        sums = [dr.zeros(mi.UInt32, size) for _ in range(3)]
        scale = FIXED_POINT / (PARTS * strata) ** 2  # whole numbers: sums do not depend on the order of rays
        for ends in self._walked(ray, row, rng, True):
            place = ends.row * self._texels + ends.column
            for c, total in enumerate(sums):
                share = mi.UInt32(ends.weight[c] * dr.opaque(mi.Float, scale) + 0.5)
                dr.scatter_reduce(dr.ReduceOp.Add, total, share, place, ends.valid)
        shape = len(ids), self._texels
        return np.stack([(total.numpy() / np.float32(FIXED_POINT)).reshape(shape) for total in sums])

    def surfaces(self, ids: Ids, samples: list[mi.UInt32], seed: int) -> _Found:
        """Vertices of the surfaces that cosine-distributed rays from some points meet after specular ones."""
        ray, point, _ = cosine_rays(self._points, mi.UInt32(ids.astype(np.uint32)), samples, seed)
        lane = dr.arange(mi.UInt32, len(ids) * len(samples[0]))
        row = lane // len(samples[0])
        rng = random_generator(self._points.key(point), lane - row * len(samples[0]), mi.UInt32(1), seed)
        found = []
        for depth, ends in enumerate(self._walked(ray, row, rng, False), 1):
            if depth < self._most:  # light of a surface at the end makes one more bounce
                kept = ends.valid.numpy()
                arrays = ends.row.numpy(), ends.column.numpy(), ends.weight.numpy().T
                found.append(_Found(*(x[kept] for x in arrays)))
        rows, columns, weights = _joined(found)
        return _Found(rows, columns, weights / np.float32(len(samples[0])))

    def _rays(
        self, ids: Ids, rows: Ids, parts: Ids, strata: int, seed: int
    ) -> tuple[mi.Ray3f, mi.UInt32, mi.PCG32]:
        """Rays into parts of hemispheres, one in each stratum, their rows, and random numbers for the rest."""
        lane = dr.arange(mi.UInt32, len(rows) * strata**2)
        entry = lane // strata**2
        stratum = lane - entry * strata**2
        row, part = (dr.gather(mi.UInt32, mi.UInt32(x.astype(np.uint32)), entry) for x in (rows, parts))
        point = dr.gather(mi.UInt32, mi.UInt32(ids.astype(np.uint32)), row)
        rng = random_generator(self._points.key(point), part, stratum, seed)
        fine = PARTS * strata
        x = mi.Float((part % PARTS) * strata + stratum % strata) + rng.next_float32()
        y = mi.Float((part // PARTS) * strata + stratum // strata) + rng.next_float32()
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(x / fine, y / fine))
        direction = mi.Frame3f(self._points.normal(point)).to_world(local)
        return start_ray(self._points, point, direction), row, rng

    def _specular_hits(self, ray: mi.Ray3f) -> tuple[mi.PreliminaryIntersection3f, mi.Mask]:
        """What rays meet, and whether that scatters light into single directions."""
        hit = self._scene.ray_intersect_preliminary(ray)
        si = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, hit.is_valid())
        return hit, hit.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Delta)

    def _walked(self, ray: mi.Ray3f, row: mi.UInt32, rng: mi.PCG32, to_sky: bool) -> Iterator[_Ends]:
        """Rays that end after one specular surface, after two, ...: at texels of the sky, or at vertices."""
        context = mi.BSDFContext()
        context.type_mask = int(mi.BSDFFlags.Delta)
        hit, met = self._specular_hits(ray)
        dr.eval(hit, met, ray, row, rng)
        index = dr.compress(met)  # few of them
        ray, row, rng, hit = (dr.gather(type(x), x, index) for x in (ray, row, rng, hit))
        weight, straight = dr.full(mi.Color3f, 1, len(index)), dr.full(mi.Mask, True, len(index))
        for _ in range(self._most):
            if len(index) == 0:
                return
            si = hit.compute_surface_interaction(ray, active=hit.is_valid())
            goes_on = hit.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Delta)
            goes_on &= dr.max(weight) > 0
            u = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
            scattered, share = si.bsdf().sample(context, si, *u, goes_on)
            weight = dr.select(goes_on, weight * share, 0)
            straight &= mi.has_flag(scattered.sampled_type, mi.BSDFFlags.Null)
            ray = si.spawn_ray(si.to_world(scattered.wo))
            hit = self._scene.ray_intersect_preliminary(ray, active=goes_on)
            valid = hit.is_valid()
            if to_sky:
                texel = texel_at(*face_coordinates(ray.d), self._resolution)
                column = dr.select(valid | straight, NOTHING, texel)
            else:
                column = dr.select(valid, self._surfaces.corner(hit, ray, rng.next_float32()), NOTHING)
            ends = goes_on & (column != NOTHING) & (dr.max(weight) > 0)
            alive = goes_on & valid & (dr.max(weight) > 0)
            dr.eval(row, column, weight, ends, alive, ray, rng, straight, hit)
            yield _Ends(row, column, weight, ends)
            index = dr.compress(alive)
            row, weight, straight, ray, rng, hit = (
                dr.gather(type(x), x, index) for x in (row, weight, straight, ray, rng, hit)
            )


def most_on_the_way(max_depth: int) -> int:
    """How many specular surfaces a ray may meet that then leaves the scene."""
    return MOST if max_depth < 0 else min(max_depth - 2, MOST)


def _joined(parts: list[_Found]) -> _Found:
    if not parts:
        none = np.zeros(0, np.int64)
        return _Found(none, none, np.zeros((0, 3), np.float32))
    return _Found(*(np.concatenate(x) for x in zip(*parts, strict=True)))


def specular_form_factors(problem: Problem, ids: Ids, rays: int, seed: int) -> Sparse:
    """What G (n, n_v) lacks without specular surfaces: what rays from some points find after these.

    Parameters
    ----------
    problem : Problem
    ids : (n,) integers
        Points.
    rays : int
        From each, a power of two.
    seed : int

    Notes
    -----
    Weights of colours are averaged. A surface that is found after k specular ones sends out light of as many bounces as
    any other, k more than Mitsuba's ``path`` would follow at the same depth.
    """
    walks, samples = SpecularRays(problem), sobol(rays)
    step = max(1, LANES // rays)
    shape = (0, problem.scene.n_vertices)
    blocks = [scipy.sparse.csr_array(shape, dtype=np.float32)]
    for a in range(0, len(ids), step):
        part = ids[a : a + step]
        rows, columns, weights = walks.surfaces(part, samples, seed)
        entries = weights.mean(axis=1), (rows, columns)
        blocks.append(scipy.sparse.coo_array(entries, shape=(len(part), shape[1])).tocsr())
    return scipy.sparse.vstack(blocks, format="csr").astype(np.float32)


def specular_light(
    problem: Problem,
    seed: int,
    options: SpecularOptions = SpecularOptions(),  # noqa: B008
    ids: Ids | None = None,
) -> SpecularLight:
    """Light from the sky that arrives by way of mirrors and glass, at some points.

    A few rays tell in which parts of its hemisphere a point sees specular surfaces; those are sampled, ever finer,
    until the noise is small enough. What is smaller than a part, and met by no ray, is not found.

    Parameters
    ----------
    problem : Problem
    seed : int
    options : SpecularOptions
    ids : (n,) integers, optional
        Points; all if not given.
    """
    every = np.arange(len(problem.points)) if ids is None else np.asarray(ids)
    walks, albedo = SpecularRays(problem), problem.reflection.albedo[every]
    seeds = iter(element_seeds(random_stream(seed, SPECULAR), 64))
    rows, parts = walks.parts_that_see(every, next(seeds))
    enough = options.error**2 / 2, options.error**2 / 2 * DIRECT * _unblocked(problem, albedo)

    def arriving(strata: int) -> list[list[Sparse]]:
        where = rows, parts
        return [_sampled(walks, every, where, strata, next(seeds), problem.emission.size) for _ in "ab"]

    def passing(strata: int) -> list[list[Sparse]]:
        return [[half] * 3 for half in _passed_twice(problem, every, strata, next(seeds), next(seeds))]

    found = [
        _refined(passing, options.strata, albedo, enough),
        _refined(arriving, options.first, albedo, enough, options.last),
    ]
    traced = len(every) * PARTS**2 + 2 * len(rows) * sum(s**2 for s in found[1].strata)
    mean = [
        (a + b + c + d) * np.float32(0.5)
        for (a, b), (c, d) in zip(*(zip(*part.halves, strict=True) for part in found), strict=True)
    ]
    grey = all((mean[0] != other).nnz == 0 for other in mean[1:])
    operator = SparseRows(tuple(scipy.sparse.csr_array(m) for m in (mean[:1] if grey else mean)))
    square, noise = (sum(x) for x in zip(*((part.square, part.noise) for part in found), strict=True))
    return SpecularLight(operator, float(np.sqrt(noise / max(square, 1e-300))), traced)


class _Refined(NamedTuple):
    """Two halves, each of three channels; the squared norms of radiance and noise, and the strata that were tried."""

    halves: list[list[Sparse]]
    square: float
    noise: float
    strata: list[int]


def _refined(
    sample: Callable[[int], list[list[Sparse]]],
    first: int,
    albedo: NDArray[np.float32],
    enough: tuple[float, float],
    last: int = 8,
) -> _Refined:
    """Sample with more strata each time, until squared noise is below a factor times the squared norm, and a number."""
    tried = [first]
    while True:
        halves = sample(tried[-1])
        square, noise = _compared(halves, albedo)
        limit = enough[0] * square + enough[1]
        if noise <= limit or tried[-1] >= last:
            return _Refined(halves, square, noise, tried)
        # between 1 / strata, as of rays at random, and its square, as of smooth light
        wanted = tried[-1] * (noise / max(limit, 1e-30)) ** (0.5 / 1.25)
        tried.append(min(last, max(tried[-1] + 1, math.ceil(min(wanted, 3 * tried[-1])))))


def _passed_twice(problem: Problem, ids: Ids, strata: int, *seeds: int) -> list[Sparse]:
    """``passed_light``, independently where it is random; nothing where nothing lets light pass."""
    if not problem.scene.passes_straight:
        return [scipy.sparse.csr_array((len(ids), problem.emission.size), dtype=np.float32)] * 2
    if problem.basis == "direction":
        return [passed_light(DirectSolver(problem), ids)] * 2
    return [passed_light(DirectSolver(problem, strata, seed), ids) for seed in seeds]


def _sampled(
    walks: SpecularRays, points: Ids, where: tuple[Ids, Ids], strata: int, seed: int, size: int
) -> list[Sparse]:
    """Light (points, size) of each channel, from rays into parts of hemispheres."""
    lit, starts = np.unique(where[0], return_index=True)  # rows are sorted
    ends = np.append(starts[1:], len(where[0]))
    found: list[list[Sparse]] = [[], [], []]
    first = 0
    while first < len(lit):
        room = LANES // strata**2 + starts[first], first + max(1, LANES // size)
        last = max(first + 1, min(int(np.searchsorted(ends, room[0], side="right")), room[1]))
        some = slice(starts[first], ends[last - 1])
        rows = np.searchsorted(lit[first:last], where[0][some])
        dense = walks.sky(points[lit[first:last]], rows, where[1][some], strata, seed)
        for channel, part in zip(found, dense, strict=True):
            channel.append(scipy.sparse.csr_array(part))
        first = last
    counts = np.zeros(len(points), np.int64)
    none = scipy.sparse.csr_array((len(points), size), dtype=np.float32)
    result = []
    for channel in found if len(lit) else []:
        together = scipy.sparse.vstack(channel, format="csr")
        counts[lit] = np.diff(together.indptr)
        starts_of_rows = np.concatenate([[0], np.cumsum(counts)])
        result.append(
            scipy.sparse.csr_array((together.data, together.indices, starts_of_rows), shape=none.shape)
        )
    return result or [none] * 3


def _compared(halves: list[list[Sparse]], albedo: NDArray[np.float32]) -> tuple[float, float]:
    """Squared norm of radiance, and of the noise in the mean of the two halves."""
    square, noise = 0.0, 0.0
    for c, (a, b) in enumerate(zip(*halves, strict=True)):
        power = np.square(albedo[:, c].astype(np.float64))
        square += float(power @ (a.multiply(b)).sum(axis=1))
        noise += float(power @ ((a - b).power(2)).sum(axis=1)) / 4
    return max(square, 0.0), noise


def _unblocked(problem: Problem, albedo: NDArray[np.float32]) -> float:
    """Squared norm of radiance under light that nothing blocks: the mean square of a cosine is a sixth."""
    weights = float(np.square(problem.emission.solid_angles.astype(np.float64) / np.pi).sum())
    return weights / 6 * float(np.square(albedo.astype(np.float64)).sum())


def passed_light(direct: DirectSolver, ids: Ids) -> Sparse:
    """Light (n, m) of texels, at some points, of which surfaces on the way let a part through, straight on.

    All of it, and nothing, is told by bits; here is what lies between.
    """
    step = max(1, LANES // (direct.lighting.size * direct.rays_per_element))
    blocks = [
        scipy.sparse.csr_array(direct.passed(np.asarray(ids[a : a + step]))) for a in range(0, len(ids), step)
    ]
    return scipy.sparse.vstack(blocks, format="csr").astype(np.float32)
