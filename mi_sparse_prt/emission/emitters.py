"""The scene's own emitters as a basis of light: a column for each, or for each group."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.scene.scene import Scene

# parameters of Mitsuba's emitters that their light is proportional to, and of the textures these may be
RADIATED = ("radiance", "intensity", "irradiance", "data")
_LEAVES = ("value", "data")


class SceneEmitters:
    """Lamps that are turned on and off, dimmed and coloured: column j is the scene lit by the j-th alone, as authored.

    Parameters
    ----------
    scene : Scene
        Its area lights, spots, points, directional lights and environment.
    groups : mapping of str to sequence of str, optional
        Names of the emitters that one column stands for: that of the shape of an area light, the id of another.
        Emitters that no group names stay dark. Without groups, each emitter is a column.

    Attributes
    ----------
    names : tuple of str
        Of the columns.
    groups : dict of str to list of str
        The emitters of each.

    Raises
    ------
    PrtError
        If the scene has no emitter, or none of a name.
    """

    kind: ClassVar[str] = "emitters"

    def __init__(self, scene: Scene, groups: Mapping[str, Sequence[str]] | None = None) -> None:
        self._scene = scene.mitsuba
        known = emitter_names(scene)
        if not known:
            raise PrtError(
                f"the scene {scene.path or 'in memory'} has no emitters: add an area light, a point, a spot ..."
            )
        chosen = {name: [name] for name in known} if groups is None else dict(groups)
        for group, members in chosen.items():
            for name in members:
                if name not in known:
                    raise PrtError(
                        f"group {group!r} names the emitter {name!r}; the scene has: {', '.join(known)}"
                    )
            if not members:
                raise PrtError(f"group {group!r} names no emitter; the scene has: {', '.join(known)}")
        self.groups = {name: list(members) for name, members in chosen.items()}
        self.names = tuple(chosen)
        numbers = self._members = [[known[name] for name in members] for members in chosen.values()]
        lengths = [len(members) for members in numbers]
        self._first = mi.UInt32(np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.uint32))
        self._count = mi.UInt32(np.array(lengths, np.uint32))
        self._emitters = mi.UInt32(np.concatenate(numbers).astype(np.uint32))
        group_of = np.full(max(known.values()) + 1, -1)
        for j, own in enumerate(numbers):
            group_of[own] = j
        self._group_of = mi.Int32(group_of.astype(np.int32))
        self._number_of = _numbers_of_pointers(self._scene)

    @property
    def size(self) -> int:
        """Columns."""
        return len(self.names)

    @property
    def unmet(self) -> NDArray[np.int64]:
        """Columns (k,) of points, spots and suns, which no ray can meet, and of groups that have some."""
        delta = [mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta) for emitter in self._scene.emitters()]
        return np.flatnonzero([any(delta[number] for number in own) for own in self._members])

    @property
    def weights(self) -> NDArray[np.float32]:
        """Of lamps in inner products: all count the same."""
        return np.ones(self.size, np.float32)

    @property
    def coordinates(self) -> dict[str, NDArray[Any]]:
        """Of lamps: ``lamp``, their names."""
        return {"lamp": np.array(self.names)}

    def neighbours(self, count: int) -> None:
        """Lamps have none."""

    def coarser(self, factor: int) -> None:
        """There is nothing between two lamps."""

    def upsampling(self, coarse: Any) -> scipy.sparse.csr_array:
        """The identity: there is no coarser version."""
        return scipy.sparse.eye_array(self.size, format="csr", dtype=np.float32)

    @property
    def sides(self) -> None:
        """Lamps have none."""

    @contextmanager
    def scene_lit_by(self, light: Any, scene: Scene) -> Iterator[mi.Scene]:
        """The scene itself with its lamps dimmed and coloured, see ``EmissionSpace``.

        Raises
        ------
        PrtError
            If an emitter takes no colour and should (``sunsky``).
        """
        brightness = np.zeros((len(scene.mitsuba.emitters()), 3), np.float32)
        for group, values in zip(self._members, self.project(light), strict=True):
            brightness[group] += values
        kept = []
        try:
            for emitter, values in zip(scene.mitsuba.emitters(), brightness, strict=True):
                kept.append(_dimmed(emitter, values))
            scene.mitsuba.parameters_changed([])  # what is dark is not sampled
            yield scene.mitsuba
        finally:
            for parameters, before in kept:
                parameters.update(before)
            scene.mitsuba.parameters_changed([])

    def __repr__(self) -> str:
        return f"SceneEmitters({', '.join(self.names)})"

    def project(self, light: Any) -> NDArray[np.float32]:
        """How bright each lamp is, relative to its own radiance: (size, 3).

        Parameters
        ----------
        light : mapping of names to numbers or RGB triples, or (size,) or (size, 3) floats, or a number
            Lamps that a mapping does not name are off.

        Raises
        ------
        PrtError
            If a name is unknown, the shape another, or a value not finite.
        """
        if isinstance(light, Mapping):
            for name in light:
                if name not in self.names:
                    raise PrtError(f"there is no lamp {name!r}; there are: {', '.join(self.names)}")
            rows = [np.broadcast_to(np.asarray(light.get(name, 0.0), np.float32), 3) for name in self.names]
            values = np.stack(rows)
        else:
            try:
                values = np.asarray(light, np.float32)
            except (TypeError, ValueError):
                raise PrtError(
                    f"light of lamps is {type(light).__name__}: give names with values, such as "
                    f"{{{self.names[0]!r}: 0.5}}"
                ) from None
            if values.shape in ((), (self.size,)):
                values = np.broadcast_to(values[..., None], (self.size, 3))
        if values.shape != (self.size, 3):
            raise PrtError(
                f"light has shape {values.shape}; {self!r} takes ({self.size}, 3), or names with values"
            )
        if not np.isfinite(values).all():
            raise PrtError("light has values that are NaN or infinite; repair it")
        return np.ascontiguousarray(values)

    def sample(
        self, element: mi.UInt32, position: mi.Point3f, uv: mi.Point2f
    ) -> tuple[mi.Vector3f, mi.Color3f, mi.Float, mi.Float]:
        """One direction in which light of an element arrives, see ``EmissionSpace.sample``."""
        emitter, count, u = self._one_of(element, uv.x)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(position))
        si.p = position
        found, weight = emitter.sample_direction(si, mi.Point2f(u, uv.y), mi.Mask(True))
        density = dr.select(found.delta, 0, found.pdf / mi.Float(count))
        return found.d, mi.Color3f(weight) * mi.Float(count), found.dist, density

    @property
    def emitted(self) -> NDArray[np.int64]:
        """Columns (k,) of lamps alone, whose light ``emit`` sends into the scene; ascending."""
        distant = [emitter.is_environment() for emitter in self._scene.emitters()]
        return np.flatnonzero([not any(distant[number] for number in own) for own in self._members])

    def emit(
        self, element: mi.UInt32, u: mi.Float, place: mi.Point2f, towards: mi.Point2f
    ) -> tuple[mi.Ray3f, mi.Color3f]:
        """Rays of light that leaves an element, see ``EmittedLight.emit``."""
        emitter, count, u = self._one_of(element, u)
        ray, weight = emitter.sample_ray(0.0, u, place, towards, mi.Mask(True))
        return mi.Ray3f(ray), mi.Color3f(weight) * mi.Float(count)

    def _one_of(self, element: mi.UInt32, u: mi.Float) -> tuple[mi.EmitterPtr, mi.UInt32, mi.Float]:
        """One of an element's emitters, how many these are, and what is left of a random number."""
        count = dr.gather(mi.UInt32, self._count, element)
        u = u * mi.Float(count)
        which = dr.minimum(mi.UInt32(u), count - 1)
        number = dr.gather(mi.UInt32, self._emitters, dr.gather(mi.UInt32, self._first, element) + which)
        return dr.gather(mi.EmitterPtr, self._scene.emitters_dr(), number), count, u - mi.Float(which)

    def element_of(
        self, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Mask
    ) -> tuple[mi.Int32, mi.Color3f]:
        """The element whose light rays meet, -1 for none, and its radiance along them."""
        emitter, group = self._met(si, active)
        return group, dr.select(group >= 0, mi.Color3f(emitter.eval(si, group >= 0)), 0)

    def density(self, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Mask) -> mi.Float:
        """Of a ray's direction among samples, see ``SampledEmission.density``."""
        emitter, group = self._met(si, active)
        known, start = group >= 0, dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.o))
        start.p = ray.o
        count = dr.maximum(dr.gather(mi.UInt32, self._count, mi.UInt32(group), known), 1)
        found = emitter.pdf_direction(start, mi.DirectionSample3f(self._scene, si, start), known)
        return dr.select(known, found / mi.Float(count), 0)

    def _met(self, si: mi.SurfaceInteraction3f, active: mi.Mask) -> tuple[mi.EmitterPtr, mi.Int32]:
        """What shines where rays end, and its element; -1 for none."""
        emitter = si.emitter(self._scene, active)
        known = active & (emitter != None)  # noqa: E711 - an array of pointers
        number = dr.gather(mi.Int32, self._number_of, dr.reinterpret_array(mi.UInt32, emitter), known)
        known &= (number >= 0) & (number < len(self._group_of))
        return emitter, dr.select(known, dr.gather(mi.Int32, self._group_of, mi.UInt32(number), known), -1)

    def attributes(self) -> dict[str, Any]:
        return {"groups": self.groups}


class StoredEmitters:
    """Lamps of a matrix that came from a file: their names, and no scene.

    Parameters
    ----------
    groups : dict of str to list of str
        As for ``SceneEmitters``.
    """

    kind: ClassVar[str] = "emitters"

    def __init__(self, groups: dict[str, list[str]]) -> None:
        self.groups = groups
        self.names = tuple(groups)

    def of_scene(self, scene: Scene) -> SceneEmitters:
        """The lamps of a scene that have these names."""
        return SceneEmitters(scene, self.groups)

    def scene_lit_by(self, light: Any, scene: Scene) -> AbstractContextManager[mi.Scene]:
        """As that of ``SceneEmitters``."""
        return self.of_scene(scene).scene_lit_by(light, scene)

    size = SceneEmitters.size
    weights = SceneEmitters.weights
    coordinates = SceneEmitters.coordinates
    neighbours = SceneEmitters.neighbours
    coarser = SceneEmitters.coarser
    upsampling = SceneEmitters.upsampling
    sides = SceneEmitters.sides
    project = SceneEmitters.project
    attributes = SceneEmitters.attributes
    __repr__ = SceneEmitters.__repr__


def _numbers_of_pointers(scene: mi.Scene) -> mi.Int32:
    """The place of each emitter in the scene's list, by Dr.Jit's own number of it; -1 for others.

    Read before rays are traced: numbers do not come to the host in the body of a symbolic loop.
    """
    pointers = dr.reinterpret_array(mi.UInt32, scene.emitters_dr()).numpy()
    table = np.full(int(pointers.max()) + 1, -1, np.int32)
    table[pointers] = np.arange(len(pointers))
    return mi.Int32(table)


def _dimmed(
    emitter: mi.Emitter, brightness: NDArray[np.float32]
) -> tuple[mi.SceneParameters, dict[str, Any]]:
    """Multiply what an emitter sends out by an RGB triple; its parameters, and what they were."""
    parameters = mi.traverse(emitter)
    light = [
        key for key in parameters.keys() if key.split(".")[0] in RADIATED and key.split(".")[-1] in _LEAVES
    ]
    if not light:
        light = [key for key in parameters.keys() if key.endswith("_scale")]
    even = not np.ptp(brightness)
    if not light or not (even or all(_coloured(parameters[key]) for key in light)):
        raise PrtError(
            f"the emitter {emitter.id()!r} ({emitter.class_name()}) takes no colour; dim it evenly"
        )
    before = {key: type(parameters[key])(parameters[key]) for key in [*light, "sampling_weight"]}
    for key in light:
        value = before[key]
        if isinstance(value, mi.TensorXf):  # an image, (height, width, channels)
            parameters[key] = mi.TensorXf(np.array(value) * (brightness[0] if even else brightness))
        elif isinstance(value, mi.Color3f):
            parameters[key] = value * mi.Color3f(*map(float, brightness))
        else:
            parameters[key] = value * float(brightness[0])
    if not brightness.any():
        parameters["sampling_weight"] = 0.0
    parameters.update()
    return parameters, before


def _coloured(value: Any) -> bool:
    """Whether a parameter has a number for each channel."""
    return isinstance(value, mi.Color3f) or (isinstance(value, mi.TensorXf) and value.shape[-1] == 3)


def shapes_of_emitters(scene: mi.Scene) -> dict[int, int]:
    """Numbers of the shapes that shine, by the numbers of their emitters."""
    pointers = dr.reinterpret_array(mi.UInt32, scene.emitters_dr()).numpy().tolist()
    numbers = {pointer: k for k, pointer in enumerate(pointers)}
    return {
        numbers[int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(shape.emitter())).numpy()[0])]: k
        for k, shape in enumerate(scene.shapes())
        if shape.is_emitter()
    }


def emitter_names(scene: Scene) -> dict[str, int]:
    """Numbers of all emitters by name: the mesh's, or the emitter's own id, or its kind."""
    return named_emitters(scene.mitsuba, [mesh.name for mesh in scene.fronts])


def named_emitters(scene: mi.Scene, shapes: Sequence[str]) -> dict[str, int]:
    """Numbers of all emitters by name: the shape's, or the emitter's own id, or its kind.

    Parameters
    ----------
    scene : mi.Scene
    shapes : sequence of str
        Names of its shapes.
    """
    on_shapes = shapes_of_emitters(scene)
    names: dict[str, int] = {}
    for k, emitter in enumerate(scene.emitters()):
        name = shapes[on_shapes[k]] if k in on_shapes else emitter.id()
        if not name or name.startswith("_"):  # Mitsuba's and ours for what has no name
            name = f"{emitter.class_name().lower()}_{k}"
        names[name if name not in names else f"{name}_{k}"] = k
    return names
