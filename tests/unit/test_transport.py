"""The result as a whole: its transpose, its operator for SciPy, glossy rows as means over views, files, signatures."""

import inspect
import sys
import zipfile
from collections.abc import Callable

import numpy as np
import pytest
import scipy.linalg
from conftest import FORMS, assert_same, made_up
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, aslinearoperator, lsmr

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.measurement import Measurement, MeshRange
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.precompute import GlossyOptions
from mi_sparse_prt.reflection.brdf_factors import BrdfFactors, DirectionGrid
from mi_sparse_prt.reflection.factor_tables import incident_tables
from mi_sparse_prt.reflection.frames import frames, orthogonalise
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Diffuse
from mi_sparse_prt.transport import LightTransport

N_V, N, TERMS = 40, 4, 3
M = 6 * N * N
GRID = DirectionGrid(24, 48)
GLOSSY = ("glossy", "glossy in texels", "glossy, indirect by paths", "grey glossy", "glossy clusters")
ALL = (*FORMS, *GLOSSY)


def kinds_of(transport: LightTransport) -> dict[str, str]:
    """Of its reflection and of its operators, nested ones too."""
    attributes = transport.stored()[0]
    return {"reflection": attributes["reflection"]["kind"], **attributes["operators"]}


def factors(seed: int, channels: int, terms: int = TERMS) -> BrdfFactors:
    """Smooth ones of either sign."""
    rng, (x, y, z) = np.random.default_rng(seed), GRID.directions.T
    waves = [np.cos(k * x + y) * z + rng.normal() * x * y for k in range(terms)]
    lobes = [[0.3 + np.cos((k + c) * y - x) * z for c in range(channels)] for k in range(terms)]
    diffuse = np.full(channels, 0.4)
    return BrdfFactors(GRID, diffuse, np.array(waves, np.float32), np.array(lobes, np.float32))


def made_up_glossy(form: str) -> LightTransport:
    """Three meshes: of a BRDF, diffuse, of another BRDF with fewer terms; all factors are random."""
    rng = np.random.default_rng(3)
    plain = made_up("shares" if "texels" in form else "bits", N, N_V)
    normals, channels = plain.direct.normals, 1 if "grey" in form else 3
    material = np.repeat([0, -1, 1], [15, 10, 15])
    surfaces = InOutFactors(
        np.repeat(plain.albedo[:, :1], 3, axis=1) if "grey" in form else plain.albedo,
        orthogonalise(rng.normal(size=(N_V, 3)).astype(np.float32), normals),
        normals,
        material,
        (factors(0, channels), factors(1, channels, TERMS - 1)),
    )
    direct = FactoredVisibility(
        plain.direct, surfaces.tangents, material, incident_tables(surfaces.factors, 16)
    )
    rows, indirect = surfaces.row_count, None
    if "paths" in form:
        density = rng.normal(size=(rows, M, 3)).astype(np.float16)
        indirect = Upsampled(
            density, made_up("bits and full indirect", N).indirect.upsampling, plain.lighting
        )
    else:
        sides = [[rng.normal(size=shape).astype(np.float32) for shape in ((rows, 4), (4, M))]] * channels
        indirect = LowRank(tuple(a for a, _ in sides), tuple(b for _, b in sides))
    groups = tuple(
        MeshRange(name, slice(a, b)) for name, a, b in (("a", 0, 15), ("b", 15, 25), ("c", 25, 40))
    )
    return LightTransport(
        plain.emission,
        "texel" if "texels" in form else "direction",
        5,
        Measurement(plain.measurement.keys, plain.measurement.areas, groups),
        surfaces,
        {"direct": direct, "indirect": indirect},
        "made up",
        {"parameters": {"max_depth": 5, "harmonics": None}},
    )


def of_form(form: str) -> LightTransport:
    if form == "glossy clusters":
        return prt.compress(made_up_glossy("glossy"), clusters=2, bases=4, progress=False)
    return made_up_glossy(form) if form in GLOSSY else made_up(form, N, N_V)


@pytest.fixture(scope="module", params=ALL)
def transport(request: pytest.FixtureRequest) -> LightTransport:
    return of_form(request.param)


@pytest.fixture(scope="module", params=GLOSSY)
def glossy(request: pytest.FixtureRequest) -> LightTransport:
    return of_form(request.param)


@pytest.fixture(scope="module")
def full(transport: LightTransport) -> NDArray[np.float64]:
    return transport.rows(np.arange(N_V)).astype(np.float64)


def close(found: NDArray, known: NDArray, tolerance: float = 1e-5) -> bool:
    """Relative to the largest number; sums of some hundred float32 numbers in any order."""
    return found.shape == known.shape and bool(
        np.abs(found - known).max(initial=0) <= tolerance * np.abs(known).max(initial=1e-30)
    )


def light_of(seed: int = 0) -> NDArray[np.float32]:
    return np.random.default_rng(seed).random((M, 3), np.float32)


# ------------------------------------------------------------------------------------ one matrix


def test_all_ways_to_ask_are_one_matrix(transport, full):
    light = light_of()
    assert transport.shape == full.shape == (N_V, M, 3)
    assert close(transport.columns(np.arange(M)), full)
    assert close(transport.columns([5, 0, 5]), full[:, [5, 0, 5]])
    assert close(transport.rows([7, 39, 7]), full[[7, 39, 7]])
    assert close(transport.relight(light), np.einsum("nmc,mc->nc", full, light))
    x = np.random.default_rng(1).normal(size=(M, 3, 4)).astype(np.float32)
    assert close(transport.apply(x), np.einsum("nmc,mck->nck", full, x))


def test_the_operators_add_up(transport):
    rows = np.arange(transport.reflection.row_count)
    parts = [operator.rows(rows) for operator in transport.operators.values()]
    assert close(transport.incident.rows(rows), sum(np.broadcast_arrays(*parts)))
    assert transport.nbytes == sum(operator.nbytes for operator in transport.operators.values())


# ------------------------------------------------------------------------------------ the transpose


def test_the_transpose(transport, full):
    """<y, T x> = <T^T y, x> for each pair of vectors and each channel, within 1e-5 of ||y|| ||T x||."""
    rng, k = np.random.default_rng(2), 4
    x, y = (rng.normal(size=(size, 3, k)).astype(np.float32) for size in (M, N_V))
    transposed = transport.T
    assert transposed.shape == (M, N_V, 3)
    assert transposed.T is transport
    forward, backward = transport.apply(x).astype(np.float64), transposed.apply(y).astype(np.float64)
    assert backward.shape == (M, 3, k)
    assert close(backward, np.einsum("nmc,nck->mck", full, y))
    for c in range(3):
        for i in range(k):
            ax, aty = forward[:, c, i], backward[:, c, i]
            limit = 1e-5 * np.linalg.norm(y[:, c, i]) * np.linalg.norm(ax)
            assert abs(y[:, c, i] @ ax - aty @ x[:, c, i]) <= limit
    assert np.array_equal(transposed.adjoint(x), transport.apply(x))


def test_nothing_is_expanded(transport, monkeypatch):
    """The transposed operator does not touch the rows or columns of T."""
    transposed, y = transport.T, np.ones((N_V, 3, 1), np.float32)
    monkeypatch.setattr(LightTransport, "rows", None)
    monkeypatch.setattr(LightTransport, "columns", None)
    assert np.isfinite(transposed.apply(y)).all()
    assert np.isfinite(transposed.as_linear_operator(0).rmatvec(np.ones(M))).all()


# ------------------------------------------------------------------------------------ SciPy


@pytest.mark.parametrize("channel", [None, 0, 1, 2])
def test_operators_for_scipy(transport, full, channel):
    """One channel, or all three block by block: red, green, blue."""
    found = transport.as_linear_operator(channel)
    blocks = [full[..., c] for c in range(3)]
    known = scipy.linalg.block_diag(*blocks) if channel is None else blocks[channel]
    rng = np.random.default_rng(3)
    assert isinstance(found, LinearOperator)
    assert aslinearoperator(found) is found
    assert found.shape == known.shape
    assert found.dtype == np.float32
    x, y = (rng.normal(size=size) for size in known.shape[::-1])
    assert close(found.matvec(x), known @ x)
    assert close(found @ x.astype(np.float32), known @ x)
    assert close(found.matvec(x[:, None]), (known @ x)[:, None])
    assert close(found.rmatvec(y), known.T @ y)
    many, lots = rng.normal(size=(known.shape[1], 5)), rng.normal(size=(known.shape[0], 5))
    assert close(found.matmat(many), known @ many)
    assert close(found.rmatmat(lots), known.T @ lots)
    assert close(found.T.matvec(y), known.T @ y)
    assert close((2 * found).matvec(x), 2 * known @ x)


@pytest.mark.parametrize("channel", [None, 1])
def test_the_transpose_for_scipy(transport, full, channel):
    found, rng = transport.T.as_linear_operator(channel), np.random.default_rng(4)
    known = (
        scipy.linalg.block_diag(*(full[..., c].T for c in range(3))) if channel is None else full[..., 1].T
    )
    assert found.shape == known.shape
    x, y = (rng.normal(size=size) for size in known.shape[::-1])
    assert close(found.matvec(x), known @ x)
    assert close(found.rmatvec(y), known.T @ y)


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")  # lsmr begins with 1e100, in float32
@pytest.mark.parametrize("form", ["bits and factored light", "glossy", "clusters"])
@pytest.mark.parametrize("channel", [None, 2])
def test_least_squares(form, channel):
    """The light that makes given radiance, damped: as the normal equations of the expanded matrix have it."""
    transport = of_form(form)
    full = transport.rows(np.arange(N_V)).astype(np.float64)
    blocks = [full[..., c] for c in (range(3) if channel is None else [channel])]
    known, damp = scipy.linalg.block_diag(*blocks), 0.1 * np.linalg.norm(blocks[0], 2)
    wanted = known @ np.random.default_rng(5).random(known.shape[1])
    found = lsmr(transport.as_linear_operator(channel), wanted, damp=damp, atol=1e-7, btol=1e-7)[0]
    expected = np.linalg.solve(known.T @ known + damp**2 * np.eye(known.shape[1]), known.T @ wanted)
    assert np.linalg.norm(found - expected) < 1e-3 * np.linalg.norm(expected)


@pytest.mark.parametrize("channel", [3, -1, "red"])
def test_there_are_three_channels(channel):
    for whole in (made_up("bits"), made_up("bits").T):
        with pytest.raises(prt.PrtError, match="0, 1, 2") as error:
            whole.as_linear_operator(channel)
        assert "\n" not in str(error.value)


# ------------------------------------------------------------------------------------ views


def mean_over_views(
    transport: LightTransport, light: NDArray[np.float32], local: NDArray, weights: NDArray
) -> NDArray[np.float64]:
    """Of radiance towards directions (k, 3) of each point's own frame, by weights (k,)."""
    surfaces = transport.reflection
    turn = frames(surfaces.tangents, surfaces.normals)
    return sum(
        weight * transport.relight(light, np.einsum("nij,i->nj", turn, direction)).astype(np.float64)
        for direction, weight in zip(local, weights, strict=True)
    )


def test_without_a_view_it_is_the_mean_over_views(glossy):
    """Radiosity / pi is radiance averaged over outgoing directions by their cosine.

    Expected: to rounding in the directions that the factors know; within 0.5% by Gauss and Legendre, where radiance is
    interpolated between those.
    """
    light = light_of(6)
    known = glossy.relight(light)
    cosine = GRID.directions[:, 2] * GRID.solid_angles / np.pi
    assert cosine.sum() == pytest.approx(1, abs=1e-3)
    surfaces = glossy.reflection
    own = mean_over_views(glossy, light, GRID.directions, cosine)
    # the diffuse part is even, and the grid's weights sum to 1 within 1e-3
    own += surfaces.albedo * glossy.irradiance(light) * (1 - cosine.sum())
    assert close(own, known, 1e-4)

    nodes, weights = np.polynomial.legendre.leggauss(12)
    squares, azimuths = (
        (nodes + 1) / 2,
        2 * np.pi * (np.arange(24) + 0.5) / 24,
    )  # sin^2, evenly: that is by cosine
    sine, rest = np.sqrt(squares), np.sqrt(1 - squares)
    local = [(s * np.cos(a), s * np.sin(a), c) for s, c in zip(sine, rest, strict=True) for a in azimuths]
    other = mean_over_views(glossy, light, np.array(local), np.repeat(weights / 2 / 24, 24))
    assert close(other, known, 5e-3)
    for c in (0, 2):
        single = np.zeros((M, 3), np.float32)
        single[11, c] = 1
        assert close(glossy.columns([11])[:, 0, c], glossy.relight(single)[:, c])


def test_a_view(glossy):
    """The sum over terms; directions of any length, one for all or one each; nothing leaves below the surface."""
    light, surfaces = light_of(7), glossy.reflection
    rng = np.random.default_rng(8)
    towards = rng.normal(size=(N_V, 3)).astype(np.float32)
    unit = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    found, coefficients = glossy.relight(light, towards), glossy.coefficients(light)
    assert found.shape == (N_V, 3) and found.dtype == np.float32
    assert np.allclose(glossy.relight(light, 7 * towards), found, rtol=1e-4, atol=1e-5)
    above = np.einsum("nd,nd->n", surfaces.normals, unit) > 0
    assert above.any() and not above.all()
    assert not found[~above].any()
    for i in np.flatnonzero(above):
        known = surfaces.albedo[i] * coefficients.unit_albedo[i]
        if surfaces.material[i] >= 0:
            f = surfaces.factors[surfaces.material[i]]
            turn = frames(surfaces.tangents[i : i + 1], surfaces.normals[i : i + 1])[0]
            g = f.grid.interpolate(f.outgoing, (turn @ unit[i])[None])[..., 0]  # [term, channel]
            known = known + (g * coefficients.terms[i, : f.terms]).sum(axis=0)
        assert np.allclose(found[i], known, rtol=1e-4, atol=1e-4)
    same = glossy.relight(light, [0.0, 0.0, 2.0])
    assert np.array_equal(same, glossy.relight(light, np.tile([[0.0, 0.0, 1.0]], (N_V, 1))))


def test_diffuse_points_look_alike_from_everywhere(glossy):
    light = light_of(9)
    diffuse = np.flatnonzero(glossy.reflection.material < 0)
    up = glossy.reflection.normals
    side = up + 0.9 * glossy.reflection.tangents
    for outgoing in (up, side):
        assert close(glossy.relight(light, outgoing)[diffuse], glossy.relight(light)[diffuse])
    plain = made_up("bits and factored light")
    assert np.array_equal(plain.relight(light, [0.0, 1.0, 0.0]), plain.relight(light))


def test_coefficients_of_a_glossy_matrix(glossy):
    """Rows of the incident light in the order of ``Reflection.rows_of``."""
    light, surfaces = light_of(10), glossy.reflection
    rows = glossy.incident.rows(np.arange(surfaces.row_count)).astype(np.float64)
    products = np.einsum("rmc,mc->rc", np.broadcast_to(rows, (len(rows), M, 3)), light)
    found = glossy.coefficients(light)
    assert close(found.unit_albedo, products[:N_V])
    for i in range(N_V):
        own = surfaces.rows_of(np.array([i]))
        assert own[0] == i
        terms = products[own[1:]] if surfaces.material[i] >= 0 else np.zeros((TERMS, 3))
        assert np.allclose(found.terms[i], terms, rtol=1e-4, atol=1e-4 * np.abs(products).max())
    assert np.array_equal(glossy.irradiance(light), found.unit_albedo)


# ------------------------------------------------------------------------------------ files


def test_files(tmp_path, transport):
    transport.save(tmp_path / "a.prt")
    loaded = prt.load_transport(tmp_path / "a.prt")
    assert_same(transport, loaded)
    light = light_of(11)
    assert np.array_equal(loaded.rows([0, 20]), transport.rows([0, 20]))
    for outgoing in (None, [0.2, 1.0, 0.4]):
        assert np.array_equal(loaded.relight(light, outgoing), transport.relight(light, outgoing))


def test_names_in_a_glossy_file(tmp_path):
    """Operators are nested with dots; what two of them have in common is kept once."""
    transport = made_up_glossy("glossy in texels")
    assert kinds_of(transport) == {
        "reflection": "in_out_factors",
        "direct": "factored_visibility",
        "direct.visibility": "fractional_visibility",
        "indirect": "low_rank",
    }
    transport.save(tmp_path / "a.prt")
    with zipfile.ZipFile(tmp_path / "a.prt") as file:
        names = {name.split("/")[0] for name in file.namelist()} - {"zarr.json"}
    lists = {f"direct.visibility.{name}" for name in ("visibility", "starts", "texels", "shares")}
    assert lists | {"direct.tables", "indirect.left_0", "measurement.keys", "reflection.albedo"} <= names
    both = {"direct.tangents", "reflection.tangents"}, {"direct.material", "reflection.material"}
    assert all(len(pair & names) == 1 for pair in both)


# ------------------------------------------------------------------------------------ its parts


def test_measurement_round_trip():
    known = made_up("bits").measurement
    again = Measurement.from_arrays(known.attributes(), known.arrays())
    assert len(again) == 50
    assert again.groups == known.groups
    assert np.array_equal(again.keys, known.keys)
    assert np.array_equal(again.areas, known.areas)
    order = np.array([4, 4, 1])
    few = known.take(order, (MeshRange("c", slice(0, 3)),))
    assert np.array_equal(few.keys, known.keys[order]) and np.array_equal(few.areas, known.areas[order])
    assert [group.name for group in few.groups] == ["c"]


@pytest.mark.parametrize(
    "change",
    [
        lambda a, r: (a, r | {"areas": r["areas"][1:]}),
        lambda a, r: ({"groups": a["groups"][:1]}, r),
        lambda a, r: ({}, r),
        lambda a, r: (a, {"keys": r["keys"]}),
    ],
    ids=["fewer areas", "fewer groups", "no groups", "no areas"],
)
def test_a_measurement_that_does_not_fit(change: Callable):
    known = made_up("bits").measurement
    with pytest.raises((ValueError, KeyError)):
        Measurement.from_arrays(*change(known.attributes(), known.arrays()))


def test_reflection_round_trips():
    diffuse, surfaces = made_up("bits").reflection, made_up_glossy("glossy").reflection
    again = Diffuse.from_arrays(diffuse.attributes(), diffuse.arrays())
    assert np.array_equal(again.albedo, diffuse.albedo)
    found = InOutFactors.from_arrays(surfaces.attributes(), surfaces.arrays())
    for name in ("albedo", "tangents", "normals", "material"):
        assert np.array_equal(getattr(found, name), getattr(surfaces, name))
    assert found.terms == TERMS
    assert np.array_equal(found.mean_lobes, surfaces.mean_lobes)
    for one, other in zip(found.factors, surfaces.factors, strict=True):
        assert one.grid == other.grid and one.varying_diffuse == other.varying_diffuse
        assert all(np.array_equal(getattr(one, n), getattr(other, n)) for n in ("incident", "outgoing"))
    with pytest.raises(ValueError, match="red, green and blue"):
        Diffuse.from_arrays({}, {"albedo": diffuse.albedo[:, :2]})


def test_rows_of_points():
    """Unit-albedo rows first; terms of glossy points follow, in the order that was asked for."""
    surfaces = made_up_glossy("glossy").reflection
    assert surfaces.row_count == N_V + 30 * TERMS
    assert np.array_equal(surfaces.glossy, [*range(15), *range(25, 40)])
    points = np.array([30, 17, 2])
    first, last = N_V + 20 * TERMS, N_V + 2 * TERMS
    expected = [*points, first, first + 1, first + 2, last, last + 1, last + 2]
    assert np.array_equal(surfaces.rows_of(points), expected)
    each = surfaces.rows_of_each(np.array([30, 2]), 1 + TERMS)
    assert np.array_equal(each, [[30, *range(first, first + 3)], [2, *range(last, last + 3)]])
    taken = surfaces.take(points)
    assert np.array_equal(taken.glossy, [0, 2])
    assert np.array_equal(taken.mean_lobes, surfaces.mean_lobes[[20, 2]])


def test_radiosity_and_its_transpose():
    """<y, R e> = <R^T y, e>, of some points and of all."""
    surfaces, rng = made_up_glossy("glossy").reflection, np.random.default_rng(12)
    incident = rng.normal(size=(surfaces.row_count, 5, 3)).astype(np.float32)
    outgoing = rng.normal(size=(N_V, 3, 5)).astype(np.float32)
    left = (np.moveaxis(surfaces.radiosity(incident), 2, 1).astype(np.float64) * outgoing).sum()
    right = (np.moveaxis(incident, 2, 1).astype(np.float64) * surfaces.radiosity_adjoint(outgoing)).sum()
    assert left == pytest.approx(right, rel=1e-4)
    points = np.array([39, 16, 16, 3])
    some = surfaces.radiosity(incident[surfaces.rows_of(points)], points)
    assert np.allclose(some, surfaces.radiosity(incident)[points], rtol=1e-5, atol=1e-5)


def test_mean_squares_of_radiance():
    """``gram`` and ``squares`` by quadrature over the views that the factors know."""
    surfaces = made_up_glossy("glossy").reflection
    weights = GRID.solid_angles * GRID.directions[:, 2] / np.pi
    for point in (3, 20, 33):
        rows = 1 + TERMS if surfaces.material[point] >= 0 else 1
        out = np.zeros((rows, 3, len(weights)))
        out[0] = surfaces.albedo[point][:, None]
        if rows > 1:
            own = surfaces.factors[surfaces.material[point]].outgoing
            out[1 : 1 + len(own)] = own
        known = np.einsum("acw,bcw,w->abc", out, out, weights)
        # the diffuse part is the same for all views; the grid's weights sum to 1 within 1e-3
        known[0, 0] = surfaces.albedo[point].astype(float) ** 2
        gram = surfaces.gram(np.array([point]))[0]
        assert np.allclose(gram, known, rtol=1e-4, atol=1e-6)
        ids, squares = surfaces.squares(slice(point, point + 1))
        assert np.array_equal(ids[0], surfaces.rows_of(np.array([point])))
        assert np.allclose(squares[0], np.einsum("aac->ac", known), rtol=1e-4, atol=1e-6)


# ------------------------------------------------------------------------------------ names that the outside relies on


NONE = inspect.Parameter.empty
SIGNATURES: list[tuple[Callable, dict[str, object]]] = [
    (
        prt.precompute,
        {
            "scene": NONE,
            "lighting": NONE,
            "method": "auto",
            "basis": "direction",
            "max_depth": 5,
            "spp": None,  # 16, or what a target error needs
            "target_error": None,
            "seed": 0,
            "progress": True,
        },
    ),
    (prt.load_scene, {"path": NONE, "edge_length": None}),
    (prt.CubemapLighting, {"resolution": 32}),
    (prt.CubemapLighting.project, {"self": NONE, "environment": NONE}),
    (prt.load_environment, {"path": NONE}),
    (prt.Environment.rotated, {"self": NONE, "rotation": NONE}),
    (prt.load_transport, {"path": NONE, "scene": None}),
    (
        prt.compress,
        {"transport": NONE, "method": "cpca", "clusters": None, "bases": 24, "target_error": None},
    ),
    (prt.validate, {"scene": NONE, "transport": NONE, "n_rows": 64}),
    (
        prt.precompute_glossy,
        {
            "scene": NONE,
            "lighting": NONE,
            "terms": 4,
            "harmonics": None,
            "direct": "exact",
        },
    ),
    (prt.render, {"scene": NONE, "transport": NONE, "environment": NONE}),
    (prt.LightTransport.rows, {"self": NONE, "ids": NONE}),
    (prt.LightTransport.columns, {"self": NONE, "ids": NONE}),
    (prt.LightTransport.relight, {"self": NONE, "lighting": NONE, "outgoing": None}),
    (prt.LightTransport.irradiance, {"self": NONE, "lighting": NONE}),
    (prt.LightTransport.for_scene, {"self": NONE, "scene": NONE}),
    (prt.LightTransport.with_bsdf, {"self": NONE, "mesh": NONE, "bsdf": NONE}),
    (prt.LightTransport.as_linear_operator, {"self": NONE, "channel": None}),
    (prt.LightTransport.save, {"self": NONE, "path": NONE}),
]


@pytest.mark.parametrize(("function", "known"), SIGNATURES, ids=lambda x: getattr(x, "__qualname__", ""))
def test_signatures(function: Callable, known: dict[str, object]):
    """Names, order and defaults of DESIGN 2; what was added since comes after or by keyword only, with a default."""
    parameters = list(inspect.signature(function).parameters.values())
    first, added = parameters[: len(known)], parameters[len(known) :]
    assert [parameter.name for parameter in first] == list(known)
    assert {parameter.name: parameter.default for parameter in first} == known
    assert all(parameter.kind is parameter.POSITIONAL_OR_KEYWORD for parameter in first)
    assert all(
        parameter.default is not NONE or parameter.kind is parameter.VAR_KEYWORD for parameter in added
    )


def test_all_that_precompute_was_given_since_is_by_keyword():
    parameters = list(inspect.signature(prt.precompute).parameters.values())
    assert all(parameter.kind is parameter.KEYWORD_ONLY for parameter in parameters[9:])
    assert {"terms", "harmonics"} <= {parameter.name for parameter in parameters[9:]}


def test_what_precompute_glossy_hands_on():
    """By keyword: its own parameters, and those of ``precompute``, which mean and default to the same."""
    parameters = inspect.signature(prt.precompute_glossy).parameters
    assert {"rays": 64, "tolerance": 0.06}.items() <= {k: p.default for k, p in parameters.items()}.items()
    assert GlossyOptions.__annotations__.keys() == {"max_depth", "seed", "progress"}
    assert GlossyOptions.__annotations__.keys() <= inspect.signature(prt.precompute).parameters.keys()


def test_one_class_of_results():
    assert prt.GlossyTransport is prt.LightTransport
    transport = made_up("bits and factored light")
    names = ("shape", "nbytes", "report", "lighting", "albedo", "direct", "indirect", "meshes", "terms", "T")
    assert all(hasattr(transport, name) for name in names)
    assert transport.terms == 0
    assert made_up_glossy("glossy").terms == TERMS


@pytest.mark.parametrize("form", ["bits and coarse indirect", "clusters"])
def test_to_xarray(form):
    """Rows as they are, by names: those of a mesh, and texels above the horizon."""
    transport, ids = made_up(form), [3, 1, 40]
    found = transport.to_xarray(ids)
    assert found.dims == ("row", "element", "channel")
    assert np.array_equal(found.values, transport.rows(ids))
    assert found.attrs["basis"] == transport.basis
    assert list(found.id) == ids
    names = [next(m.name for m in transport.meshes if m.vertices.start <= i < m.vertices.stop) for i in ids]
    assert list(found.group.values) == names
    above = found.isel(element=found.y.values > 0.5).sel(channel="g")
    assert np.array_equal(above.values, transport.rows(ids)[:, transport.lighting.directions[:, 1] > 0.5, 1])
    assert len(transport.to_xarray()) == transport.shape[0]
    with pytest.raises(prt.PrtError):
        transport.to_xarray([transport.shape[0]])


def test_to_xarray_says_what_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(prt.PrtError, match="pip install xarray"):
        made_up("bits").to_xarray([0])


def test_to_xarray_refuses_what_does_not_fit(monkeypatch):
    class Memory:
        available = 1000

    monkeypatch.setattr("psutil.virtual_memory", lambda: Memory)
    with pytest.raises(prt.PrtError, match="ask for some rows"):
        made_up("bits").to_xarray()


def test_a_cubemap_has_no_lamps():
    assert made_up("bits").lights == ()
