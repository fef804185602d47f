"""Cost against size: the same surface at other sizes, each measured in a process of its own."""

import json

import numpy as np
import pytest

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.size_costs import (
    cost_against_size,
    edge_lengths,
    measure_in_own_process,
    size_figure,
)
from mi_sparse_prt.core.errors import PrtError

SCENE = """<scene version="3.0.0">
    <default name="height" value="0.6"/>
    <emitter type="constant"/>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform>
        <bsdf type="diffuse"/>
    </shape>
    <shape type="sphere" id="ball">
        <transform name="to_world"><scale value="0.5"/><translate y="$height"/></transform>
        <bsdf type="diffuse"/>
    </shape>
</scene>
"""


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("sizes") / "scene.xml"
    path.write_text(SCENE)
    return path


def test_edge_lengths_give_the_counts(scene_file):
    """Expected: a scene that is loaded with them has as many vertices, within half a doubling, and ever more."""
    counts = (500, 2000, 8000)
    edges = edge_lengths(scene_file, {}, counts)
    assert len(edges) == 3 and edges == sorted(edges, reverse=True)
    for edge, count in zip(edges, counts, strict=True):
        assert count / 1.5 <= prt.load_scene(scene_file, edge).n_vertices <= count * 1.5


def test_counts_below_the_files_own_are_its_own(scene_file):
    """Expected: the file as it is stands for all counts that are not above its own."""
    own = prt.load_scene(scene_file, float("inf")).n_vertices
    edges = edge_lengths(scene_file, {}, (own // 4, own // 2, own, 20 * own))
    assert edges[0] == float("inf") and len(edges) == 2 and edges[1] < 1


def test_one_size_in_a_process_of_its_own(scene_file):
    """
    Rationale: time and memory of a matrix are those of a process that does nothing else.
    Expected: the size that was asked for, with the scene's parameters; direct light alone costs less and has no error;
        its memory is not that of this process, which is made larger first.
    Result: as expected.
    """
    hoard = np.ones(1 << 27)  # 1 GB
    case = {"path": str(scene_file), "parameters": {"height": "0.8"}, "resolution": 4, "method": "gather"}
    found = measure_in_own_process(**case, edge_length=0.5)
    assert found["vertices"] == prt.load_scene(scene_file, 0.5, height="0.8").n_vertices
    assert (found["resolution"], found["directions"], found["edge_length"]) == (4, 96, 0.5)
    direct, whole = found["direct"], found["whole"]
    assert 0 < direct["seconds_without_held_out"] < whole["seconds_without_held_out"] < whole["seconds"]
    assert direct["estimated_error"] < 1e-5 < whole["estimated_error"] < 0.1
    assert 0 < direct["stored_bytes"] < whole["stored_bytes"]
    assert whole["plan"]["indirect"] == "gather"
    assert 5e7 < whole["peak_memory_bytes"] < hoard.nbytes


def test_what_a_process_refuses_is_said_here():
    with pytest.raises(PrtError, match=r"nowhere\.xml does not exist"):
        measure_in_own_process(
            path="nowhere.xml", parameters={}, edge_length=None, resolution=4, method="gather"
        )


def test_report_and_figure(scene_file, tmp_path):
    """Expected: both series in order, a size that is refused is a sentence, a figure with both panels, and JSON."""
    asked = []

    def made_up(**case):
        asked.append(case)
        if case["resolution"] == 64:
            raise PrtError("the matrix needs 9 GB")
        n = prt.load_scene(scene_file, case["edge_length"]).n_vertices
        cost = {"seconds": n * case["resolution"] ** 2 / 1e6, "peak_memory_bytes": 3e8 + 1e3 * n}
        return {"vertices": n, "resolution": case["resolution"], "direct": cost, "whole": cost}

    report = cost_against_size(
        scene_file, {"height": "0.7"}, False, tmp_path, counts=(500, 1000, 2000), measure=made_up
    )
    assert json.loads(json.dumps(report)) == report
    assert all(case["parameters"] == {"height": "0.7"} and case["method"] == "auto" for case in asked)
    assert np.diff([point["vertices"] for point in report["by_vertices"]]).min() > 0
    assert {point["resolution"] for point in report["by_vertices"]} == {32}
    assert [point["resolution"] for point in report["by_resolution"]] == [8, 16, 32]
    assert report["skipped"] == ["edge length None, n = 64: the matrix needs 9 GB"]
    figure = size_figure(report)
    assert [axes.get_xscale() for axes in figure.axes] == ["log"] * 4
    assert (tmp_path / "cost_against_size.png").stat().st_size > 10_000
