"""The woodwork and the wall of ``pergola.xml``: ``python pergola.py`` writes ``wall.ply``, ``niche.ply``,
``slats.ply`` and ``bench.ply`` here.

Few vertices: Mitsuba scenes are subdivided when they are loaded. What stands on the ground reaches 0.02 into it, and
what is joined reaches into its neighbour, so that no two faces lie in one plane.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from ply import Mesh, grid, joined, quad, write

BELOW = -0.02
NICHES = (-1.125, -0.375, 0.375, 1.125)  # their middles, x
CELL = 0.75  # of the wall's front around a niche, its width
RADIUS, SILL, SPRING, TOP = 0.27, 0.38, 0.88, 1.5  # of a niche: where its vault begins and the wall ends
FRONT, BACK = -0.6, -1.05  # of the wall, z
ARC = 16  # segments of a half circle
CORNER = float(np.arctan2(TOP - SPRING, CELL / 2))  # direction of the cell's corner from the vault's centre

Points = NDArray[np.float64]


def box(low: tuple[float, float, float], high: tuple[float, float, float], front: bool = True) -> Mesh:
    """A box between two corners, with or without the face towards +z; faces share no vertices."""
    (x, y, z), (u, v, w) = low, high
    faces = [
        [(u, y, z), (x, y, z), (x, v, z), (u, v, z)],
        [(u, y, w), (u, y, z), (u, v, z), (u, v, w)],
        [(x, y, z), (x, y, w), (x, v, w), (x, v, z)],
        [(x, v, w), (u, v, w), (u, v, z), (x, v, z)],
        [(x, y, z), (u, y, z), (u, y, w), (x, y, w)],
    ]
    if front:
        faces.append([(x, y, w), (u, y, w), (u, v, w), (x, v, w)])
    return joined([quad(face) for face in faces])


def arc() -> Points:
    """Angles of the vault, from its right foot to its left one; the directions of the cell's corners are among them."""
    return np.unique(np.concatenate([np.linspace(0, np.pi, ARC + 1), [CORNER, np.pi - CORNER]]))


def niche() -> Mesh:
    """A half cylinder under a quarter of a sphere, and its floor: seen from +z, the opening around x = 0 at z = 0."""
    angle = arc()[::-1]  # columns go right
    circle = RADIUS * np.stack([np.cos(angle), np.zeros_like(angle), -np.sin(angle)], axis=1)
    rise = np.linspace(SILL, SPRING, 5)[:-1]
    straight = circle + rise[:, None, None] * [0, 1, 0]  # [row, column, xyz]
    steps = arc()[arc() <= np.pi / 2 + 1e-9][:-1, None, None]
    dome = np.cos(steps) * circle + (SPRING + RADIUS * np.sin(steps)) * np.array([0, 1, 0])
    shell = grid(np.concatenate([straight, dome]))
    n, last = len(shell.vertices), np.arange(len(shell.vertices) - len(angle), len(shell.vertices))
    cap = np.stack([last[:-1], last[1:], np.full(len(angle) - 1, n)], axis=1)
    pole = [[0, SPRING + RADIUS, 0]]
    floor = np.concatenate([circle, [[0, 0, 0]]]) + [0, SILL, 0]
    k = np.arange(len(angle) - 1)
    fan = np.stack([k + 1, k, np.full(len(k), len(angle))], axis=1)
    return joined(
        [
            Mesh(np.concatenate([shell.vertices, pole]), np.concatenate([shell.triangles, cap])),
            Mesh(floor, fan),
        ]
    )


def wall() -> Mesh:
    """A wall whose front has the openings of the niches; it is hollow, and nobody sees that."""
    parts = [box((-1.5, BELOW, BACK), (1.5, TOP, FRONT), front=False)]
    for middle in NICHES:
        parts += [Mesh(part.vertices + [middle, 0, FRONT], part.triangles) for part in _around_opening()]
    return joined(parts)


def _around_opening() -> list[Mesh]:
    """The front of one cell, at z = 0, without the opening."""
    half = CELL / 2
    columns = ((-half, -RADIUS), (-RADIUS, RADIUS), (RADIUS, half))
    parts = [_upright(a, b, BELOW, SILL) for a, b in columns]
    parts += [_upright(a, b, SILL, SPRING) for a, b in (columns[0], columns[2])]
    angle = arc()
    ray = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    with np.errstate(divide="ignore"):
        reach = np.minimum(half / np.abs(ray[:, 0]), (TOP - SPRING) / np.abs(ray[:, 1]))
    rows = np.stack([reach[:, None] * ray, RADIUS * ray])  # from the cell's border down to the arch
    return [*parts, grid(rows[::-1, ::-1] + [0, SPRING, 0])]


def _upright(left: float, right: float, low: float, high: float) -> Mesh:
    """A rectangle at z = 0 that faces +z."""
    return quad([(left, low, 0), (right, low, 0), (right, high, 0), (left, high, 0)])


def slats() -> Mesh:
    """The roof, front to back over two beams, and a trellis of bars on the left."""
    roof = [box((x - 0.02, 1.57, -0.95), (x + 0.02, 1.67, 0.95)) for x in np.linspace(-1.5, 1.5, 24)]
    bars = [box((-1.52, BELOW, z - 0.02), (-1.47, 1.54, z + 0.02)) for z in np.linspace(-0.5, 0.62, 9)]
    rails = [box((-1.48, y - 0.025, -0.62), (-1.45, y + 0.025, 0.72)) for y in (0.3, 0.8, 1.3)]
    return joined(roof + bars + rails)


def bench() -> Mesh:
    """Five slats to sit on, four to lean against, and the frames under them."""
    seat = [box((-0.75, 0.4, z - 0.035), (0.75, 0.43, z + 0.035)) for z in np.linspace(-0.2, 0.2, 5)]
    back = [box((-0.75, y, -0.305), (0.75, y + 0.06, -0.28)) for y in np.linspace(0.5, 0.78, 4)]
    frames = []
    for x in (-0.6, 0.6):
        frames += [
            box((x - 0.025, BELOW, 0.16), (x + 0.025, 0.37, 0.21)),
            box((x - 0.025, BELOW, -0.36), (x + 0.025, 0.87, -0.3)),
            box((x - 0.03, 0.34, -0.33), (x + 0.03, 0.405, 0.24)),
        ]
    return joined(seat + back + frames)


def main(folder: Path) -> None:
    """Write the four files."""
    for name, mesh in (("wall", wall()), ("niche", niche()), ("slats", slats()), ("bench", bench())):
        write(mesh, folder / f"{name}.ply")


if __name__ == "__main__":
    main(Path(__file__).parent)
