"""Time against error: methods that exist for comparison only, and everything once from end to end."""

import json

import numpy as np
import pytest
from conftest import COLOURS, build, few_held_out, problem_at, still_life

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.column_sampling import (
    columns_of_nearest,
    precompute_with_columns,
    random_columns,
)
from mi_sparse_prt.benchmark.converged_reference import ReferenceEffort
from mi_sparse_prt.benchmark.time_error import TimeErrorEffort, run_methods, time_against_error
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.methods.dense_sampling import DenseSampler
from mi_sparse_prt.methods.huang2010 import Huang2010Options, huang2010_parts
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.spatial import SpatialSampling
from mi_sparse_prt.solvers.direct_rays import DirectSolver


@pytest.fixture(scope="module")
def lighting() -> prt.CubemapLighting:
    return prt.CubemapLighting(8)


@pytest.fixture(scope="module")
def scene() -> prt.Scene:
    return build(edge_length=0.15, **still_life(COLOURS))


# Small references and few efforts: noisy, but all parts take part
QUICK = TimeErrorEffort(
    spp=4,
    brute_force_spps=(1, 4),
    adjoint_spps=(2, 8),
    targets=(0.2, 0.05),
    reference=ReferenceEffort(vertices=180, texels=12, element_spp=256, rows=36, row_spp=32),
)


# ------------------------------------------------------------------------------------------------ regional columns


def test_columns_are_those_of_the_nearest_dense_vertex(scene, lighting):
    """
    Rationale: all vertices of a region share the columns that its dense rows say; regions of two meshes are apart.
    Expected: vertices whose nearest dense one is the same have the same columns, and the columns of a mesh are chosen
        from its own rows: a row that is zero everywhere but at a few directions gives these and no others.
    Result: as expected.
    """
    sampler = DenseSampler(DirectSolver(problem_at(scene, lighting)), AngularGrid(lighting), Run())
    for mesh in scene.meshes:
        sampler.choose(mesh, SpatialSampling(0.25, radius=0.05))
    dense = sampler.dense()
    rows = np.zeros((len(dense.ids), lighting.n_directions), np.float32)
    for k, mesh in enumerate(scene.meshes):
        rows[dense.of_mesh(mesh), 10 * k : 10 * k + 10] = 1
    columns = columns_of_nearest(scene, dense, rows, random_columns, seed=0, size=60)
    nearest = np.arange(len(dense.ids), dtype=np.int32)
    directions = columns(np.stack([nearest, nearest[::-1]], axis=1))
    assert directions.shape == (len(dense.ids), round(0.06 * lighting.n_directions))
    sets = {}
    for k, mesh in enumerate(scene.meshes):
        own = directions[dense.of_mesh(mesh)]
        assert ((own == -1) | (own // 10 == k)).all() and (own >= 0).sum(axis=1).min() == 10
        sets[mesh.name] = len(np.unique(own, axis=0))
    assert max(sets.values()) == 1  # ten columns for ten places: every region has the same
    rows[:] = np.random.default_rng(0).random(rows.shape)
    directions = columns_of_nearest(scene, dense, rows, random_columns, 0, size=60)(nearest[:, None])
    ground = scene.meshes[0]
    regions = np.unique(directions[dense.of_mesh(ground)], axis=0)
    assert len(regions) == round((ground.vertices.stop - ground.vertices.start) / 60)


@pytest.mark.parametrize("choice", ["clustered_columns", "k_means_columns"])
def test_a_matrix_by_regional_columns(choice, scene, lighting):
    """
    Rationale: a peer that is broken would make all others look good.
    Expected: it evaluates 6% of the directions of a sparse vertex; dense vertices have their own rows; its error is
        below that of the same fit with no samples at all (the neighbours' mean), in direct light alone.
    Result: as expected.
    """
    transport = precompute_with_columns(scene, lighting, choice, max_depth=5, spp=4, progress=False)
    exact = prt.precompute(scene, lighting, "brute_force", max_depth=2, progress=False).direct
    weights = transport.direct.weights
    ids = np.arange(scene.n_vertices)
    truth = exact.rows(ids)[..., 0]
    error = np.linalg.norm(transport.direct.rows(ids)[..., 0] - truth)

    even = weights.copy()
    even.data = np.repeat(1 / np.diff(even.indptr), np.diff(even.indptr)).astype(np.float32)
    mean = np.linalg.norm(type(transport.direct)(transport.direct.dense, even).rows(ids)[..., 0] - truth)
    assert error < mean
    assert error < 0.24 * np.linalg.norm(truth)  # six seeds: 21.0% +- 1.0% in either way

    report = transport.report
    n_dense = weights.shape[1]
    share = round(0.06 * lighting.n_directions) * (scene.n_vertices - n_dense)
    per_dense = (report["elements_evaluated"] - share) / (n_dense * lighting.n_directions)
    assert 0.25 <= per_dense < 0.7
    assert report["seconds"]["total"] > 0
    assert transport.rows([0, 5]).shape == (2, lighting.n_directions, 3)


def test_the_papers_columns_are_the_default(grey_scene, small_lighting):
    """Expected: the same weights whether its choice is named or not, and others with another choice."""
    direct = DirectSolver(problem_at(grey_scene, small_lighting))

    def weights(**options):
        return huang2010_parts(direct, None, Run(), Huang2010Options(**options)).direct.weights.toarray()

    def first(dense, mean):
        return lambda near: np.full((len(near), 1), 40, np.int32)

    usual = weights()
    np.testing.assert_array_equal(usual, weights(columns=Huang2010Options().directions_of))
    assert not np.array_equal(usual, weights(columns=first))


# --------------------------------------------------------------------------------------------------- end to end


def test_a_method_that_refuses_the_scene_is_a_sentence(scene, lighting):
    """Expected: the others are still run."""

    def refuse(*_, **__):
        raise PrtError("not this scene")

    outcomes = dict(
        run_methods({"refusing": refuse, "auto": lambda *_, **__: "matrix"}, scene, lighting, 1, False)
    )
    assert isinstance(outcomes["refusing"], PrtError) and outcomes["auto"] == "matrix"


def test_time_against_error_from_end_to_end(monkeypatch, coloured_scene, small_lighting, tmp_path):
    """
    Rationale: the plot is what a reader judges methods by.
    Expected: every method has a point; ratios are what their definitions say; brute force's
        errors fall as 1 / sqrt(paths) within their standard errors; JSON as it is; a figure for all meshes and each.
    Result: as expected.
    """
    few_held_out(monkeypatch, spp=32)
    scene, chosen = coloured_scene, ["k_means_columns", "gather", "auto 0.2"]
    report = time_against_error(scene, small_lighting, False, tmp_path, chosen, effort=QUICK)
    assert json.loads(json.dumps(report, allow_nan=False)) == report

    assert list(report["methods"]) == chosen
    assert report["skipped"] == []
    one, four = report["brute_force"]
    assert [one["spp"], four["spp"]] == [1, 4]
    errors = [point["relative_l2"]["total"] for point in (one, four)]
    deviations = [point["relative_l2"]["standard_error"]["total"] for point in (one, four)]
    assert abs(errors[0] - 2 * errors[1]) < 4 * np.hypot(deviations[0], 2 * deviations[1])
    assert min(one["seconds"], four["seconds"]) > report["bare_rays"]["direct_seconds"] > 0
    assert report["adjoint"][0]["relative_l2"]["total"] > report["adjoint"][1]["relative_l2"]["total"]
    assert set(report["reference_noise"]["meshes"]) == {mesh.name for mesh in scene.meshes}

    for name, found in report["methods"].items():
        error = found["relative_l2"]["total"]
        assert 0 < error < (1 if name == "k_means_columns" else 0.2)  # with six columns of 96
        assert found["over_bare_rays"] == pytest.approx(found["seconds"] / report["bare_rays"]["seconds"])
        equal, own = found["equal_error"], found["without_held_out"]
        assert own["over_bare_rays"] / own["seconds"] == pytest.approx(1 / report["bare_rays"]["seconds"])
        assert own["speed_up"] * own["seconds"] == pytest.approx(equal["seconds"])
        held = found["phases"].get("held_out", 0.0)
        assert own["seconds"] == pytest.approx(found["seconds"] - held)
        assert (held > 0) == (name != "k_means_columns")
        assert equal["speed_up"] == pytest.approx(equal["seconds"] / found["seconds"])
        if equal["spp"] > 1:
            assert equal["spp"] == pytest.approx((report["noise_of_one_path"] / error) ** 2)
        assert ("target_error" in found) == name.startswith("auto")
    meshes = {f"time_against_error_{mesh.name}.png" for mesh in scene.meshes}
    assert {file.name for file in tmp_path.iterdir()} == {"time_against_error.png"} | meshes


def test_a_method_that_is_not_known(scene, lighting):
    """Expected: said before anything is traced."""
    with pytest.raises(PrtError, match="no method 'best' to time: choose from huang2010, clustered_columns"):
        time_against_error(scene, lighting, progress=False, only=["gather", "best"])
