"""Visibility by consensus against visibility that is known exactly: of planes under balls, without a scene."""

import numpy as np
import pytest

from mi_sparse_prt import CubemapLighting
from mi_sparse_prt.core.bits import unpack
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.consensus import Consensus, ConsensusOptions, Surface, sample_by_levels

LIGHTING = CubemapLighting(16)
GRID = AngularGrid(LIGHTING)
SIDE = 48
STRIDES = ConsensusOptions().strides
BALL, RADIUS = np.array([0.1, 0.35, -0.05]), 0.25


class Plane:
    """A square of SIDE x SIDE vertices that looks up at a ball, and an account of rays."""

    def __init__(self, order: np.ndarray | None = None, radius: float = RADIUS) -> None:
        x, z = np.meshgrid(*2 * [np.linspace(-1, 1, SIDE)], indexing="ij")
        positions = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], axis=-1)
        self.order = np.arange(len(positions)) if order is None else order
        self.positions = positions[self.order]
        self.normals = np.tile(np.float32([0, 1, 0]), (len(positions), 1))
        self.radius, self.rays = radius, 0

    def sees(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether rays (n, 3) that leave points (n, 3) miss the ball, (n,)."""
        towards = BALL - positions
        along = np.einsum("nd,nd->n", towards, directions)
        aside = (towards**2).sum(axis=1) - along**2
        return (directions[:, 1] > 0) & ((aside > self.radius**2) | (along < 0))

    def trace(self, vertices: np.ndarray, texels: np.ndarray) -> np.ndarray:
        self.rays += len(vertices)
        return self.sees(self.positions[vertices], LIGHTING.directions[texels])

    def exact(self) -> np.ndarray:
        """All visibility (n, n_directions)."""
        n, m = len(self.positions), LIGHTING.n_directions
        vertices, texels = np.divmod(np.arange(n * m), m)
        return self.sees(self.positions[vertices], LIGHTING.directions[texels]).reshape(n, m)

    def surface(self) -> Surface:
        return Surface(0, self.positions, self.normals, self.order.astype(np.uint64))

    def state(self, **options: int) -> Consensus:
        state = Consensus(self.normals, GRID, self.trace, ConsensusOptions(**options))
        sample_by_levels(state, self.surface(), lambda least, ids, near: np.zeros(len(ids), bool))
        return state


def masks(state: Consensus) -> tuple[np.ndarray, np.ndarray]:
    """``visible`` and ``evaluated``, (n, n_directions) bool."""
    return tuple(unpack(bits, LIGHTING.n_directions) for bits in (state.visible, state.evaluated))


def test_shadow_of_a_ball_on_a_plane():
    """Few rays, few errors, and what was traced is right."""
    plane = Plane()
    state = plane.state()
    visible, evaluated = masks(state)
    exact = plane.exact()
    np.testing.assert_array_equal(visible[evaluated], exact[evaluated])
    above = LIGHTING.directions[:, 1] > 0
    shadow_edges = np.abs(np.diff(exact[:, above].astype(int), axis=0)).mean()
    assert 0 < shadow_edges  # the ball does shade
    wrong = (visible != exact)[:, above].mean()
    assert wrong < 0.002
    assert plane.rays == evaluated.sum()  # no ray twice
    assert evaluated[:, above].mean() < 0.2


def test_nothing_in_the_way_needs_no_ray_but_those_of_the_first_level():
    plane = Plane(radius=0.0)
    state = plane.state()
    visible, evaluated = masks(state)
    np.testing.assert_array_equal(visible, plane.exact())
    assert (evaluated.any(axis=1)).sum() == len(plane.surface().levels(STRIDES)[0])


def test_the_order_of_vertices_does_not_matter():
    plane, shuffled = Plane(), Plane(np.random.default_rng(0).permutation(SIDE**2))
    a, b = plane.state(), shuffled.state()
    np.testing.assert_array_equal(a.visible[shuffled.order], b.visible)
    np.testing.assert_array_equal(a.evaluated[shuffled.order], b.evaluated)


def test_the_size_of_blocks_does_not_matter():
    whole, parts = Plane().state(), Plane().state(block=7)
    np.testing.assert_array_equal(whole.visible, parts.visible)
    np.testing.assert_array_equal(whole.evaluated, parts.evaluated)


def test_levels_are_a_partition_and_each_is_spread_evenly():
    plane = Plane()
    levels = plane.surface().levels(STRIDES)
    np.testing.assert_array_equal(np.sort(np.concatenate(levels)), np.arange(SIDE**2))
    known = np.cumsum([len(level) for level in levels])
    np.testing.assert_allclose(known, SIDE**2 / np.array(STRIDES), atol=1)
    first = plane.positions[levels[0]]
    distance = np.linalg.norm(plane.positions[:, None] - first, axis=2).min(axis=1)
    assert distance.max() < 2.5 * np.sqrt(4 / len(first))  # 2.5 times the spacing of a regular grid


@pytest.mark.parametrize("count", [1, 2, 5])
def test_meshes_of_few_vertices_are_sampled_by_rays(count):
    plane = Plane()
    keep = np.arange(count) * 7
    plane.positions, plane.normals, plane.order = plane.positions[keep], plane.normals[keep], keep
    visible, _ = masks(plane.state())
    assert (visible != plane.exact()).mean() < 0.01  # borrowed in angle at most


def test_neighbours_across_an_edge_are_not_asked():
    """Two planes back to back, one in the ball's shadow side: the lower one faces down and sees nothing of it."""
    plane = Plane()
    n = len(plane.positions)
    plane.positions = np.concatenate([plane.positions, plane.positions + [0, -1e-4, 0]])
    plane.normals = np.concatenate([plane.normals, -plane.normals])
    plane.order = np.arange(2 * n)
    plane.sees = lambda positions, directions: np.where(  # type: ignore[method-assign]
        positions[:, 1] < 0, directions[:, 1] < 0, Plane.sees(plane, positions, directions)
    )
    visible, evaluated = masks(plane.state())
    np.testing.assert_array_equal(visible[n:], np.tile(LIGHTING.directions[:, 1] < 0, (n, 1)))
    assert not evaluated[n:][:, LIGHTING.directions[:, 1] > 0].any()  # below its horizon
