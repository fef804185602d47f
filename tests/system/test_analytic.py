"""Situations whose light is known in closed form."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import COLOURS, T, build, bumpy_ball, diffuse, mesh, problem_at, still_life
from matplotlib.figure import Figure

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver

GREY = diffuse(0.5, 0.5, 0.5)
FLOOR = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(2), "bsdf": GREY}


def share_of_view(point: np.ndarray, normal: np.ndarray, polygon: np.ndarray) -> float:
    """Lambert's formula: irradiance / pi at a point from a polygon (n, 3) of radiance 1, all above the horizon."""
    r = polygon - point
    r = r / np.linalg.norm(r, axis=1, keepdims=True)
    following = np.roll(r, -1, axis=0)
    normals = np.cross(r, following)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    angles = np.arccos(np.clip((r * following).sum(axis=1), -1, 1))
    return abs(float((angles * (normals @ normal)).sum())) / (2 * np.pi)


def ring(radius: float, y: float, segments: int) -> np.ndarray:
    phi = 2 * np.pi * np.arange(segments) / segments
    return np.stack([radius * np.cos(phi), 0 * phi + y, radius * np.sin(phi)], axis=-1)


def surface(rings: list[np.ndarray], inwards: bool) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of the bands between rings of equal length, from the lowest to the highest."""
    segments = len(rings[0])
    index = np.arange(len(rings) * segments).reshape(len(rings), segments)
    right = np.roll(index, -1, axis=1)
    a, b, c, d = (x.ravel() for x in (index[:-1], right[:-1], index[1:], right[1:]))
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])
    return np.concatenate(rings), triangles if inwards else triangles[:, ::-1]


# ------------------------------------------------------------------------------------ convex and closed


@pytest.mark.usefixtures("no_held_out")
@pytest.mark.parametrize("kind", ["sphere", "cube", "ellipsoid"])
def test_a_convex_object_alone(kind, artefact):
    """Rationale: under constant light a convex object has B = albedo everywhere: it sees the whole hemisphere.

    Sphere, cube and an ellipsoid of three axes, coloured albedo; texel basis at n = 16, 4 x 4 strata, max_depth 5.

    Expected: B = albedo at every vertex within 1e-3, and no indirect light at all. A missing border vertex, a texel
    counted twice (dω / 4π = 0.07% each) or a wrong solid angle fails.

    Result: the worst vertex is off by 5e-4.
    """
    albedo = np.array([0.2, 0.5, 0.9])
    shapes = {
        "sphere": {"type": "sphere"},
        "cube": {"type": "cube", "to_world": T().rotate([0, 1, 0], 40).rotate([1, 0, 0], 25)},
        "ellipsoid": {"type": "sphere", "radius": 1.0},
    }
    shape = {**shapes[kind], "bsdf": diffuse(*albedo)}
    if kind == "ellipsoid":
        vertices, triangles = bumpy_ball(16, 32)
        vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True) * [1, 0.5, 0.7]
        shape = mesh("ellipsoid", vertices, triangles, diffuse(*albedo))
    scene = build(0.5, shape=shape)
    transport = prt.precompute(
        scene, prt.CubemapLighting(16), method="brute_force", basis="texel", strata=4, progress=False
    )
    error = transport.relight(1.0) / albedo - 1
    print(f"{kind}: worst vertex {np.abs(error).max():.1e}, mean {error.mean():+.1e}")
    assert np.abs(error).max() < 1e-3
    assert transport.indirect is None

    figure = Figure(figsize=(6, 3))
    axes = figure.subplots()
    axes.plot(error, lw=0.7)
    axes.set(xlabel="vertex", ylabel="B / albedo - 1", title=f"{kind}, {scene.n_vertices} vertices")
    artefact(figure)


def six_walls() -> dict:
    """Rectangles that face inwards and meet at edges and corners; turning them leaves rounding of 1e-7 there."""
    turns = {
        "back": ([0, 1, 0], 0),
        "left": ([0, 1, 0], 90),
        "front": ([0, 1, 0], 180),
        "right": ([0, 1, 0], 270),
    }
    turns |= {"floor": ([1, 0, 0], 90), "ceiling": ([1, 0, 0], -90)}
    return {
        name: {"type": "rectangle", "to_world": T().rotate(*turn).translate([0, 0, -1]), "bsdf": GREY}
        for name, turn in turns.items()
    }


BOX = {"type": "cube", "flip_normals": True, "bsdf": diffuse(0.8, 0.8, 0.8)}
BOXES = {
    "cube": {"box": BOX},
    "turned cube": {"box": {**BOX, "to_world": T().rotate([0, 1, 0], 17).rotate([1, 0, 0], 29)}},
    "six walls": six_walls(),
}


@pytest.mark.filterwarnings("ignore:.*faces point inwards")
@pytest.mark.parametrize("kind", BOXES)
@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_a_closed_box_is_dark(kind, basis, artefact):
    """Rationale: no light gets into a closed box; a ray offset too small or too large, or a vertex exactly in a corner,
    lets some through.

    A ball in a box: a cube that faces inwards, straight and turned, and six separate rectangles; n = 8, max_depth 5.

    Expected: every element of the direct and of the indirect part is exactly zero, corners and edges included. Only
    between separate rectangles, whose edges differ by 1e-7, may a ray that is aimed exactly at an edge pass: in the
    direction basis less than 0.03% of the elements (rooms of this symmetry aim many; 0.1% by OptiX, on a GPU), never
    in the texel basis.

    Result: all zero; 24 of 138240 elements between the six walls in the direction basis (69 by OptiX).
    """
    vertices, triangles = bumpy_ball()
    scene = build(0.5, ball=mesh("ball", vertices, triangles, GREY), **BOXES[kind])
    lighting, points = prt.CubemapLighting(8), vertex_points(scene)
    vertex, texel = np.repeat(np.arange(len(points)), 384), np.tile(np.arange(384), len(points))
    direct = DirectSolver(problem_at(scene, lighting, points, basis=basis)).elements(vertex, texel)
    path = PathSolver(problem_at(scene, lighting, points, basis=basis), 4)
    indirect = path.elements(vertex, texel).mean[:, 0]
    figure = Figure(figsize=(6, 3))
    axes = figure.subplots()
    for part, name in ((direct, "direct"), (indirect, "indirect")):
        axes.plot(part.reshape(len(points), 384).sum(axis=1), label=name)
    axes.set(xlabel="vertex", ylabel="light that leaks in")
    axes.legend()
    artefact(figure)
    print(f"{np.count_nonzero(direct)} and {np.count_nonzero(indirect)} of {direct.size} elements leak")
    slips = 3e-4 if mi.variant().startswith("llvm") else 1e-3
    allowed = slips * direct.size if kind == "six walls" and basis == "direction" else 0
    assert np.count_nonzero(direct) <= allowed
    assert np.count_nonzero(indirect) <= allowed


# ------------------------------------------------------------------------------------ form factors


def irradiance_at_origin(scene: prt.Scene, seeds: int = 64) -> tuple[float, float, float]:
    """Direct irradiance / pi under constant light at the floor's vertex at the origin, and its standard error.

    The third number is the height at which its rays start, world units.
    """
    vertex = int(np.argmin(np.linalg.norm(scene.positions, axis=1)))
    assert np.linalg.norm(scene.positions[vertex]) < 1e-6
    lighting = prt.CubemapLighting(8)
    solver = DirectSolver(problem_at(scene, lighting, basis="texel"), 6)
    texels = np.arange(lighting.n_directions)
    runs = [
        solver.elements(np.full(len(texels), vertex), texels, seed=k).sum(dtype=np.float64)
        for k in range(seeds)
    ]
    height = float(mi.math.RayEpsilon) * (1 + np.abs(scene.normalised_positions[vertex]).max()) / scene.scale
    return float(np.mean(runs)), float(np.std(runs, ddof=1) / np.sqrt(seeds)), height


SEGMENTS = 24
UP = np.array([0.0, 1.0, 0.0])
DOME = [ring(np.cos(a), np.sin(a), SEGMENTS) for a in np.radians([0, 20, 40, 60])]
FORM_FACTORS = {
    "open plane": ({}, lambda start: 1.0),
    "under a disk": (
        {"disk": (np.concatenate([[[0, 0.7, 0]], ring(0.5, 0.7, SEGMENTS)]), None)},
        lambda start: 1 - share_of_view(start, UP, ring(0.5, 0.7, SEGMENTS)),
    ),
    "in a cylinder": (
        {"cylinder": surface([ring(0.8, y, SEGMENTS) for y in (0, 0.5, 1.0)], inwards=True)},
        lambda start: share_of_view(start, UP, ring(0.8, 1.0, SEGMENTS)),
    ),
    "under a dome with a hole": (
        {"dome": surface(DOME, inwards=True)},
        lambda start: share_of_view(start, UP, DOME[-1]),
    ),
}


@pytest.mark.parametrize("kind", FORM_FACTORS)
def test_known_form_factors(kind, artefact):
    """Rationale: irradiance at a floor vertex that sees the sky through a polygon, or all but a polygon, is Lambert's
    formula of that polygon.

    The middle of a floor: open; under a disk of 24 sides (radius 0.5, height 0.7); at the bottom of a cylinder of 24
    sides (radius 0.8, height 1); at the centre of a hemispherical dome, open from 60 degrees up. Texel basis, n = 8,
    6 x 6 strata, mean of 64 seeds. For circles the values would be 1, 1 - R²/(R² + h²), R²/(R² + h²) and sin² 30°.

    Expected: within 3 standard errors (of the 64 seeds) and 3e-5 (float32) of the formula at the place where the rays
    start, 1e-4 of the scene over the floor. That is under 0.5%, so that a bias of 2% fails.

    Result: 0.66446 (known 0.66447), 0.38787 (0.38771), 0.24787 (0.24803), each +- 0.00014.
    """
    shapes, exact = FORM_FACTORS[kind]
    built = {}
    for name, (vertices, triangles) in shapes.items():
        if triangles is None:  # a fan about its first vertex
            n = np.arange(SEGMENTS)
            triangles = np.stack([0 * n, 1 + n, 1 + np.roll(n, -1)], axis=-1)
        built[name] = mesh(name, vertices, triangles, GREY)
    value, error, height = irradiance_at_origin(build(1.0, floor=FLOOR, **built))
    known = exact(height * UP)
    tolerance = 3 * error + 3e-5
    print(f"{kind}: {value:.5f} +- {error:.5f}, known {known:.5f}")
    assert tolerance < 0.005 * known
    assert abs(value - known) < tolerance

    figure = Figure(figsize=(4, 3))
    axes = figure.subplots()
    axes.errorbar([0], [value], [3 * error], fmt="o", capsize=4, label="ours, 3 standard errors")
    axes.axhline(known, color="k", lw=0.7, label="known")
    axes.set(title=kind, ylabel="irradiance / pi")
    axes.legend()
    artefact(figure)


@pytest.mark.usefixtures("no_held_out")
@pytest.mark.parametrize("angle", [20, pytest.param(45, marks=pytest.mark.slow), 70])
def test_a_cap_of_light_over_a_plane(angle, artefact):
    """Rationale: a plane under a cap of radiance 1 and half-angle a about its normal has irradiance pi sin²a.

    Here the cap is in the lighting: texels hold the share of their area inside of it. Texel basis, n = 4 to 32.

    Expected: the error is at most what the texels that the cap's edge cuts can hide: the sum over these of
    dω / pi times the range of the cosine in them. That bound is a matter of resolution, and it halves when n doubles.

    Result: errors are a small part of the bound (they average out along the edge).
    """
    scene = build(1.0, floor=FLOOR)
    known = np.sin(np.radians(angle)) ** 2
    resolutions, errors, bounds = (4, 8, 16, 32), [], []
    for n in resolutions:
        lighting = prt.CubemapLighting(n)
        directions, weights = lighting.subdirections(16)
        inside = directions[..., 1] > np.cos(np.radians(angle))
        share = (inside * weights).sum(axis=1) / weights.sum(axis=1)
        cosine = np.maximum(directions[..., 1], 0)
        cut = (share > 0) & (share < 1)
        bounds.append(float(((np.ptp(cosine, axis=1) * lighting.solid_angles)[cut]).sum() / np.pi))
        transport = prt.precompute(
            scene, lighting, method="brute_force", basis="texel", max_depth=2, strata=4, progress=False
        )
        L = np.repeat(share[:, None], 3, axis=1).astype(np.float32)
        errors.append(np.abs(transport.irradiance(L)[:, 0] - known).max())
    print(f"{angle} degrees: errors {np.round(errors, 5)}, bounds {np.round(bounds, 5)}")
    assert (np.array(errors) < bounds).all()
    assert (np.diff(np.log2(bounds)) < -0.8).all()
    assert errors[-1] < 0.02 * known

    figure = Figure(figsize=(4, 3))
    axes = figure.subplots()
    axes.loglog(resolutions, errors, "o-", label="worst vertex")
    axes.loglog(resolutions, bounds, "k--", label="bound")
    axes.set(xlabel="n", ylabel="error of irradiance / pi", title=f"cap of {angle} degrees")
    axes.legend()
    artefact(figure)


# ------------------------------------------------------------------------------------ interreflection


def test_an_integrating_sphere(artefact):
    """Rationale: inside a sphere every point sees every area alike, so interreflection has a closed form.

    A hollow sphere of albedo r, open in a cap that is the share f of its area, under constant light of radiance 1. A
    wall point sees the opening with irradiance / pi = f; each bounce keeps r (1 - f) of the light. Irradiance / pi is
    f (1 + q + ... + q^k), q = r (1 - f), for k interreflections: max_depth 2 + k, and f / (1 - q) without a limit.

    r = 0.8, opening of half-angle 60 degrees (f = 0.25), 48 x 24 facets, shading normals of the sphere. 40 wall
    vertices, texel basis at n = 2, 1024 paths per element.

    Expected: the mean over vertices within 3 standard errors and the tessellation: a chord of 48 lies (pi / 48)² / 2 =
    0.2% inside of the circle, areas and f are off by up to twice that, 0.4%. Together under 1%, so that a bias of 2%
    fails; a bounce too many or too few is 3% at least.

    Result: off by -0.3%, -0.1%, -0.1% and -0.3% (max_depth 2, 3, 5, -1), of which 0.2% is one standard error.
    """
    albedo, segments = 0.8, 48
    polar = np.radians(
        np.concatenate([[179], np.arange(172.5, 59, -7.5)])
    )  # from the bottom up to the opening
    rings = [ring(np.sin(a), np.cos(a), segments) for a in polar]
    vertices, triangles = surface(rings, inwards=True)
    bottom = len(vertices)
    vertices = np.concatenate([vertices, [[0, -1, 0]]])
    n = np.arange(segments)
    triangles = np.concatenate([triangles, np.stack([0 * n + bottom, np.roll(n, -1), n], axis=-1)])
    sphere = mesh("sphere", vertices, triangles, diffuse(*(albedo,) * 3))
    scene = build(float("inf"), sphere=sphere)
    assert ((scene.normals * scene.positions).sum(axis=1) < -0.99)[:-segments].all()  # inwards

    chosen = np.random.default_rng(0).choice(len(vertices) - 3 * segments, 40, replace=False)
    chosen = np.sort(chosen + 1)
    points, lighting = vertex_points(scene), prt.CubemapLighting(2)
    texels = np.tile(np.arange(24), 40)
    direct = DirectSolver(problem_at(scene, lighting, points, basis="texel"), 16)
    first = direct.elements(np.repeat(chosen, 24), texels).reshape(40, 24).sum(axis=1)
    f, q = 0.25, albedo * 0.75
    figure = Figure(figsize=(6, 3))
    axes = figure.subplots()
    for max_depth, known in (
        (2, f),
        (3, f * (1 + q)),
        (5, f * (1 + q + q**2 + q**3)),
        (-1, f / (1 - q)),
    ):
        path = PathSolver(problem_at(scene, lighting, points, basis="texel", max_depth=max_depth), 1024)
        estimate = path.rows(chosen)
        indirect = (estimate.mean[..., 0] * lighting.solid_angles).sum(axis=1)
        error = np.sqrt((estimate.variance[..., 0] * lighting.solid_angles**2).sum()) / 40
        value = float((first + indirect).mean())
        tolerance = 3 * error + 0.004 * known
        print(
            f"max_depth {max_depth}: {value:.5f} +- {error:.5f}, known {known:.5f} ({value / known - 1:+.3%})"
        )
        assert tolerance < 0.01 * known
        assert abs(value - known) < tolerance
        axes.plot(first + indirect, ".", label=f"max_depth {max_depth}")
        axes.axhline(known, color="k", lw=0.5)
    axes.set(xlabel="wall vertex", ylabel="irradiance / pi")
    axes.legend()
    artefact(figure)


@pytest.mark.slow  # of whole rows: test_three_solvers.py
def test_reciprocity_with_a_lamp_at_the_vertex(artefact):
    """Rationale: light takes a path in both directions alike (Helmholtz). What a vertex receives from direction w is
    what a lamp at the vertex sends out towards w.

    For a Lambertian lamp of radiance 1 and area A at x, the radiance that leaves the scene towards w, integrated over
    the image of an orthographic camera that looks along -w, is A pi times the (white) transport density T / dω from w
    to x. The lamp itself is hidden (`hide_emitters`); what is left is interreflected light. This is Mitsuba's `path`
    running the other way round, with other sampling: nothing is shared with our estimator but the scene.

    A lamp of edge 0.02 just over a ground vertex beside the ball; three directions of n = 2; max_depth 4. The ball is
    shaded flat: smooth shading normals are not reciprocal (Veach 1997, 5.3), and cost up to 12% here.

    Expected: equal within 3 standard errors of the two; together they are under 0.5%, so that 2% would be
    seen (checked).

    Result: together -0.25% +- 0.34%.
    """
    shapes = still_life(COLOURS)
    vertices, triangles = bumpy_ball()
    shapes["ball"] = mesh("ball", vertices + [-0.4, 0.7, 0], triangles, diffuse(*COLOURS[1]), smooth=False)
    scene, lighting = build(**shapes), prt.CubemapLighting(2)
    ground = np.arange(scene.meshes[0].vertices.stop)
    vertex = int(ground[np.argmin(np.linalg.norm(scene.positions[ground] - [-0.4, 0, 0.55], axis=1))])
    x = scene.normalised_positions[vertex].astype(np.float64)
    bright = [j for j in range(24) if lighting.directions[j, 1] > 0.3]
    path = PathSolver(problem_at(scene, lighting, max_depth=4), 1 << 16)
    estimate = path.elements(np.full(len(bright), vertex), np.array(bright))
    strongest = np.argsort(-estimate.mean.mean(axis=1))[:3]

    edge, height = 0.02, 1e-3
    lamp = {
        "type": "rectangle",
        "to_world": T().translate((x + [0, height, 0]).tolist()).rotate([1, 0, 0], -90).scale(edge / 2),
        "emitter": {"type": "area", "radiance": 1.0},
    }
    shapes = {f"shape_{k}": shape for k, shape in enumerate(scene.normalised.shapes())}
    integrator = mi.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
    radius, rows = 0.9, []  # the unit box fits into this disk from any side
    for k in strongest:
        w = lighting.directions[bright[k]].astype(np.float64)
        view = T().look_at(
            origin=(2 * w).tolist(), target=[0, 0, 0], up=np.eye(3)[np.argmin(np.abs(w))].tolist()
        )
        film = {
            "type": "hdrfilm",
            "width": 64,
            "height": 64,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
        }
        camera = {"type": "orthographic", "to_world": view @ T().scale([radius, radius, 1]), "film": film}
        lit = mi.load_dict({"type": "scene", "lamp": lamp, "camera": camera, **shapes})
        runs = [
            np.array(mi.render(lit, integrator=integrator, spp=256, seed=s)).mean(axis=(0, 1))[:3]
            for s in range(8)
        ]
        flux = (
            np.array(runs, np.float64) * (2 * radius) ** 2 / (edge**2 * np.pi)
        )  # [run, rgb], A pi taken out
        rows.append((flux.mean(axis=0), flux.std(axis=0, ddof=1) / np.sqrt(8)))

    theirs, theirs_error = (np.array([row[i] for row in rows]) for i in (0, 1))
    ours, ours_error = estimate.mean[strongest], np.sqrt(estimate.variance[strongest])
    error = np.hypot(ours_error, theirs_error)
    print(
        f"ratios {np.round(ours / theirs, 4).tolist()}, standard errors {np.round(error / theirs, 4).tolist()}"
    )
    together = np.sqrt((error**2).sum()) / theirs.sum()
    print(f"together {ours.sum() / theirs.sum() - 1:+.3%} +- {together:.3%}")
    assert together < 0.005
    assert (np.abs(ours - theirs) < 3 * error + 0.002 * theirs).all()
    assert abs(ours.sum() / theirs.sum() - 1) < 3 * together
    assert abs(1.02 * ours.sum() / theirs.sum() - 1) > 3 * together
    assert abs(0.98 * ours.sum() / theirs.sum() - 1) > 3 * together

    figure = Figure(figsize=(5, 3))
    axes = figure.subplots()
    for c, colour in enumerate("rgb"):
        axes.errorbar(
            np.arange(3) + 0.1 * c, (ours / theirs)[:, c], (3 * error / theirs)[:, c], fmt="o", color=colour
        )
    axes.axhline(1, color="k", lw=0.5)
    axes.set(xlabel="direction", ylabel="received / sent out", title="3 standard errors")
    artefact(figure)
