"""Rays that go on from one specular surface to the next: mirrors, glass, masks.

What scatters light into single directions keeps no rows, and rough glass none either: Mitsuba's own BSDF samples say
where a ray goes on, and with which weight. Where it meets a surface that reflects diffusely, that is an entry of the
form-factor matrix; where it leaves the scene, it is light of the texel that it leaves to.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, TypeAlias

import drjit as dr
import mitsuba as mi
import numba
import numpy as np
import scipy.ndimage
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.ragged import row_starts
from mi_sparse_prt.core.random_keys import mix, random_generator
from mi_sparse_prt.core.sparse_arrays import sparse_of_rows
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.emission.cube_faces import face_coordinates, texel_at
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.measurement.point_arrays import PointArrays, start_ray
from mi_sparse_prt.operators.operator import Ids
from mi_sparse_prt.scene.materials import is_one_of, sample_weight, single_direction
from mi_sparse_prt.solvers.form_factors import NOTHING, Surfaces, cosine_rays, sobol
from mi_sparse_prt.solvers.lamps import lamp_asked, lamp_met
from mi_sparse_prt.solvers.problem import Problem

LANES = 1 << 22  # rays per wavefront
CELLS = 16  # of a hemisphere, per axis
LEAST = 1e-6  # share of light that a specular surface is taken to send on
LONGEST = 16  # surfaces on the way, where ``max_depth`` sets no limit

Sparse: TypeAlias = scipy.sparse.csr_array
Floats: TypeAlias = NDArray[np.float32]


class Cells(NamedTuple):
    """Cells of the hemispheres of some points, of the same cosine-weighted solid angle, CELLS x CELLS of each.

    Attributes
    ----------
    rows : (m,) int64
        Which of the points, ascending.
    numbers : (m,) int64
        Of a cell of its hemisphere.
    shares : (m,) float32
        Of light, that specular surfaces in or next to it send on: the largest, by one ray into each cell.
    """

    rows: NDArray[np.int64]
    numbers: NDArray[np.int64]
    shares: NDArray[np.float32]

    def take(self, part: slice | NDArray[np.integer]) -> Cells:
        """Some of them."""
        return Cells(self.rows[part], self.numbers[part], self.shares[part])


def _bayer(size: int) -> NDArray[np.float64]:
    """Bayer's matrix (size**2,), size a power of two, of [0, 1): cells of any interval are spread evenly."""
    numbers = np.zeros((1, 1))
    while len(numbers) < size:
        numbers = np.block([[4 * numbers, 4 * numbers + 2], [4 * numbers + 3, 4 * numbers + 1]])
    return numbers.ravel() / size**2


class Strata(NamedTuple):
    """Cells that rays go into, one into each stratum.

    Attributes
    ----------
    cells : Cells
        (k,) of others; where less than one ray is wanted of each, some of them stand for all.
    which : (k,) int64
        Their places among the others.
    across : (k,) int64
        Strata per axis.
    scale : (k,) float32
        What their light is to be multiplied by.
    """

    cells: Cells
    which: NDArray[np.int64]
    across: NDArray[np.int64]
    scale: Floats

    @property
    def shares(self) -> NDArray[np.float64]:
        """Of all light that a point receives, that each ray stands for (k,)."""
        return self.scale / (CELLS * self.across.astype(np.float64)) ** 2

    def take(self, part: slice) -> Strata:
        """Some of them."""
        return Strata(self.cells.take(part), self.which[part], self.across[part], self.scale[part])


def draw_strata(
    cells: Cells, keys: NDArray[np.uint64], rays: NDArray[np.float64], most: int, seed: int
) -> Strata:
    """Strata of cells, as many as rays are wanted of each, about.

    Parameters
    ----------
    cells : Cells
        (m,) of some points.
    keys : (n,) uint64
        Of these points.
    rays : (m,) float64
        Wanted; where less than one, cells are drawn by that chance, spread evenly over each hemisphere.
    most : int
        Strata per axis, at most.
    seed : int
    """
    own, drawn = mix(mix(keys ^ np.uint64(seed))) * 2.0**-64, np.empty(len(rays), np.bool_)
    run_in_parts(_draw, len(rays), cells.rows, cells.numbers, own, _bayer(CELLS), rays, drawn)
    which = np.flatnonzero(drawn)
    wanted = rays[which]
    across = np.clip(np.rint(np.sqrt(wanted)), 1, most).astype(np.int64)
    return Strata(cells.take(which), which, across, (1 / np.minimum(wanted, 1)).astype(np.float32))


@numba.njit(nogil=True, cache=True)
def _draw(
    first: int,
    last: int,
    rows: NDArray[np.int64],
    numbers: NDArray[np.int64],
    own: NDArray[np.float64],
    bayer: NDArray[np.float64],
    rays: NDArray[np.float64],
    drawn: NDArray[np.bool_],
) -> None:
    """Whether cells are drawn: their place in Bayer's matrix, turned by their point's number, is below their chance."""
    for i in range(first, last):
        at = own[rows[i]] + bayer[numbers[i]]
        drawn[i] = (at - 1 if at >= 1 else at) < rays[i]


class ArrivedLight(NamedTuple):
    """What rays into cells found.

    Attributes
    ----------
    light : three (n, k * n_directions) sparse float32
        Unit-albedo transport of points: side by side that of light which met 1, 2, ... k surfaces, where it is told
        apart by these; else k is 1.
    squares : (m,) float32
        Of the weights of rays that found light, summed over those of each cell.
    """

    light: list[Sparse]
    squares: NDArray[np.float32]


class _Rays(NamedTuple):
    """Rays on the device, the number that each was given, and random numbers."""

    ray: Any
    of: Any
    rng: Any


class _Ends(NamedTuple):
    """Ends of rays on the device: the number that each was given, a column, its weight, and whether it is valid."""

    of: Any
    column: Any
    weight: Any
    valid: Any


class SpecularChains:
    """Rays from points that go on where they meet specular surfaces.

    Parameters
    ----------
    problem : Problem
        Light of a cubemap, or of lamps that rays can meet.
    """

    def __init__(self, problem: Problem) -> None:
        self._scene, self._surfaces = problem.scene, Surfaces(problem.scene)
        self._problem = problem
        self._rough_glass = problem.scene.rough_glass
        self._points = PointArrays(problem.points)
        self._of_sky, self._size = isinstance(problem.emission, CubemapLighting), problem.emission.size
        self._asks = not self._of_sky and bool(self._rough_glass) and len(problem.emission.unmet) > 0
        depth, self._apart = problem.max_depth, problem.depths_apart
        self._longest = LONGEST if depth < 0 else min(depth - 2, LONGEST)

    def find_cells(self, ids: Ids, seed: int) -> Cells:
        """Cells of the hemispheres of points in which, or next to which, a ray meets a specular surface."""
        found = []
        for a in range(0, len(ids), LANES // CELLS**2):
            some = mi.UInt32(ids[a : a + LANES // CELLS**2].astype(np.uint32))
            lane = dr.arange(mi.UInt32, len(some) * CELLS**2)
            row = lane // CELLS**2
            point = dr.gather(mi.UInt32, some, row)
            shares = self._shares(
                *self._ray_into(point, lane - row * CELLS**2, mi.UInt32(1), mi.UInt32(0), seed)
            )
            shares = shares.reshape(-1, CELLS, CELLS)
            rows = np.flatnonzero(shares.any(axis=(1, 2)))
            grown = scipy.ndimage.maximum_filter(shares[rows], (1, 3, 3)).reshape(-1, CELLS**2)
            of, number = np.nonzero(grown)
            found.append((a + rows[of], number, grown[of, number]))
        return Cells(*(np.concatenate(x) for x in zip(*found, strict=True)))

    def gather_light(self, ids: Ids, strata: Strata, seed: int) -> ArrivedLight:
        """Light of texels to which rays from points leave the scene, or of lamps; not of those that went straight on.

        Parameters
        ----------
        ids : (n,) integers
            Points.
        strata : Strata
            Of cells of these.
        seed : int
        """
        rays = self._rays_into(ids, strata.cells, strata.across, seed)
        gather = self._of_texels if self._of_sky else self._of_lamps
        return gather(rays, len(ids), strata.cells.rows, strata.shares)

    def _of_lamps(
        self, rays: _Rays, n: int, rows: NDArray[np.int64], shares: NDArray[np.float64]
    ) -> ArrivedLight:
        """Sums of few columns, however bright, in the order of rays."""
        sums, squares = np.zeros((3, n * self._size)), np.zeros(len(rows))
        for ends in self._follow(*rays, True):
            of, column, weight = kept_ends(ends)
            place = rows[of] * self._size + column
            for total, own in zip(sums, weight, strict=True):
                np.add.at(total, place, own * shares[of])
            np.add.at(squares, of, np.square(weight.max(axis=0), dtype=np.float64))
        light = [scipy.sparse.csr_array(total.reshape(n, -1).astype(np.float32)) for total in sums]
        return ArrivedLight(light, squares.astype(np.float32))

    def _of_texels(
        self, rays: _Rays, n: int, rows_of: NDArray[np.int64], shares: NDArray[np.float64]
    ) -> ArrivedLight:
        """Sums of many columns, of which few are not 0, in the order of rays."""
        of, column, weight = self._follow_to_sky(rays)
        starts = np.searchsorted(rows_of[of], np.arange(n + 1))
        shape = n, self._size * max(self._apart, 1)
        squares = np.bincount(of, np.square(weight.max(axis=0), dtype=np.float64), len(rows_of))
        light = weight * shares[of].astype(np.float32)
        return ArrivedLight(_summed(starts, column, light, shape), squares.astype(np.float32))

    def gather_surfaces(self, ids: Ids, samples: list[mi.UInt32], seed: int) -> list[Sparse]:
        """What cosine-distributed rays from some points find after 1, 2, ... specular surfaces, by vertices (n, n_v).

        One matrix after any number of them, where light is not told apart by depth. Weights of colours are averaged.
        """
        n, rays = len(ids), len(samples[0])
        ray, _, _, rng = cosine_rays(self._points, mi.UInt32(ids.astype(np.uint32)), samples, seed)
        row = dr.arange(mi.UInt32, n * rays) // rays
        shape = n, self._surfaces.n_vertices
        found = [scipy.sparse.csr_array(shape, dtype=np.float32) for _ in range(max(self._apart - 1, 1))]
        for depth, ends in enumerate(self._follow(ray, row, rng, False)):
            if depth + 1 < self._longest:  # light of a surface at the end makes one more bounce
                of, column, weight = kept_ends(ends)
                mean = (weight.mean(axis=0) / rays).astype(np.float32)
                found[depth if self._apart else 0] += scipy.sparse.coo_array(
                    (mean, (of, column)), shape=shape
                ).tocsr()
        return found

    def _rays_into(self, ids: Ids, cells: Cells, strata: NDArray[np.int64], seed: int) -> _Rays:
        """Rays into cells, one in each stratum, the cells that they belong to, and random numbers for the rest."""
        counts = strata**2
        of_lane = np.repeat(np.arange(len(counts), dtype=np.uint32), counts)
        first = (np.cumsum(counts) - counts).astype(np.uint32)
        entry = on_device(mi.UInt32, of_lane)
        row, cell, across, start = (
            dr.gather(mi.UInt32, mi.UInt32(x.astype(np.uint32)), entry)
            for x in (cells.rows, cells.numbers, strata, first)
        )
        stratum = dr.arange(mi.UInt32, len(of_lane)) - start
        point = dr.gather(mi.UInt32, mi.UInt32(ids.astype(np.uint32)), row)
        across = dr.maximum(across, 1)  # 0 in lanes beyond the last one, by which processors do not divide
        ray, rng = self._ray_into(point, cell, across, stratum, seed)
        return _Rays(ray, entry, rng)

    def _ray_into(
        self, point: mi.UInt32, cell: mi.UInt32, across: mi.UInt32, stratum: mi.UInt32, seed: int
    ) -> tuple[mi.Ray3f, mi.PCG32]:
        """Rays from points into strata of cells, and random numbers for the rest."""
        rng = random_generator(self._points.key(point), cell, stratum, seed)
        down = stratum // across
        x, y = (
            (mi.Float(c * across + k) + rng.next_float32()) / mi.Float(CELLS * across)
            for c, k in ((cell % CELLS, stratum - down * across), (cell // CELLS, down))
        )
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(x, y))
        direction = mi.Frame3f(self._points.normal(point)).to_world(local)
        return start_ray(self._points, point, direction), rng

    def _shares(self, ray: mi.Ray3f, rng: mi.PCG32) -> NDArray[np.float32]:
        """Of light, that what each ray meets sends on; 0 if that is no specular surface."""
        lanes = dr.width(ray.o)
        index, ray, rng = self._towards_specular(ray, rng)
        shares = dr.zeros(mi.Float, lanes)
        if len(index):
            si = self._scene.unsplit.ray_intersect(ray)
            _, share = self._scattered(si, rng, si.is_valid())
            share = dr.select(self._is_specular(si), dr.maximum(dr.max(share), LEAST), 0)
            dr.scatter(shares, share, index)
        found: NDArray[np.float32] = shares.numpy()
        return found

    def _towards_specular(self, ray: mi.Ray3f, *others: Any) -> list[Any]:
        """Lanes of rays in whose way is a specular surface, whatever is before it, and what belongs to these.

        To ask for these alone takes a fraction of the time of asking for what is met.
        """
        surfaces = self._scene.specular_surfaces
        assert surfaces is not None  # there is nothing to follow without one
        some = surfaces.ray_test(ray)
        dr.eval(some, ray, *others)
        index = dr.compress(some)
        return [index, *(dr.gather(type(x), x, index) for x in (ray, *others))]

    def _is_specular(self, si: mi.SurfaceInteraction3f) -> mi.Mask:
        return mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Delta) | is_one_of(self._rough_glass, si)

    def _follow_to_sky(self, rays: _Rays) -> tuple[NDArray[np.uint32], NDArray[np.uint32], Floats]:
        """Rays that end at texels of the sky after any number of specular surfaces, in one kernel.

        Numbers (m,) that they were given, columns (of how many surfaces they met, and a texel), and weights (3, m).
        """
        index, ray, of, rng = self._towards_specular(*rays)
        if len(index) == 0:  # no rays at all end the process if they are traced
            return np.zeros(0, np.uint32), np.zeros(0, np.uint32), np.zeros((3, 0), np.float32)
        dr.eval(ray, of, rng)
        longest, size = (
            dr.opaque(mi.UInt32, self._longest),
            dr.opaque(mi.UInt32, self._size if self._apart else 0),
        )

        def go_on(
            ray: mi.Ray3f,
            rng: mi.PCG32,
            weight: mi.Color3f,
            straight: mi.Mask,
            met: mi.UInt32,
            found: tuple[mi.UInt32, mi.Color3f],  # a column and its weight
            alive: mi.Mask,
        ) -> tuple[Any, ...]:
            hit = self._scene.unsplit.ray_intersect_preliminary(ray, active=alive)
            texel, _ = self._light_met(hit, ray, alive & ~straight)
            ends = alive & (texel != NOTHING) & (dr.max(weight) > 0)
            found = (
                dr.select(ends, (met - 1) * size + texel, found[0]),
                dr.select(ends, weight, found[1]),
            )
            si = self._scene.unsplit.interaction(hit, ray, alive)
            goes_on, ray, weight, null = self._sent_on(si, weight, rng, alive & (met < longest))
            return ray, rng, weight, straight & null, met + 1, found, goes_on

        n = len(index)
        state = (
            ray,
            rng,
            dr.full(mi.Color3f, 1, n),
            dr.full(mi.Mask, True, n),
            mi.UInt32(0),
            (dr.full(mi.UInt32, NOTHING, n), dr.zeros(mi.Color3f, n)),
            dr.full(mi.Mask, True, n),
        )
        *_, (column, brought), _ = dr.while_loop(state, lambda *state: state[-1], go_on, mode="symbolic")
        dr.eval(column, brought)
        return kept_ends(_Ends(of, column, brought, column != NOTHING))

    def _sent_on(
        self, si: mi.SurfaceInteraction3f, weight: mi.Color3f, rng: mi.PCG32, active: mi.Mask
    ) -> tuple[mi.Mask, mi.Ray3f, mi.Color3f, mi.Mask]:
        """Which rays specular surfaces send on, where to, with which weight, and whether as if nothing was there."""
        goes_on = active & si.is_valid() & self._is_specular(si) & (dr.max(weight) > 0)
        scattered, share = self._scattered(si, rng, goes_on)
        weight = dr.select(goes_on, weight * share, 0)
        straight = mi.has_flag(scattered.sampled_type, mi.BSDFFlags.Null)
        return goes_on, si.spawn_ray(si.to_world(scattered.wo)), weight, straight

    def _follow(self, ray: mi.Ray3f, of: mi.UInt32, rng: mi.PCG32, to_light: bool) -> Iterator[_Ends]:
        """Rays that end after one specular surface, after two, ...: at texels of the sky, at lamps, or at vertices.

        Of lamps, those that are asked at a surface come apart, before those that rays meet after it.
        """
        # triangles of the normalised scene have the vertices
        scene = self._scene.unsplit if to_light else self._scene.normalised
        index, ray, of, rng = self._towards_specular(ray, of, rng)
        if len(index) == 0:  # no rays at all end the process if they are traced
            return
        hit = scene.ray_intersect_preliminary(ray)
        weight, straight = dr.full(mi.Color3f, 1, len(index)), dr.full(mi.Mask, True, len(index))
        for _ in range(self._longest):
            si = scene.interaction(hit, ray)
            if to_light and self._asks:
                yield self._of_lamps_asked(si, of, weight, rng)
            goes_on, ray, weight, null = self._sent_on(si, weight, rng, mi.Mask(True))
            straight &= null
            hit = scene.ray_intersect_preliminary(ray, active=goes_on)
            valid, radiance = hit.is_valid(), mi.Color3f(1)
            if to_light:
                column, radiance = self._light_met(hit, ray, goes_on & ~straight)
            else:
                corner = self._surfaces.corner(hit, ray, rng.next_float32())
                column = dr.select(valid, self._surfaces.sender(corner, rng), NOTHING)
            brought = weight * radiance
            ends = goes_on & (column != NOTHING) & (dr.max(brought) > 0)
            alive = goes_on & valid & (dr.max(weight) > 0)
            dr.eval(of, column, weight, brought, ends, alive, ray, rng, straight, hit)
            yield _Ends(of, column, brought, ends)
            index = dr.compress(alive)
            if len(index) == 0:
                return
            of, weight, straight, ray, rng, hit = (
                dr.gather(type(x), x, index) for x in (of, weight, straight, ray, rng, hit)
            )

    def _of_lamps_asked(
        self, si: mi.SurfaceInteraction3f, of: mi.UInt32, weight: mi.Color3f, rng: mi.PCG32
    ) -> _Ends:
        """What rough glass scatters of lamps that no ray can meet; the others end the rays that go on from it."""
        rough = si.is_valid() & is_one_of(self._rough_glass, si)
        lamp, towards, light = lamp_asked(self._problem, si, rng, rough)
        brought = weight * si.bsdf().eval(mi.BSDFContext(), si, si.to_local(towards), rough) * light
        valid = rough & (dr.max(brought) > 0)
        dr.eval(of, lamp, brought, valid, rng)
        return _Ends(of, lamp, brought, valid)

    def _light_met(
        self, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Mask
    ) -> tuple[mi.UInt32, mi.Color3f]:
        """The column of what rays meet that shines, NOTHING for none, and its radiance."""
        if self._of_sky:
            texel = texel_at(*face_coordinates(ray.d), self._problem.emission.resolution)
            return dr.select(active & ~hit.is_valid(), texel, NOTHING), mi.Color3f(1)
        lamp, radiance = lamp_met(
            self._problem, self._scene.unsplit.interaction(hit, ray, active), ray, active
        )
        return dr.select(lamp >= 0, mi.UInt32(lamp), NOTHING), radiance

    def _scattered(
        self, si: mi.SurfaceInteraction3f, rng: mi.PCG32, active: mi.Mask
    ) -> tuple[mi.BSDFSample3f, mi.Color3f]:
        """Where rays go on, and what that weighs: single directions, but all that rough glass scatters."""
        u, v = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        delta = int(mi.BSDFFlags.Delta)
        if not self._rough_glass:
            return single_direction(si, u, v, active, delta)
        rough = is_one_of(self._rough_glass, si)
        sample, weight = single_direction(si, u, v, active & ~rough, delta)
        every, its = si.bsdf().sample(mi.BSDFContext(), si, u, v, active & rough)
        return dr.select(rough, every, sample), dr.select(rough, sample_weight(every, its), weight)


def kept_ends(ends: _Ends) -> tuple[NDArray[np.uint32], NDArray[np.uint32], Floats]:
    """Numbers (m,), columns and weights (3, m) of rays that are valid."""
    index = dr.compress(ends.valid)
    if len(index) == 0:  # nothing is gathered of nothing
        return np.zeros(0, np.uint32), np.zeros(0, np.uint32), np.zeros((3, 0), np.float32)
    of, column, weight = (dr.gather(type(x), x, index) for x in (ends.of, ends.column, ends.weight))
    dr.eval(of, column, weight)
    return of.numpy(), column.numpy(), weight.numpy()


def _summed(
    starts: NDArray[np.int64], columns: NDArray[np.uint32], values: Floats, shape: tuple[int, int]
) -> list[Sparse]:
    """Matrices (rows, columns) of each channel from entries, row i's from starts[i] on, of any order within a row."""
    found, sums = np.empty(len(columns), np.int32), np.empty((len(columns), 3), np.float32)
    counts = np.empty(shape[0], np.int64)
    entries = columns, np.ascontiguousarray(values.T)
    run_in_parts(_sum_rows, shape[0], starts, shape[1], entries, found, sums, counts)
    rows = np.repeat(np.arange(shape[0]), np.diff(starts))
    kept = np.arange(len(columns)) - starts[rows] < counts[rows]
    pointers, indices = row_starts(counts), found[kept]
    return [sparse_of_rows(v.copy(), indices, pointers, shape[1]) for v in sums[kept].T]


@numba.njit(nogil=True, cache=True)
def _sum_rows(
    first: int,
    last: int,
    starts: NDArray[np.int64],
    width: int,
    entries: tuple[NDArray[np.uint32], Floats],
    found: NDArray[np.int32],
    sums: Floats,
    counts: NDArray[np.int64],
) -> None:
    """Entries of equal columns added up, ascending, from where the row's entries begin."""
    columns, values = entries
    total, used = np.zeros((width, 3)), np.zeros(width, np.bool_)
    for i in range(first, last):
        at = starts[i]
        for e in range(starts[i], starts[i + 1]):
            column = columns[e]
            if not used[column]:
                used[column] = True
                found[at] = column
                at += 1
            for c in range(3):
                total[column, c] += values[e, c]
        counts[i] = at - starts[i]
        found[starts[i] : at].sort()
        for k in range(starts[i], at):
            column = found[k]
            sums[k] = total[column]
            total[column] = 0.0
            used[column] = False


def specular_form_factors(problem: Problem, ids: Ids, rays: int, seed: int) -> list[Sparse]:
    """What G (n, n_v) lacks without specular surfaces: what rays from some points find after 1, 2, ... of these.

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
    Where light is not told apart by depth, there is one matrix. A surface that is found after k specular ones then
    sends out light of as many bounces as any other, k more than Mitsuba's ``path`` would follow at the same depth.
    """
    chains, samples = SpecularChains(problem), sobol(rays)
    step = max(1, LANES // rays)
    blocks = [chains.gather_surfaces(ids[a : a + step], samples, seed) for a in range(0, len(ids), step)]
    return [scipy.sparse.vstack(some, format="csr").astype(np.float32) for some in zip(*blocks, strict=True)]
