"""Curves with a thickness as tubes of triangles."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.scene.mesh_cleaning import drop_degenerate, drop_unreferenced
from mi_sparse_prt.scene.subdivision import too_many_vertices
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh, concatenated, normalise_rows

FEWEST = 10  # vertices around a tube
# the same of one whose girth is half an edge at most, as hair: it is a pixel wide, and has light by its normals alone,
# which is smooth (99% of irradiance is in harmonics up to the second, Ramamoorthi and Hanrahan 2001)
FEWEST_OF_HAIR = 6
TURN = np.pi / 10  # rings turn by at most this much

Rows = NDArray[np.float64]


@dataclass
class Rings:
    """Circles along a curve, one after the other.

    Attributes
    ----------
    centres, axes : (n, 3) float64
        Axes are unit vectors along the curve.
    radii, leans : (n,) float64
        `leans` are the cosines of the angles between normals and axis.
    along : (n,) float64
        Mitsuba's texture coordinate along all curves of the shape.
    """

    centres: Rows
    axes: Rows
    radii: Rows
    leans: Rows
    along: Rows


def curve_mesh(shape: mi.Shape, edge_length: float, name: str, limit: int) -> TriangleMesh:
    """A Mitsuba `bsplinecurve` or `linearcurve` as tubes, in the frame of its control points.

    Ends and joints of linear curves are round, as Mitsuba has them; its splines are open, and seen through from inside,
    which triangles are not: they get flat ends. Tubes are as wide on average, seen from the side, as the round ones.

    Parameters
    ----------
    edge_length : float
        World units; rings, and the vertices of one, are at most this far apart.
    limit : int
        The largest number of vertices allowed.

    Raises
    ------
    PrtError
        More than `limit` vertices.
    """
    parameters = mi.traverse(shape)
    points = np.array(parameters["control_points"], np.float64).reshape(-1, 4)
    first = np.array(parameters["segment_indices"], np.int64)
    spline = shape.class_name() == "BSplineCurve"
    tubes, count = [], 0
    for segments in np.split(np.arange(len(first)), np.flatnonzero(np.diff(first) != 1) + 1):
        own = points[first[segments[0]] : first[segments[-1]] + (4 if spline else 2)]
        rings = _spline(own, edge_length) if spline else _polyline(own, edge_length)
        rings.along = (rings.along + segments[0]) / len(first)
        girth = 2 * np.pi * rings.radii.max()
        hair = girth <= edge_length / 2 < np.inf
        around = max(FEWEST_OF_HAIR if hair else FEWEST, int(np.ceil(girth / edge_length)))
        count += len(rings.radii) * (around + 1)
        if count > limit:
            raise too_many_vertices(name, edge_length, limit)
        tubes.append(_tube(rings, around, name))
    mesh, _ = drop_degenerate(concatenated(tubes))
    return drop_unreferenced(mesh)[0]


def _spline(points: Rows, edge_length: float) -> Rings:
    """Rings of a uniform cubic B-spline of control points (n, xyz and radius), flat at both ends."""
    corners = np.stack(
        [points[k : len(points) - 3 + k] for k in range(4)]
    )  # [corner, segment, xyz and radius]
    tangents = normalise_rows((corners[2:] - corners[:2])[..., :3].reshape(-1, 3)).reshape(2, -1, 3)
    turn = np.arccos(np.clip(np.sum(tangents[0] * tangents[1], axis=1), -1, 1))
    length = np.linalg.norm((corners[2] - corners[1])[:, :3], axis=1)
    counts = np.maximum(np.ceil(turn / TURN), np.ceil(length / edge_length)).astype(int).clip(1)
    segment = np.repeat(np.arange(len(counts)), counts)
    u = (np.arange(len(segment)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[segment]
    segment, u = np.append(segment, len(counts) - 1), np.append(u, 1.0)
    weights = [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3]
    change = [-3 * (1 - u) ** 2, 9 * u**2 - 12 * u, -9 * u**2 + 6 * u + 3, 3 * u**2]
    at, by = (
        np.einsum("cn,cnd->nd", w, corners[:, segment]) / 6 for w in (np.stack(weights), np.stack(change))
    )
    speed = np.linalg.norm(by[:, :3], axis=1)
    leans = -by[:, 3] / np.hypot(by[:, 3], np.where(speed > 0, speed, 1))
    axes, along = normalise_rows(by[:, :3]), segment + u
    closed = np.concatenate([[0, 0], np.arange(len(u)), [len(u) - 1, len(u) - 1]])
    radii, leans = at[closed, 3], leans[closed]
    radii[[0, -1]], leans[:2], leans[-2:] = 0, -1, 1
    return Rings(at[closed, :3], axes[closed], radii, leans, along[closed])


def _polyline(points: Rows, edge_length: float) -> Rings:
    """Rings of cones between balls at control points (n, xyz and radius): what they and the balls have in sight."""
    parts: list[tuple[Rows, Rows, Rows, Rows, Rows]] = []
    step = points[1:] - points[:-1]
    length = np.linalg.norm(step[:, :3], axis=1)
    kept: list[int] = np.flatnonzero(length > 0).tolist()
    axes = normalise_rows(step[:, :3])
    leans = -np.clip(step[:, 3] / np.where(length > 0, length, 1), -1, 1)  # where cones touch their balls

    def on_ball(k: int, axis: Rows, lean: Rows, along: float) -> None:
        ball, ones = points[k], np.ones(len(lean))
        centres = ball[:3] + ball[3] * lean[:, None] * axis
        parts.append((centres, axis, ball[3] * np.sqrt(1 - lean**2), lean, along * ones))

    for i, k in enumerate(kept):
        before, after = kept[i - 1] if i else None, kept[i + 1] if i + 1 < len(kept) else None
        if before is None:
            cap = _arc(np.pi, np.arccos(leans[k]))
            on_ball(k, np.tile(axes[k], (len(cap), 1)), np.cos(cap), k)
        pieces = int(np.ceil(length[k] / edge_length))
        inner = np.arange(1, pieces)[:, None] / pieces
        middle = points[k] + inner * step[k]
        centres = middle[:, :3] + middle[:, 3:] * leans[k] * axes[k]
        radii = middle[:, 3] * np.sqrt(1 - leans[k] ** 2)
        parts.append(
            (
                centres,
                np.tile(axes[k], (len(inner), 1)),
                radii,
                np.full(len(inner), leans[k]),
                k + inner[:, 0],
            )
        )
        if after is None:
            cap = _arc(np.arccos(leans[k]), 0.0)
            on_ball(k + 1, np.tile(axes[k], (len(cap), 1)), np.cos(cap), k + 1)
        else:
            turn = np.arccos(np.clip(axes[k] @ axes[after], -1, 1))
            s = (_arc(0.0, turn) / turn if turn > TURN else np.array([0.5]))[:, None]
            on_ball(
                after,
                normalise_rows(
                    np.sin((1 - s) * turn) * axes[k] + np.sin(s * turn) * axes[after] + 1e-9 * axes[k]
                ),
                leans[k] + s[:, 0] * (leans[after] - leans[k]),
                k + 1,
            )
    return Rings(*(np.concatenate([part[n] for part in parts]) for n in range(5)))


def _arc(start: float, end: float) -> Rows:
    """Angles from one to another in steps of at most TURN."""
    return np.linspace(start, end, 1 + max(1, int(np.ceil(abs(end - start) / TURN))))


def _tube(rings: Rings, around: int, name: str) -> TriangleMesh:
    """The surface through rings of `around` vertices, one of them twice, for texture coordinates."""
    t = rings.axes
    # Mitsuba measures the angle around a curve from frames that look up (z); these turn where the curve does
    up = np.array([0.0, 0, 1]) - t * t[:, 2:]
    steep = np.linalg.norm(up, axis=1, keepdims=True) < 1e-6
    up = normalise_rows(np.where(steep, np.array([0.0, 1, 0]), up))
    side = np.cross(up, t)
    # what is carried along without a twist gains this angle in the next frame
    both = t[:-1] + t[1:]
    share = np.sum(side[:-1] * t[1:], axis=1) / np.maximum(1 + np.sum(t[:-1] * t[1:], axis=1), 1e-9)
    carried = side[:-1] - share[:, None] * both
    twist = np.arctan2(np.sum(carried * up[1:], axis=1), np.sum(carried * side[1:], axis=1))
    angle = np.concatenate([[0.0], np.cumsum(twist)])[:, None] + 2 * np.pi * np.arange(around + 1) / around

    outwards = (
        np.cos(angle)[..., None] * side[:, None] + np.sin(angle)[..., None] * up[:, None]
    )  # [ring, vertex, xyz]
    widened = rings.radii * (np.pi / around) / np.sin(np.pi / around)
    positions = rings.centres[:, None] + widened[:, None, None] * outwards
    lean = rings.leans[:, None, None]
    normals = np.sqrt(1 - lean**2) * outwards + lean * t[:, None]
    uv = np.stack([angle / (2 * np.pi), np.broadcast_to(rings.along[:, None], angle.shape)], axis=2)
    index = np.arange(uv.shape[0] * uv.shape[1]).reshape(uv.shape[:2])
    a, b, c, d = (
        index[:-1, :-1].ravel(),
        index[:-1, 1:].ravel(),
        index[1:, :-1].ravel(),
        index[1:, 1:].ravel(),
    )
    triangles = np.concatenate([np.column_stack([a, b, d]), np.column_stack([a, d, c])])
    return TriangleMesh(
        name,
        positions.reshape(-1, 3).astype(np.float32),
        normalise_rows(normals.reshape(-1, 3)).astype(np.float32),
        triangles.astype(np.int32),
        uv.reshape(-1, 2).astype(np.float32),
    )
