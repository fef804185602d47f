"""The BSDFs `phong` and `ashikhmin_shirley`: against their papers' formulas, their sampling, energy, reciprocity."""

import math

import drjit as dr
import mitsuba as mi
import mitsuba.chi2
import numpy as np
import pytest

import mi_sparse_prt as prt

PHONG = {"type": "phong", "exponent": 40.0}
BRUSHED = {"type": "ashikhmin_shirley", "exponent_u": 10.0, "exponent_v": 300.0}
ROUND = {"type": "ashikhmin_shirley", "exponent_u": 50.0, "exponent_v": 50.0}
FLAT = {"type": "ashikhmin_shirley", "exponent_u": 0.0, "exponent_v": 3.0}
EVERY = {"phong": PHONG, "brushed": BRUSHED, "round": ROUND, "flat": FLAT}


def rgb(value: float) -> dict:
    return {"type": "rgb", "value": value}


def made(bsdf: dict, specular: float = 0.2, diffuse: float = 0.5) -> mi.BSDF:
    return mi.load_dict({**bsdf, "specular_reflectance": rgb(specular), "diffuse_reflectance": rgb(diffuse)})


def at(wi: np.ndarray) -> mi.SurfaceInteraction3f:
    """Surface points that are looked at from directions (m, 3), local frame."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    si.wi = mi.Vector3f(wi.T)
    return si


def values(bsdf: mi.BSDF, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """BRDF times cosine (m,), of a grey BSDF."""
    return np.array(bsdf.eval(mi.BSDFContext(), at(wi), mi.Vector3f(wo.T)))[0].astype(np.float64)


def directions(count: int, seed: int) -> np.ndarray:
    """Random ones of the upper hemisphere (count, 3)."""
    w = np.random.default_rng(seed).standard_normal((count, 3))
    w[:, 2] = np.abs(w[:, 2]) + 0.02
    return (w / np.linalg.norm(w, axis=1, keepdims=True)).astype(np.float32)


def hemisphere(n: int = 1024) -> tuple[np.ndarray, np.ndarray]:
    """Directions (m, 3) and solid angles (m,) of a quadrature: midpoints in height and azimuth."""
    z, phi = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(2 * n) + 0.5) * np.pi / n, indexing="ij")
    r = np.sqrt(1 - z**2)
    w = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1).reshape(-1, 3)
    return w.astype(np.float32), np.full(len(w), np.pi / n**2)


def by_formula(bsdf: dict, specular: float, diffuse: float, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """BRDF times cosine, in double precision, as the papers write it."""
    wi, wo = wi.astype(np.float64), wo.astype(np.float64)
    if bsdf["type"] == "phong":
        n = bsdf["exponent"]
        mirrored = np.maximum(((wi * (-1, -1, 1)) * wo).sum(axis=1), 0)
        return (diffuse / np.pi + specular * (n + 2) / (2 * np.pi) * mirrored**n) * wo[:, 2]
    u, v = bsdf["exponent_u"], bsdf["exponent_v"]
    h = wi + wo
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    hk = (h * wi).sum(axis=1)
    exponent = (u * h[:, 0] ** 2 + v * h[:, 1] ** 2) / (1 - h[:, 2] ** 2)
    fresnel = specular + (1 - specular) * (1 - hk) ** 5
    shiny = np.sqrt((u + 1) * (v + 1)) / (8 * np.pi) * h[:, 2] ** exponent
    shiny *= fresnel / (hk * np.maximum(wi[:, 2], wo[:, 2]))
    dull = 28 * diffuse / (23 * np.pi) * (1 - specular)
    dull = dull * (1 - (1 - wi[:, 2] / 2) ** 5) * (1 - (1 - wo[:, 2] / 2) ** 5)
    return (shiny + dull) * wo[:, 2]


@pytest.mark.parametrize("kind", EVERY)
def test_values_are_those_of_the_formula(kind):
    wi, wo = directions(20_000, 1), directions(20_000, 2)
    found, known = values(made(EVERY[kind]), wi, wo), by_formula(EVERY[kind], 0.2, 0.5, wi, wo)
    assert known.max() > 10 * known.mean() or kind == "flat"
    np.testing.assert_allclose(found, known, rtol=2e-3, atol=1e-5 * known.max())


@pytest.mark.parametrize("kind", EVERY)
def test_reciprocity(kind):
    wi, wo = directions(5000, 3), directions(5000, 4)
    bsdf = made(EVERY[kind])
    np.testing.assert_allclose(
        values(bsdf, wi, wo) * wi[:, 2], values(bsdf, wo, wi) * wo[:, 2], rtol=2e-3, atol=1e-6
    )


@pytest.mark.parametrize("kind", EVERY)
@pytest.mark.parametrize("lobe", ["both", "specular", "diffuse"])
def test_sampling(kind, lobe):
    """Chi-square: densities are those of the samples, at three angles; not rejected at the 1% level (fixed seed)."""
    share = {"both": (0.3, 0.4), "specular": (0.5, 0.0), "diffuse": (0.0, 0.5)}[lobe]
    extra = dict(EVERY[kind])
    extra |= {"specular_reflectance": rgb(share[0]), "diffuse_reflectance": rgb(share[1])}
    for angle in (0.0, 40.0, 75.0):
        s, c = math.sin(math.radians(angle)), math.cos(math.radians(angle))
        sample, pdf = mi.chi2.BSDFAdapter(EVERY[kind]["type"], extra, wi=mi.Vector3f(0.6 * s, 0.8 * s, c))
        test = mi.chi2.ChiSquareTest(mi.chi2.SphericalDomain(), sample, pdf, 3, 400_000, res=101, ires=8)
        assert test.run(), test.messages


@pytest.mark.parametrize("kind", EVERY)
def test_furnace(kind):
    """
    Scenario: radiance 1 from everywhere; white lobes as far as they may be.
    Expected: never more than 1 comes back, and what samples say is what a quadrature says. Known shares: a phong
        lobe sends all of its reflectance along the normal; the diffuse lobe of Ashikhmin and Shirley alone sends
        R (1 - (1 - cos / 2)^5).
    """
    wo, areas = hemisphere()
    phong = kind == "phong"
    bsdf = made(EVERY[kind], 0.4, 0.6 if phong else 1.0)
    for cosine in (1.0, 0.7, 0.3, 0.05):
        wi = np.array([[np.sqrt(1 - cosine**2), 0, cosine]], np.float32)
        every = np.broadcast_to(wi, wo.shape)
        total = float(values(bsdf, every, wo) @ areas)
        assert total < 1.001
        n = 1 << 18
        rng = np.random.default_rng(0)
        _, weight = bsdf.sample(
            mi.BSDFContext(),
            at(np.broadcast_to(wi, (n, 3))),
            mi.Float(rng.random(n, np.float32)),
            mi.Point2f(rng.random((2, n), np.float32)),
        )
        weight = np.array(weight)[0].astype(np.float64)
        error = weight.std() / np.sqrt(n)
        assert error < 0.004
        assert abs(weight.mean() - total) < 3.5 * error + 1e-3
        dull = float(values(made(EVERY[kind], 0.0, 0.5), every, wo) @ areas)
        if phong:
            assert dull == pytest.approx(0.5, rel=1e-3)
        else:
            # with no specular reflectance Schlick's term still reflects at grazing angles
            shiny = float(values(made(EVERY[kind], 0.0, 0.0), every, wo) @ areas)
            assert dull - shiny == pytest.approx(0.5 * (1 - (1 - cosine / 2) ** 5), rel=1e-3)
    if phong:
        along = np.broadcast_to(np.array([[0, 0, 1]], np.float32), wo.shape)
        assert float(values(made(PHONG, 0.4, 0.0), along, wo) @ areas) == pytest.approx(0.4, rel=1e-3)


def test_lobes_are_asked_for_one_by_one():
    wi, wo = directions(1000, 5), directions(1000, 6)
    for bsdf in map(made, EVERY.values()):
        parts = []
        for lobe in (0, 1):
            context = mi.BSDFContext()
            context.component = lobe
            parts.append(np.array(bsdf.eval(context, at(wi), mi.Vector3f(wo.T)))[0])
        np.testing.assert_allclose(sum(parts), values(bsdf, wi, wo), rtol=1e-5)
        assert all(part.max() > 0 for part in parts)


def test_nothing_behind_the_surface():
    below = directions(100, 7) * (1, 1, -1)
    for bsdf in map(made, EVERY.values()):
        assert not values(bsdf, below.astype(np.float32), directions(100, 8)).any()
        assert not values(bsdf, directions(100, 8), below.astype(np.float32)).any()


@pytest.mark.parametrize("kind", ["phong", "brushed"])
def test_in_a_scene(kind):
    """XML and dict are the same; a plane under even light shows the albedo."""
    text = "".join(
        f'<float name="{name}" value="{value}"/>' for name, value in EVERY[kind].items() if name != "type"
    )
    bsdf = (
        f'<bsdf type="{EVERY[kind]["type"]}">{text}<rgb name="specular_reflectance" value="0.2"/>'
        '<rgb name="diffuse_reflectance" value="0.5"/></bsdf>'
    )
    scene = mi.load_string(
        f'<scene version="3.0.0"><emitter type="constant"/><shape type="rectangle">{bsdf}</shape>'
        '<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/>'
        '</transform><float name="fov" value="1"/><film type="hdrfilm"><integer name="width" value="8"/>'
        '<integer name="height" value="8"/><rfilter type="box"/></film></sensor></scene>'
    )
    wo, areas = hemisphere(512)
    along = np.broadcast_to(np.array([[0, 0, 1]], np.float32), wo.shape)
    known = float(values(made(EVERY[kind]), along, wo) @ areas)
    runs = [
        np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=256, seed=k)).mean()
        for k in range(8)
    ]
    error = np.std(runs, ddof=1) / np.sqrt(8)
    assert 3 * error < 0.02 * known
    assert abs(np.mean(runs) - known) < 3 * error + 1e-3


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"type": "phong", "exponent": -1.0}, "exponent"),
        ({"type": "phong", "exponent": 1e7}, "exponent"),
        ({"type": "ashikhmin_shirley", "exponent_v": float("nan")}, "exponent_v"),
        ({"type": "phong", "diffuse_reflectance": 1.5}, "diffuse_reflectance"),
    ],
)
def test_bad_parameters(parameters, message):
    with pytest.raises((prt.PrtError, RuntimeError), match=message):
        mi.load_dict(parameters)
