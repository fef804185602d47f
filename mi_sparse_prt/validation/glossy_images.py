"""Is a relit image of glossy surfaces right, and if not, why? Against ``path``, one cause at a time.

From Mitsuba's image of the real BSDFs to ours there are three steps, each between two images that differ in one thing:

* ``factorization``: the real BSDFs become their in-out factors (BSDF `in_out_factors`), ``path`` renders both;
* ``lighting``: texels become directional lights at their centres, ``path`` renders both;
* ``transport``: ``path`` becomes the transport, with what it interpolates between vertices, finite elements, low rank.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.metrics import flip_map, relative_l2_without_noise, relative_noise
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.emission.cube_faces import face_coordinates, face_direction, texel_at
from mi_sparse_prt.emission.environment import Environment
from mi_sparse_prt.plugins.cubemap import CubemapEmitter
from mi_sparse_prt.plugins.in_out_factors import factored_bsdf
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.relighting.image import background_emitter, render
from mi_sparse_prt.scene.mitsuba_meshes import lit_scene
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.scene.shape_table import ShapeTable
from mi_sparse_prt.transport import LightTransport
from mi_sparse_prt.validation.mitsuba_reference import posed
from mi_sparse_prt.validation.validate import Validation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TURNS = (0, 60, -60)  # degrees, of the scene's own camera
MOST_BOUNCES = 64  # where there is no limit: no Russian roulette, which ends paths of negative weight
SMOOTH = 0.98  # length of the mean normal of WINDOW x WINDOW pixels of a smooth surface
WINDOW = 7  # pixels: reach of BLUR and of a film's filter to either side
SHADOWS = 0.1  # share of the smooth pixels whose shadow changes most
BLUR = 1.0  # pixels, of shadows: their noise is no edge
LANES = 1 << 24  # cosines at a time

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Halves = tuple[Image, Image]  # two images that differ in their noise

PATHS = ("real", "factored", "directions")  # what `path` renders
# what differs in two images: (image, what it is compared with)
CAUSES = {
    "total": ("ours", "real"),
    "factorization": ("factored", "real"),
    "lighting": ("directions", "factored"),
    "transport": ("ours", "directions"),
}


class GlossyValidation(Validation):
    """Outcome of ``validate_glossy``.

    Attributes
    ----------
    report : dict
        JSON as it is. ``images``: for each, ``environment``, ``camera`` (its number and, by default, the degrees by
        which it is turned), ``pixels`` (shares of the image), ``noise`` (relative L2 of the reference, FLIP between its
        halves), and for each region (``image``, ``glossy``, ``thin_shadows``) and cause (``total``, ``factorization``,
        ``lighting``, ``transport``) ``relative_l2``, its ``uncertainty`` (what noise alone may show) and ``flip``. A
        region without pixels is missing. ``worst``: the largest relative L2 of each cause in each region.
        ``parameters``.
    figures : dict of matplotlib Figure
        One for each image, ``<environment>_<camera>``.
    """


def validate_glossy(
    scene: Scene,
    transport: LightTransport,
    environments: Mapping[str, Environment | mi.Emitter | ArrayLike] | None = None,
    sensors: Sequence[mi.Sensor] | None = None,
    spp: int = 256,
    width: int = 320,
    run: Run | None = None,
) -> GlossyValidation:
    """Compare relit images of a glossy scene with Mitsuba's ``path``, cause by cause.

    Parameters
    ----------
    scene : Scene
        The scene of the transport.
    transport : LightTransport
    environments : mapping of names to environments, emitters or texel radiances (n_directions, 3), optional
        All are projected to the transport's lighting first, for all images. Default: the scene's own.
    sensors : sequence of mi.Sensor, optional
        Default: the scene's first, and the same turned by 60 and by -60 degrees about the world's Y axis (Mitsuba's
        upwards) through the scene's centre.
    spp : int
        Samples per pixel of each image, in two halves.
    width : int
        Of images, pixels; sensors keep their films' shape, and get their own size back.
    run : Run, optional
        Its seed, and whether a progress bar is shown.

    Returns
    -------
    GlossyValidation

    Raises
    ------
    PrtError
        If there is no environment or no sensor, ``spp`` is below 2, or the transport belongs to another scene.

    Notes
    -----
    Errors are relative to the second image of each pair, root of (A - B)(A' - B') / (B B') summed over all values,
    where A and A' are halves with independent noise: noise makes the relative L2 uncertain, but not larger. FLIP is of
    the means of halves (negative values as 0), and noise does make it larger.

    Thin shadows are the tenth of the pixels on smooth surfaces where the share of direct light that is not shadowed (of
    all that is in front of the surface, whatever its BSDF) changes most from pixel to pixel.
    """
    run = run or Run()
    if spp < 2:
        raise PrtError(f"validate_glossy: spp is {spp}; give at least 2, for two halves")
    transport = transport.for_scene(scene)
    own, views = scene.mitsuba.environment(), _views(scene, sensors)
    if environments is None:
        if own is None:
            raise PrtError("validate_glossy: the scene has no environment emitter; give environments")
        environments = {"scene": own}
    images, figures = [], {}
    with tqdm(
        total=len(environments) * len(views), desc="images", unit=" images", disable=not run.progress
    ) as bar:
        for i, (name, environment) in enumerate(environments.items()):
            radiance = transport.lighting.project(environment)
            references = _References(scene, transport, radiance)
            for j, (sensor, turn) in enumerate(views):
                with posed(sensor, width, turn, scene.centre):
                    regions = references.regions(sensor, spp, _seed(run.seed, i, j, 99))
                    rendered = references.rendered(sensor, spp, (run.seed, i, j))
                camera = {"number": j} if sensors else {"number": j, "turned": turn}
                entry, figure = _compared(rendered, regions)
                images.append({"environment": name, "camera": camera, **entry})
                figures[f"{name}_{j}"] = figure
                bar.update()
    report = {
        "images": images,
        "worst": _worst(images),
        "parameters": {"spp": spp, "width": width, "seed": run.seed} | transport.report.get("parameters", {}),
    }
    return GlossyValidation(report, figures)


def _views(scene: Scene, sensors: Sequence[mi.Sensor] | None) -> list[tuple[mi.Sensor, int]]:
    """Sensors and the degrees by which they are turned."""
    if sensors is not None:
        return [(sensor, 0) for sensor in sensors]
    if not scene.mitsuba.sensors():
        raise PrtError("validate_glossy: the scene has no sensor; give sensors")
    return [(scene.mitsuba.sensors()[0], turn) for turn in TURNS]


def _seed(*numbers: int) -> int:
    """One for each image, all unlike."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


class DirectionLights(CubemapEmitter):
    """One directional light at each texel's centre, of the texel's power: the direction basis, for ``path``.

    Rays that leave the scene see nothing of it.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.m_flags = mi.EmitterFlags.Infinite | mi.EmitterFlags.DeltaDirection
        self._areas = mi.Float(self._solid_angles)

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Color3f:
        return mi.Color3f(0)

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Color3f]:
        ds, _ = super().sample_direction(it, sample, active)
        n = self.resolution
        texel = texel_at(*face_coordinates(ds.d), n)
        face, within = texel // (n * n), texel % (n * n)
        s, t = ((2 * mi.Float(x) + 1) / n - 1 for x in (within % n, within // n))
        ds.d = face_direction(face, s, t)
        ds.n = -ds.d
        ds.p = it.p + ds.d * ds.dist
        ds.delta = True
        # the density of the texel's square in face coordinates is the same all over it
        ds.pdf = dr.gather(mi.Float, self._density, texel, active) * (2 / n) ** 2
        power = self._radiance_of(texel, active) * dr.gather(mi.Float, self._areas, texel, active)
        return ds, dr.select(active & (ds.pdf > 0), power / ds.pdf, 0)

    def pdf_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True
    ) -> mi.Float:
        return mi.Float(0)

    def eval_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True
    ) -> mi.Color3f:
        return mi.Color3f(0)


class _References:
    """A scene under one lighting as Mitsuba and as the transport see it."""

    def __init__(self, scene: Scene, transport: LightTransport, radiance: NDArray[np.float32]) -> None:
        self._scene, self._transport, self._radiance = scene, transport, radiance
        n, shapes = transport.lighting.resolution, scene.unlit_shapes()
        sky = background_emitter(radiance, transport.lighting)
        lights = mi.Properties("cubemap")
        lights["data"], lights["resolution"] = mi.TensorXf(radiance.reshape(6, n, n, 3)), n
        factored = _factored_shapes(scene, transport, shapes)
        unit_albedo = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}})
        self._lit = {
            "real": lit_scene(shapes, sky),
            "factored": lit_scene(factored, sky),
            "directions": lit_scene(factored, DirectionLights(lights)),
            "diffuse": lit_scene([with_bsdf(shape, unit_albedo) for shape in shapes], sky),
        }
        self._depth = MOST_BOUNCES if transport.max_depth < 0 else transport.max_depth

    def rendered(
        self, sensor: mi.Sensor, spp: int, seeds: tuple[int, ...], paths: Sequence[str] = PATHS
    ) -> dict[str, Halves]:
        """``ours``, and what Mitsuba's ``path`` makes of the scene in its several forms."""
        halves: list[dict[str, Image]] = []
        for k in (0, 1):
            # the same numbers for all: noise that two images have in common is not in their difference
            own = _seed(*seeds, k)
            one = {name: self._path(name, sensor, self._depth, spp // 2, own) for name in paths}
            one["directions"] += self._path("diffuse", sensor, 1, spp // 2, own)  # the sky
            one["ours"] = render(self._scene, self._transport, self._radiance, sensor, spp // 2, own)
            halves.append(one)
        return {name: (halves[0][name], halves[1][name]) for name in halves[0]}

    def regions(self, sensor: mi.Sensor, spp: int, seed: int) -> dict[str, Mask]:
        """Pixels (height, width) of the whole image, on glossy surfaces, and in thin shadows."""
        shape, normal = self._seen(sensor)
        image = np.ones(shape.shape, bool)
        found = _surfaces(self._transport).material[[mesh.vertices.start for mesh in self._scene.fronts]] >= 0
        glossy = np.append(found, False)[shape]  # -1: none
        light = self._path("diffuse", sensor, 2, 4 * spp, seed).mean(axis=2)
        unshadowed = self._unshadowed(normal.reshape(-1, 3)).reshape(shape.shape)
        lit = light / np.maximum(unshadowed, 1e-3 * max(float(unshadowed.max()), 1e-20))
        return {"image": image, "glossy": glossy, "thin_shadows": thin_shadows(lit, shape, normal)}

    def _unshadowed(self, normals: Image) -> NDArray[np.float32]:
        """Irradiance / pi (m,) of points with normals (m, 3), nothing being in the way."""
        lighting = self._transport.lighting
        power = self._radiance.mean(axis=1) * lighting.solid_angles / np.float32(np.pi)
        step = max(1, LANES // lighting.n_directions)
        parts = [
            np.maximum(normals[a : a + step] @ lighting.directions.T, 0) @ power
            for a in range(0, len(normals), step)
        ]
        return np.concatenate(parts)

    def _path(self, name: str, sensor: mi.Sensor, max_depth: int, spp: int, seed: int) -> Image:
        path = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": MOST_BOUNCES + 1})
        rendered = mi.render(self._lit[name], sensor=sensor, integrator=path, spp=spp, seed=seed)
        return np.array(rendered)[..., :3]

    def _seen(self, sensor: mi.Sensor) -> tuple[NDArray[np.int64], Image]:
        """Number of the mesh (height, width), -1 for none, and normal (height, width, 3) at pixels' centres."""
        width, height = sensor.film().crop_size()
        x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
        place = mi.Point2f(np.stack([x.ravel(), y.ravel()]).astype(np.float32))
        ray, _ = sensor.sample_ray(mi.Float(0), mi.Float(0.5), place, mi.Point2f(0.5))
        si = self._scene.mitsuba.ray_intersect(ray)
        table = ShapeTable([self._scene.mitsuba], np.arange(len(self._scene.fronts)))
        number = table.gather(si.shape, si.is_valid()).numpy()
        shape = np.where(si.is_valid().numpy(), number.astype(np.int64), -1)
        return shape.reshape(height, width), np.array(si.sh_frame.n).T.reshape(height, width, 3)


def thin_shadows(lit: Image, shape: NDArray[np.integer], normal: Image) -> Mask:
    """Pixels on smooth surfaces where shadows change most.

    Parameters
    ----------
    lit : (height, width) float
        Share of the light that is not shadowed, 0 to 1.
    shape : (height, width) integers
        What pixels see, -1 for nothing.
    normal : (height, width, 3) float
    """
    from scipy import ndimage

    alike = ndimage.minimum_filter(shape, WINDOW) == ndimage.maximum_filter(shape, WINDOW)
    mean = ndimage.uniform_filter(normal, (WINDOW, WINDOW, 0))
    smooth: Mask = alike & (shape >= 0) & (np.linalg.norm(mean, axis=2) > SMOOTH)
    if not smooth.any():
        return smooth
    change = ndimage.gaussian_gradient_magnitude(lit, BLUR, truncate=2)
    found: Mask = smooth & (change > 0) & (change >= np.quantile(change[smooth], 1 - SHADOWS))
    return found


def _surfaces(transport: LightTransport) -> InOutFactors:
    assert isinstance(transport.reflection, InOutFactors)
    return transport.reflection


def _factored_shapes(scene: Scene, transport: LightTransport, shapes: list[mi.Mesh]) -> list[mi.Mesh]:
    """The meshes with the glossy BSDFs replaced by the transport's factors of them."""
    found, surfaces = [], _surfaces(transport)
    for shape, mesh, own in zip(shapes, scene.fronts, scene.materials, strict=False):
        number = int(surfaces.material[mesh.vertices.start])
        if number >= 0:
            shape = with_bsdf(shape, factored_bsdf(surfaces.factors[number], own.bsdf), own.two_sided)
        found.append(shape)
    return found


def with_bsdf(mesh: mi.Mesh, bsdf: mi.BSDF, two_sided: bool = False) -> mi.Mesh:
    """A copy with another BSDF and the same vertices, normals and texture coordinates."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": bsdf}) if two_sided else bsdf
    textured = mesh.has_vertex_texcoords()
    copy = mi.Mesh(
        mesh.id(),
        mesh.vertex_count(),
        mesh.face_count(),
        props=properties,
        has_vertex_normals=True,
        has_vertex_texcoords=textured,
    )
    theirs, ours = mi.traverse(mesh), mi.traverse(copy)
    for key in ("faces", "vertex_positions", *(["vertex_texcoords"] if textured else [])):
        ours[key] = theirs[key]
    ours.update()
    ours["vertex_normals"] = theirs["vertex_normals"]  # Mitsuba makes its own whenever positions change
    ours.update()
    return copy


def _compared(rendered: dict[str, Halves], regions: dict[str, Mask]) -> tuple[dict[str, Any], Figure]:
    """Errors of each cause in each region, and the picture of them."""
    means = {name: ((a + b) / 2).astype(np.float32) for name, (a, b) in rendered.items()}
    flips = {cause: flip_map(means[b], means[a]) for cause, (a, b) in CAUSES.items()}
    first, second = rendered["real"]
    entry: dict[str, Any] = {
        "pixels": {name: float(mask.mean()) for name, mask in regions.items()},
        "noise": {
            "relative_l2": relative_noise(first, second),
            "flip_between_halves": float(flip_map(first, second).mean()),
        },
    }
    for name, mask in regions.items():
        if mask.any():
            entry[name] = {
                cause: _errors(rendered[a], rendered[b], flips[cause], mask)
                for cause, (a, b) in CAUSES.items()
            }
    return entry, _figure(means, regions, entry)


def _errors(ours: Halves, reference: Halves, flip: Image, mask: Mask) -> dict[str, float]:
    (a, b), (x, y) = ([half[mask] for half in pair] for pair in (ours, reference))
    error, uncertainty = relative_l2_without_noise(a, x, y, b)
    return {"relative_l2": error, "uncertainty": uncertainty, "flip": float(flip[mask].mean())}


def _worst(images: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    return {
        region: {
            cause: max(image[region][cause]["relative_l2"] for image in images if region in image)
            for cause in CAUSES
        }
        for region in ("image", "glossy", "thin_shadows")
        if any(region in image for image in images)
    }


def _figure(means: dict[str, Image], regions: dict[str, Mask], entry: dict[str, Any]) -> Figure:
    """Ours, Mitsuba's, Mitsuba's with factors; below them the differences ([HR10] Figures 17 to 19)."""
    from matplotlib.figure import Figure

    from mi_sparse_prt.validation.matrix_figures import tonemapped

    shown = {"ours": "ours, relit", "real": "Mitsuba path", "factored": "Mitsuba path, factored BRDFs"}
    # one tone curve for all three, so that they can be compared
    toned = np.split(tonemapped(np.concatenate([means[name] for name in shown], axis=1)), 3, axis=1)
    marked = 0.3 + 0.7 * toned[1].mean(axis=2, keepdims=True).repeat(3, axis=2)
    for region, colour in (("glossy", (1.0, 0.8, 0.4)), ("thin_shadows", (1.0, 0.0, 0.4))):
        marked[regions[region]] *= colour
    height, width = means["real"].shape[:2]
    figure = Figure(figsize=(17, 1.6 + 7 * height / width), layout="constrained")
    above, below = figure.subplots(2, 4)
    titles = (*shown.values(), "glossy (yellow), thin shadows (red)")
    for axes, picture, title in zip(above, (*toned, marked), titles, strict=True):
        axes.imshow(np.clip(picture, 0, 1))
        axes.set_title(title, fontsize=10)
    scale = max(float(np.abs(means["real"]).mean()), 1e-20)
    for axes, (cause, (a, b)) in zip(below, CAUSES.items(), strict=True):
        difference = (means[a] - means[b]) / scale
        largest = np.abs(difference).argmax(axis=2, keepdims=True)  # a channel: others may make up for it
        signed = np.take_along_axis(difference, largest, axis=2)[..., 0]
        drawn = axes.imshow(signed, vmin=-0.5, vmax=0.5, cmap="RdBu_r")
        errors = [
            f"{r.replace('_', ' ')} {entry[r][cause]['relative_l2']:.1%}" for r in regions if r in entry
        ]
        axes.set_title(f"{cause}, relative L2\n{', '.join(errors)}", fontsize=10)
    for axes in (*above, *below):
        axes.axis("off")
    figure.colorbar(drawn, ax=below, shrink=0.9, label="largest difference / mean of Mitsuba's")
    return figure
