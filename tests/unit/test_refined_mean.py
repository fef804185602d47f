"""Means of estimates that are refined until they have little noise; what these find does not decide what they count."""

import math

import numpy as np
import pytest
import scipy.sparse

from mi_sparse_prt.solvers.refined_mean import Limit, RefinedMean, Round, Timed, compared

POINTS, TEXELS = 60, 40
POWER = np.ones((POINTS, 3))


def estimate(rng, rays):
    """Light of 1 from so many rays per point, each of which finds all of it in one of ten cases."""

    def half():
        found = rng.binomial(rays, 0.1, (POINTS, TEXELS)) * (10 / rays)
        return [scipy.sparse.csr_array(found.astype(np.float32))] * 3

    return compared([half(), half()], POWER, 2 * rays * POINTS)


def mean_of(light):
    return float(light.mean()[1].mean())


def test_as_little_noise_as_is_asked_for():
    """Expected: rounds end where the noise is small enough; it is as large as is told, and light is right within 1%."""
    rng = np.random.default_rng(1)
    noise_of_one = 3 * POINTS * TEXELS * 9 / 2  # of three channels' two halves, each of one ray

    def more(wanted, _affordable):
        rays = max(int(np.ceil(noise_of_one / wanted)), 1)
        return Round(estimate(rng, rays), noise_of_one / rays, False)

    light = RefinedMean(estimate(rng, 4), more)
    assert light.refine(Limit(0.0, 40.0, 0.0))
    errors = light.mean()[0].toarray() - 1
    assert 20 < light.noise <= 44
    assert 3 * np.square(errors).sum() == pytest.approx(light.noise, rel=0.15)
    assert mean_of(light) == pytest.approx(1, abs=0.01)


def test_few_rays_that_find_nothing_take_nothing_away():
    """
    Scenario: rounds of few rays, most of which find no light at all, and so seem to have no noise.
    Expected: light is right on average; it would be lost if estimates counted by the noise that they seem to have.
    """
    found, rng = [], np.random.default_rng(5)
    for _ in range(600):

        def half(rays):
            hits = rng.binomial(rays, 0.01, (1, 1)) * (100 / rays)
            return [scipy.sparse.csr_array(hits.astype(np.float32))] * 3

        def more(*_, half=half):
            return Round(compared([half(20), half(20)], np.ones((1, 3)), 40), 3 * 100 / 20 / 2, False)

        first = compared([half(160), half(160)], np.ones((1, 3)), 320)
        light = RefinedMean(first._replace(noise=3 * 100 / 160 / 2), more)
        light.refine(Limit(0.0, 1e-6, 0.0))
        found.append(mean_of(light))
    error = np.std(found, ddof=1) / np.sqrt(len(found))
    print(f"{np.mean(found):.3f} +- {error:.3f}")
    assert np.mean(found) == pytest.approx(1, abs=4 * error)
    assert error < 0.02


def test_no_more_rays_than_there_is_time_for():
    """
    Scenario: rays take a millisecond each; ten seconds are left for noise that needs more, or less, than that.
    Expected: no round is given more rays than its time is enough for, none is begun that has too few, and that the
        noise stayed is told; light is right all the same.
    """
    rng, given = np.random.default_rng(2), []
    first = estimate(rng, 200)._replace(timed=Timed(4.0, 4000))

    def more(wanted, affordable):
        given.append(affordable)
        if len(given) > 1:
            return None
        return Round(estimate(rng, 400)._replace(timed=Timed(1.0, 4000)), first.noise / 2, False)

    light = RefinedMean(first, more)
    assert not light.refine(Limit(0.0, 1e-3, 0.0), 10.0)
    assert given == pytest.approx([10_000, 40_000], rel=0.05)  # the last rays say what the next ones take
    assert mean_of(light) == pytest.approx(
        1, abs=0.008
    )  # four standard errors of 600 rays of each element, twice
    assert Timed(1.0, 0).rays_in(math.inf) == math.inf
    assert RefinedMean(first, more).refine(Limit(0.0, 2 * first.noise, 0.0), 0.0)
