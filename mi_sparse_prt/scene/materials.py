"""R, as far as the vertices know it: what a shape's BSDF reflects, and what can be proved about its colours."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from copy import copy
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.errors import LampWarning, NotDiffuseWarning, PrtError
from mi_sparse_prt.core.variant import variant
from mi_sparse_prt.scene.even_texture import EvenTexture
from mi_sparse_prt.scene.notes import Fact, Notes
from mi_sparse_prt.scene.traversal import children
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh

#: BSDFs and textures that do not vary over the surface nor with its rotation.
PLAIN = {"SmoothDiffuse", "TwoSided", "UniformSpectrum", "SRGBReflectanceSpectrum"}

#: BSDFs and textures whose colours are all among the parameters that `mi.traverse` shows.
SHOWN = PLAIN | {"BlendBSDF", "Mask", "Null", "SmoothPlastic", "RoughPlastic", "SmoothDielectric"}
SHOWN |= {"RoughDielectric", "ThinDielectric", "SmoothConductor", "RoughConductor"}
SHOWN |= {"BitmapTexture", "Checkerboard", "MeshAttribute", "Transform"}

#: Textures that are looked up by texture coordinates.
FLAT_TEXTURES = {"BitmapTexture", "Checkerboard"}

#: BSDFs that bend the shading normal of the one that they wrap.
BUMPED = {"NormalMap", "BumpMap"}

ANGLES = 64  # at which it is looked up what panes let through
DIMMED = 0.99  # of the light, at most: rounding makes no difference to what is lost

_LAMP = Fact(
    " is an area emitter: matrices of lamps (SceneEmitters) have its light, those of a cubemap do not",
    " are area emitters: matrices of lamps (SceneEmitters) have their light, those of a cubemap do not",
    LampWarning,
)
_OTHER_LAMP = Fact(
    " shines, but not as an area emitter: it is left out (no path from a camera finds the light of directionalarea)",
    " shine, but not as area emitters: they are left out (no path from a camera finds the light of directionalarea)",
    LampWarning,
)
_MEDIUM = Fact(
    " bounds a medium: media are left out, light passes as through a vacuum (volpath renders them)",
    " bound media: these are left out, light passes as through a vacuum (volpath renders them)",
)

#: Filters and wrap modes of bitmaps; what Mitsuba takes unless told otherwise comes first.
_LOOKUPS = [(f, w) for f in ("Linear", "Nearest") for w in ("Repeat", "Mirror", "Clamp")]


def bsdf_class(bsdf: mi.BSDF) -> str:
    """The class of a BSDF, also of one that is written in Python."""
    own = type(bsdf).__name__
    return own if own != "BSDF" else str(bsdf.class_name())


def printed(thing: mi.Object) -> str:
    """An object as Mitsuba prints it, without addresses of Python plugins."""
    return re.sub(r" at 0x[0-9a-f]+", "", str(thing))


def is_one_of(bsdfs: Sequence[mi.BSDF], si: mi.SurfaceInteraction3f) -> mi.Mask:
    """Whether the surfaces that were met have one of some BSDFs."""
    result, own = mi.Mask(False), si.bsdf()
    for bsdf in bsdfs:
        other = mi.BSDFPtr(bsdf)
        dr.make_opaque(other)  # its number, which loading may change, is no constant in kernels
        result |= own == other
    return result


def single_direction(
    si: mi.SurfaceInteraction3f, u: mi.Float, v: mi.Point2f, active: mi.Mask, kinds: int
) -> tuple[mi.BSDFSample3f, mi.Color3f]:
    """A direction that surfaces scatter into as mirrors, glass or holes do, and its weight: 0 where there is none.

    Parameters
    ----------
    si : SurfaceInteraction3f
    u, v : Float, Point2f
        Random numbers; samplers of Mitsuba's return 1 now and then.
    active : Mask
    kinds : int
        Flags of ``mi.BSDFFlags``.
    """
    single = mi.BSDFContext()
    single.type_mask = kinds
    sample, weight = si.bsdf().sample(single, si, u, v, active)
    # for numbers that are, or are rounded to, 1, BSDFs choose the last of their kinds even if it is not asked for
    found = active & ((mi.UInt32(sample.sampled_type) & kinds) != 0)
    return sample, dr.select(found, weight, 0)


def sample_weight(sample: mi.BSDFSample3f, weight: mi.Color3f) -> mi.Color3f:
    """The weight of a BSDF's sample, 0 where rounding left it no direction or no density, as some at grazing angles.

    A weight that is not a number otherwise is a BSDF's fault, and stays.
    """
    found = dr.isfinite(sample.pdf) & dr.all(dr.isfinite(sample.wo))
    return dr.select(found, weight, 0)


def bends_normals(bsdf: mi.BSDF) -> bool:
    """Whether a bump or normal map turns its shading normals; its flags do not tell."""
    return bool(_classes(printed(bsdf)) & BUMPED)


class Material:
    """A shape's BSDF, and what can be said about it.

    Attributes
    ----------
    name : str
        The shape's name, for messages.
    bsdf : mi.BSDF
    diffuse : bool
        It reflects diffusely and does nothing else.
    glossy : bool
        It scatters some light into a range of directions, and not alike into all.
    known_by_irradiance : bool
        What it reflects follows from its irradiance, but for single directions.
    bends_normals : bool
        A bump or normal map turns its shading normals.
    two_sided : bool
        It reflects light on its back, too, by more than a mirror's single direction.
    scatters_through : bool
        Some light goes through it into all directions: curtains, leaves.
    passes_light : bool
        Some light goes through it.
    single_directions : bool
        It scatters some light into single directions: a mirror, glass, a mask.
    rough_glass : bool
        Light goes through it into a range of directions. It keeps none: rays go on, as from mirrors.
    bends_light : bool
        It sends light on in other single directions, or is rough glass.
    passes_straight : bool
        Some of it goes straight on, as if nothing were there.
    textured : bool
        It is looked up by texture coordinates.
    constant : bool
        It certainly does not vary over the surface nor with its rotation, and neither does the shape's own light.
    """

    def __init__(self, shape: mi.Shape, name: str, notes: Notes) -> None:
        self.name = name
        self._emitter = shape.emitter() if shape.is_emitter() else None
        self._radiance = None if self._emitter is None else _radiance(self._emitter)
        self._set_bsdf(shape.bsdf(), 1)
        if not self.diffuse:
            notes.add(name, _not_diffuse(self.bsdf, self._lambertian))
        if self._emitter is not None:
            notes.add(name, _OTHER_LAMP if self._radiance is None else _LAMP)
        if shape.interior_medium() is not None or shape.exterior_medium() is not None:
            notes.add(name, _MEDIUM)

    def _set_bsdf(self, bsdf: mi.BSDF, side: int) -> None:
        """Look at a BSDF from its front (1) or its back (-1)."""
        self.bsdf, self._side = bsdf, side
        self._text = printed(bsdf)
        self._classes = _classes(self._text)
        flags = int(bsdf.flags())
        self._lambertian = _lambertian(bsdf)
        self.bends_normals = bool(self._classes & BUMPED)
        self.diffuse = self._lambertian and not self.bends_normals
        self.glossy = bool(flags & int(mi.BSDFFlags.Glossy))
        spread = mi.BSDFFlags.Glossy | mi.BSDFFlags.DiffuseTransmission
        self.known_by_irradiance = not (flags & int(spread) or self.bends_normals)
        self.scatters_through = bool(flags & int(mi.BSDFFlags.DiffuseTransmission))
        self.passes_light = bool(flags & int(mi.BSDFFlags.Transmission | mi.BSDFFlags.Null))
        self.single_directions = bool(flags & int(mi.BSDFFlags.Delta))
        self.rough_glass = bool(flags & int(mi.BSDFFlags.GlossyTransmission))
        bent = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission
        self.bends_light = self.rough_glass or bool(flags & int(bent))
        self.passes_straight = bool(flags & int(mi.BSDFFlags.Null))
        self.two_sided = any(_reflects_behind(int(bsdf.flags(k))) for k in range(bsdf.component_count()))
        textured = self._radiance is not None and self._radiance.is_spatially_varying()
        self.textured = bool(self._classes & FLAT_TEXTURES)
        self.constant = self._classes <= PLAIN and not textured

    @cached_property
    def dims(self) -> bool:
        """Whether light that goes straight through certainly loses some of itself, wherever it does: thin panes."""
        kind = bsdf_class(self.bsdf)
        of_one_opacity = kind == "MaskBSDF" and "opacity.value" in mi.traverse(self.bsdf)
        if not (of_one_opacity or (kind == "ThinDielectric" and self._classes <= PLAIN | {"ThinDielectric"})):
            return False
        si = dr.zeros(mi.SurfaceInteraction3f, 2 * ANGLES)
        cosine = (dr.arange(mi.Float, 2 * ANGLES) + 0.5) / ANGLES - 1
        si.wi = mi.Vector3f(dr.sqrt(1 - cosine * cosine), 0, cosine)
        through = mi.Color3f(self.bsdf.eval_null_transmission(si))
        return bool(np.max(np.array(dr.sum(through) / 3)) < DIMMED)

    @property
    def shines(self) -> bool:
        """Whether the shape is an emitter."""
        return self._emitter is not None

    def back(self) -> Material:
        """What the back of the shape is made of."""
        behind = copy(self)
        if self._text.startswith("TwoSided["):
            behind._set_bsdf(dict(children(self.bsdf))["brdf_1"], 1)
        else:
            behind._set_bsdf(self.bsdf, -1)
        return behind

    def emission(self) -> mi.Emitter | None:
        """A copy of the shape's area emitter for another shape, with the same texture if it has one; None without.

        Other emitters of shapes (``directionalarea``) are found by no path from a camera, and are left out.
        """
        if self._radiance is None:
            return None
        values = mi.traverse(self._emitter)
        if "radiance.value" not in values:
            apart = variant() == "cuda_ad_rgb" and self._radiance.is_spatially_varying()
            radiance = EvenTexture(self._radiance) if apart else self._radiance
            return mi.load_dict({"type": "area", "radiance": radiance})
        radiance = np.ravel(values["radiance.value"]).astype(float)
        spectrum = {"type": "rgb", "value": np.broadcast_to(radiance, 3).tolist()}
        return mi.load_dict({"type": "area", "radiance": spectrum})

    def albedo(self, shape: mi.Mesh, mesh: TriangleMesh) -> NDArray[np.float32]:
        """(n, 3) reflectance at the vertices of `mesh`, evaluated by Mitsuba on its twin `shape`.

        Of a mask, that of what it covers: vertices know nothing of the holes between them. Of rough glass 0.
        Each vertex is looked at in the corner of one of its triangles, from the direction of its normal.
        """
        covered, si = _covered(self.bsdf), self._looked_at(shape, mesh)
        if self.rough_glass:
            value = mi.Color3f(0)
        elif _lambertian(covered):
            value = covered.eval_diffuse_reflectance(si)
        else:
            value = self._directional_albedo(covered, si, self._side)
        albedo = np.array(dr.zeros(mi.Color3f, len(mesh.positions)) + value, dtype=np.float32).T.copy()
        bad = np.flatnonzero(~((albedo >= 0) & (albedo <= 1 + 1e-5)).all(axis=1))
        if bad.size:
            raise PrtError(
                f"shape '{self.name}': vertex {bad[0]} has the albedo {albedo[bad[0]].tolist()} "
                f"({bad.size} such vertices): reflectance must lie in 0..1"
            )
        return np.ascontiguousarray(np.minimum(albedo, 1))

    def transmittance(self, shape: mi.Mesh, mesh: TriangleMesh) -> NDArray[np.float32]:
        """(n, 3) light that goes through into all directions alike, as ``albedo``; 0 of rough glass."""
        n = len(mesh.positions)
        if self.rough_glass or not self.scatters_through:
            return np.zeros((n, 3), np.float32)
        value = self._directional_albedo(_covered(self.bsdf), self._looked_at(shape, mesh), -self._side)
        return np.array(dr.zeros(mi.Color3f, n) + value, dtype=np.float32).T.copy()

    def _looked_at(self, shape: mi.Mesh, mesh: TriangleMesh) -> mi.SurfaceInteraction3f:
        """Its vertices, from the direction of their normals."""
        n = len(mesh.positions)
        corner_of = np.zeros(n, np.int64)  # [vertex] -> index into the flattened triangles
        flat = mesh.triangles.ravel()
        corner_of[flat[::-1]] = np.arange(len(flat))[::-1]
        triangle, corner = np.divmod(corner_of, 3)

        pi = dr.zeros(mi.PreliminaryIntersection3f, n)
        pi.prim_index = on_device(mi.UInt32, triangle.astype(np.uint32))
        pi.prim_uv = mi.Point2f(
            on_device(mi.Float, (corner == 1).astype(np.float32)),
            on_device(mi.Float, (corner == 2).astype(np.float32)),
        )
        pi.shape = mi.ShapePtr(shape)
        pi.t = mi.Float(1.0)
        ray = dr.zeros(mi.Ray3f, n)
        si = shape.compute_surface_interaction(ray, pi)
        si.t = mi.Float(1.0)
        si.wi = mi.Vector3f(0, 0, self._side)
        return si

    def _directional_albedo(self, bsdf: mi.BSDF, si: mi.SurfaceInteraction3f, side: int) -> mi.Color3f:
        """The share of light from the normal's direction that is sent to a side (1, -1), but for single directions."""
        context = mi.BSDFContext()
        total = dr.zeros(mi.Color3f, dr.width(si))
        n = 8  # strata per axis
        for k in range(n * n):
            # The lobe's random number runs in bit-reversed order, so that each lobe sees the whole square.
            lobe, x, y = _radical_inverse(k) + 0.5 / (n * n), (k % n + 0.5) / n, (k // n + 0.5) / n
            lobe, x, y = (dr.opaque(mi.Float, value) for value in (lobe, x, y))  # one kernel for all strata
            u = mi.Point2f(x, y)
            sample, weight = bsdf.sample(context, si, lobe, u)
            single = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
            total += dr.select((sample.wo.z * side > 0) & ~single, mi.Color3f(weight), 0)
            dr.eval(total)
        return dr.clip(total / (n * n), 0, 1)

    def grey(self, mesh: TriangleMesh) -> bool:
        """Whether the BSDF provably reflects the three channels alike."""
        if not self._classes <= SHOWN:
            return False
        if "MeshAttribute" in self._classes and not all(
            _has_equal_channels(values)
            for values in (*mesh.vertex_attributes.values(), *mesh.face_attributes.values())
        ):
            return False
        parameters = mi.traverse(self.bsdf)
        return all(_has_equal_channels(parameters[k]) for k in parameters.keys() if not k.endswith("to_uv"))

    def digest(self) -> bytes:
        """SHA-256 of the BSDF, see ``digest``."""
        return digest(self._text, mi.traverse(self.bsdf))


def digest(text: str, parameters: mi.SceneParameters, left_out: tuple[str, ...] = ()) -> bytes:
    """SHA-256 of an object's text, of all parameters that `mi.traverse` shows, and of how bitmaps are looked up."""
    state = hashlib.sha256(text.encode())
    for name in sorted(set(parameters.keys()) - set(left_out)):
        if parameters.properties[name][0] is None:  # a texture that is not given, which cannot be asked for
            continue
        value = parameters[name]
        state.update(name.encode())
        state.update(np.array(value.matrix if hasattr(value, "matrix") else value).tobytes())
        texture = next((of for of in parameters.properties[name] if isinstance(of, mi.Texture)), None)
        if name.endswith("data") and texture is not None and value.ndim == 3:
            found = _lookup(texture, value, parameters[name.removesuffix("data") + "to_uv"])
            state.update(str(found).encode() if found != _LOOKUPS[0] else b"")
    return state.digest()


def _not_diffuse(bsdf: mi.BSDF, lambertian: bool) -> Fact:
    """What there is to say of shapes with a BSDF that is not diffuse, or not but for its normals."""
    what = "bends the shading normals" if lambertian else "is not diffuse"
    said = (
        f": BSDF {bsdf_class(bsdf)} {what}; a matrix treats {{}} vertices as diffuse with the same reflectance "
        'unless it is given terms="auto", indirect paths use the real BSDF'
    )
    return Fact(said.format("its"), said.format("their"), NotDiffuseWarning)


def _classes(text: str) -> set[str]:
    """What a plugin is made of: Mitsuba prints it as Class[...], nested BSDFs and textures too."""
    return set(re.findall(r"^\w+|\b[A-Z]\w*(?=\[)", text))


def _radiance(emitter: mi.Emitter) -> mi.Texture | None:
    """The texture, of one colour or more, that an area light shines with; None of emitters of other kinds."""
    if emitter.class_name() != "AreaLight":
        return None
    return next(node for node, (_, depth) in mi.traverse(emitter).hierarchy.items() if depth == 1)


def _reflects_behind(flags: int) -> bool:
    """Whether a component of a BSDF, by its flags, reflects on its back, by more than a mirror's single direction."""
    wide = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.GlossyReflection
    return bool(flags & int(wide)) and bool(flags & int(mi.BSDFFlags.BackSide))


def _lambertian(bsdf: mi.BSDF) -> bool:
    """Whether it reflects diffusely, and does nothing else, by what it says of itself."""
    return int(bsdf.flags()) & int(mi.BSDFFlags.All) == int(mi.BSDFFlags.DiffuseReflection)


def _covered(bsdf: mi.BSDF) -> mi.BSDF:
    """What a mask covers; any other BSDF itself."""
    return dict(children(bsdf))["nested_bsdf"] if bsdf.class_name() == "MaskBSDF" else bsdf


def _lookup(texture: mi.Texture, data: mi.TensorXf, to_uv: mi.ScalarTransform3f) -> tuple[str, str]:
    """Filter and wrap mode of a bitmap (h, w, channels), which it tells nobody: those that explain its values."""
    uv = np.random.default_rng(0).uniform(-1, 2, (2, 256)).astype(np.float32)
    si = dr.zeros(mi.SurfaceInteraction3f, uv.shape[1])
    si.uv, si.wi = mi.Point2f(uv), mi.Vector3f(0, 0, 1)
    wanted = np.array(texture.eval(si))  # [channel, point]
    inside = mi.Point2f((np.array(to_uv.matrix) @ np.vstack([uv, np.ones_like(uv[:1])]))[:2])
    off = []
    for filtering, wrapping in _LOOKUPS:
        modes = getattr(dr.FilterMode, filtering), getattr(dr.WrapMode, wrapping)
        values = np.array(mi.Texture2f(mi.TensorXf(data), True, False, *modes).eval(inside))
        off.append(np.abs(values - wanted).max())
    return _LOOKUPS[int(np.argmin(np.round(off, 3)))]  # 1e-3: bitmaps may be kept as half floats


def _has_equal_channels(value: Any) -> bool:
    """Whether colours, a `mi.Color3f` or [..., channel], have equal channels; other things always do."""
    values = np.array(value, np.float64)
    if isinstance(value, mi.Color3f):
        values = values.T  # [1, channel]
    if values.ndim < 2 or values.shape[-1] not in (3, 4):
        return True
    return bool(np.all(np.ptp(values[..., :3], axis=-1) <= 1e-6))


def _radical_inverse(k: int, bits: int = 6) -> float:
    return int(f"{k:0{bits}b}"[::-1], 2) / 2**bits
