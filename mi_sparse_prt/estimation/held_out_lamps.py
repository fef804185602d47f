"""How good a matrix of lamps is, from points at which all of its columns are found again by rays and paths."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.random_keys import element_seeds, random_stream
from mi_sparse_prt.estimation.element_sampling import draw_by_energy
from mi_sparse_prt.estimation.held_out import HELD_OUT, HeldOutError, Sample, estimate_errors, seen_shares
from mi_sparse_prt.solvers.lamps import LampRays, LightByPaths
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.specular import SpecularOptions, specular_light
from mi_sparse_prt.transport import LightTransport

ELEMENTS = 1 << 12  # in all, about. Twice as many told no more of a kitchen: 2.2 to 2.5% by four seeds
LEAST = 2  # of each group
SEEN = 1 << 11  # elements of what cameras see
SPP = 256  # of 64, those of a lamp behind glass told an error of 0
STRATA = 4  # per axis of a cell, of rays towards mirrors and glass
BLOCK = 4096  # points at a time

Doubles: TypeAlias = NDArray[np.float64]


def held_out_lamp_error(problem: Problem, transport: LightTransport, seed: int) -> HeldOutError:
    """Estimate the relative L2 error of a matrix of lamps; see ``held_out_error``.

    Of a matrix that has only what surfaces reflect, that is the error of this, relative to what lamps send on, too.
    """
    stream = random_stream(seed, HELD_OUT)
    rng, seeds = np.random.default_rng(stream), element_seeds(stream, 4)
    albedo = problem.reflection.albedo.astype(np.float64)
    groups, energy, m = transport.measurement.groups, _energy(transport, albedo), problem.emission.size
    places = [slice(group.vertices.start * m, group.vertices.stop * m) for group in groups]
    drawn = [draw_by_energy(energy.ravel(), place, ELEMENTS, LEAST, rng) for place in places]
    shares = _seen_shares(problem)
    drawn += _drawn_where_seen(energy, shares, rng)
    elements, weights = (np.concatenate(part) for part in zip(*drawn, strict=True))
    asked = (
        elements // m,
        elements % m,
    )  # those of all groups at once: each evaluation starts dozens of kernels
    ours = transport.incident.elements(*asked).astype(np.float64)
    seen = "direct" in transport.operators
    x, y = (_true(problem, asked, seen, *pair) for pair in (seeds[:2], seeds[2:]))
    power = albedo[asked[0]] ** 2
    sums = ((power * a * b).sum(axis=1) for a, b in ((ours - x.light, ours - y.light), (x.all, y.all)))
    columns = weights, *(column[:, None] for column in sums), shares.ravel()[elements], np.ones(len(weights))
    ends = np.cumsum([len(one) for one, _ in drawn])[:-1]
    parts = [Sample(*some) for some in zip(*(np.split(column, ends) for column in columns), strict=True)]
    return estimate_errors(
        {(g.name, "all"): part for g, part in zip(groups, parts, strict=False)}, parts[len(groups) :]
    )


def _seen_shares(problem: Problem) -> Doubles:
    """How much of what cameras see is each vertex, lit by lamps as bright as they are, squared (n, m)."""
    brightness = getattr(problem.emission, "brightness", np.ones((problem.emission.size, 3)))
    return seen_shares(problem)[:, None] * np.square(brightness, dtype=np.float64).mean(axis=1)


def _drawn_where_seen(
    energy: NDArray[np.float32], shares: Doubles, rng: np.random.Generator
) -> list[tuple[NDArray[np.int64], Doubles]]:
    """Elements that cameras see, and how many of these each stands for, if any have light."""
    places = np.flatnonzero(shares)
    bright = (energy * shares).ravel()[places]
    if not bright.any():
        return []
    chosen, weights = draw_by_energy(bright, slice(0, len(bright)), SEEN, LEAST, rng)
    return [(places[chosen], weights)]


def _energy(transport: LightTransport, albedo: Doubles) -> NDArray[np.float32]:
    """What vertices send on of each lamp, squared, as the matrix has it (n, m)."""
    energy = np.empty((len(albedo), transport.incident.shape[1]), np.float32)
    for a in range(0, len(albedo), BLOCK):
        ids = np.arange(a, min(a + BLOCK, len(albedo)))
        energy[ids] = np.square(transport.incident.rows(ids) * albedo[ids, None]).sum(axis=2)
    return energy


class _True(NamedTuple):
    """Unit-albedo light (m, 3) of listed elements: such as is in a matrix, and all of it."""

    light: Doubles
    all: Doubles


def _true(problem: Problem, asked: tuple[Any, Any], seen: bool, rays: int, paths: int) -> _True:
    """Light that nothing reflected is in the matrix if it is ``seen``; by the seeds of rays and of paths."""
    sent = LampRays(problem, 16, rays).elements(*asked).mean.astype(np.float64)
    if problem.max_depth == 2:
        return _True(sent, sent)
    reflected = LightByPaths(problem, *asked, SPP, paths).estimate().mean.astype(np.float64)
    if not seen:
        return _True(reflected, sent + reflected)
    every = sent + reflected + _by_mirrors(problem, asked, rays)
    return _True(every, every)


def _by_mirrors(problem: Problem, asked: tuple[Any, Any], seed: int) -> Doubles:
    """What mirrors and glass bring (m, 3): rays into each cell that sees any."""
    found = np.zeros((len(asked[0]), 3))
    if problem.scene.bends_light:
        ids, place = np.unique(asked[0], return_inverse=True)
        light = specular_light(problem, seed, SpecularOptions(STRATA, STRATA), ids)
        for channel in range(3):
            matrix = light.matrices[channel % len(light.matrices)].toarray()
            found[:, channel] = matrix[place, asked[1]]
    return found
