"""Error against the radius of neighbours: rows and errors against a loop that solves one vertex at a time."""

import json

import mitsuba as mi
import numpy as np
import pytest

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.neighbour_radius import (
    CURVES,
    _draw_samples,
    error_against_radius,
    plot_error_against_radius,
)
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.reconstruction.l1 import l1_fit
from mi_sparse_prt.reconstruction.normal_equations import normal_equations
from mi_sparse_prt.sampling.features import choose_features

RESOLUTION, DIRECTIONS, VERTICES = 8, 60, 20


@pytest.fixture(scope="module")
def scene() -> prt.Scene:
    """A sphere above a ground of 21 x 21 vertices or so."""
    loaded = mi.load_dict(
        {
            "type": "scene",
            "ground": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(2),
            },
            "ball": {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.5},
        },
        optimize=False,
    )
    return prt.Scene.from_mitsuba(loaded, edge_length=0.3)


@pytest.fixture(scope="module")
def report(scene: prt.Scene) -> dict:
    return error_against_radius(
        scene,
        prt.CubemapLighting(RESOLUTION),
        "ground",
        [1e-4, 0.1, 0.3],
        n_vertices=VERTICES,
        directions=DIRECTIONS,
        progress=False,
    )


def test_errors_are_those_of_vertices_one_at_a_time(scene: prt.Scene, report: dict) -> None:
    """Distances by hand, lstsq in float64 for "full", and the solver itself, one problem at a time, for L1."""
    samples = _draw_samples(scene, prt.CubemapLighting(RESOLUTION), _mesh(scene), VERTICES)
    squared = {"l1": 0.0, "full": 0.0}
    neighbours = 0
    for p, exact in zip(samples.positions, samples.exact, strict=True):
        near = np.flatnonzero(np.linalg.norm(samples.dense_positions - p, axis=1) <= 0.1)[None].astype(
            np.int32
        )
        neighbours += near.size
        rows = samples.dense[near[0]]
        full = np.linalg.lstsq(rows.T.astype(float), exact.astype(float), rcond=None)[0]
        squared["full"] += float(((full @ rows - exact) ** 2).sum())
        chosen = choose_features(near, samples.dense, samples.features, DIRECTIONS)
        chosen = chosen[chosen >= 0][None]
        weights = l1_fit(*normal_equations(samples.dense, near, chosen, exact[chosen])).weights[0]
        squared["l1"] += float(((weights @ rows - exact) ** 2).sum())
    norm = float((samples.exact.astype(float) ** 2).sum())
    assert report["neighbours"][1] == neighbours / VERTICES
    assert report["error"]["l1"][1] == pytest.approx(np.sqrt(squared["l1"] / norm), rel=1e-3)
    assert report["error"]["full"][1] == pytest.approx(np.sqrt(squared["full"] / norm), rel=1e-5)


def test_the_report_is_json_and_the_same_again(scene: prt.Scene, report: dict) -> None:
    assert json.loads(json.dumps(report)) == report
    again = error_against_radius(
        scene, prt.CubemapLighting(RESOLUTION), "ground", [0.1], VERTICES, DIRECTIONS, progress=False
    )
    for curve in CURVES:
        assert again["error"][curve][0] == pytest.approx(report["error"][curve][1], rel=1e-6)


def test_vertices_without_neighbours_are_fully_wrong(report: dict) -> None:
    assert report["without_neighbours"][0] == 1 and report["neighbours"][0] == 0
    assert [report["error"][curve][0] for curve in CURVES] == pytest.approx([1, 1, 1])
    assert [report["weights"][curve][0] for curve in CURVES] == [0, 0, 0]


def test_a_fit_to_all_directions_is_the_best(report: dict) -> None:
    """No weights fit a row better in the mean square; and more neighbours cannot make it worse."""
    full = np.array(report["error"]["full"])
    assert (full <= np.minimum(report["error"]["l1"], report["error"]["least_squares"]) * (1 + 1e-6)).all()
    assert (np.diff(full) <= 1e-6 * full[:-1]).all()
    assert report["weights"]["l1"][2] < report["weights"]["full"][2]


def test_the_plot_has_all_curves(report: dict) -> None:
    left, right = plot_error_against_radius(report).axes
    assert [line.get_label() for line in left.lines] == list(CURVES.values())
    assert len(right.lines) == len(CURVES) + 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mesh_name": "moon"}, "no mesh 'moon'"),
        ({"radii": []}, "radii"),
        ({"radii": [-0.1]}, "radii"),
        ({"n_vertices": 0}, "n_vertices"),
        ({"directions": 0}, "directions"),
    ],
)
def test_senseless_arguments_are_refused(scene: prt.Scene, changes: dict, message: str) -> None:
    arguments = {"mesh_name": "ground", "radii": [0.1], "n_vertices": 5, "directions": 10} | changes
    with pytest.raises(PrtError, match=message):
        error_against_radius(scene, prt.CubemapLighting(4), progress=False, **arguments)


def _mesh(scene: prt.Scene):
    return next(mesh for mesh in scene.meshes if mesh.name == "ground")
