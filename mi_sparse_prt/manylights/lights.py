"""A Mitsuba scene's light as many point lights and directions ([HPB07] 4; Keller, "Instant Radiosity", 1997)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.morton import morton_order
from mi_sparse_prt.core.random_keys import random_generator
from mi_sparse_prt.emission.emitters import named_emitters
from mi_sparse_prt.manylights.light_arrays import (
    COSINE,
    DIRECTION,
    EMITTER,
    SURFACE,
    LightArrays,
    LightKinds,
    joined,
    no_lights,
)
from mi_sparse_prt.manylights.particles import next_2d, reflected_lights, trace_particles
from mi_sparse_prt.manylights.surfaces import Surfaces

AREA, SUN = "AreaLight", "SunskyEmitter"
SUN_RADIUS = np.deg2rad(1.0)  # around the brightest direction: a sun and its rim
NEAR = 0.1  # radii of the scene, at which surfaces that face each other have the largest geometry term
PLACED = ("PointLight", "SpotLight", "Projector", "DirectionalEmitter")  # a light each, as they are
NONE = 0xFFFFFFFF
FEWEST = 16  # lights of an area lamp, however dim
PILOT = 1 << 12  # rays that tell how bright emitters are, and particles that tell how often they land
_POWER, _DIRECTIONS, _PILOT, _PARTICLES, _AREAS = range(5)  # of random numbers

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Longs = NDArray[np.int64]


@dataclass(frozen=True)
class LightOptions:
    """How many lights stand for a scene's light.

    Attributes
    ----------
    count : int
        Lights in all, about.
    indirect : float
        Share of these that stand for reflected light, where there is any and ``max_depth`` lets it be.
    max_depth : int
        As ``path`` counts: 2 is direct light, 3 one reflection more; -1 for no limit but Russian roulette.
    clamp : float, optional
        Largest geometry term (cos cos / distance^2, in 1 / unit^2) of indirect lights, with glossy reflection counted
        in as far as it is more than that of white diffuse surfaces; inf for none. By default that of
        two surfaces that face each other at a tenth of the radius of the scene's bounding sphere.
    seed : int
    """

    count: int = 100_000
    indirect: float = 0.5
    max_depth: int = 5
    clamp: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.count < 1:
            raise PrtError(f"{self.count} lights: give 1 or more")
        if not 0 <= self.indirect <= 1:
            raise PrtError(f"the share of indirect lights is {self.indirect}: give 0 to 1")
        if self.max_depth < 2 and self.max_depth != -1:
            raise PrtError(f"max_depth is {self.max_depth}: give 2 (direct light) or more, or -1")
        if self.clamp is not None and not self.clamp > 0:
            raise PrtError(f"clamp is {self.clamp}: give a number above 0, inf for none")


class Lights:
    """Lights of a scene: the columns of the matrix.

    Parameters
    ----------
    arrays : LightArrays
        On the device, in an order in which neighbours are near each other.
    glossy : SurfaceInteraction3f or None
        Of the lights whose BSDF has to be asked.
    group : (n,) int32
        Which emitter of the scene each light descends from.
    names : sequence of str
        Of the emitters.
    clamp : float
        See ``LightOptions``.
    radius : float
        Of the scene's bounding sphere.
    identity : (n,) int64
        Names each light by the random numbers that made it: with the same seed and ``LightCounts``, a light is where it
        was before, or near there, when the scene has changed a little.
    """

    def __init__(
        self,
        arrays: LightArrays,
        glossy: mi.SurfaceInteraction3f | None,
        group: NDArray[np.int32],
        names: Sequence[str],
        clamp: float,
        radius: float,
        identity: Longs,
    ) -> None:
        self.arrays, self.group, self.names, self.clamp = arrays, group, tuple(names), clamp
        self.radius, self.identity = radius, identity
        self.kinds = LightKinds(bool(dr.any(arrays.kind == EMITTER)) if len(group) else False, glossy)

    def __len__(self) -> int:
        return len(self.group)

    def take(self, ids: NDArray[np.integer]) -> LightArrays:
        """Some lights on the device."""
        return self.arrays.take(on_device(mi.UInt32, np.asarray(ids, np.uint32)))

    def named(self, identity: Longs, group: NDArray[np.int32]) -> Lights:
        """Lights by their identities (k,), and the emitters of these; those that are not among these are dark."""
        order = np.argsort(self.identity)
        names = np.append(self.identity[order], -1)  # no light's: one there is at least
        place = np.searchsorted(names[:-1], identity)
        ids, here = np.append(order, 0)[place], names[place] == identity
        arrays = self.arrays.take(on_device(mi.UInt32, ids.astype(np.uint32)), on_device(mi.Mask, here))
        dr.eval(arrays)
        return Lights(arrays, self.kinds.surfaces, group, self.names, self.clamp, self.radius, identity)

    @cached_property
    def flux(self) -> Doubles:
        """Radiant flux (n,) that each light sends out, mean of the channels; of a direction, into the scene."""
        angle = {DIRECTION: np.pi * self.radius**2, COSINE: np.pi, EMITTER: 4 * np.pi, SURFACE: 1.0}
        scale = np.array([angle[kind] for kind in sorted(angle)])
        power = self.arrays.power.numpy().mean(axis=0, dtype=np.float64)
        return np.asarray(power * scale[self.arrays.kind.numpy()])

    def name(self, light: int) -> str:
        """What a light is, for messages."""
        reflected = int(self.arrays.depth.numpy()[light]) > 2
        return f"light {light} of emitter '{self.names[self.group[light]]}'" + (
            " (reflected)" if reflected else ""
        )

    def counts(self) -> dict[str, dict[str, int]]:
        """Direct and indirect lights of each emitter; ``named`` ones that are dark are not counted."""
        depth = self.arrays.depth.numpy()
        return {
            name: {
                "direct": int(((self.group == k) & (depth == 2)).sum()),
                "indirect": int(((self.group == k) & (depth > 2)).sum()),
            }
            for k, name in enumerate(self.names)
        }


class LightCounts(NamedTuple):
    """How many lights each emitter has.

    Attributes
    ----------
    power : (emitters,) float64
        Radiant flux into the scene: lights and particles are shared out by it.
    sky : int
        Directions that stand for the environment, those of its sun counted in.
    particles : int
    clamp : float
        See ``LightOptions``.
    """

    power: Doubles
    sky: int
    particles: int
    clamp: float


class _Part(NamedTuple):
    """Some lights, interactions of those on glossy surfaces, the emitter that each descends from, and its identity."""

    arrays: LightArrays
    glossy: mi.SurfaceInteraction3f | None
    group: NDArray[np.int32]
    identity: Longs


class _Source:
    """The emitters of a scene, and the sphere around what they shine at."""

    def __init__(self, scene: mi.Scene) -> None:
        self.scene, self.emitters, self.surfaces = scene, list(scene.emitters()), Surfaces(scene)
        numbers = named_emitters(scene, [shape.id() for shape in scene.shapes()])
        self.names = sorted(numbers, key=lambda name: numbers[name])
        self._refuse_others()
        box = scene.bbox()
        sphere = box.bounding_sphere() if box.valid() else None
        self.centre = mi.Point3f(sphere.center if sphere else 0)
        self.radius = float(sphere.radius) if sphere else 0.0
        self.environment = next((k for k, e in enumerate(self.emitters) if e.is_environment()), -1)
        kinds = [emitter.class_name() for emitter in self.emitters]
        self.areas = [k for k, kind in enumerate(kinds) if kind == AREA]
        self.placed = [k for k, kind in enumerate(kinds) if kind in PLACED]

    def _refuse_others(self) -> None:
        for emitter, name in zip(self.emitters, self.names, strict=True):
            kind = emitter.class_name()
            if not (emitter.is_environment() or kind == AREA or kind in PLACED):
                raise PrtError(
                    f"emitter '{name}' is of type {kind}, of which no lights are made: use area, envmap, constant, "
                    "sunsky, cubemap, point, spot, projector or directional"
                )
        for thing in (*self.emitters, *self.scene.sensors()):
            if thing.get_medium() is not None:
                raise PrtError(
                    f"'{thing.id()}' is in a medium: many lights know none; remove it, or use volpath"
                )

    def pointers(self, numbers: NDArray[np.integer]) -> mi.EmitterPtr:
        """Emitters by their numbers."""
        index = on_device(mi.UInt32, np.asarray(numbers, np.uint32))
        return dr.gather(mi.EmitterPtr, self.scene.emitters_dr(), index)

    def directions(self, uv: mi.Point2f) -> tuple[mi.Vector3f, mi.Color3f, mi.Float]:
        """Directions towards the environment, its radiance over their density, whose mean is irradiance, and that."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
        si.p = self.centre
        found, weight = self.emitters[self.environment].sample_direction(si, uv)
        even = dr.zeros(mi.Float, dr.width(uv))  # numbers may be the same everywhere
        return found.d, mi.Color3f(weight) + even, found.pdf + even

    def rays(self, number: mi.UInt32, rng: mi.PCG32) -> tuple[mi.Ray3f, mi.Color3f]:
        """Rays that emitters send out, and their flux over the density; those of an environment fill the sphere."""
        far = number == (self.environment if self.environment >= 0 else NONE)
        pointer = dr.gather(mi.EmitterPtr, self.scene.emitters_dr(), number)
        u, place, direction = rng.next_float32(), next_2d(rng), next_2d(rng)
        ray, flux = pointer.sample_ray(mi.Float(0), u, place, direction, ~far)
        if self.environment < 0:
            return mi.Ray3f(ray), mi.Color3f(flux) + dr.zeros(mi.Color3f, dr.width(number))
        towards, irradiance, _ = self.directions(direction)
        across = mi.warp.square_to_uniform_disk_concentric(place) * self.radius
        frame = mi.Frame3f(towards)
        origin = self.centre + frame.s * across.x + frame.t * across.y + towards * self.radius
        own = mi.Ray3f(origin, -towards)
        return dr.select(far, own, mi.Ray3f(ray)), dr.select(
            far, irradiance * (dr.pi * self.radius**2), mi.Color3f(flux)
        )


def scene_lights(
    scene: mi.Scene,
    options: LightOptions = LightOptions(),  # noqa: B008
    counts: LightCounts | None = None,
) -> Lights:
    """Turn all light of a scene into point lights and directions.

    Area lamps become stratified points that send out light by the cosine; environments (``envmap``, ``constant``,
    ``sunsky``, ``cubemap``) stratified directions, a sun one of its own; ``point``, ``spot``, ``projector`` and
    ``directional`` stay what they are. Where particles from these land, lights stand for what the surface reflects.

    Parameters
    ----------
    scene : mi.Scene
        World units.
    options : LightOptions
    counts : LightCounts, optional
        Those of ``count_lights`` for this scene, if not given; or for how it was in another frame.

    Returns
    -------
    Lights
        None, if the scene is dark.

    Raises
    ------
    PrtError
        An emitter of another kind, a medium, or light that is not finite.
    """
    source = _Source(scene)
    counts = counts or _counts(source, options)
    share, seed = _shares(source, counts.power, options), options.seed
    parts = [_distant(source, counts.sky, seed), _placed(source, counts.power)]
    parts += [_area(source, k, max(FEWEST, round(share[k])), seed) for k in source.areas if k in share]
    if counts.particles:
        parts += _landed(source, counts.power, counts.particles, options, _PARTICLES)
    return _together([part for part in parts if len(part.group)], source, counts.clamp)


def count_lights(scene: mi.Scene, options: LightOptions = LightOptions()) -> LightCounts:  # noqa: B008
    """How many lights ``scene_lights`` gives each emitter.

    Raises
    ------
    PrtError
        As ``scene_lights``.
    """
    return _counts(_Source(scene), options)


def mean_counts(counts: Sequence[LightCounts]) -> LightCounts:
    """The mean of several frames."""
    power, sky, particles, clamp = (np.mean(column, axis=0) for column in zip(*counts, strict=True))
    return LightCounts(power, round(sky), round(particles), float(clamp))


def _counts(source: _Source, options: LightOptions) -> LightCounts:
    power = _powers(source, options.seed)
    sky = round(_shares(source, power, options).get(source.environment, 0))
    indirect = options.count - _direct(source, power, options)
    particles = _particles(source, power, indirect, options) if indirect > 0 else 0
    clamp = options.clamp
    if clamp is None:
        clamp = 1 / (NEAR * source.radius) ** 2 if source.radius else np.inf
    return LightCounts(power, _with_sun(source, sky, options.seed), particles, clamp)


def _direct(source: _Source, power: Doubles, options: LightOptions) -> int:
    """How many lights are not those of particles."""
    reflects = options.max_depth != 2 and source.radius > 0 and power.any()
    return max(1, round(options.count * (1 - options.indirect * reflects)))


def _shares(source: _Source, power: Doubles, options: LightOptions) -> dict[int, float]:
    """Of direct lights, how many each area lamp and the environment have, if they shine."""
    shining = [k for k in (*source.areas, source.environment) if k >= 0 and power[k] > 0]
    direct = _direct(source, power, options)
    return {k: direct * power[k] / power[shining].sum() for k in shining}


def _powers(source: _Source, seed: int) -> Doubles:
    """Radiant flux (emitters,) into the scene: means of the channels of some rays."""
    if not source.emitters:
        return np.zeros(0)
    rays = max(64, PILOT // len(source.emitters))
    number = dr.arange(mi.UInt32, rays * len(source.emitters)) // rays
    _, flux = source.rays(number, _random(dr.width(number), seed, _POWER))
    power = mi.Float(dr.sum(flux) / 3).numpy().reshape(-1, rays).mean(axis=1, dtype=np.float64)
    for name, value in zip(source.names, power, strict=True):
        if not np.isfinite(value):
            raise PrtError(f"emitter '{name}' sends out light that is not finite: repair it")
    return power


def _with_sun(source: _Source, count: int, seed: int) -> int:
    """As many directions as leave so many in the sky, if there is a sun in it."""
    if not count or source.emitters[source.environment].class_name() != SUN:
        return count
    direction, _, radiance = _directions(source, PILOT, seed)
    return round(count / max(1 - _in_sun(direction, radiance).mean(), 0.05))


def _distant(source: _Source, count: int, seed: int) -> _Part:
    """Stratified directions of the environment; what is within the rim of a sun is one light."""
    if not count:
        return _part(no_lights(0), source.environment)
    direction, power, radiance = _directions(source, count, seed)
    number = np.arange(len(power))
    if source.emitters[source.environment].class_name() == SUN:
        inside = _in_sun(direction, radiance)
        mean = power[inside].sum(axis=1) @ direction[inside]
        direction = np.concatenate([direction[~inside], mean[None] / max(np.linalg.norm(mean), 1e-30)])
        power = np.concatenate([power[~inside], power[inside].sum(axis=0, keepdims=True)])
        number = np.append(number[~inside], len(inside))
    lights = no_lights(len(power))
    lights.kind = dr.full(mi.UInt32, DIRECTION, len(power))
    lights.place = mi.Point3f(np.ascontiguousarray(direction.T, np.float32))
    lights.power = mi.Color3f(np.ascontiguousarray(power.T, np.float32))
    return _part(lights, source.environment, number)


def _directions(source: _Source, count: int, seed: int) -> tuple[Doubles, Doubles, Doubles]:
    """Unit vectors (n, 3), irradiance (n, 3) and radiance (n,), about ``count`` of them."""
    uv = _stratified(count, _random(_square(count), seed, _DIRECTIONS))
    towards, weight, density = source.directions(uv)
    power = weight.numpy().T.astype(np.float64)
    radiance = power.mean(axis=1) * density.numpy()
    return towards.numpy().T.astype(np.float64), power / len(power), radiance


def _in_sun(direction: Doubles, radiance: Doubles) -> NDArray[np.bool_]:
    """Which directions are within the rim of the brightest one."""
    return np.asarray(direction @ direction[radiance.argmax()] > np.cos(SUN_RADIUS))


def _placed(source: _Source, power: Doubles) -> _Part:
    """Emitters that shine from a point, which Mitsuba evaluates, or from a direction."""
    numbers = np.array(source.placed, np.int32)
    lights = no_lights(len(numbers))
    if len(numbers):
        lights.emitter = source.pointers(numbers)
        si = dr.zeros(mi.SurfaceInteraction3f, len(numbers))
        si.p = source.centre
        found, weight = lights.emitter.sample_direction(si, mi.Point2f(0.5), mi.Mask(True))
        far = mi.has_flag(lights.emitter.flags(), mi.EmitterFlags.DeltaDirection)
        lights.kind = dr.select(far, mi.UInt32(DIRECTION), EMITTER)
        lights.place = dr.select(far, mi.Point3f(found.d), found.p)
        mean = mi.Color3f(on_device(mi.Float, (power[numbers] / (4 * np.pi)).astype(np.float32)))
        lights.power = dr.select(far, mi.Color3f(weight), mean)
    return _Part(lights, None, numbers, _identity(numbers, 0))


def _area(source: _Source, number: int, count: int, seed: int) -> _Part:
    """Stratified points on an area lamp."""
    size = _square(count)
    shape = source.emitters[number].get_shape()  # a pointer would ask curves, too: they have none
    uv = _stratified(count, _random(size, seed, _AREAS + number))
    found = shape.sample_position(mi.Float(0), uv)
    si = dr.zeros(mi.SurfaceInteraction3f, size)
    si.p, si.n, si.uv, si.wi = found.p, found.n, found.uv, mi.Vector3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(found.n)
    si.t, si.shape = mi.Float(0), mi.ShapePtr(shape)
    radiance = mi.Color3f(source.emitters[number].eval(si)) + dr.zeros(mi.Color3f, size)
    lights = no_lights(size)
    lights.kind = dr.full(mi.UInt32, COSINE, size)
    lights.place, lights.normal = found.p, mi.Vector3f(found.n)
    lights.power = dr.select(found.pdf > 0, radiance / (found.pdf * dr.opaque(mi.Float, size)), 0)
    return _part(lights, number)


def _particles(source: _Source, power: Doubles, count: int, options: LightOptions) -> int:
    """How many particles leave about so many lights: a few tell first how often each lands."""
    found = _landed(source, power, PILOT, options, _PILOT)
    pilot = sum(int(dr.count(dr.max(part.arrays.power) > 0)[0]) for part in found)
    return max(1, round(count * PILOT / pilot)) if pilot else 0


def _landed(source: _Source, power: Doubles, particles: int, options: LightOptions, key: int) -> list[_Part]:
    """Lights where particles land, a part for each number of surfaces met; emitters have particles by their power."""

    def emit(particle: mi.UInt32) -> tuple[mi.Ray3f, mi.Color3f, mi.UInt32, mi.PCG32]:
        place = (np.arange(particles) + 0.5) / particles
        number = np.searchsorted(np.cumsum(power) / power.sum(), place).clip(max=len(power) - 1)
        emitter = on_device(mi.UInt32, number.astype(np.uint32))
        rng = _random(particles, options.seed, key)
        ray, flux = source.rays(emitter, rng)
        scale = power.sum() / (power[number] * particles)
        return ray, flux * on_device(mi.Float, scale.astype(np.float32)), emitter, rng

    found = []
    for one in trace_particles(source.scene, emit, particles, options.max_depth):
        group = one.emitter.numpy().astype(np.int32)
        identity = _identity(one.depth.numpy(), one.particle.numpy().astype(np.int64), True)
        found.append(_Part(*reflected_lights(one, source.surfaces), group, identity))
    return found


def _part(lights: LightArrays, emitter: int, number: Longs | None = None) -> _Part:
    """Direct lights of an emitter, which are numbered from 0 if not otherwise."""
    size = dr.width(lights.kind)
    group = np.full(size, emitter, np.int32)
    return _Part(lights, None, group, _identity(group, np.arange(size) if number is None else number))


def _identity(kind: NDArray[np.integer], number: NDArray[np.integer] | int, reflected: bool = False) -> Longs:
    """See ``Lights``: of a direct light its emitter, of a reflected one its depth, and its number among those."""
    return np.asarray((2 * kind.astype(np.int64) + reflected) << 40 | number)


def _one(parts: list[_Part]) -> _Part:
    """Several parts in one; of lights on glossy surfaces, numbers go on from part to part."""
    first = 0
    for part in parts:
        part.arrays.surface += dr.select(part.arrays.kind == SURFACE, dr.opaque(mi.UInt32, first), 0)
        first += 0 if part.glossy is None else dr.width(part.glossy.t)
    glossy = None
    if first:
        glossy, first = dr.zeros(mi.SurfaceInteraction3f, first), 0
        for part in parts:
            if part.glossy is not None:
                size = dr.width(part.glossy.t)
                dr.scatter(glossy, part.glossy, dr.arange(mi.UInt32, size) + dr.opaque(mi.UInt32, first))
                first += size
        dr.eval(glossy)
    group = np.concatenate([np.zeros(0, np.int32), *(part.group for part in parts)])
    identity = np.concatenate([np.zeros(0, np.int64), *(part.identity for part in parts)])
    return _Part(joined([part.arrays for part in parts]), glossy, group, identity)


def _together(parts: list[_Part], source: _Source, clamp: float) -> Lights:
    """All lights that are not dark, directions first, along a curve through them: rays of neighbours are coherent."""
    whole = _one(parts)
    if not len(whole.group):
        return Lights(whole.arrays, None, whole.group, source.names, clamp, source.radius, whole.identity)
    power = whole.arrays.power.numpy()
    if not np.isfinite(power).all():
        bad = source.names[whole.group[np.flatnonzero(~np.isfinite(power).all(axis=0))[0]]]
        raise PrtError(
            f"emitter '{bad}' sends out light, or a surface reflects it, that is not finite: repair it"
        )
    lit = np.flatnonzero((power > 0).any(axis=0))
    place, far = whole.arrays.place.numpy().T[lit], whole.arrays.kind.numpy()[lit] == DIRECTION
    ids = lit[order_lights(place, far)]
    arrays = whole.arrays.take(on_device(mi.UInt32, ids.astype(np.uint32)))
    dr.eval(arrays)
    group, identity = whole.group[ids], whole.identity[ids]
    return Lights(arrays, whole.glossy, group, source.names, clamp, source.radius, identity)


def order_lights(place: Floats, far: NDArray[np.bool_]) -> Longs:
    """Numbers of lights (n, 3), directions first, along a curve through them."""
    return np.concatenate(
        [np.flatnonzero(m)[morton_order(place[m], np.arange(m.sum(), dtype=np.uint64))] for m in (far, ~far)]
    )


def _square(count: int) -> int:
    """The square number nearest to a count, at least 1."""
    return max(1, round(np.sqrt(count))) ** 2


def _stratified(count: int, rng: mi.PCG32) -> mi.Point2f:
    """A point in each of ``_square(count)`` cells of the unit square."""
    cells = round(np.sqrt(_square(count)))
    cell, across = dr.arange(mi.UInt32, cells**2), dr.opaque(mi.UInt32, cells)
    row = cell // across
    offset = next_2d(rng)
    return mi.Point2f(
        (mi.Float(cell - row * across) + offset.x) / mi.Float(across),
        (mi.Float(row) + offset.y) / mi.Float(across),
    )


def _random(count: int, seed: int, key: int) -> mi.PCG32:
    """Random numbers of so many lanes for one purpose."""
    lane = dr.arange(mi.UInt32, count)
    return random_generator(mi.UInt64(lane), dr.opaque(mi.UInt32, key), mi.UInt32(0), seed)
