"""Lightcuts: trees of lights, bounds that hold, cuts that end where an error is not seen."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.manylights import lightcuts as lightcuts_module
from mi_sparse_prt.manylights.elements import Elements
from mi_sparse_prt.manylights.light_tree import LightTree, build_light_tree, largest_values
from mi_sparse_prt.manylights.lightcuts import lightcuts
from mi_sparse_prt.manylights.lights import LightOptions, scene_lights
from mi_sparse_prt.manylights.samples import Samples
from mi_sparse_prt.manylights.surfaces import Surfaces

T = mi.ScalarTransform4f
WALL = {"type": "rectangle", "bsdf": {"type": "twosided", "bsdf": diffuse(0.6, 0.5, 0.4)}}
BULB = {
    "type": "sphere",
    "radius": 0.1,
    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [40, 30, 20]}},
}


def room(**more: dict) -> mi.Scene:
    """Lamps of all kinds of lights: surfaces, directions, points and a spot."""
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 50,
                "to_world": T().look_at([0.3, 1.4, 3.6], [0, 0.7, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 12, "height": 10, "rfilter": {"type": "box"}},
            },
            "floor": WALL | {"to_world": T().rotate([1, 0, 0], -90).scale(3)},
            "wall": WALL | {"to_world": T().translate([0, 1, -2]).scale(3)},
            "ball": {
                "type": "sphere",
                "center": [-0.5, 0.5, 0],
                "radius": 0.5,
                "bsdf": diffuse(0.7, 0.6, 0.2),
            },
            "bulb": BULB | {"center": [0.7, 1.1, 0.3]},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.3, 0.4]}},
            "point": {"type": "point", "position": [-1, 1.5, 1], "intensity": {"type": "rgb", "value": 0.5}},
            "spot": {
                "type": "spot",
                "to_world": T().look_at([1, 2, 1], [0, 0, 0], [0, 1, 0]),
                "intensity": {"type": "rgb", "value": 2},
            },
        }
        | more
    )


def matrix_of(scene: mi.Scene, count: int = 600) -> Elements:
    surfaces = Surfaces(scene)
    samples = Samples(scene, surfaces, scene.sensors()[0], 4, 4, 0)
    return Elements(scene, surfaces, samples, scene_lights(scene, LightOptions(count, max_depth=4)))


@pytest.fixture(scope="module")
def matrix() -> Elements:
    return matrix_of(room())


@pytest.fixture(scope="module")
def whole(matrix: Elements) -> np.ndarray:
    return matrix.rows(np.arange(matrix.shape[0])).astype(np.float64)  # [sample, light, rgb]


@pytest.fixture(scope="module")
def tree(matrix: Elements) -> LightTree:
    return build_light_tree(matrix.lights, np.random.default_rng(3))


def members(tree: LightTree, node: int) -> list[int]:
    if tree.children[node, 0] < 0:
        return [node]
    return [light for child in tree.children[node] for light in members(tree, child)]


def test_all_lights_are_in_one_tree_each(matrix: Elements, tree: LightTree) -> None:
    """Expected: each light is below one root; intensities add up; lights of a node are alike in kind and depth; its
    representative is one of its lights, and that of one of its children.
    """
    kinds, depths = matrix.lights.arrays.kind.numpy(), matrix.lights.arrays.depth.numpy()
    below = [members(tree, root) for root in tree.roots]
    assert sorted(sum(below, [])) == list(range(matrix.shape[1]))
    for lights in below:
        assert len({(kinds[k], depths[k]) for k in lights}) == 1
    for node in range(matrix.shape[1], len(tree.children)):
        lights = members(tree, node)
        assert tree.intensities[node] == pytest.approx(tree.intensities[lights].sum())
        assert tree.representatives[node] in tree.representatives[tree.children[node]]
        assert tree.representatives[node] in lights


def test_representatives_are_drawn_by_intensity(matrix: Elements) -> None:
    """The root of most lights, 80 trees. Expected: the mean intensity of its representative is that of a drawing in
    proportion to intensity, within 4 standard errors.
    """
    found = []
    for seed in range(80):
        tree = build_light_tree(matrix.lights, np.random.default_rng(seed))
        root = max(tree.roots, key=lambda node: tree.intensities[node])
        found.append(tree.intensities[tree.representatives[root]])
    intensities = tree.intensities[members(tree, root)]
    expected = (intensities**2).sum() / intensities.sum()
    error = np.std(found, ddof=1) / np.sqrt(len(found))
    assert abs(np.mean(found) - expected) <= 4 * error + 1e-6 * expected


def test_no_node_sends_more_than_its_bound(matrix: Elements, whole: np.ndarray, tree: LightTree) -> None:
    """All nodes and samples. Expected: the sum of its lights' elements is at most the bound, to rounding; these are not
    so large that they say nothing: of nodes of up to 8 lights, half of those that are seen are within a factor of 4.
    """
    cuts = lightcuts_module._Cuts(matrix, tree, np.arange(matrix.shape[0]))
    n = matrix.shape[1]
    ratios = []
    for node in range(n, len(tree.children)):
        lights = members(tree, node)
        sent = whole[:, lights].mean(axis=2).sum(axis=1)
        samples, nodes = np.arange(len(sent)), np.full(len(sent), node)
        most = largest_values(tree, nodes, samples, cuts._receivers, matrix.clamp)
        assert np.all(sent <= most * (1 + 1e-3) + 1e-9), node
        if len(lights) <= 8:
            ratios.append(most[sent > 0] / sent[sent > 0])
    assert np.median(np.concatenate(ratios)) < 4


@pytest.mark.slow
@pytest.mark.parametrize("threshold", [0.1, 0.02])
def test_errors_are_about_the_threshold(matrix: Elements, whole: np.ndarray, threshold: float) -> None:
    """Five seeds. Expected: RMS of the samples' errors is about the threshold at most, fewer elements than all, and
    the mean is right within 4 standard errors and a tenth of the threshold (what is split depends on what was found).
    """
    expected, before = whole.sum(axis=1), matrix.evaluated
    found = np.array([lightcuts(matrix, seed, threshold) for seed in range(5)])
    share = (matrix.evaluated - before) / (5 * whole[..., 0].size)
    errors = np.linalg.norm(found - expected, axis=(1, 2)) / np.linalg.norm(expected)
    means = found.mean(axis=(1, 2)) / expected.mean() - 1
    print(f"{share:.0%} of the elements, errors {errors}, means {means.mean():.4f} +- {means.std():.4f}")
    assert np.sqrt(np.mean(errors**2)) < 1.25 * threshold
    assert share < 0.7
    assert abs(means.mean()) < 4 * means.std(ddof=1) / np.sqrt(5) + threshold / 10


def test_without_a_threshold_nothing_is_lost(matrix: Elements, whole: np.ndarray) -> None:
    """Expected: cuts of all lights are the sum of all columns."""
    np.testing.assert_allclose(lightcuts(matrix, 0, 0.0), whole.sum(axis=1), rtol=2e-4, atol=1e-6)


def test_samples_together_or_apart(matrix: Elements, monkeypatch: pytest.MonkeyPatch) -> None:
    together = lightcuts(matrix, 1)
    monkeypatch.setattr(lightcuts_module, "TOGETHER", 250)
    np.testing.assert_allclose(lightcuts(matrix, 1), together, rtol=1e-5, atol=1e-7)


def test_glossy_scenes_are_refused() -> None:
    gold = {"type": "sphere", "center": [0.5, 0.3, 0.5], "radius": 0.3, "bsdf": {"type": "roughconductor"}}
    with pytest.raises(PrtError, match="diffuse surfaces alone"):
        lightcuts(matrix_of(room(gold=gold), 50))


def test_one_light_and_none() -> None:
    """Expected: the light's column; black."""
    dark = {name: {"type": "sphere", "center": [9, 9, 9], "radius": 0.1} for name in ("bulb", "sky", "point")}
    one = matrix_of(room(**dark), 1)
    n = one.shape[1]
    np.testing.assert_allclose(
        lightcuts(one, 0, 0.0), one.sum_columns(np.arange(n), np.ones((n, 3), np.float32))
    )
    assert not lightcuts(matrix_of(room(**dark, spot=dark["sky"]), 10)).any()
