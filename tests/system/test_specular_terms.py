"""Specular light as terms of glossy surfaces receive it: where rays go, and in which blocks."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import GROUND, T, build, problem_at

import mi_sparse_prt as prt
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.reflection.factor_tables import incident_tables
from mi_sparse_prt.reflection.surfaces import chosen_reflection
from mi_sparse_prt.solvers import specular_terms
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.specular import SpecularOptions, SpecularSearch
from mi_sparse_prt.solvers.specular_terms import TermRows, term_rows

pytestmark = pytest.mark.filterwarnings("ignore::mi_sparse_prt.core.errors.PrtWarning")
SHINY = {"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": 0.3}
GOLD = {"type": "conductor", "material": "Au"}
COAT = {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.5, 0.3, 0.2]}}


def glossy_problem() -> Problem:
    """A glossy ground before a wall with a coat, which sends 4% of light on and more, and a ball of gold."""
    shapes = {
        "ground": {**GROUND, "bsdf": SHINY},
        "wall": {"type": "rectangle", "to_world": T().translate([0, 1, -1]), "bsdf": COAT},
        "gold": {"type": "sphere", "center": [0.5, 0.2, 0.2], "radius": 0.2, "bsdf": GOLD},
    }
    scene = build(0.4, **shapes)
    reflection = chosen_reflection(scene, 0.05).seen
    assert reflection.terms
    problem = problem_at(scene, prt.CubemapLighting(4), basis="texel")
    return replace(problem, reflection=reflection, specular_apart=True)


def sums(found: TermRows) -> np.ndarray:
    """Light (terms' rows, channels) of all texels."""
    assert len(found.matrices) == 3
    return np.stack([np.asarray(m.sum(axis=1)).ravel() for m in found.matrices], axis=1)


@pytest.mark.slow
def test_fewer_rays_into_coats_find_the_same(monkeypatch):
    """
    Expected: with rays by the share of light that surfaces send on, less than half of the rays; the light of all
        terms is that of as many rays into each cell, on average over seeds, within 4 standard errors and 2%.
    """
    problem = glossy_problem()
    few = [term_rows(problem, seed) for seed in range(60)]
    monkeypatch.setattr(specular_terms, "LEAST_SHARE", 1.0)
    many = [term_rows(problem, 50 + seed) for seed in range(30)]
    print(f"{few[0].rays} and {many[0].rays} rays")
    assert few[0].rays < 0.5 * many[0].rays
    a, b = (np.array([sums(found).sum(axis=0) for found in some]) for some in (few, many))
    error = np.hypot(*(x.std(axis=0, ddof=1) / np.sqrt(len(x)) for x in (a, b)))
    print(a.mean(axis=0) / b.mean(axis=0), error / b.mean(axis=0))
    assert np.all(error < 0.006 * np.abs(b.mean(axis=0)))
    assert np.all(np.abs(a.mean(axis=0) - b.mean(axis=0)) < 4 * error)
    weight = np.random.default_rng(0).normal(size=len(sums(few[0])))
    a, b = (np.array([weight @ sums(found) for found in some]) for some in (few, many))
    error = np.hypot(*(x.std(axis=0, ddof=1) / np.sqrt(len(x)) for x in (a, b)))
    assert np.all(np.abs(a.mean(axis=0) - b.mean(axis=0)) < 4 * error)


def test_blocks_do_not_show(monkeypatch):
    """Expected: the same bits, whether all points are looked at together or a few at a time."""
    problem = glossy_problem()
    whole = term_rows(problem, 3)
    monkeypatch.setattr(specular_terms, "LANES", 8 * 20_000)
    parts = term_rows(problem, 3)
    assert parts.rays == whole.rays
    for a, b in zip(whole.matrices, parts.matrices, strict=True):
        assert a.shape == b.shape
        assert a.nnz and abs(a - b).max() == 0


def test_light_through_a_half_open_sky():
    """
    Rationale: a sheet over all of a glossy ground lets 60% of each texel through, straight on.
    Expected: terms of what passes are 0.6 times those of the open sky at the centres of texels, within 0.5%.
    """
    half = {"type": "mask", "opacity": 0.4, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
    sheet = {
        "type": "rectangle",
        "to_world": T().translate([0, 0.5, 0]).rotate([1, 0, 0], -90).scale(40),
        "bsdf": half,
    }
    scene = build(float("inf"), ground={**GROUND, "bsdf": SHINY}, sheet=sheet)
    reflection = chosen_reflection(scene, 0.05).seen
    problem = problem_at(scene, prt.CubemapLighting(16), basis="texel")
    problem = replace(problem, reflection=reflection, specular_apart=True)
    search = SpecularSearch(problem, 3, SpecularOptions(8, 8))
    found = term_rows(problem, 3, search.passed)
    assert np.array_equal(reflection.glossy, np.arange(len(reflection.glossy)))
    n, size = len(reflection.glossy), problem.emission.size
    above = problem.emission.directions[:, 1] > 0.2
    bits = np.full((n, size // 32), 0xFFFFFFFF, np.uint32)
    open_sky = FactoredVisibility(
        Visibility(bits, scene.normals[:n], problem.emission),
        reflection.tangents[:n],
        np.zeros(n, int),
        incident_tables(reflection.factors),
    )
    expected = 0.6 * open_sky.rows(np.arange(n, n + n * reflection.terms))[:, above, 0]
    (matrix,) = found.matrices
    ours = matrix.toarray().reshape(len(expected), -1, size).sum(axis=1)[:, above]
    error = np.linalg.norm(ours - expected) / np.linalg.norm(expected)
    print(f"{error:.3%} off, {(ours * expected).sum() / np.square(expected).sum():.4f} of what is expected")
    assert error < 0.005
