"""The error that a matrix reports of itself, against its true error."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy.sparse
from conftest import FORMS, T, altered, build, bumpy_ball, diffuse, made_up, still_life
from conftest import mesh as mesh_of

import mi_sparse_prt as prt
from mi_sparse_prt.estimation import element_sampling, held_out
from mi_sparse_prt.estimation.element_sampling import Effort, for_direct_light, for_indirect_light
from mi_sparse_prt.estimation.held_out import Sample, estimate_errors, relative
from mi_sparse_prt.measurement.measurement import mesh_vertices
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.reflection.reflection import Diffuse
from mi_sparse_prt.solvers.direct_rays import BITS
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.transport import LightTransport

LIGHTING = prt.CubemapLighting(4)
SEEDS = range(6)


def held_out_error(
    scene: prt.Scene,
    transport: LightTransport,
    max_depth: int,
    seed: int,
    target: float | None = None,
    effort: Effort = Effort(),  # noqa: B008  frozen
    certain: bool = False,
) -> dict:
    """Of a matrix of diffuse vertices."""
    points, surfaces = mesh_vertices(scene), Diffuse(scene.albedo)
    problem = Problem(scene, transport.emission, points, surfaces, transport.basis, max_depth)
    return held_out.held_out_error(problem, transport, seed, target, effort, certain=certain).report()


def row_sample(weights: np.ndarray, squares: np.ndarray, norms: np.ndarray) -> Sample:
    """Of one quantity."""
    n = len(weights)
    return Sample(weights, np.asarray(squares)[:, None], np.asarray(norms)[:, None], np.zeros(n), np.ones(n))


@cache
def converged(scene: prt.Scene, basis: str) -> list[np.ndarray]:
    """The whole matrix twice, independently, at 64 samples per element."""
    return [
        prt.precompute(
            scene,
            LIGHTING,
            method="brute_force",
            basis=basis,
            spp=64,
            strata=6,
            seed=1000 + k,
            progress=False,
        )
        .rows(np.arange(scene.n_vertices))
        .astype(np.float64)
        for k in (0, 1)
    ]


def true_error(ours: np.ndarray, truth: list[np.ndarray], rows: slice = slice(None)) -> float:
    """Relative L2 with the truth's noise taken out."""
    x, y = (t[rows] for t in truth)
    return float(np.sqrt(((ours[rows] - x) * (ours[rows] - y)).sum() / (x * y).sum()))


def errors_of(scene: prt.Scene, transport: LightTransport, truth: list[np.ndarray]) -> dict[str, float]:
    """True errors, in total and per mesh."""
    ours = transport.rows(np.arange(scene.n_vertices)).astype(np.float64)
    return {"total": true_error(ours, truth)} | {
        m.name: true_error(ours, truth, m.vertices) for m in scene.meshes
    }


def estimates(report: dict) -> tuple[dict[str, float], dict[str, float]]:
    """Estimates and their standard errors, in total and per mesh."""
    errors = report["standard_error"]
    return {"total": report["total"], **report["meshes"]}, {"total": errors["total"], **errors["meshes"]}


@pytest.fixture(scope="module")
def exact() -> tuple[prt.Scene, LightTransport]:
    """Direct light of a tiny scene at 1536 directions, by brute force."""
    scene = build(**still_life())
    transport = prt.precompute(
        scene, prt.CubemapLighting(16), method="brute_force", max_depth=2, progress=False
    )
    return scene, transport


def with_bits(transport: LightTransport, bits: np.ndarray) -> LightTransport:
    return altered(transport, direct=replace(transport.direct, bits=bits))


def flipped(transport: LightTransport, one_of: int, seed: int) -> LightTransport:
    """One of so many visible bits wrong."""
    bits = transport.direct.bits.copy()
    seen = np.argwhere(np.unpackbits(bits.view(np.uint8), axis=1, bitorder="little"))
    rng = np.random.default_rng(seed)
    wrong = seen[rng.choice(len(seen), len(seen) // one_of, replace=False)]
    np.bitwise_xor.at(
        bits, (wrong[:, 0], wrong[:, 1] // BITS), np.uint32(1) << (wrong[:, 1] % BITS).astype(np.uint32)
    )
    return with_bits(transport, bits)


# ------------------------------------------------------------------------------------ reports


@pytest.mark.slow  # of few elements: test_intervals_from_few_elements
@pytest.mark.parametrize(
    ("basis", "coarse"),
    [("direction", None), ("texel", 2)],
    ids=["direction", "texel, coarse indirect"],
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
            grey_scene,
            LIGHTING,
            method="brute_force",
            basis=basis,
            spp=8,
            seed=seed,
            indirect_resolution=coarse,
            progress=False,
        )
        true = errors_of(grey_scene, transport, truth)
        found, errors = estimates(transport.report["estimated_error"])
        deviations += [(found[k] - true[k]) / errors[k] for k in true]
        widths.append(errors["total"] / true["total"])
        ratios.append(found["total"] / true["total"])
    deviations = np.abs(deviations)
    assert (deviations < 2).sum() >= 20
    assert deviations.max() < 5
    assert max(widths) < 0.25
    assert 0.9 < np.mean(ratios) < 1.1  # no bias of its own


def test_indirect_light_that_is_left_out(grey_scene):
    """Rationale: a plan may leave interreflections out. Its matrix lacks them, and must say so; it said 0 before."""
    transport = prt.precompute(grey_scene, LIGHTING, method=Plan("exact"), seed=2, progress=False)
    assert "indirect" not in transport.operators
    true = errors_of(grey_scene, transport, converged(grey_scene, "direction"))
    assert true["total"] > 0.1
    assert transport.report["estimated_error"]["total"] == pytest.approx(true["total"], rel=0.25)
    runs = [estimates(held_out_error(grey_scene, transport, 5, seed)) for seed in SEEDS]
    for name, error in true.items():
        found = np.mean([run[0][name] for run in runs])
        spread = np.sqrt(np.mean([run[1][name] ** 2 for run in runs]) / len(runs))
        assert abs(found - error) < 4 * spread < 0.2 * error


def test_an_error_put_in_is_found(exact):
    """Known damage to an exact matrix: a dark mesh, swapped rows."""
    scene, transport = exact
    report = held_out_error(scene, transport, 2, seed=0)
    assert report["total"] < 1e-6
    assert 0 < report["standard_error"]["total"] < 0.02

    bits = transport.direct.bits.copy()
    bits[scene.meshes[1].vertices] = 0
    dark = with_bits(transport, bits)
    truth = [transport.rows(np.arange(scene.n_vertices)).astype(np.float64)] * 2
    report = held_out_error(scene, dark, 2, seed=0)
    assert report["meshes"]["ball"] == pytest.approx(1)
    assert report["meshes"]["ground"] < 1e-6
    true = errors_of(scene, dark, truth)["total"]
    assert abs(report["total"] - true) < 3 * report["standard_error"]["total"]

    swapped = with_bits(
        transport, transport.direct.bits[np.random.default_rng(0).permutation(scene.n_vertices)]
    )
    report, true = held_out_error(scene, swapped, 2, seed=0), errors_of(scene, swapped, truth)["total"]
    assert abs(report["total"] - true) < 3 * report["standard_error"]["total"]


def test_rays_that_judge_themselves(exact):
    """A sixteenth of the elements; no doubt is left where none is wrong, and a mistake of ours is seen all the same."""
    scene, transport = exact
    whole, few = (held_out_error(scene, transport, 2, 0, certain=sure) for sure in (False, True))
    assert 10 * few["elements"] < whole["elements"]
    assert max(few["total"], whole["total"]) < 1e-6
    assert few["standard_error"]["total"] < 1e-6 < 1e-4 < whole["standard_error"]["total"]
    wrong = held_out_error(scene, flipped(transport, 50, 1), 2, 0, certain=True)
    known = held_out_error(scene, flipped(transport, 50, 1), 2, 0)
    assert wrong["total"] > 0.05
    assert abs(wrong["total"] - known["total"]) < 3 * wrong["standard_error"]["total"]


def test_few_of_the_rays_that_judge_themselves_tell_as_much(exact):
    """Expected: squared norms and errors of a sixteenth of the elements are those of all, on average; 2% would show."""
    scene, right = exact
    wrong = flipped(right, 5, 1)
    rows = [matrix.rows(np.arange(scene.n_vertices)).astype(np.float64) for matrix in (right, wrong)]
    truth = np.array([np.square(rows[0] - rows[1]).sum(), np.square(rows[0]).sum()])
    problem = Problem(scene, right.emission, mesh_vertices(scene), Diffuse(scene.albedo), "direction", 2)
    shares, stream = np.zeros(scene.n_vertices), np.random.SeedSequence(3)
    estimator = held_out._Estimator(problem, wrong, Effort(certain=True), stream, False, shares)
    found = []
    for seed in range(200):
        every = estimator.samples(np.random.default_rng(seed), 1.0).values()
        sums = [(s.weights @ s.squares[:, 0], s.weights @ s.norms[:, 0]) for s in every]
        found.append(np.sum(sums, axis=0) / truth)
    mean, spread = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(len(found))
    print(mean, spread)
    assert (spread < 0.005).all()
    assert (abs(mean - 1) < 4 * spread).all()


@pytest.mark.parametrize(("noise", "finer"), [(0.1, False), (20.0, True)])
def test_where_noise_hides_the_error_there_are_more_paths(grey_scene, monkeypatch, noise, finer):
    """Expected: four times the paths where their noise hides the error, and no more elsewhere."""
    transport = prt.precompute(grey_scene, LIGHTING, Plan("exact", "gather", 64, 0.06), progress=False)
    asked, elements = [], PathSolver.elements

    def noisy(self, *where):
        asked.append(self.spp)
        found = elements(self, *where)
        spread = noise * found.mean.mean() / np.sqrt(self.spp)
        wrong = spread * np.random.default_rng(len(asked)).standard_normal(found.mean.shape)
        return replace(found, mean=found.mean + wrong.astype(np.float32), variance=found.variance + spread**2)

    monkeypatch.setattr(PathSolver, "elements", noisy)
    report = held_out_error(grey_scene, transport, 5, 0, effort=Effort(spp=128))
    assert asked == ([128, 512] if finer else [128])
    print(report["total"], report["standard_error"]["total"])


def test_a_seed_is_a_choice(exact):
    """The same seed gives the same report, another one another."""
    scene, transport = exact
    transport = flipped(transport, 100, seed=0)
    first, again, other = (held_out_error(scene, transport, 2, seed) for seed in (0, 0, 1))
    assert first == again
    assert first["total"] != other["total"]
    assert first["elements"] <= scene.n_vertices * 1536 / 2


# ------------------------------------------------------------------------------------ few elements


FEW = Effort(fewest_rays=1500, paths=150, few_paths=150, spp=128)  # for a mesh
SOME = Effort(fewest_rays=16_000)


@pytest.mark.parametrize("where", [pytest.param("anywhere", marks=pytest.mark.slow), "one vertex"])
def test_rare_wrong_bits(exact, where):
    """1 of 2000 visible bits is wrong; or all of one vertex in each mesh. A tenth of the elements is looked at.

    Rationale: errors of visibility are few and large, and a handful of vertices can hold most of them.

    Expected: over 40 seeds the squared error is right within 3 standard errors of its mean, and that standard error
    is small enough to see a bias of 2% of the error; at least 85% of the intervals of +-2 reported standard errors
    hold the truth, and the reported ones are as large as the spread of the estimates (40 say that within a third).
    """
    scene, transport = exact
    truth = [transport.rows(np.arange(scene.n_vertices)).astype(np.float64)] * 2
    if where == "anywhere":
        wrong = flipped(transport, 2000, seed=1)
    else:
        bits = transport.direct.bits.copy()
        bits[[m.vertices.start + 7 for m in scene.meshes]] = 0
        wrong = with_bits(transport, bits)
    true = errors_of(scene, wrong, truth)["total"]
    reports = [held_out_error(scene, wrong, 2, seed, effort=SOME) for seed in range(40)]
    found = np.array([r["total"] for r in reports])
    errors = np.array([r["standard_error"]["total"] for r in reports])
    spread = (found**2).std(ddof=1) / np.sqrt(len(found))
    assert abs((found**2).mean() - true**2) < 3 * spread
    assert spread < 0.04 * true**2
    assert (np.abs(found - true) < 2 * errors).mean() >= 0.85
    assert 0.67 < np.sqrt((errors**2).mean()) / found.std() < 1.5


@pytest.mark.slow
def test_a_target_far_off_takes_a_quarter(exact):
    """
    Expected: a quarter of the elements where the target is far off; estimates without bias (3 standard errors, that
        would show 2% of the error), twice as far from the truth on average, and reported so. Where the error is the
        target, nearly all of them, and as good an estimate as without a target.
    """
    scene, transport = exact
    truth = [transport.rows(np.arange(scene.n_vertices)).astype(np.float64)] * 2
    wrong = flipped(transport, 4000, seed=1)
    true = errors_of(scene, wrong, truth)["total"]
    usual, less, near = (
        [held_out_error(scene, wrong, 2, seed, target, SOME) for seed in range(count)]
        for target, count in ((None, 40), (100 * true, 160), (true, 40))
    )
    elements = [np.mean([r["elements"] for r in reports]) for reports in (usual, less, near)]
    assert 0.24 < elements[1] / elements[0] < 0.26
    assert 0.75 < elements[2] / elements[0] < 1.01
    squares, all_squares = (np.array([r["total"] for r in reports]) ** 2 for reports in (less, usual))
    spread = squares.std(ddof=1) / np.sqrt(len(squares))
    assert abs(squares.mean() - true**2) < 3 * spread
    assert spread < 0.04 * true**2
    assert 1.5 < squares.std() / all_squares.std() < 2.7
    reported = [np.median([r["standard_error"]["total"] for r in reports]) for reports in (usual, less, near)]
    assert 1.5 < reported[1] / reported[0] < 2.7
    assert 0.8 < reported[2] / reported[0] < 1.4


@pytest.mark.parametrize(
    ("method", "basis"),
    [
        pytest.param("brute_force", "direction", marks=pytest.mark.slow),
        pytest.param("brute_force", "texel", marks=pytest.mark.slow),
        ("sparse", "direction"),
        pytest.param("huang2010", "direction", marks=pytest.mark.slow),
    ],
)
def test_intervals_from_few_elements(grey_scene, method, basis):
    """150 elements of each mesh by paths, at most 1500 by rays, 80 times.

    Expected: intervals of 2 standard errors hold the true error (against a converged matrix) in at least 85% of the
    cases, in total and over the meshes; those of half a standard error do not. The mean of the squared error is
    right within 3 standard errors (and 2% for the truth's own).
    """
    transport = prt.precompute(
        grey_scene, LIGHTING, method=method, basis=basis, spp=4, seed=5, progress=False
    )
    truth = converged(grey_scene, basis)
    true = errors_of(grey_scene, transport, truth)
    reports = [
        estimates(held_out_error(grey_scene, transport, 5, seed, effort=FEW)) for seed in range(100, 180)
    ]
    found, errors = (np.array([[part[i][k] for k in true] for part in reports]) for i in (0, 1))
    expected = np.array(list(true.values()))  # total and meshes
    inside = np.abs(found - expected) / errors  # [seed, total and meshes]
    squares = found[:, 0] ** 2
    assert (inside[:, 0] < 2).mean() >= 0.85
    assert (inside[:, 1:] < 2).mean() >= 0.85
    assert (inside < 0.5).mean() < 0.85
    error = squares.std(ddof=1) / np.sqrt(len(squares))
    assert abs(squares.mean() - expected[0] ** 2) < 3 * error + 0.02 * expected[0] ** 2


# ------------------------------------------------------------------------------------ the ratio and its spread


def test_errors_in_proportion_need_no_interval():
    """10% too bright everywhere: the ratio is 0.1 whichever elements are looked at, however different they are."""
    rng = np.random.default_rng(0)
    norms, weights = rng.exponential(size=100), 1 + rng.random(100)
    samples = [
        row_sample(weights[part], 0.01 * norms[part], norms[part]) for part in np.split(np.arange(100), [60])
    ]
    found, error = relative(samples)
    assert found == pytest.approx(0.1)
    assert error < 1e-8


def test_the_spread_is_that_of_many_draws():
    """400 draws of about 400 of 4000 elements, each with its own probability: reported against real spread.

    The worst element, counted once more, adds a few percent to the reported one.
    """
    rng = np.random.default_rng(1)
    norms = rng.gamma(2, size=4000)
    squares = 0.04 * norms * rng.gamma(2, 0.5, size=4000)
    chances = 0.02 + 0.08 * norms / norms.mean()
    draws = []
    for _ in range(400):
        drawn = rng.random(4000) < chances
        draws.append(relative([row_sample(1 / chances[drawn], squares[drawn], norms[drawn])]))
    found, errors = np.transpose(draws)
    true = np.sqrt(squares.sum() / norms.sum())
    assert found.mean() == pytest.approx(true, rel=0.01)
    # sqrt(1 - 0.1) of it: a tenth of all elements is known
    assert 1 < errors.mean() / found.std() < 1.25


def test_parts_with_elements_of_their_own():
    """Two sums over the same matrix, of elements drawn apart, are added: 0.03 + 0.01 over 1."""
    direct = row_sample(np.full(50, 2.0), np.full(50, 0.03), np.full(50, 0.9))
    indirect = row_sample(np.full(10, 10.0), np.full(10, 0.01), np.full(10, 0.1))
    assert relative([direct, indirect])[0] == pytest.approx(0.2)
    parts = estimate_errors({("a", "direct"): direct, ("a", "indirect"): indirect}).parts
    assert parts == pytest.approx({"direct": 0.03**0.5, "indirect": 0.1})


def test_noise_of_one_part_hides_no_other():
    """
    Expected: -0.02 of direct and indirect light, which is noise, takes nothing from 0.01 of light by way of mirrors;
        but a negative product of errors of the first two counts.
    """
    direct = row_sample(np.full(50, 2.0), np.full(50, 0.03), np.full(50, 0.8))
    indirect = row_sample(np.full(10, 10.0), np.full(10, -0.05), np.full(10, 0.1))
    specular = row_sample(np.full(10, 10.0), np.full(10, 0.01), np.full(10, 0.1))
    samples = {("a", "direct"): direct, ("a", "indirect"): indirect, ("a", "specular"): specular}
    found = estimate_errors(samples)
    assert found.total == pytest.approx(0.1)
    assert found.meshes["a"] == pytest.approx(0.1)
    less = {**samples, ("a", "indirect"): row_sample(np.full(10, 10.0), np.full(10, -0.01), np.full(10, 0.1))}
    assert estimate_errors(less).total == pytest.approx(np.sqrt(0.03 - 0.01 + 0.01))


@pytest.mark.parametrize("n", [80, 8192])
def test_where_nothing_is_wrong_one_element_may_be(n):
    """Of n equal elements one, had it been wrong, would be a relative error of sqrt(1 / n). Dark ones do not count."""
    norms = np.zeros(n)
    norms[: n // 2] = 3.0
    found, error = relative([row_sample(np.full(n, 7.0), np.zeros(n), norms)])
    assert found == 0
    assert error == pytest.approx(np.sqrt(2 / n))


def test_a_black_mesh_has_no_error():
    black, ones = np.zeros(5), np.ones(5)
    assert relative([row_sample(ones, black, black)]) == (0.0, 0.0)
    assert relative([row_sample(ones, ones, black)]) == (1.0, 0.0)


def test_a_black_mesh_among_others():
    """The ball is black: it has no error, and adds none to the total."""
    dark = build(**still_life(((0.5,) * 3, (0.0,) * 3, (0.7,) * 3)))
    transport = prt.precompute(dark, LIGHTING, method="brute_force", spp=4, progress=False)
    reported = transport.report["estimated_error"]
    assert reported["meshes"]["ball"] == reported["standard_error"]["meshes"]["ball"] == 0
    assert 0 < reported["total"] < 1


@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_meshes_of_three_vertices(basis):
    """Two triangles, one over the other, at 24 directions: fewer elements than are asked for."""
    corners, one = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0]]), np.array([[0, 1, 2]])
    grey = diffuse(0.5, 0.5, 0.5)
    scene = build(
        10.0,
        low=mesh_of("low", corners, one, grey),
        high=mesh_of("high", corners + [0.1, 0.4, 0.1], one[:, ::-1], grey),
    )
    transport = prt.precompute(
        scene, prt.CubemapLighting(2), method="brute_force", basis=basis, spp=4, progress=False
    )
    reported = transport.report["estimated_error"]
    assert np.isfinite([*estimates(reported)[0].values(), *estimates(reported)[1].values()]).all()
    assert 0 < reported["elements"] <= 2 * 6 * 24  # for direct and for indirect light


# ------------------------------------------------------------------------------------ the choice of elements


def test_weighted_sums_are_those_of_all_elements(exact):
    """Sums of an arbitrary function over what is drawn, against its sum over a mesh: above the horizon, everywhere.

    Expected: the mean of 50 draws within 3.5 standard errors, which are below 0.5%.
    """
    scene, transport = exact
    lighting = transport.lighting
    transport = altered(flipped(transport, 50, seed=3), indirect=made_of_light(scene, lighting))
    inside = scene.meshes[1].vertices
    values = np.random.default_rng(4).random((scene.n_vertices, lighting.n_directions)) + 0.5
    above = scene.normals @ lighting.directions.T > 0
    direct = [
        for_direct_light(transport, scene.normals, inside, np.random.default_rng(k), Effort())
        for k in range(50)
    ]
    indirect = [for_indirect_light(transport, inside, np.random.default_rng(k), Effort()) for k in range(50)]
    for drawn, all_values in ((direct, values * above), (indirect, values)):
        sums = np.array([(c.weights * all_values[c.vertices, c.texels]).sum() for c in drawn])
        error = sums.std(ddof=1) / np.sqrt(len(sums))
        assert error < 0.005 * all_values[inside].sum()
        assert abs(sums.mean() - all_values[inside].sum()) < 3.5 * error
        assert all(((c.vertices >= inside.start) & (c.vertices < inside.stop)).all() for c in drawn)


def made_of_light(scene: prt.Scene, lighting: prt.CubemapLighting) -> Upsampled:
    """Indirect light of random size at each element."""
    density = np.random.default_rng(5).exponential(size=(scene.n_vertices, lighting.n_directions, 1))
    return Upsampled(density.astype(np.float16), lighting.upsampling(lighting), lighting)


def test_every_vertex_is_looked_at_and_all_edges(exact):
    """Bits that differ from one of the 24 around them are all kept, of the others every fifth, whatever vertex it is.

    Edges are found one element at a time, by their angle.
    """
    scene, transport = exact
    directions = transport.lighting.directions
    found = for_direct_light(
        transport, scene.normals, slice(0, scene.n_vertices), np.random.default_rng(0), Effort()
    )
    assert set(found.vertices) == set(range(scene.n_vertices))
    bits = np.unpackbits(transport.direct.bits.view(np.uint8), axis=1, bitorder="little")
    factors = {}
    base = element_sampling.FAR_FROM_EDGES
    for i, j, weight in list(zip(found.vertices, found.texels, found.weights, strict=True))[::300]:
        around = np.argsort(-(directions @ directions[j]), kind="stable")[: element_sampling.AROUND + 1]
        around = around[scene.normals[i] @ directions[around].T > 0]
        edge = len(set(bits[i, around])) > 1
        chance = transport.lighting.solid_angles[j] * (scene.normals[i] @ directions[j])
        factors.setdefault(edge, []).append(weight * chance * (1 if edge else base))
    assert len(factors[True]) > 5 and len(factors[False]) > 5
    every = np.concatenate(list(factors.values()))
    assert np.median(np.abs(every / np.median(every) - 1)) < 1e-4
    assert (np.abs(every / np.median(every) - 1) < 1e-3).mean() > 0.95  # ties among the 24 nearest


# ------------------------------------------------------------------------------------ single elements


@pytest.mark.parametrize("form", FORMS)
def test_elements_are_those_of_rows(form):
    """Of every form in which a part is stored, and of rows interpolated between them."""
    transport = made_up(form)
    rng = np.random.default_rng(0)
    n, n_directions = transport.shape[:2]
    ids, texels = rng.integers(n, size=300), rng.integers(n_directions, size=300)
    parts = list(transport.operators.values())
    weights = scipy.sparse.random_array((n, n), density=0.1, format="csr", rng=rng, dtype=np.float32)
    parts += [Interpolated(part, weights) for part in parts if not isinstance(part, MeanCosine)]
    for part in parts:
        rows = part.rows(ids)[np.arange(300), texels]
        assert np.allclose(part.elements(ids, texels), rows, rtol=1e-5, atol=1e-7 * np.abs(rows).max())
        assert part.elements(ids[:0], texels[:0]).shape == (0, rows.shape[1])


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


@pytest.mark.parametrize("where", ["still life", pytest.param("corner", marks=pytest.mark.slow)])
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
