"""Indirect light, element by element, against Mitsuba's own `path`.

Mitsuba's indirect light is the difference of two renders with the same seed, at the wanted max_depth and at 2: their
direct parts use the same random numbers and cancel. Ours is evaluated at the sensor's own hits, so that nothing but
the estimators is compared. Standard errors are computed from samples on both sides.
"""

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
import pytest
from conftest import COLOURS, T, build, bumpy_ball, diffuse, mesh, problem_at, still_life
from matplotlib.figure import Figure
from scipy import stats

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.vertices import sensor_points, vertex_rays
from mi_sparse_prt.solvers import paths as path_module
from mi_sparse_prt.solvers.paths import PathSolver


@dataclass
class Comparison:
    """Our indirect elements and Mitsuba's, one channel, (rows, columns) float64, with their standard errors."""

    ours: np.ndarray
    theirs: np.ndarray
    ours_error: np.ndarray
    theirs_error: np.ndarray
    rounding: np.ndarray  # of the difference of two renders: float32 of the direct part

    @property
    def difference(self) -> np.ndarray:
        return self.ours - self.theirs

    @property
    def error(self) -> np.ndarray:
        return np.sqrt(self.ours_error**2 + self.theirs_error**2 + self.rounding**2)

    def scaled(self, factor: float) -> "Comparison":
        """The same with our side multiplied: a bias that a test must find."""
        return Comparison(factor * self.ours, self.theirs, self.ours_error, self.theirs_error, self.rounding)

    @property
    def relative_error(self) -> float:
        """Standard error of the sum of all elements, relative to it."""
        return float(np.sqrt((self.error**2).sum()) / self.theirs.sum())

    @property
    def total_z(self) -> float:
        return float(self.difference.sum() / np.sqrt((self.error**2).sum()))

    @property
    def z(self) -> np.ndarray:
        """z-scores of the elements whose samples are many enough to be normal: standard error under 15%."""
        known = self.error < 0.15 * np.maximum((self.ours + self.theirs) / 2, 0)
        return self.difference[known] / self.error[known]

    @property
    def row_z(self) -> np.ndarray:
        """z-scores of the sums of rows that are lit at all."""
        total, error = self.difference.sum(axis=1), np.sqrt((self.error**2).sum(axis=1))
        lit = self.theirs.sum(axis=1) > 3 * error
        return total[lit] / error[lit]


def compare(
    scene: prt.Scene,
    rows: np.ndarray,
    n: int,
    basis: str,
    max_depth: int,
    spp: int,
    reference: tuple[int, int],
) -> list[Comparison]:
    """Both sides of all columns of some rows, one item per channel (one in all if the scene is grey).

    ``reference``: number of independent estimates, and samples of each.
    """
    lighting, rays = prt.CubemapLighting(n), vertex_rays(scene.normalised, scene)
    shape = (len(rows), lighting.n_directions)
    vertex, texel = np.repeat(rows, shape[1]), np.tile(np.arange(shape[1]), shape[0])
    points, channels = sensor_points(scene, rays), 1 if scene.grey else 3
    path = PathSolver(problem_at(scene, lighting, points, basis=basis, max_depth=max_depth), spp, seed=1)
    estimate = path.elements(vertex, texel)
    direct, indirect = mitsuba_columns(scene, rays.take(rows), lighting, basis, max_depth, *reference)
    result = []
    for c in range(channels):
        scale = (scene.albedo[vertex, c] * lighting.solid_angles[texel]).astype(np.float64).reshape(shape)
        error = np.sqrt(estimate.variance[:, c].reshape(shape))
        theirs = indirect[..., c]  # [estimate, row, column]
        result.append(
            Comparison(
                ours=scale * estimate.mean[:, c].reshape(shape),
                theirs=theirs.mean(axis=0),
                ours_error=scale * error,
                theirs_error=theirs.std(axis=0, ddof=1) / np.sqrt(len(theirs)),
                rounding=1e-6 * direct[..., c],
            )
        )
    return result


def mitsuba_columns(scene, rays, lighting, basis, max_depth, estimates, spp) -> tuple[np.ndarray, np.ndarray]:
    """Mean direct part (rows, columns, 3), and each estimate's indirect part (estimates, rows, columns, 3).

    One render has all estimates of a column, each in pixels of its own.
    """
    light = {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}
    if basis == "texel":
        light = {"type": "cubemap", "resolution": lighting.resolution, "texel": 0}
    shapes = {f"shape_{k}": shape for k, shape in enumerate(scene.normalised.shapes())}
    lit = mi.load_dict({"type": "scene", "light": light, **shapes})
    parameters = mi.traverse(lit)
    whole, first = (mi.load_dict({"type": "path", "max_depth": depth}) for depth in (max_depth, 2))

    def sensor_of(times: int) -> mi.Sensor:
        sensor = mi.load_dict({"type": "mesh_vertices", "vertices": times * len(rays.origins)})
        sensor.bind(lit, rays.take(np.tile(np.arange(len(rays.origins)), times)))
        return sensor

    # one direction's direct light has no noise
    every, once = sensor_of(estimates), sensor_of(1 if basis == "direction" else estimates)

    def render(sensor: mi.Sensor, integrator: mi.Integrator, seed: int) -> np.ndarray:
        image = mi.render(lit, sensor=sensor, integrator=integrator, spp=spp, seed=seed)
        return sensor.radiance(image).astype(np.float64).reshape(-1, len(rays.origins), 3)

    direct = np.zeros((len(rays.origins), lighting.n_directions, 3))
    indirect = np.zeros((estimates, *direct.shape))
    for j, d in enumerate(lighting.directions.astype(np.float64)):
        if basis == "texel":
            parameters["light.texel"] = j
        else:
            across = np.eye(3)[np.argmin(np.abs(d))]
            parameters["light.to_world"] = mi.Transform4f().look_at([0, 0, 0], -d, across)
        parameters.update()
        weight = float(lighting.solid_angles[j]) if basis == "direction" else 1.0
        part = render(once, first, j)
        direct[:, j] = weight * part.mean(axis=0)
        indirect[:, :, j] = weight * (render(every, whole, j) - part)
    return direct, indirect


def draw(result: Comparison) -> Figure:
    """The distribution of z-scores, and the elements themselves."""
    figure = Figure(figsize=(11, 4))
    left, right = figure.subplots(1, 2)
    x = np.linspace(-4, 4, 200)
    left.hist(result.z, 40, range=(-4, 4), density=True, color="0.7", label=f"{len(result.z)} elements")
    left.hist(
        result.row_z, 20, range=(-4, 4), density=True, histtype="step", label=f"{len(result.row_z)} rows"
    )
    left.plot(x, stats.norm.pdf(x), "k", lw=1)
    left.set(
        xlabel="z", title=f"total z {result.total_z:+.2f}, its standard error {result.relative_error:.2%}"
    )
    left.legend()
    right.plot(result.theirs.ravel(), result.ours.ravel(), ".", ms=2)
    top = max(result.theirs.max(), 1e-9)
    right.plot([0, top], [0, top], "k", lw=0.5)
    right.set(xlabel="Mitsuba", ylabel="ours", title="indirect elements")
    return figure


def assert_unbiased(result: Comparison) -> None:
    """The mean over all elements agrees within 3 standard errors, and would not if one side were 2% brighter."""
    print(
        f"total z {result.total_z:+.2f}, standard error {result.relative_error:.3%}; {len(result.z)} elements: "
        f"{(np.abs(result.z) > 2).mean():.2%} beyond 2, {(np.abs(result.z) > 3).mean():.2%} beyond 3; "
        f"rows: KS p = {stats.kstest(result.row_z, 'norm').pvalue:.3f}"
    )
    assert abs(result.total_z) < 3
    assert abs(result.scaled(1.02).total_z) > 3
    assert abs(result.scaled(0.98).total_z) > 3


def assert_normal(result: Comparison) -> None:
    """z-scores of elements and of rows are distributed as N(0, 1), and would not be with a bias of 2%.

    Elements: the shares beyond 2 and 3 (4.55% and 0.27%, known to about 1% and 0.25% from 400 elements; Mitsuba's
    standard errors have 15 degrees of freedom, which makes the tails somewhat heavier) and their spread. Rows: a
    Kolmogorov-Smirnov test at p = 0.1%.
    """
    z = np.abs(result.z)
    assert len(z) > 250
    assert 0.02 < (z > 2).mean() < 0.09
    assert (z > 3).mean() < 0.015
    assert 0.9 < result.z.std() < 1.15
    assert stats.kstest(result.row_z, "norm").pvalue > 1e-3
    for factor in (1.02, 0.98):
        assert stats.kstest(result.scaled(factor).row_z, "norm").pvalue < 1e-3


@pytest.mark.slow  # in colour below
@pytest.mark.parametrize("max_depth", [3, 5])
def test_grey_scene(grey_scene, artefact, max_depth):
    """Rationale: one interreflection and three, in the direction basis, one channel for all.

    A ball and a box over a ground; every fourth vertex, 24 columns at n = 2; 2048 paths of ours against 16 x 64 of
    Mitsuba's `path`, whose directional emitter is found by shadow rays alone, as ours.

    Expected: the mean within 3 standard errors; z-scores of elements and rows standard normal; a 2% bias fails both.
    The two estimators are the same, so their variances per path agree within 10%.

    Result: at max_depth 5 total z -1.3 with a standard error of 0.3% of the total; 4.8% of elements beyond 2.
    """
    rows = np.arange(0, grey_scene.n_vertices, 4)
    (result,) = compare(grey_scene, rows, 2, "direction", max_depth, 2048, (16, 64))
    artefact(draw(result))
    assert_unbiased(result)
    assert_normal(result)
    variances = [2048 * (result.ours_error**2).sum(), 1024 * (result.theirs_error**2).sum()]
    assert 0.9 < variances[0] / variances[1] < 1.1


def test_coloured_scene(coloured_scene, artefact):
    """Rationale: colour comes from the surfaces that paths meet, channel by channel.

    The same scene with an orange ground, a blue ball and a green box; max_depth 5.

    Expected: as in the grey scene, in all three channels, which differ from each other by far more than their errors.

    Result: total z -0.9, -1.3, -1.3 with standard errors of 0.3%; 6% of elements beyond 2, 0.6% beyond 3.
    """
    rows = np.arange(0, coloured_scene.n_vertices, 4)
    channels = compare(coloured_scene, rows, 2, "direction", 5, 2048, (16, 64))
    for result, name in zip(channels, ("red", "green", "blue"), strict=True):
        artefact(draw(result), f"_{name}")
        assert_unbiased(result)
        assert_normal(result)
    totals = [result.ours.sum() for result in channels]
    assert max(totals) > 1.2 * min(totals)


@pytest.mark.slow  # test_three_solvers.py
def test_texel_basis(coloured_scene, artefact):
    """Rationale: in the texel basis paths see random directions of the texel; Mitsuba's cubemap emitter too.

    The coloured scene, max_depth 4, n = 2. Mitsuba adds paths that hit the light by chance (MIS), so variances differ.

    Expected: as in the direction basis.

    Result: total z +0.5 with a standard error of 0.3%; 7.6% of elements beyond 2, 0.8% beyond 3.
    """
    rows = np.arange(0, coloured_scene.n_vertices, 4)
    result = compare(coloured_scene, rows, 2, "texel", 4, 4096, (16, 96))[1]
    artefact(draw(result))
    assert_unbiased(result)
    assert_normal(result)


def room() -> prt.Scene:
    """A bright room, open in a third of one wall, with a ball in it: light is reflected many times."""

    def wall(place: mi.ScalarTransform4f) -> dict:
        return {"type": "rectangle", "to_world": place, "bsdf": diffuse(0.9, 0.9, 0.9)}

    vertices, triangles = bumpy_ball()
    return build(
        1.0,
        floor=wall(T().translate([0, -1, 0]).rotate([1, 0, 0], -90)),
        ceiling=wall(T().translate([0, 1, 0]).rotate([1, 0, 0], 90)),
        back=wall(T().translate([0, 0, -1])),
        left=wall(T().translate([-1, 0, 0]).rotate([0, 1, 0], 90)),
        right=wall(T().translate([1, 0, 0]).rotate([0, 1, 0], -90)),
        front=wall(T().translate([0, -1 / 3, 1]).rotate([0, 1, 0], 180).scale([1, 2 / 3, 1])),
        ball=mesh("ball", vertices + [0, -0.3, 0], triangles, diffuse(0.8, 0.8, 0.8)),
    )  # fmt: skip


@pytest.mark.slow
def test_without_a_depth_limit(artefact):
    """Rationale: max_depth -1 ends paths by Russian roulette alone, in a room of albedo 0.9 that is nearly closed.

    Every sixth vertex, 24 columns at n = 2, against Mitsuba's `path` without a limit. Depth 5 must be clearly darker,
    or the test would say nothing about long paths.

    Expected: the mean within 3 standard errors and a 2% bias caught; rows standard normal.

    Result: total z +0.9 with a standard error of 0.4%; max_depth 5 has 39% of the light.
    """
    scene = room()
    rows = np.arange(0, scene.n_vertices, 6)
    (result,) = compare(scene, rows, 2, "direction", -1, 2048, (4, 512))
    artefact(draw(result))
    assert_unbiased(result)
    assert stats.kstest(result.row_z, "norm").pvalue > 1e-3
    solver = PathSolver(problem_at(scene, prt.CubemapLighting(2), sensor_points(scene)), 256)
    mean = solver.rows(rows).mean[..., 0] * solver.lighting.solid_angles * scene.albedo[rows, :1]
    print(f"max_depth 5 has {mean.sum() / result.ours.sum():.1%} of the light")
    assert mean.sum() < 0.8 * result.ours.sum()


def glossy_scene() -> prt.Scene:
    """A diffuse ground among a glass ball, a tilted mirror box, rough metal, milky glass and a half-open mask."""
    shapes = still_life(COLOURS)
    vertices, triangles = bumpy_ball()
    mirror = {"type": "conductor", "specular_reflectance": {"type": "rgb", "value": [0.9, 0.8, 0.7]}}
    sheet = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided", "bsdf": diffuse(0.8, 0.8, 0.8)}}
    return build(
        0.5,
        ground=shapes["ground"],
        glass=mesh("glass", vertices + [-0.4, 0.7, 0], triangles, {"type": "dielectric"}),
        box={**shapes["box"], "bsdf": mirror},
        metal=mesh(
            "metal", 0.4 * vertices + [0.3, 0.3, 0.9], triangles, {"type": "roughconductor", "alpha": 0.3}
        ),
        milk=mesh(
            "milk", 0.4 * vertices + [-0.7, 0.3, 1], triangles, {"type": "roughdielectric", "alpha": 0.2}
        ),
        sheet={"type": "rectangle", "to_world": T().translate([0.3, 0.9, -0.9]).scale(0.4), "bsdf": sheet},
    )


@pytest.mark.slow  # test_three_solvers.py and test_specular.py
@pytest.mark.filterwarnings("ignore:.*is not diffuse")
def test_paths_that_meet_glass_metal_and_mirrors(artefact, monkeypatch):
    """Rationale: paths may meet any BSDF, and light that a mirror or glass focuses is found by no shadow ray.

    A diffuse ground among a glass ball, a mirror box, rough metal, milky glass and a mask of half opacity; every third
    ground vertex; texel basis at n = 1 (large lights, so that Mitsuba finds them through glass as well), max_depth 5.

    Expected: the mean of each channel within 3 standard errors and a 2% bias caught; rows standard normal. Without the
    paths that see the light in mirrors and through glass, most of it is missing (checked: the test can fail there).

    Result: total z 0.0 in all channels with a standard error of 0.4%; without those paths 19% of the light is left.
    """
    scene = glossy_scene()
    rows = np.arange(0, scene.meshes[0].vertices.stop, 3)
    channels = compare(scene, rows, 1, "texel", 5, 1 << 15, (16, 960))
    for result, name in zip(channels, ("red", "green", "blue"), strict=True):
        artefact(draw(result), f"_{name}")
        assert_unbiased(result)
        assert stats.kstest(result.row_z, "norm").pvalue > 1e-3

    monkeypatch.setattr(path_module, "has_mirrors", lambda _: False)
    lighting = prt.CubemapLighting(1)
    blind = PathSolver(problem_at(scene, lighting, sensor_points(scene), basis="texel"), 4096).rows(rows)
    found = (blind.mean[..., 2] * scene.albedo[rows, 2, None] * lighting.solid_angles).sum()
    print(f"without mirror paths {found / result.theirs.sum():.1%} of the indirect light")
    assert found < 0.5 * result.theirs.sum()
