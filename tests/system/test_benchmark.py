"""The benchmark on a small scene: what it reports, and that kernels serve blocks of any offset and size."""

import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import problem_at
from typer.testing import CliRunner

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.direct_speed import BareOcclusion
from mi_sparse_prt.benchmark.kernels import launched_kernels
from mi_sparse_prt.benchmark.speed import MAX_DEPTH, SPP
from mi_sparse_prt.cli import app
from mi_sparse_prt.core.profiling import peak_memory, reset_peak_memory
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver

SCENE = """<scene version="3.0.0">
    <emitter type="constant"/>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.5, 0.7"/></bsdf>
    </shape>
    <shape type="cube" id="box">
        <transform name="to_world"><scale value="0.5"/><translate y="0.6"/></transform>
        <bsdf type="diffuse"/>
    </shape>
</scene>
"""
BLOCKS = ((0, 11), (11, 22), (22, 28))  # the last one is smaller


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("benchmark") / "scene.xml"
    path.write_text(SCENE)
    return path


@pytest.fixture(scope="module")
def scene(scene_file):
    return prt.load_scene(scene_file, float("inf"))


@pytest.fixture(scope="module")
def lighting():
    return prt.CubemapLighting(4)


def test_report_of_a_small_scene(scene_file, tmp_path):
    """
    Rationale: later runs are compared with this JSON, so its fields are a format.
    Expected: every part has its times, rates and kernels; the bare loop counts what the matrix holds.
    Result: as expected; 28 vertices x 96 directions.
    """
    report_file = tmp_path / "benchmark.json"
    reset_peak_memory()
    before = peak_memory()  # of what other tests of this process hold
    result = CliRunner().invoke(
        app,
        [
            "benchmark",
            str(scene_file),
            "--resolution",
            "4",
            "--edge-length",
            "inf",
            "--json",
            str(report_file),
        ],
    )
    assert result.exit_code == 0, result.output
    assert "ratio" in result.stdout and "Dr.Jit threads" in result.stdout
    report = json.loads(report_file.read_text())

    assert {"cpu", "cores", "drjit_threads", "memory_bytes", "load_average", "versions"} <= report[
        "machine"
    ].keys()
    assert {"mitsuba", "drjit", "variant"} <= report["machine"]["versions"].keys()
    assert report["scene"]["vertices"] == 28 and report["scene"]["directions"] == 96
    assert report["repeats"] == 3

    direct = report["direct"]
    assert direct["visible"] == direct["bare_visible"]
    assert 0 < direct["visible"] < direct["rays"] < 28 * 96
    assert len(direct["runs"]) == 3
    assert direct["ratio"] == pytest.approx(np.median([run["ratio"] for run in direct["runs"]]))
    assert direct["rays_per_second"] == pytest.approx(direct["rays"] / direct["seconds"])
    assert direct["matrix_bytes"] == 28 * 96 / 8
    assert 0 < direct["peak_memory_bytes"] < before + 1e9
    for part in (direct, report["paths"]["rows"], report["paths"]["scattered"]):
        kernels = part["kernels"]
        assert kernels["launches"] == kernels["in_memory"] + kernels["on_disk"] + kernels["compiled"] > 0
        assert part["first_run_seconds"] > 0
    assert report["paths"]["paths"] == 28 * 96 * SPP
    assert report["paths"]["rows"]["paths_per_second"] > 0
    assert report["paths"]["scattered"]["paths_per_second"] > 0
    assert report["relight"]["direct"]["seconds"] > 0
    assert report["relight"]["with_indirect"]["matrix_bytes"] > report["relight"]["direct"]["matrix_bytes"]


def test_one_kernel_serves_all_direct_blocks(scene, lighting):
    """
    Rationale: compiling costs as much as tracing millions of rays; an offset or a size that gets into the kernel's
        text compiles anew for every block.
    Expected: one kernel for three blocks of different offset and size.
    Result: as expected.
    """
    solver = DirectSolver(problem_at(scene, lighting))
    found = launched_kernels(lambda: [solver.rows(np.arange(*block, dtype=np.uint32)) for block in BLOCKS])
    assert found.launches == len(BLOCKS)
    assert found.distinct == 1


def test_a_baked_offset_would_be_found():
    """
    Rationale: the test above has to be able to fail.
    Expected: the same work with the offset as a Python number is as many kernels as blocks; with an opaque one, one.
    Result: as expected.
    """
    values = dr.arange(mi.Float, 100) + dr.opaque(mi.Float, 0)
    dr.eval(values)

    def block(offset, size):
        return dr.eval(dr.gather(mi.Float, values, dr.arange(mi.UInt32, size) + offset) * 2)

    baked = launched_kernels(lambda: [block(a, b - a) for a, b in BLOCKS])
    assert baked.distinct == len(BLOCKS) == baked.compiled + baked.on_disk
    assert launched_kernels(lambda: [block(dr.opaque(mi.UInt32, a), b - a) for a, b in BLOCKS]).distinct == 1


@pytest.mark.parametrize("channels", [1, 3])
def test_one_kernel_serves_all_path_blocks(scene, lighting, channels):
    """
    Rationale: as for direct light; and a wavefront of paths must be traced once, not once per channel.
    Expected: one kernel and one launch per block, for rows and for listed elements, whatever the offset and size.
    Result: as expected.
    """
    solver = PathSolver(problem_at(scene, lighting, max_depth=MAX_DEPTH), SPP)
    solver.channels = channels
    rng = np.random.default_rng(0)

    def work():
        for a, b in BLOCKS:
            solver.rows(np.arange(a, b, dtype=np.uint32))
        for n in (50, 31):
            solver.elements(rng.integers(28, size=n), rng.integers(96, size=n))

    found = launched_kernels(work)
    assert found.distinct == 1
    assert found.launches == len(BLOCKS) + 2


def test_the_bare_loop_traces_the_same_rays(scene, lighting):
    """
    Rationale: the ratio means something only if both sides trace the same rays.
    Expected: per block, the count of the bare loop is the number of bits of the matrix, and its rays are the
        elements above the horizon.
    Result: as expected.
    """
    points = vertex_points(scene)
    bare = BareOcclusion(scene.normalised, lighting, points)
    solver = DirectSolver(problem_at(scene, lighting, points))
    above = points.normals @ lighting.directions.T > 1e-6
    for a, b in BLOCKS:
        bits = solver.rows(np.arange(a, b, dtype=np.uint32))
        assert bare.count_visible(a, b) == np.bitwise_count(bits).sum()
        assert bare.count_rays(a, b) == above[a:b].sum()
