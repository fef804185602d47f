"""Which elements judge a matrix: at random, more often where its errors are likely to be, with weights that undo that.

An element that is drawn with the probability p has the weight 1 / p, so that weighted sums over the drawn elements
estimate, without bias, sums over all of them (Horvitz and Thompson 1952); only their variance depends on p.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import Bits, bit_of
from mi_sparse_prt.core.random_keys import GOLDEN_RATIO, finalise_compiled
from mi_sparse_prt.core.read_only import read_only
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.scene.scene import FEW_MESHES, TOGETHER
from mi_sparse_prt.transport import LightTransport

FAR_FROM_EDGES = 0.2  # of the elements drawn where all bits around agree, this many are kept
AROUND = 24  # texels: 5 x 5 without the middle
NEAR_EDGES = 0.08  # of the elements; only to plan how many to draw
BELOW_HORIZON = 0.25  # added to the cosine where direct light is not bits alone: it may be wrong there, too
FEW = 8  # times fewer elements in that case: hardly one is without an error
CERTAIN = 16  # times fewer elements where none can be wrong: they find a norm

POOL = 8  # times as many, of which these are drawn
EVEN = 0.2  # of them drawn without regard to the light that the matrix has there

MEAN_COSINE = 0.25  # of max(0, n . w) over the sphere
BLOCK = 1 << 12  # vertices at a time: some hundred trials each

_NO_EDGES = np.zeros((0, 0), np.uint32), np.zeros((0, 0), np.int32)


@dataclass(frozen=True)
class Effort:
    """How much of a matrix is held out.

    Attributes
    ----------
    rays : float
        Of the elements of a mesh, for direct light that is bits; but as many as ``fewest_rays``, or a quarter of it.
    fewest_rays : int
    paths : int
        Elements for indirect light, shared out among meshes: as many as ``few_paths`` where there are many of these, at
        most 1 / 16 of a mesh, but as many as ``fewest_paths`` where one is small.
    few_paths, fewest_paths : int
    spp : int
        Paths for each of these.
    strata : int
        Texel basis: shadow rays per axis of a texel.
    specular : int
        Rows for light by way of mirrors and glass, of all meshes together.
    specular_strata : int
        Rays for these, in each of four estimates: strata per axis of a part of the hemisphere.
    certain : bool
        Whether direct light is of the very rays that judge it, as ``held_out_error`` is told.
    """

    rays: float = 0.002
    fewest_rays: int = 1 << 16
    paths: int = 8192
    few_paths: int = 512
    fewest_paths: int = 64
    spp: int = 128
    strata: int = 4
    specular: int = 128
    specular_strata: int = 4
    certain: bool = False

    def rays_of(self, total: int, n_meshes: int) -> float:
        """How many elements of a mesh, one of ``n_meshes``, are drawn for direct light that is bits, about."""
        count = max(self.rays * total, min(total / 4, self.fewest_rays * _share(n_meshes)))
        return count / CERTAIN if self.certain else count

    def paths_of(self, total: int, n_meshes: int, part: float = 1.0) -> int:
        """How many elements of a mesh, one of ``n_meshes``, that has so many are drawn for indirect light, about."""
        share = max(self.paths // n_meshes, round(self.few_paths * _share(n_meshes)))
        fewest = max(round(self.fewest_paths * _share(n_meshes)), 1)
        return max(round(part * min(share, total // 16)), min(fewest, total))


def _share(n_meshes: int) -> float:
    """Of the least number of elements, where meshes are many: cost follows vertices, not shapes."""
    return 1.0 if n_meshes <= FEW_MESHES else TOGETHER / n_meshes


@dataclass(frozen=True)
class Chosen:
    """Elements of a mesh.

    Attributes
    ----------
    vertices, texels : (m,) int64
        Sorted by vertex.
    weights : (m,) float64
        How many elements of the mesh each stands for.
    """

    vertices: NDArray[np.int64]
    texels: NDArray[np.int64]
    weights: NDArray[np.float64]


def for_direct_light(
    transport: LightTransport,
    normals: NDArray[np.float32],
    inside: slice,
    rng: np.random.Generator,
    effort: Effort,
    part: float = 1.0,
) -> Chosen:
    """Draw elements for direct light, at all vertices of a mesh: a few of them may hold most of the error.

    At each vertex texels are drawn by cosine and solid angle. An element is seldom wrong where all bits around it
    agree, so only some of those are kept.

    Parameters
    ----------
    transport : LightTransport
    normals : (n_v, 3) float32
        Of all vertices.
    inside : slice
        The vertices of the mesh.
    rng : numpy.random.Generator
    effort : Effort
    part : float
        Of these elements.
    """
    lighting, direct = transport.lighting, transport.operators["direct"]
    total = (inside.stop - inside.start) * lighting.n_directions
    rays = part * effort.rays_of(total, len(transport.meshes))
    floor, edges = 0.0, _NO_EDGES
    if not direct.dark_below_horizon:
        rays, floor = rays / FEW, BELOW_HORIZON
    if direct.edges is not None:
        rays /= NEAR_EDGES + (1 - NEAR_EDGES) * FAR_FROM_EDGES
        edges = direct.edges[inside], lighting.neighbours(AROUND + 1)
    return _by_cosine(lighting, normals[inside], inside.start, rays, floor, edges, rng)


def for_indirect_light(
    transport: LightTransport, inside: slice, rng: np.random.Generator, effort: Effort, part: float = 1.0
) -> Chosen:
    """Draw elements for indirect light, where the matrix has most of it: there its errors and the paths' noise are.

    Parameters
    ----------
    transport : LightTransport
        If it has no indirect light, elements are drawn evenly.
    inside : slice
        The vertices of the mesh.
    rng : numpy.random.Generator
    effort : Effort
    part : float
        Of these elements.
    """
    indirect = transport.operators.get("indirect")
    total = (inside.stop - inside.start) * transport.lighting.n_directions
    count = effort.paths_of(total, len(transport.meshes), part)
    pool = np.sort(rng.choice(total, min(total, POOL * count), replace=False))
    vertices, texels = np.divmod(pool, transport.lighting.n_directions)
    vertices += inside.start
    found = indirect.elements(vertices, texels) if indirect else np.ones((len(pool), 1), np.float32)
    light = np.abs(transport.albedo[vertices] * found).sum(axis=1)
    mean = float(light.mean(dtype=np.float64))
    density = EVEN + (1 - EVEN) * (light / mean if mean > 0 else np.ones(len(pool)))
    probability = np.minimum(1.0, count / len(pool) * density.astype(np.float64))
    kept = rng.random(len(pool)) < probability
    return Chosen(vertices[kept], texels[kept], total / len(pool) / probability[kept])


def _by_cosine(
    lighting: CubemapLighting,
    normals: NDArray[np.float32],
    first: int,
    count: float,
    floor: float,
    edges: tuple[Bits, NDArray[np.int32]],
    rng: np.random.Generator,
) -> Chosen:
    """About ``count`` elements, drawn by (cosine + floor) x solid angle: random texels, kept or rejected by that.

    Of those far from edges (bits, texels around each) few are kept. Vertices are counted from ``first`` on.
    """
    directions, areas = lighting.directions, lighting.solid_angles / lighting.solid_angles.max()
    n, (bits, around), parts = len(normals), edges, []
    trials = max(1, round(count * (1 + floor) / (float(areas.mean()) * (MEAN_COSINE + floor) * n)))
    seeds = rng.integers(1 << 63, size=n, dtype=np.uint64)
    for a in range(0, n, BLOCK):
        block = slice(a, min(a + BLOCK, n))
        size = block.stop - a, trials
        texels, weights, counts = np.empty(size, np.int32), np.empty(size), np.zeros(size[0], np.int64)
        among = normals[block], directions, areas, floor, read_only(bits[block]), around, seeds[block]
        run_in_parts(_keep, size[0], *among, texels, weights, counts)
        vertices = np.repeat(np.arange(first + a, first + block.stop), counts)
        parts.append((vertices, *_packed(texels, weights, counts)))
    return Chosen(*(np.concatenate(column) for column in zip(*parts, strict=True)))


@numba.njit(nogil=True, cache=True)
def _keep(
    start: int,
    end: int,
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
    areas: NDArray[np.float32],
    floor: float,
    bits: Bits,
    around: NDArray[np.int32],
    seeds: NDArray[np.uint64],
    texels: NDArray[np.int32],
    weights: NDArray[np.float64],
    counts: NDArray[np.int64],
) -> None:
    """Texels and weights of the trials of each vertex that are kept, (n, trials), and how many these are, (n,)."""
    trials = texels.shape[1]
    for i in range(start, end):
        state = seeds[i]
        for _ in range(trials):
            state += np.uint64(GOLDEN_RATIO)
            random = finalise_compiled(state)
            texel = int(((random >> np.uint64(32)) * np.uint64(len(directions))) >> np.uint64(32))
            uniform = (random & np.uint64(0xFFFFFFFF)) / 2.0**32
            probability = (
                areas[texel] * (max(_cosine(normals[i], directions[texel]), 0.0) + floor) / (1 + floor)
            )
            if uniform >= probability:
                continue
            # what was below the probability is uniform again, relative to it
            if len(around) and not _near_edge(bits[i], normals[i], directions, texel, around[texel]):
                if uniform >= FAR_FROM_EDGES * probability:
                    continue
                probability *= FAR_FROM_EDGES
            texels[i, counts[i]] = texel
            weights[i, counts[i]] = len(directions) / (trials * probability)
            counts[i] += 1


@numba.njit(cache=True)
def _packed(
    texels: NDArray[np.int32], weights: NDArray[np.float64], counts: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The first of each row's values, as many as counted, one row after another."""
    total, a = counts.sum(), 0
    flat, weight = np.empty(total, np.int64), np.empty(total)
    for i in range(len(counts)):
        for k in range(counts[i]):  # not slices: their error message alone compiles for seconds
            flat[a + k], weight[a + k] = texels[i, k], weights[i, k]
        a += counts[i]
    return flat, weight


@numba.njit
def _cosine(normal: NDArray[np.float32], direction: NDArray[np.float32]) -> float:
    return normal[0] * direction[0] + normal[1] * direction[1] + normal[2] * direction[2]


@numba.njit
def _near_edge(
    bits: Bits,
    normal: NDArray[np.float32],
    directions: NDArray[np.float32],
    texel: int,
    around: NDArray[np.int32],
) -> bool:
    """Whether a bit differs from one of those around it; below the horizon there is nothing to differ from."""
    own = bit_of(bits, texel)
    for j in around:
        if bit_of(bits, j) != own and _cosine(normal, directions[j]) > 0:
            return True
    return False


def draw_by_energy(
    energy: NDArray[np.floating], group: slice, count: int, least: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Some elements of a group: half are drawn where much energy is, the others anywhere.

    Parameters
    ----------
    energy : (n,) float
        Of all elements; not below 0.
    group : slice
    count : int
        Elements of all groups together, about: half are shared out by energy, the others by size.
    least : int
        Of each group.
    rng : Generator

    Returns
    -------
    chosen : (k,) int64
        Ascending; all of the group, once each, if it has no more.
    weights : (k,) float64
        How many elements each stands for.
    """
    own = energy[group].astype(np.float64)
    total, size = max(float(energy.sum(dtype=np.float64)), 1e-300), len(own)
    count = max(least, round(count * (size / len(energy) + own.sum() / total) / 2))
    if count >= size:
        return np.arange(group.start, group.stop), np.ones(size)
    bright = own / own.sum() if own.any() else np.full(size, 1 / size)
    chance = (1 / size + bright) / 2
    chosen = np.sort(rng.choice(size, count, p=chance / chance.sum()))
    return group.start + chosen, 1 / (count * chance[chosen])
