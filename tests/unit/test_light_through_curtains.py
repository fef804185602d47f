"""Light that comes through surfaces into all directions: what they send on to others is lit from both sides."""

import numpy as np
import pytest
from conftest import T, build, diffuse

import mi_sparse_prt as prt
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import diffuse_problem


def hall(through: float, covered: bool, **more: dict) -> Scene:
    """A wall behind a curtain, with some light from beside."""
    curtain = {
        "type": "principledthin",
        "base_color": {"type": "rgb", "value": [0.8, 0.6, 0.4]},
        "diff_trans": through,
        "roughness": 0.8,
    }
    shape = {
        "type": "rectangle",
        "bsdf": {"type": "mask", "opacity": 0.6, "nested": curtain} if covered else curtain,
    }
    wall = {"type": "twosided", "nested": diffuse(0.6, 0.5, 0.4)}
    return build(
        edge_length=0.25,
        wall={"type": "rectangle", "to_world": T().translate([0, 0, -1]), "bsdf": wall},
        curtain=shape,
        **more,
    )


@pytest.mark.parametrize("covered", [False, True], ids=["bare", "mask"])
@pytest.mark.parametrize(("through", "off"), [(2.0, 0.01), pytest.param(1.2, 0.05, marks=pytest.mark.slow)])
def test_a_curtain_lights_the_wall_behind_it(through, off, covered):
    """Expected: indirect light of the wall is that of paths, within 1% if all goes through, and 5% if some does not.

    Reflected light is taken to be as at normal incidence.
    Result: 0.2 and 3.3% less. Without what comes through, nothing of the first and a third of the second.
    """
    scene, sky = hall(through, covered), prt.CubemapLighting(4)
    ids = np.arange(scene.meshes[0].vertices.stop)
    matrix = prt.precompute(scene, sky, Plan("exact", "gather", rays=256), max_depth=4, progress=False)
    ours = matrix.operators["indirect"].rows(ids).sum(axis=(0, 1))
    every = np.repeat(ids, sky.n_directions), np.tile(np.arange(sky.n_directions), len(ids))
    paths = PathSolver(diffuse_problem(scene, sky, 4), 512, 3).elements(*every)
    power = np.tile(sky.solid_angles.astype(np.float64), len(ids))[:, None]
    truth, error = (power * paths.mean).sum(axis=0), np.sqrt((power**2 * paths.variance).sum(axis=0))
    print(through, ours / truth - 1, error / truth)
    assert (error < 0.002 * truth).all()
    np.testing.assert_allclose(ours, truth, rtol=off)


def test_among_glossy_surfaces():
    """Expected: where a surface beside it has terms, within 5% of the light where none has; it has no part in it."""
    ball = {
        "type": "sphere",
        "center": [8, 0, 0],
        "radius": 0.3,
        "bsdf": {"type": "roughplastic", "alpha": 0.3},
    }
    scene, sky = hall(1.2, False, ball=ball), prt.CubemapLighting(4)
    ids = np.arange(scene.meshes[0].vertices.stop)
    matrices = [
        prt.precompute(
            scene, sky, "gather", basis="texel", max_depth=4, terms=terms, target_error=0.1, progress=False
        )
        for terms in (0, "auto")
    ]
    assert matrices[1].terms
    sums = [matrix.operators["indirect"].rows(ids).sum() for matrix in matrices]
    assert sums[1] == pytest.approx(sums[0], rel=0.05)


def test_what_goes_through():
    """Expected: no part of the albedo; half of ``diff_trans`` of the colour, on both sides, also of what is masked."""
    scene = hall(1.2, True)
    curtain = scene.meshes[1].vertices
    colour = np.array([0.8, 0.6, 0.4])
    assert np.abs(scene.transmitted[curtain] / (0.6 * colour) - 1).max() < 0.1
    np.testing.assert_allclose(scene.transmitted[scene.backs[curtain]], scene.transmitted[curtain], rtol=1e-4)
    assert not scene.transmitted[scene.meshes[0].vertices].any()
    assert (scene.albedo[curtain] < 0.6 * colour).all()
