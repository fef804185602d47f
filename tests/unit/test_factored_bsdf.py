"""The BSDF `in_out_factors`: against the factors it is made of, its sampling, in a scene, diffuse textures.

Sums of few products are not reciprocal: that is not asked for.
"""

import math

import mitsuba as mi
import mitsuba.chi2
import numpy as np
import pytest
from test_glossy_bsdfs import at, directions, hemisphere, rgb

import mi_sparse_prt as prt
from mi_sparse_prt.plugins.in_out_factors import factored_bsdf
from mi_sparse_prt.reflection.brdf_factors import BrdfFactors, DirectionGrid, diffuse_reflectance, factor_brdf
from mi_sparse_prt.reflection.factor_tables import incident_tables, outgoing_tables, table_directions

BRUSHED = {
    "type": "ashikhmin_shirley",
    "exponent_u": 5.0,
    "exponent_v": 60.0,
    "specular_reflectance": {"type": "rgb", "value": [0.5, 0.3, 0.2]},
    "diffuse_reflectance": {"type": "rgb", "value": [0.1, 0.3, 0.5]},
}
CHECKED = {
    "type": "phong",
    "exponent": 10.0,
    "diffuse_reflectance": {"type": "checkerboard", "color0": rgb(0.2), "color1": rgb(0.6)},
}


@pytest.fixture(scope="module")
def brushed() -> BrdfFactors:
    return factor_brdf(mi.load_dict(BRUSHED), "brushed", 3, DirectionGrid(32, 64))


def values(bsdf: mi.BSDF, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """BRDF times incident cosine (m, 3); Mitsuba's wi is the outgoing direction."""
    return np.array(bsdf.eval(mi.BSDFContext(), at(outgoing), mi.Vector3f(incident.T))).T


def test_values_are_those_of_the_tables(brushed):
    """At directions of the tables' entries there is no interpolation: the sum of products, of either sign."""
    every = table_directions()
    inside = np.flatnonzero(every[:, 2] > 0.05)
    rng = np.random.default_rng(0)
    i, o = rng.choice(inside, 20_000), rng.choice(inside, 20_000)
    f = incident_tables([brushed])[0].reshape(len(every), -1)
    g = outgoing_tables([brushed])[0].reshape(len(every), -1, 3)
    known = np.einsum("mk,mkc->mc", f[i], g[o]) + brushed.diffuse / np.pi * every[i, 2:]
    found = values(factored_bsdf(brushed), every[i], every[o])
    np.testing.assert_allclose(found, known, atol=2e-4 * np.abs(known).max())
    assert (known.min(axis=0) < -1e-2 * known.max()).any()


def test_values_are_those_of_the_factors(brushed):
    """Tables of 128 x 128 instead of a grid of 32 x 64: interpolation moves values by a percent (relative L2)."""
    wi, wo = directions(20_000, 1), directions(20_000, 2)
    found, known = values(factored_bsdf(brushed), wi, wo), brushed.values(wi, wo)
    assert np.linalg.norm(found - known) < 0.01 * np.linalg.norm(known)
    swapped = values(factored_bsdf(brushed), wo, wi)  # which direction is which makes a difference
    assert np.linalg.norm(swapped - known) > 0.2 * np.linalg.norm(known)


def test_nothing_behind_the_surface(brushed):
    below, above = directions(100, 3) * np.float32([1, 1, -1]), directions(100, 4)
    bsdf = factored_bsdf(brushed)
    assert not values(bsdf, below, above).any()
    assert not values(bsdf, above, below).any()


@pytest.mark.parametrize("angle", [0.0, 40.0, 75.0])
def test_sampling(brushed, angle):
    """Chi-square: densities are those of the samples; not rejected at the 1% level (fixed seed)."""
    tables = {
        "type": "in_out_factors",
        "incident": mi.TensorXf(incident_tables([brushed])[0]),
        "outgoing": mi.TensorXf(outgoing_tables([brushed])[0]),
    }
    s, c = math.sin(math.radians(angle)), math.cos(math.radians(angle))
    sample, pdf = mi.chi2.BSDFAdapter("in_out_factors", tables, wi=mi.Vector3f(0.6 * s, 0.8 * s, c))
    test = mi.chi2.ChiSquareTest(mi.chi2.SphericalDomain(), sample, pdf, 3, 400_000, res=101, ires=8)
    assert test.run(), test.messages


def test_samples_find_what_a_quadrature_finds(brushed):
    """Albedo for one direction, where part of the values is negative."""
    wo, areas = hemisphere(512)
    towards = np.float32([[0.6, 0.48, 0.64]])
    bsdf = factored_bsdf(brushed)
    known = values(bsdf, wo, np.broadcast_to(towards, wo.shape)).T.astype(np.float64) @ areas
    n = 1 << 18
    rng = np.random.default_rng(0)
    _, weight = bsdf.sample(
        mi.BSDFContext(),
        at(np.broadcast_to(towards, (n, 3))),
        mi.Float(rng.random(n, np.float32)),
        mi.Point2f(rng.random((2, n), np.float32)),
    )
    weight = np.array(weight).astype(np.float64)
    assert weight.min() < 0
    error = weight.std(axis=1) / np.sqrt(n)
    assert (error < 0.01 * known).all()
    assert (np.abs(weight.mean(axis=1) - known) < 3.5 * error + 1e-3 * known).all()


def test_path_renders_negative_values():
    """
    Scenario: a plane whose BRDF is one product, f = cos and g = -0.2, under even light.
    Expected: every pixel is -0.2 pi; nothing is clipped on its way to the film, by either way to sample light.
    """
    grid = DirectionGrid()
    f, g = grid.directions[None, :, 2], np.full((1, 1, len(grid.directions)), -0.2, np.float32)
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at([0, 1, 5], [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant"},
            "plane": {"type": "rectangle", "bsdf": factored_bsdf(BrdfFactors(grid, np.zeros(1), f, g))},
            "camera": {"type": "perspective", "fov": 1, "to_world": view, "film": film},
        }
    )
    path = {"type": "path", "max_depth": 3, "rr_depth": 99}
    image = np.array(mi.render(scene, integrator=mi.load_dict(path), spp=4096))[..., :3]
    error = image.std() / np.sqrt(image[..., 0].size)
    assert error < 1e-3
    assert abs(image.mean() + 0.2 * np.pi) < 4 * error + 1e-3  # bilinear cosine: a few 1e-4


def test_a_texture_of_the_diffuse_part():
    """The whole is the real BSDF's diffuse part at each place plus the same glossy part everywhere."""
    real = mi.load_dict(CHECKED)
    factors = factor_brdf(real, "checked", 3, DirectionGrid(32, 64))
    assert factors.varying_diffuse
    with pytest.raises(prt.PrtError, match="varies"):
        factored_bsdf(factors)
    bsdf = factored_bsdf(factors, real)
    wi, wo = directions(1000, 5), directions(1000, 6)
    si = at(wo)
    si.uv = mi.Point2f(np.random.default_rng(0).random((2, 1000), np.float32))
    found = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(wi.T))).T
    reflectance = diffuse_reflectance(real, "checked", si)
    assert np.ptp(reflectance) == pytest.approx(0.4, abs=1e-3)
    si.wi = mi.Vector3f(wo.T)  # `diffuse_reflectance` may turn it
    known = factors.values(wi, wo) + reflectance / np.pi * wi[:, 2:]
    assert np.linalg.norm(found - known) < 0.01 * np.linalg.norm(known)


def test_a_texture_in_a_picture():
    """
    Scenario: a plane with a checkerboard as its diffuse part under even light, seen from the front.
    Expected: the squares' reflectance, and what a quadrature of the factors finds along the normal.
    """
    real = mi.load_dict(CHECKED)
    factors = factor_brdf(real, "checked", 3, DirectionGrid(32, 64))
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at([0, 0, 20], [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant"},
            "plane": {"type": "rectangle", "bsdf": factored_bsdf(factors, real)},
            "camera": {"type": "perspective", "fov": 5, "to_world": view, "film": film},
        }
    )
    path = mi.load_dict({"type": "path", "max_depth": 2})
    image = np.array(mi.render(scene, integrator=path, spp=4096))[..., 0]
    squares = sorted([image[:4, :4].mean(), image[4:, :4].mean()])  # side by side
    wi, areas = hemisphere(512)
    along = np.broadcast_to(np.float32([[0, 0, 1]]), wi.shape)
    glossy = float(factors.values(wi, along)[:, 0] @ areas)
    np.testing.assert_allclose(squares, np.array([0.2, 0.6]) + glossy, atol=0.006)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"incident": np.zeros((4, 4, 2))}, "outgoing"),
        ({"incident": np.zeros((4, 4, 2)), "outgoing": np.zeros((4, 4, 3, 3))}, "shape"),
        ({"incident": np.full((4, 4, 2), np.nan), "outgoing": np.zeros((4, 4, 2, 3))}, "NaN"),
    ],
)
def test_bad_parameters(parameters, message):
    tensors = {name: mi.TensorXf(value.astype(np.float32)) for name, value in parameters.items()}
    with pytest.raises((prt.PrtError, RuntimeError), match=message):
        mi.load_dict({"type": "in_out_factors", **tensors})
