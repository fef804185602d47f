"""V and R for direct light: visibility towards the texels of the lighting by ray tracing ([Leh07] 2.2, [HR10] eq. 1).

The result is stored as what cannot be computed analytically: one bit per element in the direction basis (the cosine
and the solid angle are analytic), a 16-bit mean cosine in the texel basis.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS
from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.random_keys import random_generator
from mi_sparse_prt.emission.texel_arrays import TexelArrays
from mi_sparse_prt.measurement.point_arrays import PointArrays, start_ray
from mi_sparse_prt.operators.fractional_visibility import FULL
from mi_sparse_prt.operators.mean_cosine import FIXED_POINT
from mi_sparse_prt.scene.traced_scene import TracedScene
from mi_sparse_prt.solvers.problem import Problem

Weights = Callable[[Any, Any], list[Any]]  # of points and directions (unit, world)

NOTHING = 1e-5  # of the light: rounding leaves less, 6e-8 or so, where the opacity is 1
ALL = 0.999  # of the light: what lets as much pass is not there

SHARES = 1 << 31  # a random number's use, beyond those of strata
LANES = 1 << 24  # rays per wavefront: about 0.3 s each, so that Ctrl-C and progress bars respond


class PassedLight(NamedTuple):
    """Light that came straight through surfaces.

    Attributes
    ----------
    elements : (m,) int64
        Of those that were asked for, ascending: all others have none.
    values : (m, k) float32
        By how many surfaces it met, 1 to k, where light is told apart by these; else k is 1.
    """

    elements: NDArray[np.int64]
    values: NDArray[np.float32]


class _Passed(NamedTuple):
    """Light that comes straight through surfaces.

    Attributes
    ----------
    share : Float
        Of colours the mean.
    surfaces : UInt32
        That it met.
    whole : Mask
        As if nothing was there. Cut-outs are holes in what is around them; boundaries without a reflection are not, in
        so far as light is told apart by depth.
    """

    share: mi.Float
    surfaces: mi.UInt32
    whole: mi.Mask


class DirectSolver:
    """Direct light at points of a scene, one element per point and texel.

    Parameters
    ----------
    problem : Problem
        Direction basis: visibility towards the texel's centre. Texel basis: the cosine-weighted mean over stratified
        directions in the texel (``solvers.texel_edges`` gets nearly as near to that with few more rays than centres
        take).
    strata : int
        Texel basis: strata per axis of a texel; strata**2 rays per element, each at a random place of its stratum.
    seed : int
    """

    def __init__(self, problem: Problem, strata: int = 2, seed: int = 0) -> None:
        self.problem, self.scene = problem, problem.scene.unsplit
        self.lighting, self.points = problem.emission, problem.points
        self.basis, self.seed = problem.basis, seed
        self.strata = strata if self.basis == "texel" else 1
        self._points, self._texels = PointArrays(self.points), TexelArrays(self.lighting)

    @property
    def rays_per_element(self) -> int:
        """Shadow rays that one element above the horizon costs."""
        return self.strata**2

    @property
    def block_size(self) -> int:
        """Rows whose rays fill one wavefront."""
        return max(1, LANES // (self._padded * self.rays_per_element))

    def row_storage(self, n: int) -> NDArray[np.uint32] | NDArray[np.uint16]:
        """Zeros for n rows in the stored form of the basis: (n, ceil(n_directions / 32)) or (n, n_directions)."""
        if self.basis == "direction":
            return np.zeros((n, self._padded // BITS), dtype=np.uint32)
        return np.zeros((n, self._n_texels), dtype=np.uint16)

    def rows(self, point_ids: NDArray[np.integer]) -> NDArray[np.uint32] | NDArray[np.uint16]:
        """Trace whole rows and return them in stored form (see ``row_storage``)."""
        if self.basis == "direction":
            point, texel = self._of_rows(point_ids)
            visible, _ = self.trace(point, self._texels.centre(texel), texel < self._n_texels)
            return _packed(visible, texel).numpy().reshape(len(point_ids), -1)
        # one id more than rows: Dr.Jit would compile another kernel for an array of size one
        n, ids = len(point_ids), mi.UInt32(np.append(point_ids, point_ids[-1:]))
        element, stratum = self._lanes(n * self._n_texels)
        row = element // self._n_texels
        texel = element - row * self._n_texels
        point = dr.gather(mi.UInt32, ids, row)
        mean = self._means(point, texel, stratum, lambda *_: [mi.Float(1)], self.seed)[0]
        return mi.UInt32(mean * FIXED_POINT + 0.5).numpy().astype(np.uint16).reshape(n, -1)

    def rows_and_passed(self, point_ids: NDArray[np.integer]) -> tuple[NDArray[np.uint32], PassedLight]:
        """Of texels' centres, bits (``rows``) and what surfaces let through (``partly_passed``), by the same rays."""
        point, texel = self._of_rows(point_ids)
        direction, active = self._texels.centre(texel), texel < self._n_texels
        cosine = dr.dot(self._points.normal(point), direction)
        active &= cosine > 0
        passed = self._transmittance(start_ray(self._points, point, direction), active)
        seen, apart = active & passed.whole, self._by_depth(passed, active & ~passed.whole, cosine)
        dr.eval(seen, apart)  # at once: each reduction would trace the rays again
        bits, (lanes, values) = _packed(seen, texel), _listed(apart)
        row, column = np.divmod(lanes, self._padded)
        power = self.lighting.solid_angles[column] / np.float32(np.pi)
        found = PassedLight(row * self._n_texels + column, values * power[:, None])
        return bits.numpy().reshape(len(point_ids), -1), found

    def elements(
        self, point_ids: NDArray[np.integer], texel_ids: NDArray[np.integer], seed: int | None = None
    ) -> NDArray[np.float32]:
        """Unit-albedo direct transport (the T of albedo 1) of listed elements.

        Parameters
        ----------
        point_ids, texel_ids : (n,) integers
        seed : int, optional
            Texel basis: another seed gives an independent estimate.

        Returns
        -------
        (n,) float32
            ``V max(0, n.w) d_omega / pi``, or the mean of ``V max(0, n.w)`` over the texel times ``d_omega / pi``.
        """
        cosine = np.zeros(len(point_ids), dtype=np.float32)
        size = LANES // self.rays_per_element
        for a in range(0, len(point_ids), size):
            part = slice(a, a + size)
            points, texels = (on_device(mi.UInt32, ids[part]) for ids in (point_ids, texel_ids))
            if self.basis == "direction":
                visible, cos = self.trace(points, self._texels.centre(texels), mi.Mask(True))
                cosine[part] = dr.select(visible, cos, 0).numpy()
            else:
                cosine[part] = self.weighted_means(points, texels, lambda *_: [mi.Float(1)], seed)[0].numpy()
        return cosine * self.lighting.solid_angles[texel_ids] / np.float32(np.pi)

    def shares(
        self, point_ids: NDArray[np.integer], texel_ids: NDArray[np.integer], strata: int | None = None
    ) -> NDArray[np.int16]:
        """What is seen of listed texels, (n,): of their mean cosine above the horizon, 255 is all; -1 below it.

        Texel basis. As far as rays in strata can tell, of which there may be others than the solver's.
        """
        found, strata = np.zeros(len(point_ids), np.int16), strata or self.strata
        size = LANES // strata**2
        for a in range(0, len(point_ids), size):
            part = slice(a, a + size)
            # one more: Dr.Jit would compile another kernel for arrays of size one
            ids = (np.append(some[part], some[part][-1:]) for some in (point_ids, texel_ids))
            points, texels = (on_device(mi.UInt32, some) for some in ids)
            found[part] = self._shares(points, texels, strata).numpy()[:-1]
        return found

    def rows_of_shares(self, point_ids: NDArray[np.integer]) -> NDArray[np.int16]:
        """``shares`` of all texels, (n, n_texels)."""
        found = np.zeros((len(point_ids), self._n_texels), np.int16)
        size = max(1, LANES // (self._n_texels * self.rays_per_element))
        for a in range(0, len(point_ids), size):
            ids = np.append(point_ids[a : a + size], point_ids[-1:])
            lane = dr.arange(mi.UInt32, len(ids) * self._n_texels)
            row = lane // self._n_texels
            point = dr.gather(mi.UInt32, on_device(mi.UInt32, ids), row)
            shares = self._shares(point, lane - row * self._n_texels, self.strata).numpy()
            found[a : a + size] = shares.reshape(len(ids), -1)[:-1]
        return found

    def _shares(self, points: mi.UInt32, texels: mi.UInt32, strata: int) -> mi.Int32:
        """See ``shares``: one ray in each lane, those of a texel side by side, where they are coherent."""
        # one kernel for all numbers of strata
        across, rays = (dr.opaque(mi.UInt32, number) for number in (strata, strata**2))
        lane = dr.arange(mi.UInt32, len(texels) * strata**2)
        element = lane // rays
        stratum = lane - element * rays
        row = stratum // across
        point, texel = dr.gather(mi.UInt32, points, element), dr.gather(mi.UInt32, texels, element)
        rng = random_generator(self._points.key(point), texel, SHARES + stratum, self.seed)
        uv = (
            (mi.Float(place) + rng.next_float32()) / mi.Float(across)
            for place in (stratum - row * across, row)
        )
        direction, area = self._texels.inside(texel, *uv)
        visible, cosine = self.trace(point, direction, mi.Mask(True))
        every = dr.maximum(cosine, 0) * area
        seen = dr.select(visible, every, 0)
        dr.eval(seen, every)
        seen, total = (dr.block_reduce(dr.ReduceOp.Add, x, strata**2) for x in (seen, every))
        return dr.select(total > 0, mi.Int32(FULL * seen / total + 0.5), -1)

    def visible(self, point_ids: NDArray[np.integer], texel_ids: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Whether points see the centres of texels, (n,) bool; never below the horizon. One ray per element."""
        seen = np.zeros(len(point_ids), dtype=bool)
        for a in range(0, len(point_ids), LANES):
            part = slice(a, a + LANES)
            points, texels = (on_device(mi.UInt32, ids[part]) for ids in (point_ids, texel_ids))
            seen[part] = self.trace(points, self._texels.centre(texels), mi.Mask(True))[0].numpy()
        return seen

    def _of_rows(self, point_ids: NDArray[np.integer]) -> tuple[mi.UInt32, mi.UInt32]:
        """Point and texel of every lane; rows have some lanes more than texels."""
        # one id more than rows: Dr.Jit would compile another kernel for an array of size one
        n, ids = len(point_ids), mi.UInt32(np.append(point_ids, point_ids[-1:]))
        lane = dr.arange(mi.UInt32, n * self._padded)
        row = lane // self._padded
        return dr.gather(mi.UInt32, ids, row), lane - row * self._padded

    def _lanes(self, n_elements: int) -> tuple[mi.UInt32, mi.UInt32]:
        """Element and stratum of every lane, strata of an element side by side."""
        lane = dr.arange(mi.UInt32, n_elements * self.rays_per_element)
        element = lane // self.rays_per_element
        return element, lane - element * self.rays_per_element

    @property
    def _n_texels(self) -> int:
        return self.lighting.n_directions

    @property
    def _padded(self) -> int:
        """Directions rounded up to whole words of bits."""
        return -(-self._n_texels // BITS) * BITS

    def trace(self, point: mi.UInt32, direction: mi.Vector3f, active: mi.Mask) -> tuple[mi.Mask, mi.Float]:
        """Which points see the sky in a direction (unit, world), and the cosine; lanes side by side.

        Below the horizon no ray is traced and nothing is seen. Surfaces are in the way; where specular light is apart,
        those are not that let all light pass; but boundaries that do nothing else, where light is told apart by depth.
        """
        cosine = dr.dot(self._points.normal(point), direction)
        active &= cosine > 0
        ray = start_ray(self._points, point, direction)
        if self.problem.specular_apart and self.problem.scene.passes_straight:
            active = _unblocked(self.problem.scene.dimming_surfaces, ray, active)
            return active & self._passed(ray, active).whole, cosine
        return active & ~self.scene.ray_test(ray, active=active), cosine

    def partly_passed(
        self, point_ids: NDArray[np.integer], texel_ids: NDArray[np.integer], seed: int | None = None
    ) -> PassedLight:
        """Unit-albedo transport of listed elements that surfaces let through, but for what counts as seen (``trace``).

        Parameters
        ----------
        point_ids, texel_ids : (n,) integers
        seed : int, optional
            Texel basis: another seed gives an independent estimate.
        """
        depths = max(self.problem.depths_apart, 1)
        found, values = [np.zeros(0, np.int64)], [np.zeros((0, depths), np.float32)]
        size = LANES // (4 * self.rays_per_element)
        for a in range(0, len(point_ids), size):
            part = slice(a, a + size)
            points, texels = (on_device(mi.UInt32, ids[part]) for ids in (point_ids, texel_ids))
            element, stratum = self._lanes(len(texels))
            point, texel = dr.gather(mi.UInt32, points, element), dr.gather(mi.UInt32, texels, element)
            if self.basis == "direction":
                direction, area, total = self._texels.centre(texel), mi.Float(1), mi.Float(1)
            else:
                own = self.seed if seed is None else seed
                direction, area, total = self._inside(point, texel, stratum, own)
            cosine = dr.dot(self._points.normal(point), direction)
            passed = self._transmittance(start_ray(self._points, point, direction), cosine > 0)
            apart = self._by_depth(passed, (cosine > 0) & ~passed.whole, cosine * area)
            dr.eval(apart)  # at once: each reduction would trace the rays again
            sums = [dr.block_reduce(dr.ReduceOp.Add, one, self.rays_per_element) / total for one in apart]
            dr.eval(sums)
            places, some = _listed(sums)
            found.append(a + places)
            values.append(some)
        elements = np.concatenate(found)
        power = self.lighting.solid_angles[np.asarray(texel_ids)[elements]] / np.float32(np.pi)
        return PassedLight(elements, np.concatenate(values) * power[:, None])

    def _by_depth(self, passed: _Passed, active: mi.Mask, weight: mi.Float) -> list[mi.Float]:
        """Weighted light of rays, told apart by how many surfaces it met, or not."""
        value = dr.select(active, passed.share * weight, 0)
        depths = self.problem.depths_apart
        return [dr.select(passed.surfaces == k + 1, value, 0) for k in range(depths)] if depths else [value]

    def _transmittance(self, ray: mi.Ray3f, active: mi.Mask) -> _Passed:
        """Light that comes straight through surfaces, each of which counts as a bounce."""
        return self._passed(ray, _unblocked(self.problem.scene.blocking_surfaces, ray, active))

    def _passed(self, ray: mi.Ray3f, active: mi.Mask) -> _Passed:
        """Light that surfaces let through which let some of it through."""
        scene, depth, apart = self.problem.scene, self.problem.max_depth, self.problem.depths_apart > 0
        most = dr.opaque(mi.UInt32, depth - 2 if depth >= 0 else 1 << 30)
        share, count, boundary = pass_straight(
            scene.passing_surfaces,
            ray,
            active,
            most,
            lambda si: si.spawn_ray(ray.d),
            lambda passed: dr.sum(passed) / 3,  # the number of lanes is a constant in a kernel of dr.mean
        )
        share = dr.select(active, share, 0)
        return _Passed(share, count, (share >= ALL) & (~boundary if apart else True))

    def weighted_means(
        self, points: mi.UInt32, texels: mi.UInt32, weights: Weights, seed: int | None = None
    ) -> list[mi.Float]:
        """Means of V max(0, n.w) times some weights, one value per listed element and weight.

        Parameters
        ----------
        points, texels : UInt32
        weights : callable
            Of points and directions (unit, world).
        seed : int, optional
        """
        if self.basis == "direction":
            direction = self._texels.centre(texels)
            visible, cosine = self.trace(points, direction, mi.Mask(True))
            return [dr.select(visible, cosine * weight, 0) for weight in weights(points, direction)]
        element, stratum = self._lanes(len(texels))
        point, texel = dr.gather(mi.UInt32, points, element), dr.gather(mi.UInt32, texels, element)
        return self._means(point, texel, stratum, weights, self.seed if seed is None else seed)

    def _means(
        self, point: mi.UInt32, texel: mi.UInt32, stratum: mi.UInt32, weights: Weights, seed: int
    ) -> list[mi.Float]:
        """Over each texel, lanes being its strata; one value per element and weight.

        Samples weigh by their solid angles over the sum of these, so that a mean cosine never leaves [0, 1].
        """
        direction, area, total = self._inside(point, texel, stratum, seed)
        visible, cosine = self.trace(point, direction, mi.Mask(True))
        seen = dr.select(visible, cosine * area, 0)
        return [
            dr.block_reduce(dr.ReduceOp.Add, seen * weight, self.rays_per_element) / total
            for weight in weights(point, direction)
        ]

    def _inside(
        self, point: mi.UInt32, texel: mi.UInt32, stratum: mi.UInt32, seed: int
    ) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
        """A direction in each stratum of a texel, its weight, and the sum of weights of each element."""
        rng = random_generator(self._points.key(point), texel, stratum, seed)
        row = stratum // self.strata
        u = (mi.Float(stratum - row * self.strata) + rng.next_float32()) / self.strata
        v = (mi.Float(row) + rng.next_float32()) / self.strata
        direction, area = self._texels.inside(texel, u, v)
        return direction, area, dr.block_reduce(dr.ReduceOp.Add, area, self.rays_per_element)


def _unblocked(scene: TracedScene | None, ray: mi.Ray3f, active: mi.Mask) -> mi.Mask:
    """Rays that meet no surface of some that need not be told apart: to ask for any takes a third of the time."""
    if scene is None:
        return active
    active = active & ~scene.ray_test(ray, active)
    dr.eval(active)  # a kernel on a GPU traces rays in one scene only
    return active


@dr.syntax
def pass_straight(
    scene: mi.Scene | TracedScene,
    ray: mi.Ray3f,
    active: mi.Mask,
    most: mi.UInt32,
    onwards: Callable[[Any], Any],
    measure: Callable[[Any], Any],
) -> tuple[Any, mi.UInt32, mi.Mask]:
    """What surfaces let through straight on: masks, thin panes, ``null``.

    Parameters
    ----------
    scene : mi.Scene or TracedScene
    ray : Ray3f
        May end somewhere.
    active : Mask
    most : UInt32
        Surfaces that light may pass.
    onwards : callable
        Of an interaction: the rest of the ray.
    measure : callable
        Of a transmittance (Color3f): what is multiplied, a colour or one number.

    Returns
    -------
    share : Color3f or Float
        Of the light.
    count : UInt32
        Surfaces that it passed.
    boundary : Mask
        One of these does nothing but to let light through.
    """
    scatters = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.Null)
    share, count, boundary = measure(mi.Color3f(1)), mi.UInt32(0), mi.Mask(False)
    ray, active = mi.Ray3f(ray), mi.Mask(active)
    while active:
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        flags = si.bsdf().flags()
        through = active & mi.has_flag(flags, mi.BSDFFlags.Null) & (count < most)
        passed = measure(mi.Color3f(si.bsdf().eval_null_transmission(si, through)))
        onward = share * passed
        onward = dr.select(dr.max(mi.Color3f(onward)) > NOTHING, onward, 0)
        share = dr.select(active, dr.select(through, onward, 0), share)
        count += dr.select(through, 1, 0)
        boundary |= through & ((flags & scatters) == 0)
        ray = onwards(si)
        active &= dr.max(mi.Color3f(share)) > 0
    return share, count, boundary


def arriving_share(
    scene: mi.Scene | TracedScene,
    ray: mi.Ray3f,
    active: mi.Mask,
    passes: bool,
    most: mi.UInt32,
    onwards: Callable[[Any], Any],
) -> tuple[mi.Color3f, mi.UInt32]:
    """The share of light that arrives along shadow rays, and by how many surfaces it went straight on.

    Parameters
    ----------
    scene, ray, active, most, onwards
        See ``pass_straight``.
    passes : bool
        Some surfaces of the scene let light pass; if none does, one quick ray tells.
    """
    if not passes:
        return dr.select(scene.ray_test(ray, active), mi.Color3f(0), 1), mi.UInt32(0)
    share, count, _ = pass_straight(scene, ray, active, most, onwards, lambda passed: passed)
    return share, count


def _packed(seen: mi.Mask, texel: mi.UInt32) -> mi.UInt32:
    """Bits of lanes, one word for as many as it has."""
    return dr.block_reduce(dr.ReduceOp.Or, dr.select(seen, mi.UInt32(1) << (texel & (BITS - 1)), 0), BITS)


def _listed(values: list[mi.Float]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Lanes (m,) in which evaluated values are not all 0, which are few, and these values (m, k)."""
    index = dr.compress(sum(values[1:], values[0]) > 0)
    if not len(index):
        return np.zeros(0, np.int64), np.zeros((0, len(values)), np.float32)
    some = np.stack([dr.gather(mi.Float, one, index).numpy() for one in values], axis=1)
    return index.numpy().astype(np.int64), some
