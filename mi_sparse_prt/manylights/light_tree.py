"""Trees of lights, and how much light of a node can reach a diffuse sample (Walter et al. 2005, "Lightcuts")."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.morton import morton_order
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.manylights.light_arrays import DIRECTION, EMITTER
from mi_sparse_prt.manylights.lights import Lights

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ids = NDArray[np.int64]


@dataclass(frozen=True)
class LightTree:
    """Binary trees, one for all lights of one kind and depth whose normals are about alike.

    Attributes
    ----------
    roots : (k,) int64
        Nodes; the first n nodes are the lights.
    children : (nodes, 2) int64
        -1 for lights.
    representatives : (nodes,) int64
        A light of each, drawn in proportion to its intensity; one of the two children has the same.
    intensities : (nodes,) float64
        Mean of the channels, of all lights of a node.
    bounds : (nodes, 11) float32
        Centre and half extent of the box, world; axis of the normals, cosine and sine of the angle of their cone (of
        lights from far away: of the directions towards them).
    colours : (nodes, 3) float32
        Intensities.
    far, reflected : (nodes,) bool
        Whether lights are directions, and whether their geometry term is clamped.
    """

    roots: Ids
    children: Ids
    representatives: Ids
    intensities: Doubles
    bounds: Floats
    colours: Floats
    far: NDArray[np.bool_]
    reflected: NDArray[np.bool_]


class _Level(NamedTuple):
    """Neighbouring nodes of one tree."""

    ids: Ids
    representatives: Ids
    colours: Doubles
    low: Doubles
    high: Doubles
    axes: Doubles
    angles: Doubles

    def part(self, which: Any) -> _Level:
        """Some of the nodes."""
        return _Level._make(values[which] for values in self)


def _side_by_side(levels: Sequence[_Level]) -> _Level:
    return _Level._make(map(np.concatenate, zip(*levels, strict=True)))


def build_light_tree(lights: Lights, rng: np.random.Generator) -> LightTree:
    """Neighbours along a space-filling curve are joined, pair by pair.

    Parameters
    ----------
    lights : Lights
    rng : np.random.Generator
        Draws the representatives.
    """
    arrays = lights.arrays
    kinds, depths = arrays.kind.numpy(), arrays.depth.numpy()
    places, normals = (np.array(x.numpy(), np.float64).T for x in (arrays.place, arrays.normal))
    colours = arrays.power.numpy().T.astype(np.float64)
    far = kinds == DIRECTION
    axes = np.where(far[:, None], places, normals)
    n, zero = len(kinds), np.zeros(len(kinds))
    whole = _Level(np.arange(n), np.arange(n), colours, places, places, axes, zero)
    levels, joins, roots, free = [whole], [np.full((n, 2), -1)], [], n
    for ids in _alike(kinds, depths, axes):
        order = ids[morton_order(places[ids], ids.astype(np.uint64))]
        level = whole.part(order)
        while len(level.ids) > 1:
            above, pairs = _joined(level, free, rng)
            free += len(pairs)
            levels.append(above.part(slice(len(pairs))))
            joins.append(pairs)
            level = above
        roots.append(level.ids[0])
    every = _side_by_side(levels)
    first = every.representatives
    return LightTree(
        np.array(roots, np.int64),
        np.concatenate(joins),
        first,
        every.colours.mean(axis=1),
        _bounds(every),
        every.colours.astype(np.float32),
        far[first],
        depths[first] > 2,
    )


def _alike(kinds: NDArray[np.uint32], depths: NDArray[np.uint32], axes: Doubles) -> Iterator[Ids]:
    """Lights of one kind and depth that face the same side of a cube; emitters each for itself: none has bounds."""
    largest = np.abs(axes).argmax(axis=1)
    side = 2 * largest + (axes[np.arange(len(axes)), largest] < 0)
    alone = np.where(kinds == EMITTER, np.arange(len(kinds)) + 1, 0)
    keys = np.stack([alone, kinds.astype(np.int64), depths.astype(np.int64), side], axis=1)
    _, group = np.unique(keys, axis=0, return_inverse=True)
    order = np.argsort(group, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(group[order])) + 1)


def _joined(level: _Level, free: int, rng: np.random.Generator) -> tuple[_Level, Ids]:
    """Pairs of neighbours as nodes from number ``free`` on, and a last one as it is; the children of pairs."""
    pairs = len(level.ids) // 2
    a, b = (level.part(slice(k, 2 * pairs, 2)) for k in (0, 1))
    total = a.colours + b.colours
    second = rng.random(pairs) * total.sum(axis=1) >= a.colours.sum(axis=1)
    axes, angles = _cones(a, b)
    above = _Level(
        np.arange(free, free + pairs),
        np.where(second, b.representatives, a.representatives),
        total,
        np.minimum(a.low, b.low),
        np.maximum(a.high, b.high),
        axes,
        angles,
    )
    joined = _side_by_side([above, level.part(slice(2 * pairs, None))])
    return joined, np.stack([a.ids, b.ids], axis=1)


def _cones(a: _Level, b: _Level) -> tuple[Doubles, Doubles]:
    """Cones around those of pairs: axes (k, 3) and half angles (k,)."""
    sums = a.axes * a.colours.sum(axis=1)[:, None] + b.axes * b.colours.sum(axis=1)[:, None]
    lengths = np.linalg.norm(sums, axis=1)
    axes = np.where(lengths[:, None] > 0, sums / np.maximum(lengths, 1e-300)[:, None], a.axes)
    between = [np.arccos(np.clip((axes * x.axes).sum(axis=1), -1, 1)) + x.angles for x in (a, b)]
    return axes, np.minimum(np.maximum(*between), np.pi)


def _bounds(nodes: _Level) -> Floats:
    centres, halves = (nodes.high + nodes.low) / 2, (nodes.high - nodes.low) / 2
    cone = np.stack([np.cos(nodes.angles), np.sin(nodes.angles)], axis=1)
    return np.concatenate([centres, halves * (1 + 1e-5), nodes.axes, cone], axis=1).astype(np.float32)


def largest_values(tree: LightTree, nodes: Ids, samples: Ids, receivers: Floats, clamp: float) -> Floats:
    """The most that lights of nodes (k,) may send to diffuse samples (k,): mean radiance (k,), nothing in between.

    Parameters
    ----------
    tree : LightTree
    nodes, samples : (k,) int64
    receivers : (m, 9) float32
        Of samples: position, normal towards the camera, world; radiance per irradiance, RGB.
    clamp : float
        Of the geometry terms of reflected light.
    """
    result = np.empty(len(nodes), np.float32)
    bounds = tree.bounds, tree.colours, tree.far, tree.reflected
    run_in_parts(_fill_largest, len(nodes), *bounds, nodes, samples, receivers, clamp, result)
    return result


@numba.njit(nogil=True, cache=True)
def _fill_largest(
    start: int,
    end: int,
    bounds: Floats,
    colours: Floats,
    far: NDArray[np.bool_],
    reflected: NDArray[np.bool_],
    nodes: Ids,
    samples: Ids,
    receivers: Floats,
    clamp: float,
    result: Floats,
) -> None:
    for e in range(start, end):
        node, i = nodes[e], samples[e]
        most = _largest_factor(bounds[node], receivers[i], far[node], clamp if reflected[node] else np.inf)
        sent = 0.0
        for c in range(3):
            sent += float(receivers[i, 6 + c]) * float(colours[node, c]) / 3
        result[e] = sent * most if sent > 0 else 0.0


@numba.njit(cache=True)
def _largest_factor(box: Floats, at: Floats, far: bool, clamp: float) -> float:
    """The largest geometry term, or cosine of lights from far away."""
    if far:
        return _largest_cosine(at[3:6], box[6:9], float(box[9]), float(box[10]))
    near, height, half = 0.0, 0.0, 0.0
    towards = np.empty(3, np.float32)
    for k in range(3):
        towards[k] = at[k] - box[k]
        outside = abs(float(towards[k])) - float(box[3 + k])
        near += max(outside, 0.0) ** 2
        height += abs(float(at[3 + k])) * float(box[3 + k]) - float(at[3 + k] * towards[k])
        half += float(box[3 + k]) ** 2
    if height <= 0:  # the box is behind the sample
        return 0.0
    if near <= 0:  # the sample is inside of it
        return clamp
    square, sends = float(np.square(towards).sum()), 1.0
    if square > half:  # the ball around the box is seen within an angle; it and the cone add up
        sine = math.sqrt(half / square)
        cosine = math.sqrt(1 - half / square)
        both = float(box[10]) * cosine + float(box[9]) * sine
        if both >= 0 and box[9] > -1:
            most = float(box[9]) * cosine - float(box[10]) * sine
            sends = _largest_cosine(towards / np.float32(math.sqrt(square)), box[6:9], most, both)
    geometry = sends * min(height / math.sqrt(near), 1.0) / near
    return min(geometry, clamp)


@numba.njit(cache=True)
def _largest_cosine(direction: Floats, axis: Floats, cosine: float, sine: float) -> float:
    """Of a direction and those in a cone around an axis, 0 or more."""
    along = 0.0
    for k in range(3):
        along += float(direction[k]) * float(axis[k])
    along = min(max(along, -1.0), 1.0)
    if along >= cosine:
        return 1.0
    return max(along * cosine + math.sqrt(1 - along * along) * sine, 0.0)
