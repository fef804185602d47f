"""The error that a matrix reports of itself, against its true error."""

import numpy as np
import pytest

import mi_sparse_prt as prt
from mi_sparse_prt.validation.held_out import HeldOut

LIGHTING = prt.CubemapLighting(4)
SEEDS = range(6)


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
