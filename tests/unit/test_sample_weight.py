"""Samples of BSDFs that rounding left no density or direction: rays do not go on there, and nothing else is lost."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import GROUND, T

from mi_sparse_prt.scene.materials import sample_weight

INF, NAN = float("inf"), float("nan")
EVERY = 4  # one sample of so many has no density
GOLD = {"type": "roughconductor", "material": "Au", "alpha": 0.02}
CAMERA = {
    "type": "perspective",
    "to_world": T().look_at([0, 1.2, 4], [0, 0.4, 0], [0, 1, 0]),
    "film": {"type": "hdrfilm", "width": 12, "height": 8, "rfilter": {"type": "box"}},
}
LIGHT = {
    "lamp": {"type": "sphere", "center": [0, 3, 0], "radius": 0.5, "emitter": {"type": "area"}},
    "sky": {"type": "constant", "radiance": 0.3},
}


class Slipping(mi.BSDF):
    """Gold, some samples of which are infinitely dense, as where Mitsuba divides by an angle that rounds to 0."""

    def __init__(self, properties: mi.Properties) -> None:
        mi.BSDF.__init__(self, properties)
        self.gold = mi.load_dict(GOLD)
        self.m_components = [self.gold.flags(0)]
        self.m_flags = self.gold.flags()

    def sample(self, context, si, lobe, u, active=True):  # noqa: ANN001, ANN201
        sample, weight = self.gold.sample(context, si, lobe, u, active)
        sample.pdf = dr.select(u.x < 1 / EVERY, INF, sample.pdf)
        return sample, weight

    def eval(self, context, si, wo, active=True):  # noqa: ANN001, ANN201
        return self.gold.eval(context, si, wo, active)

    def pdf(self, context, si, wo, active=True):  # noqa: ANN001, ANN201
        return self.gold.pdf(context, si, wo, active)

    def eval_pdf(self, context, si, wo, active=True):  # noqa: ANN001, ANN201
        return self.gold.eval_pdf(context, si, wo, active)

    def to_string(self) -> str:
        return "Slipping[]"


def test_what_is_no_sample_weighs_nothing():
    """Expected: a weight that is not finite with a direction and a density is a BSDF's fault, and stays."""
    sample = dr.zeros(mi.BSDFSample3f, 5)
    sample.pdf = mi.Float([1, INF, NAN, 2, 3])
    sample.wo = mi.Vector3f([0, 0, 0, NAN, 0], 0, 1)
    weight = sample_weight(sample, mi.Color3f(mi.Float([0.5, 0.6, 0.7, 0.8, NAN])))
    np.testing.assert_array_equal(weight.numpy()[0], np.float32([0.5, 0, 0, 0, NAN]))


@pytest.mark.usefixtures("never_held_out")
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(
    "light", [pytest.param(("sky",), marks=pytest.mark.slow), ("lamp", "sky")], ids=["sky", "lamp"]
)
def test_pictures_are_finite(light, tmp_path):
    """Expected: followed gold has no infinite pixels, and loses no more than these samples find."""
    mi.register_bsdf("slipping", Slipping)

    def picture(bsdf: dict) -> np.ndarray:
        ball = {"type": "sphere", "center": [0, 0.4, 0], "radius": 0.4, "bsdf": bsdf}
        scene = mi.load_dict(
            {"type": "scene", "ground": GROUND, "ball": ball, "camera": CAMERA} | {k: LIGHT[k] for k in light}
        )
        ours = {"type": "sparse_prt", "resolution": 2, "edge_length": 0.3, "max_depth": 3}
        integrator = mi.load_dict({**ours, "cache": str(tmp_path), "progress": False})
        return np.array(mi.render(scene, integrator=integrator, spp=256))

    whole, ours = picture(GOLD), picture({"type": "slipping"})
    print(ours.mean() / whole.mean())
    assert np.isfinite(ours).all()
    assert (1 - 1 / EVERY) * whole.mean() < ours.mean() < whole.mean()
