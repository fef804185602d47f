"""``method="gather"`` from scene to file: exact direct light, and interreflections by finite elements."""

import numpy as np
import pytest
from conftest import COLOURS, GREY, build, problem_at, still_life
from numpy.typing import NDArray

import mi_sparse_prt as prt
from mi_sparse_prt.core.metrics import relative_l2
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.solvers.paths import PathSolver

LIGHTING = prt.CubemapLighting(8)
FINE = 0.1  # edges, for interpolation on them to be good


@pytest.fixture(scope="module")
def scene() -> prt.Scene:
    return build(FINE, **still_life(COLOURS))


@pytest.fixture(scope="module")
def gathered(scene: prt.Scene) -> prt.LightTransport:
    return prt.precompute(scene, LIGHTING, method="gather", progress=False)


@pytest.mark.usefixtures("no_held_out")
def test_direct_light_is_that_of_brute_force(scene, gathered):
    exact = prt.precompute(scene, LIGHTING, method="brute_force", max_depth=2, progress=False)
    assert np.array_equal(gathered.direct.bits, exact.direct.bits)


@pytest.mark.parametrize("basis", ["direction", pytest.param("texel", marks=pytest.mark.slow)])
def test_errors_are_small_and_the_estimate_knows_them(scene, gathered, basis):
    """Indirect rows of 100 vertices against 2 x 64 paths per element, whose noise two halves take out.

    Expected: 3% of the whole at most. In the direction basis there is no other error, and the estimate is within 3 of
    its standard errors or a fifth.
    """
    transport = gathered
    if basis == "texel":
        transport = prt.precompute(scene, LIGHTING, method="gather", basis=basis, progress=False)
    chosen = np.sort(np.random.default_rng(1).choice(len(scene.positions), 100, replace=False))
    ours = scene.albedo[chosen][:, None] * transport.indirect.rows(chosen)
    halves = [_paths(scene, chosen, basis, seed) for seed in (5, 6)]
    square = np.vdot(ours - halves[0], ours - halves[1]) / np.vdot(*[transport.rows(chosen)] * 2)
    measured = float(np.sqrt(max(square, 0)))
    estimate = transport.report["estimated_error"]
    spread = estimate["standard_error"]["total"]
    print(f"measured {measured:.3%}, estimated {estimate['total']:.3%} +- {spread:.3%}")
    assert measured < 0.03
    if basis == "direction":
        assert estimate["total"] == pytest.approx(measured, abs=max(3 * spread, 0.2 * measured + 1e-3))


def _paths(scene: prt.Scene, chosen: NDArray, basis: str, seed: int) -> NDArray:
    """Indirect rows of some vertices by 64 paths per element."""
    solver = PathSolver(problem_at(scene, LIGHTING, basis=basis), 64, seed=seed)
    white = solver.rows(chosen).mean * LIGHTING.solid_angles[:, None]
    return scene.albedo[chosen][:, None] * white


def test_rows_columns_and_relight_are_one_matrix(gathered):
    part = gathered.indirect
    assert isinstance(part, LowRank) and len(part.left) == 3
    full = gathered.rows(np.arange(gathered.shape[0]))
    some = np.array([5, 100, 383])
    assert np.allclose(gathered.columns(some), full[:, some], rtol=1e-5, atol=1e-7)
    light = np.random.default_rng(0).random((384, 3)).astype(np.float32)
    expected = np.einsum("njc,jc->nc", full, light)
    assert np.allclose(gathered.relight(light), expected, rtol=1e-5, atol=1e-5 * expected.max())
    ids, texels = np.array([0, 7, 7, 900]), np.array([0, 3, 383, 11])
    single = part.elements(ids, texels)
    assert np.allclose(single, part.rows(ids)[np.arange(4), texels], rtol=1e-5, atol=1e-8)


def test_files_and_other_orders(tmp_path, scene, gathered):
    gathered.save(tmp_path / "a.prt")
    again = prt.load_transport(tmp_path / "a.prt")
    for side in ("left", "right"):
        factors = zip(getattr(gathered.indirect, side), getattr(again.indirect, side), strict=True)
        assert all(np.array_equal(a, b) for a, b in factors)
    assert again.report == gathered.report
    source = np.random.default_rng(0).permutation(gathered.shape[0])
    turned = gathered.indirect.take(source)
    assert np.array_equal(turned.rows([3]), gathered.indirect.rows(source[[3]]))


def test_the_report_says_what_was_left_out(gathered):
    report = gathered.report
    assert report["parameters"]["method"] == "gather"
    assert report["elements"] == {"direct": report["elements_total"], "indirect": 0}
    assert report["rays"]["gather"] == 256 * gathered.shape[0]
    assert any("interreflections" in sentence for sentence in report["skipped"])
    phases = {name: s for name, s in report["seconds"].items() if name not in ("total", "compile")}
    assert sum(phases.values()) == pytest.approx(report["seconds"]["total"], rel=0.02)
    assert {"direct", "gather_rays", "interreflection"} <= phases.keys()


@pytest.mark.slow  # test_glossy_error.py
def test_a_target_error_is_met_by_more_rays():
    """A loose target takes the first attempt; a tight one costs more, and the report counts all attempts."""
    scene = build(FINE, **still_life(GREY))
    loose, tight = (
        prt.precompute(scene, LIGHTING, method="gather", target_error=target, progress=False).report
        for target in (0.5, 0.006)
    )
    n = len(scene.positions)
    assert loose["rays"]["gather"] == 64 * n
    assert tight["rays"]["gather"] >= (64 + 256) * n
    assert tight["estimated_error"]["total"] < loose["estimated_error"]["total"]
    assert tight["elements_evaluated"] == loose["elements_evaluated"]


@pytest.mark.usefixtures("no_held_out")
def test_without_interreflections_it_is_direct_light(scene):
    for transport in (
        prt.precompute(scene, LIGHTING, method="gather", max_depth=2, progress=False),
        prt.precompute(build(0.5, ground=still_life()["ground"]), LIGHTING, method="gather", progress=False),
    ):
        assert transport.indirect is None
        assert "gather" not in transport.report["rays"]


@pytest.mark.filterwarnings("ignore::mi_sparse_prt.core.errors.PrtWarning")
def test_other_materials_count_as_diffuse_and_the_error_is_told():
    """Expected: the estimate is what rows of paths, which ask the real BSDF, differ by."""
    shapes = still_life()
    shapes["box"]["bsdf"] = {"type": "roughconductor", "alpha": 0.3}
    scene = build(0.5, **shapes)
    ours, exact = (
        prt.precompute(scene, prt.CubemapLighting(4), plan, progress=False)
        for plan in (Plan("exact", "gather", 1024, 0.01), Plan("exact", "paths", spp=512))
    )
    rows = np.arange(scene.n_vertices)
    true = relative_l2(ours.rows(rows), exact.rows(rows))
    told = ours.report["estimated_error"]
    print(f"true {true:.3%}, told {told['total']:.3%} +- {told['standard_error']['total']:.3%}")
    assert abs(told["total"] - true) < 4 * told["standard_error"]["total"] + 0.1 * true


@pytest.mark.usefixtures("no_held_out")
def test_same_seed_same_matrix(scene, gathered):
    again = prt.precompute(scene, LIGHTING, method="gather", progress=False)
    assert np.array_equal(again.rows([1, 50]), gathered.rows([1, 50]))
    other = prt.precompute(scene, LIGHTING, method="gather", seed=1, progress=False)
    assert not np.array_equal(other.rows([1, 50]), gathered.rows([1, 50]))
