"""The pipeline: its report, what it skips, what it refuses, and that a seed decides all."""

import json

import numpy as np
import pytest
from conftest import GREY, build, diffuse, still_life

import mi_sparse_prt as prt
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.planner.memory import KERNELS
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.transport import LightTransport

LIGHTING = prt.CubemapLighting(4)


def precompute(scene: prt.Scene, **parameters: object) -> LightTransport:
    """Every element, if not told otherwise."""
    usual = {"method": "brute_force", "spp": 4, "progress": False}
    return prt.precompute(scene, LIGHTING, **(usual | parameters))


@pytest.fixture
def no_indirect_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """From here on the test fails if any indirect element is computed."""

    def fail(self: PathSolver, *_: object, **__: object) -> None:
        raise AssertionError("indirect light was computed")

    monkeypatch.setattr(PathSolver, "rows", fail)
    monkeypatch.setattr(PathSolver, "elements", fail)


# ------------------------------------------------------------------------------------ report


@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_the_report_has_what_others_rely_on(grey_scene, basis):
    report = precompute(grey_scene, basis=basis).report
    assert json.loads(json.dumps(report)) == report
    expected = {"seconds", "elements_total", "elements_evaluated", "rays", "estimated_error", "skipped"}
    expected |= {"peak_memory_bytes", "seed", "parameters", "versions"}
    assert expected <= report.keys()

    n = grey_scene.n_vertices
    assert report["elements_total"] == report["elements_evaluated"] == n * 96
    above = (grey_scene.normals @ LIGHTING.directions.T > 0).mean()
    per_element = 1 if basis == "direction" else 4
    assert report["rays"]["direct"] == pytest.approx(above * n * 96 * per_element, abs=per_element)
    assert report["rays"]["indirect_paths"] == n * 96 * 4
    assert any(f"{1 - above:.0%}" in sentence for sentence in report["skipped"])
    assert report["peak_memory_bytes"] > 1e8
    assert report["parameters"]["basis"] == basis
    assert report["parameters"]["max_depth"] == 5
    assert {"mitsuba", "drjit", "numpy"} <= report["versions"].keys()
    assert report["scene"]["hash"] == grey_scene.hash

    error = report["estimated_error"]
    names = {mesh.name for mesh in grey_scene.meshes}
    assert error["meshes"].keys() == error["standard_error"]["meshes"].keys() == names
    assert 0 < error["total"] < 0.2
    assert min(error["meshes"].values()) < error["total"] < max(error["meshes"].values())


def test_phases_add_up(grey_scene):
    seconds = dict(precompute(grey_scene).report["seconds"])
    total, compiling = seconds.pop("total"), seconds.pop("compile")
    assert compiling >= 0
    assert all(value >= 0 for value in seconds.values())
    assert sum(seconds.values()) == pytest.approx(total, rel=0.02)
    assert {"direct", "indirect", "held_out", "other"} <= seconds.keys()
    assert seconds["other"] < 0.3 * total


def test_the_forecast_is_of_the_right_size(grey_scene, capsys):
    transport = precompute(grey_scene, spp=64, progress=True)
    forecast = transport.report["forecast"]
    assert forecast["bytes"] == pytest.approx(KERNELS + transport.nbytes)
    traced = transport.report["seconds"]["direct"] + transport.report["seconds"]["indirect"]
    assert 0.2 * traced < forecast["seconds"] < 5 * traced
    shown = capsys.readouterr()
    assert "313 vertices x 96 directions" in shown.out + shown.err
    assert "indirect" in shown.err


@pytest.mark.parametrize(("method", "elements"), [("sparse", 0.097), ("huang2010", 0.113)])
def test_the_forecast_of_few_elements(grey_scene, monkeypatch, capsys, method, elements):
    """Where a path takes long, time goes as the elements do, of which these are the shares in large scenes.

    Expected: about that share of the time of brute force. So small a matrix takes no memory beside compiled code.
    """
    monkeypatch.setattr(
        "mi_sparse_prt.planner.forecast.seconds_per_row",
        lambda solver: 10.0 if isinstance(solver, PathSolver) else 0.01,
    )
    transport = precompute(grey_scene, method=method, progress=True)
    forecast = transport.report["forecast"]
    assert forecast["seconds"] == pytest.approx(elements * 10 * 313, rel=0.25)
    assert KERNELS + transport.nbytes / 2 < forecast["bytes"] < 1.01 * KERNELS
    assert f"about {forecast['seconds']:.0f} s" in capsys.readouterr().out


def test_quiet_without_progress(grey_scene, capsys):
    precompute(grey_scene, max_depth=2)
    assert capsys.readouterr() == ("", "")


# ------------------------------------------------------------------------------------ what is skipped


@pytest.mark.usefixtures("no_indirect_rows")
@pytest.mark.parametrize(
    ("shapes", "parameters", "reason"),
    [
        (still_life(), {"max_depth": 2}, "max_depth 2"),
        (still_life(((0, 0, 0),) * 3), {}, "black"),
        ({"ball": {"type": "sphere", "bsdf": diffuse(1, 1, 1)}}, {}, "no surface sees another"),
    ],
    ids=["max_depth 2", "black", "a convex object alone"],
)
def test_indirect_light_that_cannot_be_is_not_computed(shapes, parameters, reason):
    transport = precompute(build(**shapes), **parameters)
    assert transport.indirect is None
    assert "indirect_paths" not in transport.report["rays"]
    assert any(reason in sentence for sentence in transport.report["skipped"])
    assert transport.report["seconds"].get("indirect", 0) == 0
    assert transport.report["estimated_error"]["total"] < 1e-6  # bits are exact


@pytest.mark.usefixtures("no_indirect_rows")
def test_the_guard_itself_works(grey_scene):
    with pytest.raises(AssertionError, match="was computed"):
        precompute(grey_scene)


def test_a_grey_scene_has_one_channel(grey_scene, coloured_scene):
    grey, coloured = precompute(grey_scene), precompute(coloured_scene)
    assert grey.indirect.density.shape == (313, 96, 1)
    assert coloured.indirect.density.shape == (313, 96, 3)
    assert any("channels" in sentence for sentence in grey.report["skipped"])
    assert not any("channels" in sentence for sentence in coloured.report["skipped"])


def test_fewer_directions_for_indirect_light(grey_scene):
    """The mean over a coarse texel, interpolated: the same light in total, within what interpolation costs."""
    fine = precompute(grey_scene, spp=64)
    coarse = precompute(grey_scene, spp=256, indirect_resolution=2)
    assert coarse.indirect.density.shape == (313, 24, 1)
    assert coarse.nbytes < 0.5 * fine.nbytes
    assert np.array_equal(coarse.direct.bits, fine.direct.bits)
    both = [np.linalg.norm(t.indirect.relight(np.ones((96, 3), np.float32))) for t in (fine, coarse)]
    assert both[1] == pytest.approx(both[0], rel=0.05)
    assert coarse.report["parameters"]["indirect_resolution"] == 2


def test_bases_are_stored_in_their_own_form(grey_scene):
    assert isinstance(precompute(grey_scene, max_depth=2).direct, Visibility)
    assert isinstance(precompute(grey_scene, max_depth=2, basis="texel").direct, MeanCosine)


# ------------------------------------------------------------------------------------ seeds


@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_a_seed_decides_all(coloured_scene, basis):
    first, again, other = (precompute(coloured_scene, basis=basis, seed=s) for s in (1, 1, 2))
    ids = np.arange(coloured_scene.n_vertices)
    assert np.array_equal(first.rows(ids), again.rows(ids))
    assert first.report["estimated_error"] == again.report["estimated_error"]
    assert (first.indirect.density != other.indirect.density).mean() > 0.2
    same_direct = np.array_equal(first.direct.rows(ids), other.direct.rows(ids))
    assert same_direct == (basis == "direction")
    # both are estimates of the same
    assert np.linalg.norm(first.rows(ids) - other.rows(ids)) < 0.2 * np.linalg.norm(first.rows(ids))


def test_an_interrupted_run_goes_on_to_the_same_matrix(grey_scene, monkeypatch, tmp_path):
    whole = precompute(grey_scene)
    monkeypatch.setattr("mi_sparse_prt.solvers.paths.LANES", 1 << 14)  # blocks of 42 vertices
    rows, calls = PathSolver.rows, []

    def interrupted(self: PathSolver, ids: np.ndarray) -> object:
        calls.append(ids)
        if len(calls) == 6:  # two are the forecast's
            raise KeyboardInterrupt
        return rows(self, ids)

    with monkeypatch.context() as patch:
        patch.setattr(PathSolver, "rows", interrupted)
        with pytest.raises(KeyboardInterrupt):
            precompute(grey_scene, checkpoint_folder=tmp_path)
    (kept,) = tmp_path.iterdir()
    assert kept.stat().st_size == 3 * (
        42 * 96 * 2 + 20
    )  # three blocks of half floats, each with place and checksum

    monkeypatch.setattr(PathSolver, "rows", lambda self, ids: (calls.append(ids), rows(self, ids))[1])
    calls.clear()
    resumed = precompute(grey_scene, checkpoint_folder=tmp_path)
    assert calls[2][0] == 3 * 42
    assert np.array_equal(resumed.indirect.density, whole.indirect.density)
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------------------------ bad arguments


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"method": "magic"}, "method"),
        ({"basis": "sphere"}, "basis"),
        ({"max_depth": 1}, "max_depth"),
        ({"max_depth": 0}, "max_depth"),
        ({"max_depth": -2}, "max_depth"),
        ({"max_depth": 3.5}, "max_depth"),
        ({"spp": 0}, "spp"),
        ({"spp": 2.5}, "spp"),
        ({"strata": 0}, "strata"),
        ({"indirect_resolution": 3}, "power of two"),
        ({"indirect_resolution": 8}, "indirect_resolution"),
        ({"target_error": 0}, "target_error"),
        ({"target_error": -0.1}, "target_error"),
        ({"target_error": float("nan")}, "target_error"),
        ({"seed": -1}, "seed"),
        ({"seed": 0.5}, "seed"),
    ],
    ids=str,
)
def test_arguments_that_make_no_sense(grey_scene, parameters, message):
    with pytest.raises(prt.PrtError, match=message) as error:
        precompute(grey_scene, **parameters)
    assert "\n" not in str(error.value)


def test_a_matrix_that_does_not_fit_is_refused_before_it_is_computed(grey_scene, monkeypatch):
    class Memory:
        available = 1000

    monkeypatch.setattr("psutil.virtual_memory", lambda: Memory)
    with pytest.raises(prt.PrtError, match="GB"):
        precompute(grey_scene)


def test_huang2010_refuses_rows_that_do_not_fit_before_it_samples_them(grey_scene, monkeypatch):
    """Memory for bits (four kilobytes, thrice), and not for float32 rows of a quarter of 313 vertices."""

    class Memory:
        available = 20_000

    def fail(*_: object) -> None:
        raise AssertionError("rays were traced")

    monkeypatch.setattr("psutil.virtual_memory", lambda: Memory)
    monkeypatch.setattr("mi_sparse_prt.planner.memory.KERNELS", 0.0)
    monkeypatch.setattr(DirectSolver, "visible", fail)
    with pytest.raises(prt.PrtError, match="huang2010.*GB"):
        precompute(grey_scene, method="huang2010", max_depth=2)


def test_a_target_error_is_met(grey_scene):
    """The planner chooses samples; the held-out estimate stays under the target, within its own confidence."""
    transport = precompute(grey_scene, target_error=0.03)
    error = transport.report["estimated_error"]
    assert error["total"] < 0.03 + 2 * error["standard_error"]["total"]
    assert error["total"] > 0.01  # and no effort is wasted
    assert transport.report["parameters"]["target_error"] == 0.03


def test_albedo_is_a_factor_of_the_rows():
    """A white and a grey ball over the same ground: the incident light is the same, what leaves is not."""
    ids = np.arange(300)
    white = precompute(build(**still_life((GREY[0], (1, 1, 1), GREY[2]))), max_depth=2)
    dark = precompute(build(**still_life((GREY[0], (0.25, 0.5, 0.75), GREY[2]))), max_depth=2)
    ball = white.meshes[1].vertices
    np.testing.assert_allclose(
        dark.rows(ids[ball]), white.rows(ids[ball]) * np.float32([0.25, 0.5, 0.75]), rtol=1e-6
    )
