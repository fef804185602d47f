"""Small scenes that the tests of the core share, so that kernels are compiled once.

Pure helpers are imported (``from conftest import diffuse``), what is expensive comes as session fixtures.
"""

import gc
import importlib
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import zip_longest
from pathlib import Path

# ruff: noqa: E402
PINNED = "PYTEST_XDIST_WORKER" in os.environ and hasattr(os, "sched_setaffinity")
if PINNED:
    # A core for each worker, before libraries count cores and make as many threads, which would wait for each other.
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw")) % len(cores)]})
    THREADS = set(os.listdir("/proc/self/task"))

import matplotlib
import mitsuba as mi
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import mi_sparse_prt as prt
from mi_sparse_prt.estimation.element_sampling import Effort
from mi_sparse_prt.estimation.held_out import HeldOutError, held_out_error
from mi_sparse_prt.measurement.measurement import Measurement, MeshRange, mesh_vertices
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.operators.fractional_visibility import FractionalVisibility
from mi_sparse_prt.operators.haar_rows import HaarRows
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.reflection.brdf_factors import DirectionGrid, factor_cache
from mi_sparse_prt.reflection.brdf_factors.factor_cache import FactorOptions
from mi_sparse_prt.reflection.reflection import Diffuse
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.problem import Problem, diffuse_problem
from mi_sparse_prt.transport import LightTransport

if PINNED:
    # Dr.Jit's second thread, which Mitsuba needs to read files, asks for work all the time on the core of the first
    # one: both pinning and this take a fifth off the time of kernels.
    for thread in set(os.listdir("/proc/self/task")) - THREADS:
        os.setpriority(os.PRIO_PROCESS, int(thread), 19)
if "PYTEST_XDIST_WORKER" in os.environ:  # as many processes as cores
    threadpool_limits(1, user_api="blas")  # whose threads would wait for each other
matplotlib.use("Agg")
# coarser figures than users have: to draw them was a third of the time of some tests
importlib.import_module("mi_sparse_prt.validation.validate").DPI = 60
T = mi.ScalarTransform4f
ARTEFACTS = Path(__file__).parent / "artefacts"
GREY = ((0.5,) * 3, (0.6,) * 3, (0.7,) * 3)  # ground, ball, box
COLOURS = ((0.8, 0.5, 0.2), (0.1, 0.4, 0.8), (0.3, 0.9, 0.3))
FORMS = (
    "bits",
    "fixed point",
    "bits and coarse indirect",
    "fixed point and full indirect",
    "bits and factored light",
    "fixed point and factored grey light",
    "shares",
    "shares and factored light",
    "wavelets",
    "grey wavelets",
    "clusters",
    "grey clusters",
)


def diffuse(*rgb: float) -> dict:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}


PALE = diffuse(0.8, 0.8, 0.8)
GROUND = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": PALE}
BALL = {"type": "sphere", "center": [0.0, 0.4, 0.0], "radius": 0.4, "bsdf": PALE}  # stands on it


def mesh(name: str, vertices: np.ndarray, triangles: np.ndarray, bsdf: dict, smooth: bool = True) -> mi.Mesh:
    """A Mitsuba mesh of these vertices (n, 3) and triangles (m, 3), with normals that Mitsuba makes if ``smooth``."""
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    result = mi.Mesh(name, len(vertices), len(triangles), has_vertex_normals=smooth, props=properties)
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = mi.Float(np.asarray(vertices, np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.asarray(triangles, np.uint32).ravel())
    parameters.update()
    return result


def bumpy_ball(rings: int = 8, segments: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a closed ball of radius 0.4 to 0.6 that shadows itself; the poles are vertices."""
    theta, phi = np.meshgrid(
        np.pi * np.arange(1, rings) / rings, 2 * np.pi * np.arange(segments) / segments, indexing="ij"
    )
    radius = 0.5 + 0.1 * np.sin(3 * theta) * np.cos(4 * phi)
    ring_points = np.stack(
        [np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], axis=-1
    )  # [ring, segment, xyz]
    vertices = np.concatenate(
        [[[0, 0.5, 0]], (ring_points * radius[..., None]).reshape(-1, 3), [[0, -0.5, 0]]]
    )
    index = 1 + np.arange((rings - 1) * segments).reshape(rings - 1, segments)
    right = np.roll(index, -1, axis=1)
    last = np.full(segments, len(vertices) - 1)
    triangles = [
        np.stack([np.zeros(segments, int), right[0], index[0]], axis=-1),
        *(np.stack([a, b, c], -1).reshape(-1, 3) for a, b, c in _strips(index, right)),
        np.stack([last, index[-1], right[-1]], axis=-1),
    ]
    return vertices, np.concatenate(triangles)


def _strips(index: np.ndarray, right: np.ndarray) -> list:
    return [(index[:-1], right[:-1], index[1:]), (right[:-1], right[1:], index[1:])]


def still_life(albedos: tuple = GREY, place: mi.ScalarTransform4f | None = None) -> dict:
    """A bumpy ball and a turned box over an open ground; nothing touches, nothing is coplanar."""
    place = place or T()
    ground, ball, box = (diffuse(*rgb) for rgb in albedos)
    vertices, triangles = bumpy_ball()
    vertices = vertices + [-0.4, 0.7, 0]
    vertices = vertices @ np.array(place.matrix)[:3, :3].T + np.array(place.matrix)[:3, 3]
    return {
        "ground": {
            "type": "rectangle",
            "to_world": place @ T().rotate([1, 0, 0], -90).scale(1.5),
            "bsdf": ground,
        },
        "ball": mesh("ball", vertices, triangles, ball),
        "box": {
            "type": "cube",
            "to_world": place
            @ T().translate([0.65, 0.45, 0.2]).rotate([0, 1, 0], 30).rotate([1, 0, 0], 11).scale(0.3),
            "bsdf": box,
        },
    }


def build(edge_length: float = 0.5, optimize: bool = False, **shapes: object) -> Scene:
    return Scene.from_mitsuba(mi.load_dict({"type": "scene", **shapes}, optimize=optimize), edge_length)


def made_up(form: str, n: int = 4, n_vertices: int = 50) -> LightTransport:
    """A matrix of random factors in one of the forms that it is stored in; no scene is behind it."""
    rng = np.random.default_rng(7)
    lighting = prt.CubemapLighting(n)
    m = lighting.n_directions
    normals = rng.normal(size=(n_vertices, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    if form.startswith(("bits", "shares")):
        bits = rng.integers(0, 1 << 32, (n_vertices, -(-m // 32)), dtype=np.uint32)
        bits[:, -1] &= (1 << (m % 32)) - 1 if m % 32 else 0xFFFFFFFF
        direct = Visibility(bits, normals, lighting)
        if form.startswith("shares"):
            listed = rng.random((n_vertices, m)) < 0.1
            starts = np.concatenate([[0], np.cumsum(listed.sum(axis=1))])
            texels = np.nonzero(listed)[1].astype(np.uint16)
            shares = rng.integers(0, 256, len(texels), dtype=np.uint8)
            direct = FractionalVisibility(bits, starts, texels, shares, normals, lighting)
    else:
        direct = MeanCosine(rng.integers(0, 1 << 16, (n_vertices, m), dtype=np.uint16), lighting)
    if "wavelets" in form:
        channels = 1 if "grey" in form else 3
        kept = rng.random((n_vertices * channels, m)) < 0.2
        starts = np.concatenate([[0], np.cumsum(kept.sum(axis=1))])
        values = rng.normal(size=kept.sum()).astype(np.float16)
        scales = rng.random((n_vertices, channels), np.float32)
        direct = HaarRows(starts, np.nonzero(kept)[1].astype(np.uint16), values, scales, lighting)
    if "clusters" in form:
        channels = 1 if "grey" in form else 3
        direct = Clustered(
            rng.integers(0, 4, n_vertices).astype(np.uint16),
            rng.normal(size=(n_vertices, channels, 3)).astype(np.float16),
            rng.normal(size=(4, m)).astype(np.float16),
            rng.normal(size=(4, 3, m)).astype(np.float16),
            lighting,
        )
    indirect = None
    if "indirect" in form:
        coarse = lighting if "full" in form else prt.CubemapLighting(n // 2)
        channels = 1 if "full" in form else 3
        density = rng.random((n_vertices, coarse.n_directions, channels)).astype(np.float16)
        indirect = Upsampled(density, lighting.upsampling(coarse), lighting)
    if "factored" in form:
        ranks = (3,) if "grey" in form else (2, 3, 5)
        sides = [[rng.random(shape, np.float32) for shape in ((n_vertices, r), (r, m))] for r in ranks]
        indirect = LowRank(tuple(a for a, _ in sides), tuple(b for _, b in sides))
    compressed = isinstance(direct, HaarRows | Clustered)
    operators = {"compressed" if compressed else "direct": direct} | (
        {"indirect": indirect} if indirect else {}
    )
    albedo, areas = rng.random((n_vertices, 3), dtype=np.float32), rng.random(n_vertices, dtype=np.float32)
    keys = rng.integers(0, 1 << 63, n_vertices, dtype=np.uint64)
    return LightTransport(
        emission=lighting,
        basis="direction" if form.startswith("bits") else "texel",
        max_depth=5,
        measurement=Measurement(
            keys, areas, (MeshRange("a", slice(0, 20)), MeshRange("b", slice(20, n_vertices)))
        ),
        reflection=Diffuse(albedo),
        operators=operators,
        scene_hash="made up",
        report={"parameters": {"max_depth": 5}},
    )


def altered(transport: LightTransport, **changes: object) -> LightTransport:
    """A matrix with other operators (None: without), points or reflectances, by short names."""
    operators = dict(transport.operators)
    for name in ("direct", "indirect"):
        if name in changes:
            operators[name] = changes.pop(name)
    measured = {"areas": "areas", "vertex_keys": "keys", "meshes": "groups"}
    measurement = {new: changes.pop(old) for old, new in measured.items() if old in changes}
    if "albedo" in changes:
        changes["reflection"] = Diffuse(changes.pop("albedo"))
    if "lighting" in changes:
        changes["emission"] = changes.pop("lighting")
    return replace(
        transport,
        operators={name: operator for name, operator in operators.items() if operator is not None},
        measurement=replace(transport.measurement, **measurement),
        **changes,
    )


def problem_of(scene: Scene, transport: LightTransport, max_depth: int) -> Problem:
    """What a matrix of a scene's vertices was to be."""
    return Problem(
        scene,
        transport.emission,
        mesh_vertices(scene),
        transport.reflection,
        transport.basis,
        max_depth,
    )


def problem_at(
    scene: Scene,
    lighting: prt.CubemapLighting,
    points: Points | None = None,
    basis: str = "direction",
    max_depth: int = 5,
) -> Problem:
    """Of a scene that is taken for diffuse: at its vertices, or at other points."""
    problem = replace(diffuse_problem(scene, lighting, max_depth), basis=basis)
    return problem if points is None else problem.at(points)


PIPELINE = importlib.import_module("mi_sparse_prt.precompute")  # the package's own is the function


def few_held_out(monkeypatch: pytest.MonkeyPatch, **effort: int) -> None:
    """Precomputations find their error with another effort than all tests do."""
    monkeypatch.setattr(PIPELINE, "held_out_error", partial(held_out_error, effort=Effort(**effort)))


@pytest.fixture
def usual_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """As users have it: half of the time of all tests together would go into it."""
    few_held_out(monkeypatch)


PIPELINE.held_out_error = partial(held_out_error, effort=Effort(spp=64, specular_strata=4))


def _unknown_error(*_: object, **__: object) -> HeldOutError:
    return HeldOutError(math.nan, {}, {"total": math.nan, "meshes": {}}, 0, {}, [])


@contextmanager
def without_held_out() -> Iterator[None]:
    """Precomputations do not find their error, which is NaN: where nobody looks at it, nor aims at one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PIPELINE, "held_out_error", _unknown_error)
        patch.setattr(PIPELINE, "held_out_lamp_error", _unknown_error)
        yield


@pytest.fixture
def no_held_out() -> Iterator[None]:
    """``without_held_out``, for one test."""
    with without_held_out():
        yield


@pytest.fixture(scope="module")
def never_held_out() -> Iterator[None]:
    """``without_held_out``, for a file."""
    with without_held_out():
        yield


@pytest.fixture
def usual_factors(monkeypatch: pytest.MonkeyPatch) -> None:
    """BRDF factors at as many directions as users have: 16 times the work, of some seconds for each BSDF."""
    monkeypatch.setattr(factor_cache, "FactorOptions", FactorOptions)


factor_cache.FactorOptions = partial(FactorOptions, grid=DirectionGrid(32, 64), pairs=1 << 15)


def assert_same(a: LightTransport, b: LightTransport) -> None:
    """Bit by bit: what files have of them, factors and attributes."""
    (attributes, ours), (others, theirs) = a.stored(), b.stored()
    assert attributes == others
    assert ours.keys() == theirs.keys()
    for name, array in ours.items():
        assert (array.dtype, array.shape) == (theirs[name].dtype, theirs[name].shape), name
        assert array.tobytes() == theirs[name].tobytes(), name


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files of systems and of units in turn, those with most tests first: the order of ``--no-loadscope-reorder``.

    What takes long is begun early, and short files of units are left for the end, so that no worker waits for long.
    Files that compile the same functions (of units beside each other: operators, matrices) do not begin together: both
    workers would compile them, where the second one finds them in the cache a little later.
    """
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    by_size = sorted(files, key=lambda path: (-len(files[path]), path))
    units = [path for path in by_size if path.parent.name == "unit"]
    systems = [path for path in by_size if path.parent.name != "unit"]
    in_turn = [path for pair in zip_longest(systems, units) for path in pair if path is not None]
    items[:] = [item for path in in_turn for item in files[path]]


def pytest_collection_finish() -> None:
    """What is there to stay, modules and tests, is not looked at each time that something is collected: 0.4 s each."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def no_garbage() -> Iterator[None]:
    """Scenes that nobody has are given back: kernels have a branch for every kind of BSDF that is alive."""
    yield
    gc.collect()


@pytest.fixture(scope="session")
def grey_scene() -> Scene:
    return build(**still_life())


@pytest.fixture(scope="session")
def coloured_scene() -> Scene:
    return build(**still_life(COLOURS))


@pytest.fixture(scope="session")
def small_lighting() -> prt.CubemapLighting:
    return prt.CubemapLighting(4)


@pytest.fixture
def artefact(request: pytest.FixtureRequest):
    """Save a matplotlib figure under the test's name in tests/artefacts (ignored by git)."""

    def save(figure: object, suffix: str = "") -> None:
        ARTEFACTS.mkdir(exist_ok=True)
        name = "".join(c if c.isalnum() else "_" for c in request.node.name).strip("_")
        figure.savefig(ARTEFACTS / f"{name}{suffix}.png", dpi=60, bbox_inches="tight")

    return save
