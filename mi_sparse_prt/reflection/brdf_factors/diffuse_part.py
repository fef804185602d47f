"""The diffuse part of a BSDF and what is left without it, the glossy part, which is what factors are made of."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.reflection.brdf_factors.direction_grid import (
    DirectionGrid,
    Doubles,
    Floats,
)
from mi_sparse_prt.scene.materials import bsdf_class

SLANTED = (0.6, 0.0, 0.8)  # light that goes back where it came from: no highlight
ROUNDING = 1e-5  # relative


class UnfactorableError(PrtError):
    """A BSDF that in-out factors cannot stand for.

    Attributes
    ----------
    reason : str
        What it does that they cannot, without the name of its shape.
    """

    def __init__(self, name: str, reason: str, advice: str) -> None:
        super().__init__(f"shape '{name}': {reason}{advice}")
        self.reason = reason


class GlossyPart:
    """The front of a reflective BSDF without its diffuse part, in the local frame of the surface, +Z its normal.

    Parameters
    ----------
    bsdf : mi.BSDF
        Textures are looked at where their coordinates are (0, 0).
    name : str
        For messages.

    Attributes
    ----------
    diffuse : (3,) float64
        Reflectance of what is alike for all directions.
    channels : int
        1 if the BSDF is grey, else 3; if the diffuse part varies over the surface, only the glossy one decides that.
    varying_diffuse : bool
        The diffuse part varies over the surface, and nothing else does.

    Raises
    ------
    PrtError
        If the BSDF transmits, mirrors, varies over the surface in more than a Lambertian reflectance, or has values
        that are no numbers.
    """

    def __init__(self, bsdf: mi.BSDF, name: str) -> None:
        self._bsdf, self._name = bsdf, name
        self.varying_diffuse = _check(bsdf, name)
        w = DirectionGrid(16, 32).directions
        w = w[w[:, 2] > 0.05]  # below, Fresnel terms have their say
        incident, outgoing = np.repeat(w, len(w), axis=0), np.tile(w, (len(w), 1))
        value = evaluate_brdf(bsdf, name, incident, outgoing)
        least = np.pi * (value / incident[:, 2:]).min(axis=0).astype(np.float64)
        coloured = value - incident[:, 2:] * least / np.pi if self.varying_diffuse else value
        grey = np.ptp(coloured, axis=1).max() <= 1e-6 * max(float(value.max()), 1e-30)
        self.diffuse: Doubles = least
        self.channels = 1 if grey else 3

    def values(self, incident: Floats, outgoing: Floats) -> Floats:
        """Glossy BRDF times the incident cosine, (m, channels), at pairs of directions (m, 3)."""
        light, view = (mi.Vector3f(np.ascontiguousarray(w.T)) for w in (incident, outgoing))
        return np.stack([channel.numpy() for channel in self._glossy(light, view)], axis=1)

    def rows(self, grid: DirectionGrid, some: slice) -> Floats:
        """The same, (b, channels, outgoing), for some of a grid's incident directions and all outgoing ones."""
        n = len(grid.directions)
        start, stop, step = some.indices(n)
        count = len(range(start, stop, step))
        every = mi.Vector3f(np.ascontiguousarray(grid.directions.T))
        lane = dr.arange(mi.UInt32, count * n)
        row = lane // dr.opaque(mi.UInt32, n)
        incident = row * dr.opaque(mi.UInt32, step) + dr.opaque(mi.UInt32, start)
        light = dr.gather(mi.Vector3f, every, incident)
        channels = self._glossy(light, dr.gather(mi.Vector3f, every, lane - row * dr.opaque(mi.UInt32, n)))
        return np.stack([channel.numpy().reshape(count, n) for channel in channels], axis=1)

    def _glossy(self, light: mi.Vector3f, view: mi.Vector3f) -> list[mi.Float]:
        """Channels at pairs of directions, the incident ones first."""
        value = _evaluate(
            self._bsdf, self._name, dr.zeros(mi.SurfaceInteraction3f, dr.width(light)), light, view
        )
        cosine = dr.select(view.z > 0, dr.maximum(light.z, 0), 0)
        channels = []
        for c in range(self.channels):
            lambertian = cosine * mi.Float(dr.opaque(mi.Float, float(np.float32(self.diffuse[c] / np.pi))))
            part = value[c] - lambertian
            channels.append(dr.select(dr.abs(part) <= ROUNDING * lambertian, 0, part))
        dr.eval(channels)
        return channels


def diffuse_reflectance(bsdf: mi.BSDF, name: str, si: mi.SurfaceInteraction3f) -> Floats:
    """Reflectance (n, 3) of a BSDF's diffuse part at n places of a surface.

    It belongs to factors that say ``varying_diffuse``: these and it are the whole BRDF. (The albedo of vertices is
    another thing, the glossy part's is in it.)

    Parameters
    ----------
    bsdf : mi.BSDF
    name : str
        For messages.
    si : mi.SurfaceInteraction3f
        The n places; their directions do not matter.

    Raises
    ------
    PrtError
        As `GlossyPart`.
    """
    part = GlossyPart(bsdf, name)
    back = np.array([SLANTED], np.float32)
    here = np.broadcast_to(back, (dr.width(si), 3))
    there = evaluate_brdf(bsdf, name, back, back)
    change = _evaluate_at(bsdf, name, mi.SurfaceInteraction3f(si), here, here) - there
    found: Floats = np.maximum(part.diffuse + change * (np.pi / SLANTED[2]), 0).astype(np.float32)
    return found


def evaluate_brdf(bsdf: mi.BSDF, name: str, incident: Floats, outgoing: Floats) -> Floats:
    """BRDF times the incident cosine, (m, 3), at pairs of directions (m, 3) in the local frame.

    Textures are looked at where their coordinates are (0, 0).

    Raises
    ------
    PrtError
        If a value is NaN or infinite.
    """
    return _evaluate_at(bsdf, name, dr.zeros(mi.SurfaceInteraction3f, len(incident)), incident, outgoing)


def _evaluate_at(
    bsdf: mi.BSDF, name: str, si: mi.SurfaceInteraction3f, incident: Floats, outgoing: Floats
) -> Floats:
    """As `evaluate_brdf`, at places, whose directions are overwritten."""
    light, view = (mi.Vector3f(np.ascontiguousarray(w.T)) for w in (incident, outgoing))
    found: Floats = np.asarray(np.array(_evaluate(bsdf, name, si, light, view)).T, np.float32)
    return found


def _evaluate(
    bsdf: mi.BSDF, name: str, si: mi.SurfaceInteraction3f, light: mi.Vector3f, view: mi.Vector3f
) -> mi.Color3f:
    """As `_evaluate_at`, on the device."""
    si.wi = view  # Mitsuba's wi is where the light leaves for
    value = dr.zeros(mi.Color3f, dr.width(light)) + bsdf.eval(mi.BSDFContext(), si, light)
    wrong = ~dr.all(dr.isfinite(value))
    dr.eval(value, wrong)
    if dr.any(wrong):
        first = int(np.flatnonzero(wrong.numpy())[0])
        raise UnfactorableError(
            name,
            f"its BSDF is {np.array(value)[:, first].tolist()} for light from {np.array(light)[:, first].tolist()}",
            "; correct the BSDF's parameters or use path tracing instead",
        )
    return value


def _check(bsdf: mi.BSDF, name: str) -> bool:
    """Whether the diffuse part varies over the surface; raises if the BSDF cannot be factored."""
    flags = int(bsdf.flags())
    problem = None
    varies = lambertian = False
    if flags & int(mi.BSDFFlags.Transmission | mi.BSDFFlags.Null):
        problem = "transmits light"
    elif flags & int(mi.BSDFFlags.Delta | mi.BSDFFlags.Delta1D):
        problem = "mirrors"
    elif "MeshAttribute" in str(bsdf):  # no value without the mesh
        problem = "varies over the surface with an attribute of its mesh"
    else:
        varies, lambertian = _variation(bsdf, name)
        if varies and not lambertian:
            problem = "varies over the surface in more than a Lambertian reflectance"
    if problem:
        raise UnfactorableError(
            name,
            f"BSDF {bsdf_class(bsdf)} {problem}",
            ", which factors of a BRDF cannot; use path tracing instead",
        )
    return varies


def _variation(bsdf: mi.BSDF, name: str) -> tuple[bool, bool]:
    """Whether texture coordinates make a difference, which flags do not always tell, and if so, whether it is
    Lambertian: alike for all pairs of directions.
    """
    incident, outgoing = probe_directions()
    places = 256  # texture coordinates
    uv = np.random.default_rng(0).random((2, places), np.float32)
    uv[:, 0] = 0
    si = dr.zeros(mi.SurfaceInteraction3f, places * len(incident))
    si.uv = mi.Point2f(np.repeat(uv, len(incident), axis=1))
    many = np.tile(incident, (places, 1)), np.tile(outgoing, (places, 1))
    value = _evaluate_at(bsdf, name, si, *many).reshape(places, len(incident), 3) / incident[:, 2:]
    rounding = ROUNDING * (np.abs(value).max(axis=(0, 2)) + 0.01)[:, None]  # [pair, 1]
    change = value - value[0]  # [place, pair, channel]
    least_glossy = int(np.argmin(rounding))
    alike = np.abs(change - change[:, [least_glossy]]) <= rounding + rounding[least_glossy]
    return bool((np.abs(change) > rounding).any()), bool(alike.all())


def is_anisotropic(bsdf: mi.BSDF, name: str) -> bool:
    """Whether a BRDF changes when both directions are turned about the normal."""
    incident, outgoing = probe_directions()
    turn = np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]], np.float32)  # by 53 degrees
    value = evaluate_brdf(bsdf, name, incident, outgoing)
    turned = evaluate_brdf(bsdf, name, incident @ turn, outgoing @ turn)
    unlike = 1e-2 * np.abs(value).max()  # more than tables and rounding make
    return bool((np.abs(turned - value) > unlike).any())


def probe_directions(count: int = 12) -> tuple[Floats, Floats]:
    """Pairs of directions (3 * count, 3), incident and outgoing: at the highlight, beside it, and anywhere."""
    rng = np.random.default_rng(0)
    outgoing, other = (_sample_high_directions(rng, count) for _ in range(2))
    mirrored = outgoing * np.array([-1, -1, 1], np.float32)
    beside = mirrored + 0.15 * other
    beside /= np.linalg.norm(beside, axis=1, keepdims=True)
    return np.concatenate([mirrored, beside, other]), np.tile(outgoing, (3, 1))


def _sample_high_directions(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Random directions (count, 3), none close to the horizon."""
    z, phi = rng.uniform(0.3, 1, count), rng.uniform(0, 2 * np.pi, count)
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1).astype(np.float32)
