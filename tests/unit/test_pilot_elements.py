"""The elements on which plans are tried."""

import numpy as np
import pytest
from conftest import problem_at

import mi_sparse_prt as prt
from mi_sparse_prt.estimation.pilot_elements import PilotElements

LIGHTING = prt.CubemapLighting(4)


def test_the_choice_of_elements(grey_scene):
    def drawn(seed: int, *counts: int) -> PilotElements:
        return PilotElements(problem_at(grey_scene, LIGHTING, max_depth=2), False, seed, *counts)

    held, other, everything = drawn(0, 20, 7), drawn(1, 20, 7), drawn(0, 10**6, 10**6)
    assert held.vertices.shape == (60,)
    assert held.texels.shape == (60, 7)
    assert (np.diff(held.vertices) > 0).all()
    for mesh in grey_scene.meshes:
        assert ((held.vertices >= mesh.vertices.start) & (held.vertices < mesh.vertices.stop)).sum() == 20
    assert all(len(set(texels)) == 7 for texels in held.texels)
    assert (held.vertices != other.vertices).any()
    assert np.array_equal(everything.vertices, np.arange(grey_scene.n_vertices))
    assert np.array_equal(np.sort(everything.texels, axis=1)[0], np.arange(96))


def test_the_squared_error_of_a_matrix(grey_scene):
    """A direct matrix 10% too bright: exactly, a hundredth of the squared norm."""
    held = PilotElements(problem_at(grey_scene, LIGHTING, max_depth=2), False, seed=0)
    transport = prt.precompute(grey_scene, LIGHTING, "brute_force", max_depth=2, progress=False)
    ours = 1.1 * transport.rows(held.vertices)
    squares = held.squared_error(np.take_along_axis(ours, held.texels[..., None], axis=1))
    assert held.relative_square(squares) == pytest.approx(0.01, rel=1e-3)
