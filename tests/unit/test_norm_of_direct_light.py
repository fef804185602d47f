"""How much direct light there is, which says what noise of specular light matters."""

import numpy as np
from conftest import T, build, diffuse

import mi_sparse_prt as prt
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import diffuse_problem
from mi_sparse_prt.solvers.specular import _direct_norm


def test_few_bright_points_among_many():
    """Rationale: of a dark ground with a white plate, points drawn evenly are of the ground.

    Expected: the mean of 8 seeds within 3% of the sum over all points, and each within 15%.
    Result: 0.05 and 1.4%; drawn evenly, 3.2 and 88%.
    """
    scene = build(
        edge_length=0.05,
        ground={
            "type": "rectangle",
            "to_world": T().rotate([1, 0, 0], -90).scale(2),
            "bsdf": diffuse(0.02, 0.02, 0.02),
        },
        plate={
            "type": "rectangle",
            "to_world": T().translate([0, 0.1, 0]).rotate([1, 0, 0], -90).scale(0.2),
            "bsdf": diffuse(0.9, 0.8, 0.7),
        },
        wall={
            "type": "rectangle",
            "to_world": T().translate([0, 1, -0.3]),
            "bsdf": diffuse(0.02, 0.02, 0.02),
        },
    )
    problem = diffuse_problem(scene, prt.CubemapLighting(4))
    every = np.arange(scene.n_vertices)
    power = np.square(scene.albedo.astype(np.float64))
    size = problem.emission.size
    light = DirectSolver(problem).elements(np.repeat(every, size), np.tile(np.arange(size), len(every)))
    squares = np.square(light.astype(np.float64)).reshape(len(every), size).sum(axis=1)
    truth = float(squares @ power.sum(axis=1))
    found = np.array([_direct_norm(problem, every, power, seed) for seed in range(8)]) / truth
    print(scene.n_vertices, found.mean() - 1, np.abs(found - 1).max())
    assert abs(found.mean() - 1) < 0.03
    assert np.abs(found - 1).max() < 0.15
    assert _direct_norm(problem, every, 0 * power, 0) == 0
