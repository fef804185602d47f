"""The bush of ``foliage.xml``: ``python foliage.py`` writes ``leaves.ply``, ``twigs.ply`` and ``meadow.ply`` here.

Stems carry branches, branches carry twigs, and leaves turn around both by the golden angle. A leaf is a closed solid of
two one-sided sheets that meet at its rim, 7 mm apart in its middle if the bush is 1.5 m high: its front and its back
have vertices of their own, and no light passes.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from ply import Mesh, grid, joined, write

SEED = 5
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
UP = np.array([0.0, 1.0, 0.0])
STEMS, BRANCHES, TWIGS = 8, 6, 5  # branches of a stem, twigs of a branch
LEAVES = 13  # of a branch or a twig
SIDES = 5  # of a tube
GROUND, CELLS = 2.0, 100  # half its width, and quads along it

Points = NDArray[np.float64]


class Shoot(NamedTuple):
    """A stem, branch or twig: points (k, 3) of its axis, and their radii (k,), the last of which is its tip."""

    axis: Points
    radii: Points

    def at(self, share: float) -> tuple[Points, Points, float]:
        """Place, direction and radius at a share of the length."""
        place = share * (len(self.axis) - 1)
        k = min(int(place), len(self.axis) - 2)
        step, rest = self.axis[k + 1] - self.axis[k], place - k
        return self.axis[k] + rest * step, _unit(step), (1 - rest) * self.radii[k] + rest * self.radii[k + 1]


def bush(rng: np.random.Generator) -> tuple[list[Shoot], list[Shoot]]:
    """Stems, and the branches and twigs that carry leaves."""
    stems = []
    for k in range(STEMS):
        outwards = _around(UP, k * GOLDEN_ANGLE)
        lean = 0.15 + 0.75 * k / STEMS
        start = 0.07 * np.sqrt(k / STEMS) * outwards
        stems.append(_grown(rng, start, _unit(UP + lean * outwards), 1.2 - 0.3 * lean, 0.02, 8))
    branches = [
        _branching(rng, stem, share, 0.9, 0.5 - 0.22 * share)
        for stem in stems
        for share in np.linspace(0.25, 0.97, BRANCHES)
    ]
    twigs = [
        _branching(rng, branch, share, 0.8, 0.24)
        for branch in branches
        for share in np.linspace(0.25, 0.97, TWIGS)
    ]
    return stems, branches + twigs


def _grown(
    rng: np.random.Generator, start: Points, direction: Points, length: float, radius: float, steps: int
) -> Shoot:
    """A shoot that wavers and turns towards the light."""
    axis = [start]
    for _ in range(steps):
        direction = _unit(direction + 0.12 * rng.standard_normal(3) + 0.05 * UP)
        axis.append(axis[-1] + length / steps * direction)
    return Shoot(np.array(axis), radius * np.linspace(1, 0.3, steps + 1))


def _branching(rng: np.random.Generator, parent: Shoot, share: float, spread: float, length: float) -> Shoot:
    """A shoot that leaves another one at a share of its length."""
    start, along, radius = parent.at(share)
    direction = _unit(along + spread * _around(along, rng.uniform(0, 2 * np.pi)))
    return _grown(rng, start, direction, length * rng.uniform(0.8, 1.2), 0.6 * radius, 4)


def tube(shoot: Shoot) -> Mesh:
    """The surface of a shoot, open where it leaves its parent."""
    rings, turn = [], 2 * np.pi * np.arange(SIDES) / SIDES
    for k, (place, radius) in enumerate(zip(shoot.axis[:-1], shoot.radii[:-1], strict=True)):
        along = _unit(shoot.axis[k + 1] - shoot.axis[max(k - 1, 0)])
        rings.append(place + radius * np.array([_around(along, angle) for angle in turn]))
    index = np.arange(SIDES * len(rings)).reshape(len(rings), SIDES)
    right = np.roll(index, -1, axis=1)
    tip = np.full(SIDES, index.size)
    corners = (
        (index[:-1], right[:-1], right[1:]),
        (index[:-1], right[1:], index[1:]),
        (index[-1], right[-1], tip),
    )
    triangles = [np.stack(three, axis=-1).reshape(-1, 3) for three in corners]
    return Mesh(np.concatenate([*rings, shoot.axis[-1:]]), np.concatenate(triangles))


def leaves(rng: np.random.Generator, shoot: Shoot) -> list[Mesh]:
    """Leaves along a shoot, which turn their fronts to the sky and outwards."""
    result = []
    for k, share in enumerate(np.linspace(0.25, 1, LEAVES)):
        place, along, radius = shoot.at(share)
        outwards = _around(along, k * GOLDEN_ANGLE)
        stalk = _unit(0.7 * along + outwards + 0.25 * rng.standard_normal(3))
        front = 0.9 * UP + 0.4 * _unit(place * [1, 0, 1]) + 0.35 * rng.standard_normal(3)
        result.append(_leaf(place + (radius + 0.004) * outwards, stalk, front, 0.11 * rng.uniform(0.75, 1.2)))
    return result


def _leaf(base: Points, stalk: Points, front: Points, length: float) -> Mesh:
    """One leaf: a rim of four vertices, folded upwards, and a front and a back sheet on it."""
    normal = _unit(front - (front @ stalk) * stalk)
    frame = np.stack([stalk, np.cross(normal, stalk), normal])
    rim = np.array([[0, 0, 0], [0.42, -0.25, 0.07], [1, 0, -0.1], [0.42, 0.25, 0.07]])
    sheets = []
    for side in (1, -1):
        middle = [0.42, 0, side * 0.032]
        ring = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
        sheets.append(Mesh(base + length * np.vstack([rim, middle]) @ frame, ring[:, ::side]))
    return joined(sheets)


def meadow() -> Mesh:
    """The ground: a square with low mounds, nowhere below 0."""
    x, z = np.meshgrid(*[np.linspace(-GROUND, GROUND, CELLS + 1)] * 2)
    height = 0.035 * np.sin(1.9 * x + 0.8) * np.cos(1.6 * z - 0.4) + 0.02 * np.sin(3.7 * z + 2.3 * x)
    # seen from above, columns go right (x) and rows go up (-z)
    return grid(np.stack([x, height - height.min(), z], axis=-1)[::-1])


def _unit(v: Points) -> Points:
    return v / np.linalg.norm(v)


def _around(axis: Points, angle: float) -> Points:
    """The unit vector at a right angle to an axis, turned about it."""
    first = _unit(np.cross(axis, [0.31, 0.12, 0.94]))
    return np.cos(angle) * first + np.sin(angle) * np.cross(axis, first)


def main(folder: Path) -> None:
    """Write the three files."""
    rng = np.random.default_rng(SEED)
    stems, carriers = bush(rng)
    write(joined([leaf for shoot in carriers for leaf in leaves(rng, shoot)]), folder / "leaves.ply")
    write(joined([tube(shoot) for shoot in stems + carriers]), folder / "twigs.ply")
    write(meadow(), folder / "meadow.ply")


if __name__ == "__main__":
    main(Path(__file__).parent)
