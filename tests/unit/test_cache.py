"""Matrices found again: by scene and settings, in any vertex order, and only if they are whole."""

import warnings

import numpy as np
import pytest
from conftest import GREY, T, build, still_life

import mi_sparse_prt as prt
from mi_sparse_prt import cache

LIGHTING = prt.CubemapLighting(2)
SETTINGS = {"method": "brute_force", "spp": 2, "max_depth": 3}
SAME = ((0.5,) * 3,) * 3  # one material for all shapes, so that Mitsuba merges what it can


class Counted:
    """``precompute``, with a count of its calls."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, *args: object, **parameters: object) -> prt.LightTransport:
        self.calls += 1
        return prt.precompute(*args, **parameters)


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counted:
    counter = Counted()
    monkeypatch.setattr(cache, "precompute", counter)
    return counter


def cached(scene, folder, lighting=LIGHTING, **settings):
    return cache.cached_precompute(scene, lighting, folder, progress=False, **(SETTINGS | settings))


def test_the_second_call_loads(grey_scene, counted, tmp_path):
    folder = tmp_path / "made" / "on demand"
    first = cached(grey_scene, folder)
    second = cached(grey_scene, folder)
    assert counted.calls == 1
    assert len(list(folder.glob("*.prt"))) == 1
    assert len(list(folder.iterdir())) == 1
    ids = np.arange(grey_scene.n_vertices)
    assert np.array_equal(first.rows(ids), second.rows(ids))
    assert second.report == first.report


def test_defaults_are_the_same_key_as_when_spelt_out(grey_scene, counted, tmp_path):
    cached(grey_scene, tmp_path)
    cached(grey_scene, tmp_path, basis="direction", method="brute_force", seed=0, strata=2)
    assert counted.calls == 1


@pytest.mark.parametrize(
    "other",
    [{"spp": 3}, {"max_depth": 2}, {"basis": "texel"}, {"seed": 1}, {"indirect_resolution": 1},
     {"lighting": prt.CubemapLighting(1)}, {"strata": 3, "basis": "texel"}, {"target_error": 0.3}],
    ids=str,
)  # fmt: skip
def test_other_parameters_are_another_file(grey_scene, counted, tmp_path, other):
    cached(grey_scene, tmp_path)
    cached(grey_scene, tmp_path, **other)
    assert counted.calls == 2
    assert len(list(tmp_path.iterdir())) == 2


def test_other_geometry_or_materials_are_another_file(counted, tmp_path):
    moved = still_life()
    moved["box"]["to_world"] = moved["box"]["to_world"] @ T().translate([1e-4, 0, 0])
    for shapes in (still_life(), moved, still_life((GREY[0], (0.6, 0.6, 0.6001), GREY[2]))):
        cached(build(**shapes), tmp_path)
    assert counted.calls == 3
    assert len(list(tmp_path.iterdir())) == 3


def test_order_of_shapes_and_merging_do_not_matter(counted, tmp_path):
    """One file serves the XML's order, another order, and Mitsuba's merged mesh; rows come in the asking order."""
    shapes = still_life(SAME)
    scene = build(**shapes)
    first = cached(scene, tmp_path)
    row_of = {tuple(p): i for i, p in enumerate(np.c_[scene.positions, scene.normals].tolist())}
    assert len(row_of) == scene.n_vertices
    for other in (build(**dict(reversed(list(shapes.items())))), build(optimize=True, **shapes)):
        found = cached(other, tmp_path)
        source = [row_of[tuple(p)] for p in np.c_[other.positions, other.normals].tolist()]
        assert np.array_equal(found.rows(np.arange(other.n_vertices)), first.rows(source))
    assert len(build(optimize=True, **shapes).meshes) == 2  # ground and box are one
    assert counted.calls == 1
    assert len(list(tmp_path.iterdir())) == 1


def test_a_damaged_file_is_replaced_with_a_warning(grey_scene, counted, tmp_path):
    first = cached(grey_scene, tmp_path)
    (path,) = tmp_path.iterdir()
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.warns(prt.PrtWarning, match="damaged"):
        second = cached(grey_scene, tmp_path)
    assert counted.calls == 2
    assert np.array_equal(first.rows([0, 100]), second.rows([0, 100]))
    with warnings.catch_warnings():
        warnings.simplefilter("error", prt.PrtWarning)
        cached(grey_scene, tmp_path)
    assert counted.calls == 2


def test_a_cache_that_cannot_be_written_costs_only_a_warning(grey_scene, counted, tmp_path):
    folder = tmp_path / "file"
    folder.write_text("not a folder")
    with pytest.warns(prt.PrtWarning):
        transport = cached(grey_scene, folder)
    assert transport.shape == (313, 24, 3)
    assert folder.read_text() == "not a folder"


def test_bad_settings_are_refused_before_anything_is_written(grey_scene, counted, tmp_path):
    with pytest.raises(prt.PrtError, match="basis"):
        cached(grey_scene, tmp_path, basis="sphere")
    assert counted.calls == 0
    assert list(tmp_path.iterdir()) == []


def test_the_default_folder_is_the_users(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.cache_folder() == tmp_path / "mi_sparse_prt"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache.cache_folder() == tmp_path / "home" / ".cache" / "mi_sparse_prt"
