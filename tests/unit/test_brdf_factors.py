"""In-out factors of BRDFs: the best ones of their rank, their errors as brute force has them, and what is refused."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.special import eval_legendre

import mi_sparse_prt as prt
from mi_sparse_prt.reflection.brdf_factors import (
    DirectionGrid,
    diffuse_reflectance,
    evaluate_brdf,
    factor_brdf,
    factorization,
    measure_factor_error,
)
from mi_sparse_prt.reflection.brdf_factors.diffuse_part import GlossyPart
from mi_sparse_prt.reflection.brdf_factors.factor_error import sample_pairs
from mi_sparse_prt.reflection.brdf_factors.factorization import glossy_rows
from mi_sparse_prt.reflection.brdf_factors.isotropic import values_by_turn

SMALL = DirectionGrid(12, 24)
TINY = DirectionGrid(8, 16)


def rgb(*value: float) -> dict:
    return {"type": "rgb", "value": list(value)}


def phong(exponent: float, specular: tuple = (0.4, 0.4, 0.4)) -> mi.BSDF:
    diffuse = rgb(0.3, 0.3, 0.3)
    return mi.load_dict(
        {
            "type": "phong",
            "exponent": exponent,
            "specular_reflectance": rgb(*specular),
            "diffuse_reflectance": diffuse,
        }
    )


BRUSHED = {"type": "ashikhmin_shirley", "exponent_u": 5.0, "exponent_v": 60.0}


def pairs(grid: DirectionGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All pairs of directions of a grid, and what each counts in squares."""
    w = grid.directions
    areas = grid.solid_angles
    weights = areas[:, None] * (areas * w[:, 2])
    return np.repeat(w, len(w), axis=0), np.tile(w, (len(w), 1)), weights.ravel()


# ------------------------------------------------------------------------------------ the grid


def test_solid_angles_are_those_of_the_hemisphere():
    assert DirectionGrid().solid_angles.sum() == pytest.approx(2 * np.pi)
    assert np.allclose(np.linalg.norm(DirectionGrid(8, 16).directions, axis=1), 1, atol=1e-6)


def test_interpolation():
    """Grid points give their own values, angles between them are linear, azimuths close; nothing below the horizon."""
    rng = np.random.default_rng(0)
    values = rng.standard_normal((2, 3, 12 * 24)).astype(np.float32)
    assert np.allclose(SMALL.interpolate(values, SMALL.directions), values, atol=2e-5)
    assert not SMALL.interpolate(values, -SMALL.directions).any()
    every = SMALL.directions
    theta, phi = np.arccos(every[:, 2]), np.arctan2(every[:, 1], every[:, 0])
    t, p = rng.uniform(0.15, 1.4, 500), rng.uniform(-np.pi, np.pi, 500)
    between = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=1).astype(np.float32)
    assert np.allclose(SMALL.interpolate(theta, between), t, atol=1e-5)
    smooth = SMALL.interpolate(np.cos(phi), between)
    assert np.abs(smooth - np.cos(p)).max() < (2 * np.pi / 24) ** 2 / 8 + 1e-5


def test_harmonics_obey_the_addition_theorem():
    w, y = SMALL.directions.astype(np.float64), SMALL.harmonics(6)
    for degree in range(7):
        own = y[degree**2 : (degree + 1) ** 2]
        known = (2 * degree + 1) / (4 * np.pi) * eval_legendre(degree, np.clip(w @ w.T, -1, 1))
        assert np.allclose(own.T @ own, known, atol=1e-5)


# ------------------------------------------------------------------------------------ the factors


def test_a_diffuse_surface_needs_no_terms():
    bsdf = mi.load_dict({"type": "diffuse", "reflectance": rgb(0.2, 0.5, 0.7)})
    factors = factor_brdf(bsdf, "wall", 2, SMALL)
    assert factors.diffuse == pytest.approx([0.2, 0.5, 0.7], rel=1e-5)
    wi, wo, _ = pairs(SMALL)
    assert np.abs(factors.values(wi, wo) - evaluate_brdf(bsdf, "wall", wi, wo)).max() < 1e-5
    assert measure_factor_error(factors, bsdf, "wall").terms_for(1e-3) == 1


def light_products(grid: DirectionGrid) -> np.ndarray:
    """(n, n) mean products of light from two directions, by Legendre polynomials; the rest is at the same ones."""
    w = grid.directions.astype(np.float64)
    between = np.clip(w @ w.T, -1, 1)
    rest = 1 / 18**2
    found = np.diag(rest / grid.solid_angles)
    for degree in range(17):
        power = 1 / (degree + 1) ** 2 - rest
        found += power * (2 * degree + 1) / (4 * np.pi) * eval_legendre(degree, between)
    return found


@pytest.mark.parametrize("kind", ["phong", "coloured phong", "brushed"])
def test_no_factors_of_that_rank_are_better(kind):
    """
    Rationale: under light of the mean power that is said, squared errors of pictures are a quadratic form.
    Expected: on the grid itself they are the least there are, which numpy's eigenvalues of that form tell.
    """
    bsdf = {
        "phong": phong(20),
        "coloured phong": phong(20, (0.5, 0.3, 0.1)),
        "brushed": mi.load_dict(BRUSHED),
    }[kind]
    wi, wo, _ = pairs(TINY)
    areas, n = TINY.solid_angles, len(TINY.directions)
    light = light_products(TINY) * areas[:, None] * areas
    seen = np.sqrt(areas * TINY.directions[:, 2])[:, None]
    true = evaluate_brdf(bsdf, "ball", wi, wo).astype(np.float64)
    for terms in (1, 4, 16):
        factors = factor_brdf(bsdf, "ball", terms, TINY)
        channels = len(factors.diffuse)
        assert channels == (3 if kind == "coloured phong" else 1)
        glossy = true[:, :channels] - wi[:, 2:] * factors.diffuse / np.pi
        matrix = (glossy.reshape(n, n, channels) * seen).reshape(n, -1)
        least = np.linalg.eigvalsh(matrix.T @ light @ matrix)[:-terms].sum()
        missing = (factors.values(wi, wo) - true[:, :channels]).reshape(n, n, channels) * seen
        found = (missing.reshape(n, -1) * (light @ missing.reshape(n, -1))).sum()
        assert 0.999 * least < found < 1.03 * least
        assert factors.terms == terms


def test_even_light_is_nearly_exact():
    """Four terms of a lobe that takes dozens; the singular vectors of the same matrix have 10% there."""
    factors = factor_brdf(phong(20), "ball", 4, DirectionGrid(16, 32))
    grid = factors.grid
    wi, wo, _ = pairs(grid)
    shape = (len(grid.directions), -1)
    true, found = (
        evaluate_brdf(phong(20), "ball", wi, wo)[:, 0].reshape(shape),
        factors.values(wi, wo).reshape(shape),
    )
    seen = grid.solid_angles * grid.directions[:, 2]
    picture, missing = grid.solid_angles @ true, grid.solid_angles @ (found - true)
    assert np.sqrt(seen @ missing**2) < 0.025 * np.sqrt(seen @ picture**2)


def test_the_diffuse_part_of_a_glossy_surface():
    assert factor_brdf(phong(20), "ball", 1, SMALL).diffuse == pytest.approx([0.3], rel=1e-3)


def test_fewer_terms_are_the_first_ones():
    bsdf = phong(10)
    many, few = (factor_brdf(bsdf, "ball", terms, SMALL) for terms in (8, 3))
    wi, wo, _ = pairs(DirectionGrid(5, 7))
    known, found = many.first(3).values(wi, wo), few.values(wi, wo)
    assert np.abs(found - known).max() < 2e-3 * np.abs(known).max()
    assert many.first(3).terms == 3


@pytest.mark.parametrize("terms", [1, 2, 3, 4, 5])
def test_factors_of_an_isotropic_brdf_are_isotropic(terms):
    """Turning both directions by one step of the grid changes nothing, whatever the number of terms.

    The terms of this one go around the normal 0, 1, 1, 2, 2, 0 times: the first four of them are not isotropic.
    """
    bsdf, grid = mi.load_dict({"type": "roughconductor", "alpha": 0.3}), DirectionGrid(16, 32)
    every = factor_brdf(bsdf, "ball", 8, grid)
    found = every.complete(terms)
    assert found.terms == terms
    wi, wo = (some[::7] for some in pairs(TINY)[:2])
    angle = 2 * np.pi / grid.azimuths
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]], np.float32)
    peak = np.abs(found.values(wi, wo)).max()
    assert np.abs(found.values(wi @ turn, wo @ turn) - found.values(wi, wo)).max() < 2e-3 * peak
    if terms in (2, 4):
        split = every.first(terms)
        assert np.abs(split.values(wi @ turn, wo @ turn) - split.values(wi, wo)).max() > 2e-2 * peak


def test_other_brdfs_keep_their_first_terms():
    many = factor_brdf(mi.load_dict(BRUSHED), "ball", 8, SMALL)
    assert np.array_equal(many.complete(4).incident, many.first(4).incident)


def even_pairs(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random pairs of directions, by solid angle and by its product with the cosine."""
    rng = np.random.default_rng(5)
    found = []
    for z in (rng.random(count), np.sqrt(rng.random(count))):
        r, phi = np.sqrt(1 - z**2), 2 * np.pi * rng.random(count)
        found.append(np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1).astype(np.float32))
    return found[0], found[1]


def test_errors_are_those_of_even_pairs():
    """400 000 pairs that are drawn without regard to the BSDF: the same relative error, within 3%."""
    bsdf = phong(10)
    factors = factor_brdf(bsdf, "ball", 6, DirectionGrid(24, 48))
    error = measure_factor_error(factors, bsdf, "ball")
    wi, wo = even_pairs(400_000)
    true = evaluate_brdf(bsdf, "ball", wi, wo)[:, 0].astype(np.float64)
    for terms in (1, 3, 6):
        missing = factors.first(terms).values(wi, wo)[:, 0] - true
        known = np.sqrt((missing**2).sum() / (true**2).sum())
        assert error.whole[terms - 1] == pytest.approx(known, rel=0.03)
    assert (np.diff(error.whole) < 0).all()
    assert error.terms_for(error.whole[3]) == 4
    assert error.terms_for(0.0) is None
    assert (error.peak > 0).all() and (error.grazing > 0).all()


@pytest.mark.parametrize("kind", ["phong", "brushed"])
def test_held_out_pairs_stand_for_all(kind):
    """
    Rationale: half of them are drawn by the BSDF, which favours its peaks.
    Expected: they add up to the measure of all pairs, 2 pi times pi, and squares to those of a million even pairs,
        within 2% at more than 15 degrees above the surface; below, a few pairs have most of it.
    """
    bsdf = phong(10) if kind == "phong" else mi.load_dict(BRUSHED)
    even = even_pairs(1_000_000)
    *drawn, weights = sample_pairs(bsdf, 1 << 17, 1)
    assert weights.sum() == pytest.approx(2 * np.pi**2, rel=0.005)

    def squares(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        high = np.minimum(wi[:, 2], wo[:, 2]) > np.sin(np.radians(15))
        return high * evaluate_brdf(bsdf, "ball", wi, wo)[:, 0].astype(np.float64) ** 2

    known = squares(*even) * (2 * np.pi**2 / len(even[0]))
    found = squares(*drawn) * weights
    assert known.std() * np.sqrt(len(known)) < 0.01 * known.sum()
    assert found.sum() == pytest.approx(known.sum(), rel=0.02)


def test_errors_in_light_are_those_of_random_skies():
    """
    Rationale: what an image errs by, under light of which neighbouring directions are alike.
    Expected: the relative L2 of radiance over 200 random skies, summed on a grid, within 5%.
    """
    bsdf, grid = phong(10), DirectionGrid(24, 48)
    factors = factor_brdf(bsdf, "ball", 6, grid)
    error = measure_factor_error(factors, bsdf, "ball")
    order, rng = 24, np.random.default_rng(2)
    degree = np.repeat(np.arange(order + 1), 2 * np.arange(order + 1) + 1)
    skies = (rng.standard_normal((200, len(degree))) / (degree + 1)) @ grid.harmonics(order)
    views = even_pairs(64)[1]
    wi, wo = np.tile(grid.directions, (len(views), 1)), np.repeat(views, len(grid.directions), axis=0)
    true = evaluate_brdf(bsdf, "ball", wi, wo)[:, 0].astype(np.float64)
    for terms in (1, 4, 6):
        missing = factors.first(terms).values(wi, wo)[:, 0] - true
        radiance, off = (
            x.reshape(len(views), -1) @ (grid.solid_angles[:, None] * skies.T) for x in (true, missing)
        )
        assert error.lit[terms - 1] == pytest.approx(np.linalg.norm(off) / np.linalg.norm(radiance), rel=0.05)
    assert (error.lit < error.whole).all()


@pytest.mark.parametrize("roughness", [0.02, 0.05])
def test_what_is_not_known_is_no_small_error(roughness):
    """
    Rationale: the squared error is a mean of products, of which next to none find the lobe of lacquer. It may be below
    0, was taken for 0 then (of 9 terms, and all but those), and these drew balls of 30 times their light.
    Expected: errors of all numbers of terms are those of a lobe that the grid does not have.
    """
    lacquer = mi.load_dict(
        {
            "type": "principled",
            "base_color": {"type": "rgb", "value": 0.0},
            "roughness": roughness,
            "specular": 0.9,
        }
    )
    error = measure_factor_error(factor_brdf(lacquer, "ball", 16), lacquer, "ball")
    assert (error.lit > 1).all()


def test_same_seed_same_factors():
    a, b = (factor_brdf(phong(10), "ball", 4, SMALL, seed=3) for _ in range(2))
    assert np.array_equal(a.incident, b.incident) and np.array_equal(a.outgoing, b.outgoing)


# ------------------------------------------------------------------------------------ textures


def textured(kind: str, **parameters: object) -> mi.BSDF:
    """With a coloured checkerboard of 8 x 8 fields for the diffuse part."""
    board = {
        "type": "checkerboard",
        "color0": rgb(0.1, 0.2, 0.3),
        "color1": rgb(0.6, 0.5, 0.1),
        "to_uv": mi.ScalarTransform4f().scale([4, 4, 1]),
    }
    where = "reflectance" if kind == "diffuse" else "diffuse_reflectance"
    bsdf = {"type": kind, where: board, **parameters}
    return mi.load_dict({"type": "twosided", "bsdf": bsdf} if kind == "diffuse" else bsdf)


def places(count: int) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.uv = mi.Point2f(np.random.default_rng(2).random((2, count), np.float32))
    return si


@pytest.mark.parametrize("kind", ["diffuse", "phong"])
def test_a_diffuse_part_that_varies_is_left_out(kind):
    """Factors and `diffuse_reflectance` together are what Mitsuba evaluates anywhere on the surface."""
    bsdf = textured(kind) if kind == "diffuse" else textured(kind, exponent=10.0, specular_reflectance=0.4)
    factors = factor_brdf(bsdf, "wall", 16, SMALL)
    assert factors.varying_diffuse and factors.first(2).varying_diffuse
    assert factors.diffuse.shape == (1,) and not factors.diffuse.any()
    si = places(len(SMALL.directions))
    local = diffuse_reflectance(bsdf, "wall", si)
    assert len(np.unique(local.round(3), axis=0)) == 2
    si.wi = mi.Vector3f(0.6, 0.0, 0.8)
    true = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(SMALL.directions.T))).T
    towards = np.tile(np.float32([[0.6, 0, 0.8]]), (len(true), 1))
    found = factors.values(SMALL.directions, towards) + local * SMALL.directions[:, 2:] / np.pi
    if kind == "diffuse":
        assert np.abs(found - true).max() < 1e-6
        assert measure_factor_error(factors, bsdf, "wall").whole.max() == 0
    else:
        dull = SMALL.directions[:, 2:] / np.pi
        constant = factor_brdf(phong(10), "wall", 16, SMALL).values(SMALL.directions, towards) - 0.3 * dull
        assert np.abs(found - local * dull - constant).max() < 0.01 * constant.max()
        assert np.linalg.norm(found - true) < 0.25 * np.linalg.norm(true)


def test_errors_without_the_diffuse_part():
    """Relative to the lobe alone: the squares are those of the same lobe over a constant part."""
    bsdf, plain = textured("phong", exponent=10.0, specular_reflectance=0.4), phong(10)
    lobe, whole = (
        measure_factor_error(factor_brdf(b, "wall", 3, SMALL), b, "wall").whole for b in (bsdf, plain)
    )
    wi, wo = even_pairs(1 << 17)
    true = evaluate_brdf(plain, "wall", wi, wo)[:, 0].astype(np.float64)
    ratio = np.sqrt((true**2).sum() / ((true - 0.3 * wi[:, 2] / np.pi) ** 2).sum())
    assert lobe == pytest.approx(whole * ratio, rel=0.03)


def test_the_same_everywhere():
    local = diffuse_reflectance(phong(10), "wall", places(50))
    assert local.shape == (50, 3) and np.allclose(local, 0.3, rtol=1e-3)
    assert not factor_brdf(phong(10), "wall", 1, SMALL).varying_diffuse


# ------------------------------------------------------------------------------------ what is refused


@pytest.mark.parametrize(
    ("bsdf", "problem"),
    [
        ({"type": "dielectric"}, "transmits"),
        ({"type": "conductor"}, "mirrors"),
        ({"type": "plastic"}, "mirrors"),
        ({"type": "roughconductor", "alpha": {"type": "checkerboard"}}, "varies over the surface"),
        ({"type": "phong", "specular_reflectance": {"type": "checkerboard"}}, "varies over the surface"),
        ({"type": "phong", "exponent": 500.0, "specular_reflectance": {"type": "checkerboard"}}, "varies"),
        (
            {"type": "roughplastic", "diffuse_reflectance": {"type": "checkerboard"}},
            "varies over the surface",
        ),
        ({"type": "ashikhmin_shirley", "diffuse_reflectance": {"type": "checkerboard"}}, "varies over"),
        ({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}, "attribute"),
    ],
)
def test_refused_by_name(bsdf, problem):
    with pytest.raises(prt.PrtError, match=f"shape 'vase'.*{problem}") as error:
        factor_brdf(mi.load_dict(bsdf), "vase", 2, SMALL)
    assert "\n" not in str(error.value)


def test_rows_do_not_depend_on_how_many_are_made_at_a_time():
    part = GlossyPart(phong(20, (0.1, 0.2, 0.3)), "vase")
    whole, parts = (list(glossy_rows(part, SMALL, lanes)) for lanes in (1 << 21, 1 << 12))
    assert len(whole) == 1 < len(parts)
    np.testing.assert_array_equal(np.concatenate([values for _, values in parts]), whole[0][1])


def test_values_that_are_no_numbers():
    bsdf = phong(10)
    values = mi.traverse(bsdf)
    values["specular_reflectance.value"] = mi.Color3f(3e38)
    values.update()
    with pytest.raises(prt.PrtError, match="shape 'vase'.*inf"):
        factor_brdf(bsdf, "vase", 2, SMALL)


@pytest.mark.parametrize("kind", ["roughconductor", "roughplastic", "principled"])
def test_mitsubas_own(kind):
    """Rough enough for the small grid: a third of the error of one term is gone with sixteen."""
    rough = {"roughness": 0.5} if kind == "principled" else {"alpha": 0.4}
    bsdf = mi.load_dict({"type": kind, **rough})
    error = measure_factor_error(factor_brdf(bsdf, "ball", 16, DirectionGrid(24, 48)), bsdf, "ball")
    assert error.whole[15] < 0.67 * error.whole[0]


@pytest.mark.parametrize("terms", [1, 4, 16])
def test_waves_of_an_isotropic_brdf_are_as_good_as_all_pairs(terms, monkeypatch):
    """Coloured gold on a small grid; squared errors over the light that factors are made for, by the whole matrix."""
    gold = mi.load_dict({"type": "roughconductor", "alpha": 0.3, "material": "Au"})
    smooth, rest = factorization._light(SMALL)
    matrix = factorization._weighted_matrix(GlossyPart(gold, "gold"), SMALL)
    into, out = factorization._weights(SMALL)

    def squared_error() -> float:
        found = factor_brdf(gold, "gold", terms, SMALL)
        right = (found.outgoing * out).reshape(terms, -1)
        off = matrix - (found.incident * into).T @ right
        return float(np.square(smooth @ off).sum() + rest * np.square(off).sum())

    by_waves = squared_error()
    monkeypatch.setattr(factorization, "values_by_turn", lambda *_: None)
    assert 0.95 * squared_error() < by_waves <= 1.001 * squared_error()


@pytest.mark.parametrize("bsdf", [BRUSHED, {"type": "roughconductor", "alpha_u": 0.2, "alpha_v": 0.21}])
def test_an_anisotropic_brdf_has_no_waves(bsdf):
    assert values_by_turn(GlossyPart(mi.load_dict(bsdf), "brushed"), SMALL) is None
