"""The error that a matrix reports of itself, against its true error."""

from functools import cache

import numpy as np
import pytest
from conftest import T, build, bumpy_ball, diffuse
from conftest import mesh as mesh_of

import mi_sparse_prt as prt
from mi_sparse_prt.validation.held_out import HeldOut, _relative, _Stratum

LIGHTING = prt.CubemapLighting(4)
SEEDS = range(6)


@cache
def converged(scene: prt.Scene, basis: str) -> list[np.ndarray]:
    """The whole matrix twice, independently, at 128 samples per element."""
    return [
        prt.precompute(scene, LIGHTING, basis=basis, spp=128, strata=6, seed=1000 + k, progress=False)
        .rows(np.arange(scene.n_vertices))
        .astype(np.float64)
        for k in (0, 1)
    ]


def true_error(ours: np.ndarray, truth: list[np.ndarray], rows: slice = slice(None)) -> float:
    """Relative L2 with the truth's noise taken out."""
    x, y = (t[rows] for t in truth)
    return float(np.sqrt(((ours[rows] - x) * (ours[rows] - y)).sum() / (x * y).sum()))


@pytest.mark.parametrize(
    ("basis", "coarse"), [("direction", None), ("texel", 2)], ids=["direction", "texel, coarse indirect"]
)
def test_the_estimate_covers_the_true_error(grey_scene, basis, coarse):
    """Matrices of 6 seeds: the true error lies within two of the reported standard errors, in total and per mesh.

    The truth is a converged matrix. For normal errors 95% of the intervals hold it; of 24 (6 seeds, the total and 3
    meshes) 20 at least are expected (the chance of fewer is 1%), none further off than 5. The intervals also say
    something: they are narrower than a quarter of the error in total, and errors are told apart from half of theirs.
    """
    truth = converged(grey_scene, basis)
    deviations, widths, ratios = [], [], []
    for seed in SEEDS:
        transport = prt.precompute(
            grey_scene, LIGHTING, basis=basis, spp=8, seed=seed, indirect_resolution=coarse, progress=False
        )
        ours = transport.rows(np.arange(grey_scene.n_vertices)).astype(np.float64)
        reported = transport.report["estimated_error"]
        true = true_error(ours, truth)
        deviations.append((reported["total"] - true) / reported["standard_error"]["total"])
        widths.append(reported["standard_error"]["total"] / true)
        ratios.append(reported["total"] / true)
        for mesh in grey_scene.meshes:
            true = true_error(ours, truth, mesh.vertices)
            estimate = reported["meshes"][mesh.name]
            deviations.append((estimate - true) / reported["standard_error"]["meshes"][mesh.name])
    deviations = np.abs(deviations)
    assert (deviations < 2).sum() >= 20
    assert deviations.max() < 5
    assert max(widths) < 0.25
    assert 0.9 < np.mean(ratios) < 1.1  # no bias of its own


def test_an_error_put_in_is_found(grey_scene):
    """Known damage to an exact matrix: 10% too bright, a dark mesh, swapped rows."""
    transport = prt.precompute(grey_scene, LIGHTING, max_depth=2, progress=False)
    held = HeldOut(grey_scene, LIGHTING, "direction", 2, False, seed=0)
    exact = transport.rows(np.arange(grey_scene.n_vertices))

    def estimate(rows: np.ndarray) -> dict:
        return held.error(rows[held.vertices[:, None], held.texels])

    assert estimate(exact)["total"] < 1e-6
    assert estimate(1.1 * exact)["total"] == pytest.approx(0.1, rel=1e-3)
    assert set(np.round(list(estimate(1.1 * exact)["meshes"].values()), 3)) == {0.1}

    dark = exact.copy()
    dark[grey_scene.meshes[1].vertices] = 0
    report = estimate(dark)
    assert report["meshes"]["ball"] == pytest.approx(1)
    assert report["meshes"]["ground"] < 1e-6
    true = true_error(dark, [exact.astype(np.float64)] * 2)
    assert abs(report["total"] - true) < 3 * report["standard_error"]["total"]

    swapped = exact[np.random.default_rng(0).permutation(len(exact))]
    true = true_error(swapped, [exact.astype(np.float64)] * 2)
    assert abs(estimate(swapped)["total"] - true) < 3 * estimate(swapped)["standard_error"]["total"]


def test_the_choice_of_elements(grey_scene):
    held = HeldOut(grey_scene, LIGHTING, "direction", 2, False, 0, vertices_per_mesh=20, texels_per_vertex=7)
    assert held.vertices.shape == (60,)
    assert held.texels.shape == (60, 7)
    assert (np.diff(held.vertices) > 0).all()
    for mesh in grey_scene.meshes:
        inside = (held.vertices >= mesh.vertices.start) & (held.vertices < mesh.vertices.stop)
        assert inside.sum() == 20
    assert all(len(set(texels)) == 7 for texels in held.texels)
    other = HeldOut(grey_scene, LIGHTING, "direction", 2, False, 1, vertices_per_mesh=20, texels_per_vertex=7)
    assert (held.vertices != other.vertices).any()
    everything = HeldOut(grey_scene, LIGHTING, "direction", 2, False, 0, 10**6, 10**6)
    assert np.array_equal(everything.vertices, np.arange(grey_scene.n_vertices))
    assert np.array_equal(np.sort(everything.texels, axis=1)[0], np.arange(96))


# ------------------------------------------------------------------------------------ few elements


def deviations_of(held: HeldOut, ours: np.ndarray, true: dict[str, float]) -> dict[str, tuple[float, float]]:
    """(estimate - truth) / standard error, and standard error / truth, in total and per mesh."""
    report = held.error(ours[held.vertices[:, None], held.texels])
    estimates = {"total": report["total"], **report["meshes"]}
    errors = {"total": report["standard_error"]["total"], **report["standard_error"]["meshes"]}
    return {k: ((estimates[k] - true[k]) / errors[k], errors[k] / true[k]) for k in true}


@pytest.mark.parametrize(
    ("method", "max_depth", "width"),
    [("brute_force", 5, 0.15), ("sparse", 5, 0.3), ("sparse", 2, 0.4)],
    ids=["noise", "wrong bits and noise", "wrong bits"],
)
def test_intervals_from_few_elements(grey_scene, method, max_depth, width):
    """30 vertices of a mesh, 16 texels of each, 25 times: a twentieth of the scene.

    Errors of visibility are few and large: 2 standard errors of those that happen to be seen would hold the truth in
    half of the cases.

    Expected: intervals of 2 standard errors hold the true error (against a converged matrix) in at least 85% of the
    cases, in total and over the meshes; those of half a standard error do not. The width says something.
    """
    transport = prt.precompute(
        grey_scene, LIGHTING, method=method, max_depth=max_depth, spp=4, seed=5, progress=False
    )
    ours = transport.rows(np.arange(grey_scene.n_vertices)).astype(np.float64)
    if max_depth == 2:
        exact = prt.precompute(grey_scene, LIGHTING, max_depth=2, progress=False)
        truth = [exact.rows(np.arange(grey_scene.n_vertices)).astype(np.float64)] * 2
    else:
        truth = converged(grey_scene, "direction")
    true = {"total": true_error(ours, truth)}
    true |= {m.name: true_error(ours, truth, m.vertices) for m in grey_scene.meshes}

    found = [
        deviations_of(
            HeldOut(grey_scene, LIGHTING, "direction", max_depth, max_depth > 2, seed, 30, 16), ours, true
        )
        for seed in range(100, 125)
    ]
    table = np.array([list(one.values()) for one in found])  # [seed, total and meshes, deviation and width]
    inside = np.abs(table[..., 0])
    assert (inside[:, 0] < 2).mean() >= 0.85
    assert (inside[:, 1:] < 2).mean() >= 0.85
    assert (inside < 0.5).mean() < 0.85
    assert np.median(table[:, 0, 1]) < width


def test_errors_in_proportion_need_no_interval():
    """10% too bright everywhere: the ratio is 0.1 whichever vertices are looked at, however different they are."""
    rng = np.random.default_rng(0)
    norms = rng.exponential(size=(20, 1)) * rng.random((20, 5))
    strata = [_Stratum(0.01 * part, part, size) for part, size in ((norms[:12], 100), (norms[12:], 30))]
    relative, error = _relative(strata)
    assert relative == pytest.approx(0.1)
    assert error < 1e-8


def test_the_spread_is_that_of_many_draws():
    """Normal errors of 400 draws of 50 vertices from gamma-distributed ones: reported against real spread.

    The worst vertex, counted once more, adds 5 to 20% to the reported one.
    """
    rng = np.random.default_rng(1)
    draws = []
    for _ in range(400):
        norms = rng.gamma(2, size=(50, 8))
        squares = 0.04 * norms * rng.gamma(2, 0.5, size=(50, 1))
        draws.append(_relative([_Stratum(squares, norms, 50)]))
    estimates, errors = np.transpose(draws)
    assert estimates.mean() == pytest.approx(0.2, rel=0.02)
    assert 1 < errors.mean() / estimates.std() < 1.25


@pytest.mark.parametrize(("k", "t"), [(10, 8), (256, 32)])
def test_where_nothing_is_wrong_one_element_may_be(k, t):
    """Of N equal elements one, had it been wrong, would be a relative error of sqrt(1 / N). Dark ones do not count."""
    norms = np.zeros((k, t))
    norms[:, : t // 2] = 3.0
    relative, error = _relative([_Stratum(np.zeros((k, t)), norms, 1000)])
    assert relative == 0
    assert error == pytest.approx(np.sqrt(2 / (k * t)))


def test_a_black_mesh_has_no_error():
    black = np.zeros((4, 5))
    assert _relative([_Stratum(black, black, 9)]) == (0.0, 0.0)
    assert _relative([_Stratum(black + 1, black, 9)]) == (1.0, 0.0)


def test_one_vertex_alone():
    relative, error = _relative([_Stratum(np.full((1, 4), 0.04), np.ones((1, 4)), 1)])
    assert relative == pytest.approx(0.2)
    assert np.isfinite(error)


# ------------------------------------------------------------------------------------ method "sparse"


def corner() -> prt.Scene:
    """A bumpy ball before two walls on a floor: most of its light is reflected."""
    vertices, triangles = bumpy_ball()
    wall = {"type": "rectangle", "bsdf": diffuse(0.7, 0.7, 0.7)}
    return build(
        1.0,
        floor={**wall, "to_world": T().rotate([1, 0, 0], -90)},
        back={**wall, "to_world": T().translate([0, 1, -1.01])},
        side={**wall, "to_world": T().translate([-1.01, 1, 0]).rotate([0, 1, 0], 90)},
        ball=mesh_of("ball", vertices + [0, 0.65, 0], triangles, diffuse(0.5, 0.5, 0.5)),
    )


@pytest.mark.parametrize("where", ["still life", "corner"])
def test_the_estimate_for_sparse_is_within_a_fifth(grey_scene, where):
    """Two seeds of ``method="sparse"`` with indirect light; the truth is a converged matrix.

    Expected: their mean estimate is within 20% of their mean true error, and each within 20% and 2 standard errors.
    """
    scene = grey_scene if where == "still life" else corner()
    truth = converged(scene, "direction")
    ratios, widths = [], []
    for seed in range(2):
        transport = prt.precompute(scene, LIGHTING, method="sparse", spp=8, seed=seed, progress=False)
        true = true_error(transport.rows(np.arange(scene.n_vertices)).astype(np.float64), truth)
        reported = transport.report["estimated_error"]
        ratios.append(reported["total"] / true)
        widths.append(reported["standard_error"]["total"] / true)
    assert abs(np.mean(ratios) - 1) < 0.2
    assert (np.abs(np.array(ratios) - 1) < 0.2 + 2 * np.array(widths)).all()
    assert max(widths) < 0.2
