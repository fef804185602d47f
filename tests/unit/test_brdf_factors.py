"""In-out factors of BRDFs: the best ones of their rank, their errors as brute force has them, and what is refused."""

import mitsuba as mi
import numpy as np
import pytest

import mi_sparse_prt as prt
from mi_sparse_prt.measurement import brdf_factors as module
from mi_sparse_prt.measurement.brdf_factors import DirectionGrid, evaluated, factor_brdf, factor_error

SMALL = DirectionGrid(12, 24)


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
    assert np.allclose(SMALL.interpolated(values, SMALL.directions), values, atol=2e-5)
    assert not SMALL.interpolated(values, -SMALL.directions).any()
    every = SMALL.directions
    theta, phi = np.arccos(every[:, 2]), np.arctan2(every[:, 1], every[:, 0])
    t, p = rng.uniform(0.15, 1.4, 500), rng.uniform(-np.pi, np.pi, 500)
    between = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=1).astype(np.float32)
    assert np.allclose(SMALL.interpolated(theta, between), t, atol=1e-5)
    smooth = SMALL.interpolated(np.cos(phi), between)
    assert np.abs(smooth - np.cos(p)).max() < (2 * np.pi / 24) ** 2 / 8 + 1e-5


# ------------------------------------------------------------------------------------ the factors


def test_a_diffuse_surface_needs_no_terms():
    bsdf = mi.load_dict({"type": "diffuse", "reflectance": rgb(0.2, 0.5, 0.7)})
    factors = factor_brdf(bsdf, "wall", 2, SMALL)
    assert factors.diffuse == pytest.approx([0.2, 0.5, 0.7], rel=1e-5)
    wi, wo, _ = pairs(SMALL)
    assert np.abs(factors.values(wi, wo) - evaluated(bsdf, "wall", wi, wo)).max() < 1e-5
    assert factor_error(factors, bsdf, "wall").terms_for(1e-3) == 1


@pytest.mark.parametrize("kind", ["phong", "coloured phong", "brushed"])
def test_no_factors_of_that_rank_are_better(kind):
    """Against numpy's full singular value decomposition of the same samples, on the grid itself."""
    bsdf = {
        "phong": phong(20),
        "coloured phong": phong(20, (0.5, 0.3, 0.1)),
        "brushed": mi.load_dict(BRUSHED),
    }[kind]
    wi, wo, weights = pairs(SMALL)
    true = evaluated(bsdf, "ball", wi, wo).astype(np.float64)
    n = len(SMALL.directions)
    for terms in (1, 4, 16):
        factors = factor_brdf(bsdf, "ball", terms, SMALL)
        channels = len(factors.diffuse)
        assert channels == (3 if kind == "coloured phong" else 1)
        glossy = true[:, :channels] - wi[:, 2:] * factors.diffuse / np.pi
        matrix = (glossy * np.sqrt(weights)[:, None]).reshape(n, n * channels)
        least = np.sqrt((np.linalg.svd(matrix, compute_uv=False)[terms:] ** 2).sum())
        missing = (factors.values(wi, wo) - true[:, :channels]) * np.sqrt(weights)[:, None]
        assert least * 0.999 < np.linalg.norm(missing) < 1.02 * least
        assert factors.terms == terms


def test_the_diffuse_part_of_a_glossy_surface():
    assert factor_brdf(phong(20), "ball", 1, SMALL).diffuse == pytest.approx([0.3], rel=1e-3)


def test_fewer_terms_are_the_first_ones():
    bsdf = phong(10)
    many, few = (factor_brdf(bsdf, "ball", terms, SMALL) for terms in (8, 3))
    wi, wo, _ = pairs(DirectionGrid(5, 7))
    known, found = many.first(3).values(wi, wo), few.values(wi, wo)
    assert np.abs(found - known).max() < 2e-3 * np.abs(known).max()
    assert many.first(3).terms == 3


def even_pairs(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random pairs of directions, by solid angle and by its product with the cosine."""
    rng = np.random.default_rng(5)
    found = []
    for z in (rng.random(count), np.sqrt(rng.random(count))):
        r, phi = np.sqrt(1 - z**2), 2 * np.pi * rng.random(count)
        found.append(np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1).astype(np.float32))
    return found[0], found[1]


def test_errors_are_those_of_even_pairs():
    """A million pairs that are drawn without regard to the BSDF: the same relative error, within 3%."""
    bsdf = phong(10)
    factors = factor_brdf(bsdf, "ball", 6, DirectionGrid(24, 48))
    error = factor_error(factors, bsdf, "ball")
    wi, wo = even_pairs(1_000_000)
    true = evaluated(bsdf, "ball", wi, wo)[:, 0].astype(np.float64)
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
    *drawn, weights = module._held_out(bsdf, 1)
    assert weights.sum() == pytest.approx(2 * np.pi**2, rel=0.005)

    def squares(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        high = np.minimum(wi[:, 2], wo[:, 2]) > np.sin(np.radians(15))
        return high * evaluated(bsdf, "ball", wi, wo)[:, 0].astype(np.float64) ** 2

    known = squares(*even) * (2 * np.pi**2 / len(even[0]))
    found = squares(*drawn) * weights
    assert known.std() * np.sqrt(len(known)) < 0.01 * known.sum()
    assert found.sum() == pytest.approx(known.sum(), rel=0.02)


def test_same_seed_same_factors():
    a, b = (factor_brdf(phong(10), "ball", 4, SMALL, seed=3) for _ in range(2))
    assert np.array_equal(a.incident, b.incident) and np.array_equal(a.outgoing, b.outgoing)


@pytest.mark.parametrize(
    ("bsdf", "problem"),
    [
        ({"type": "dielectric"}, "transmits"),
        ({"type": "conductor"}, "mirrors"),
        ({"type": "plastic"}, "mirrors"),
        ({"type": "diffuse", "reflectance": {"type": "checkerboard"}}, "varies over the surface"),
    ],
)
def test_refused_by_name(bsdf, problem):
    with pytest.raises(prt.PrtError, match=f"shape 'vase'.*{problem}") as error:
        factor_brdf(mi.load_dict(bsdf), "vase", 2, SMALL)
    assert "\n" not in str(error.value)


def test_values_that_are_no_numbers(monkeypatch):
    monkeypatch.setattr(module, "LANES", 1 << 12)
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
    error = factor_error(factor_brdf(bsdf, "ball", 16, DirectionGrid(24, 48)), bsdf, "ball")
    assert error.whole[15] < 0.67 * error.whole[0]
