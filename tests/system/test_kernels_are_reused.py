"""Kernels do not depend on how many lanes there are: to compile one takes a tenth of a second, or seconds."""

import re
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from conftest import BALL, GROUND, PALE, T, build

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.measurement import mesh_vertices
from mi_sparse_prt.reflection.reflection import Diffuse
from mi_sparse_prt.scene.materials import is_one_of
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.specular import specular_light
from mi_sparse_prt.solvers.texel_edges import fractional_visibility

GLASS = {**BALL, "center": [-0.6, 0.4, 0.3], "bsdf": {"type": "dielectric"}}
ROUGH = {**BALL, "center": [0.6, 0.4, 0.1], "bsdf": {"type": "roughdielectric", "alpha": 0.2}}
MASK = {
    "type": "rectangle",
    "to_world": T().translate([0, 0.5, 0.9]).scale(0.5),
    "bsdf": {"type": "mask", "opacity": 0.4, "nested": {"type": "twosided", "bsdf": PALE}},
}


def problem(basis: str) -> Problem:
    scene = build(0.25, ground=GROUND, glass=GLASS, rough=ROUGH, mask=MASK)
    where, seen = mesh_vertices(scene), Diffuse(scene.albedo)
    return Problem(scene, prt.CubemapLighting(4), where, seen, basis, 5, True)


def compiled_by(work: Callable[[], object]) -> set[str]:
    """Kernels that some work runs and that trace rays."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        work()
        history = dr.kernel_history([dr.KernelType.JIT])
    codes = [_code(kernel) for kernel in {kernel["hash"]: kernel for kernel in history}.values()]
    return {code for code in codes if any(word in code for word in ("_in_ctx", "_optix_"))}


def _code(kernel: dict[str, object]) -> str:
    """Without its name, nor how arrays lie in memory."""
    text = kernel["ir"]
    text = text if isinstance(text, str) else text.read()  # type: ignore[attr-defined]
    return re.sub(r"drjit_[0-9a-f]+|align \d+|, !nontemporal !\d", "", text)


def test_specular_light_of_other_points() -> None:
    """
    Rationale: a mean of colours by Dr.Jit, and sums with a copy for each thread, have the number of lanes in the code.
    Expected: light of other points, more and of another number, takes no kernel that was not there.
    """
    here = problem("texel")
    ids = np.arange(len(here.points))
    before = compiled_by(lambda: [specular_light(here, 0, ids=some) for some in (ids[::40], ids[1::25])])
    after = compiled_by(lambda: specular_light(here, 1, ids=ids[2::12]))
    assert before and after <= before


def test_edges_of_texels() -> None:
    """Expected: bisection takes one kernel for all steps, and for any number of places."""
    here = problem("texel")
    solver = DirectSolver(Problem(here.scene, here.emission, here.measurement, here.reflection, "direction"))
    bits = solver.rows(np.arange(len(here.points)))
    found = compiled_by(lambda: fractional_visibility(solver, bits))
    assert 1 <= len(found) <= 2  # the first step starts from 0


def test_surfaces_by_their_material() -> None:
    """Expected: one kernel for any BSDF that is asked for: what number it got when the scene was loaded is no part."""
    here = problem("texel").scene.unsplit
    bsdfs = [shape.bsdf() for shape in here.shapes()]
    assert len({int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(b))[0]) for b in bsdfs}) > 2

    def find(bsdf: mi.BSDF) -> None:
        lane = dr.arange(mi.Float, 64)
        ray = mi.Ray3f(mi.Point3f(lane / 32 - 1, 3, 0), mi.Vector3f(0, -1, 0))
        dr.eval(is_one_of([bsdf], here.ray_intersect(ray)))

    assert len(compiled_by(lambda: [find(bsdf) for bsdf in bsdfs])) == 1
