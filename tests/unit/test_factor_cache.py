"""Factors of BRDFs found again on disk: by what the BSDF is, and only if the file is whole."""

import time
from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_sparse_prt as prt
from mi_sparse_prt.reflection.brdf_factors import (
    DirectionGrid,
    FactorOptions,
    factor_cache,
    measure_factor_error,
)

SMALL = DirectionGrid(10, 20)
FEW = FactorOptions(SMALL, 1 << 12)
factors_of = partial(factor_cache.factors_of, options=FEW)


class Counted:
    """``factor_brdf``, with a count of its calls."""

    def __init__(self) -> None:
        self.calls, self.made = 0, factor_cache.factor_brdf

    def __call__(self, *args: object) -> object:
        self.calls += 1
        return self.made(*args)


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counted:
    counter = Counted()
    monkeypatch.setattr(factor_cache, "factor_brdf", counter)
    return counter


def phong(exponent: float = 10.0, **other: object) -> mi.BSDF:
    return mi.load_dict({"type": "phong", "exponent": exponent, **other})


def test_the_second_call_reads(counted, tmp_path):
    folder = tmp_path / "made" / "on demand"
    first = factors_of(phong(), "vase", folder=folder)
    start = time.perf_counter()
    second = factors_of(phong(), "another name", 6, folder=folder)
    assert time.perf_counter() - start < 0.2
    assert counted.calls == 1
    assert first.terms == 4 and second.terms == 6
    assert np.array_equal(first.incident, second.incident[:4])
    assert np.array_equal(first.outgoing, second.outgoing[:4])
    assert np.array_equal(first.diffuse, second.diffuse) and second.grid == SMALL
    assert [path.suffix for path in folder.iterdir()] == [".npz"]


def test_in_the_users_cache_by_default(counted, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    factors_of(phong(), "vase")
    assert len(list((tmp_path / "mi_sparse_prt" / "brdf").glob("*.npz"))) == 1


def bitmap(value: float) -> dict:
    pixels = np.full((2, 2, 3), 0.5, np.float32)
    pixels[1, 1] = value
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "filter_type": "nearest"}


def test_what_makes_another_file(counted, tmp_path, monkeypatch):
    any_factors = counted.made(phong(), "vase", 16, SMALL)
    any_error = measure_factor_error(any_factors, phong(), "vase", pairs=FEW.pairs)
    counted.made = lambda *_: any_factors  # what they are does not matter here
    monkeypatch.setattr(factor_cache, "measure_factor_error", lambda *_, **__: any_error)
    brushed = {"type": "ashikhmin_shirley", "exponent_u": 10.0, "exponent_v": 10.0}
    bsdfs = [
        phong(),
        phong(10.00001),
        phong(specular_reflectance=0.21),
        phong(diffuse_reflectance=bitmap(0.2)),
        phong(diffuse_reflectance=bitmap(0.3)),
        mi.load_dict(brushed),
        mi.load_dict({"type": "roughconductor", "alpha": 0.4, "distribution": "beckmann"}),
        mi.load_dict({"type": "roughconductor", "alpha": 0.4, "distribution": "ggx"}),
    ]
    for bsdf in bsdfs:
        factors_of(bsdf, "vase", folder=tmp_path)
    assert counted.calls == len(bsdfs)
    other = FactorOptions(DirectionGrid(8, 20), FEW.pairs)
    factor_cache.factors_of(phong(), "vase", folder=tmp_path, options=other)
    monkeypatch.setattr(factor_cache, "FORMAT", factor_cache.FORMAT + 1)
    factors_of(phong(), "vase", folder=tmp_path)
    assert counted.calls == len(bsdfs) + 2 == len(list(tmp_path.iterdir()))


class Silent(mi.BSDF):
    """A plugin that shows none of its parameters."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.reflectance = props["reflectance"]
        self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
        self.m_flags = self.m_components[0]

    def eval(
        self, context: object, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: bool = True
    ) -> mi.Color3f:
        return mi.Color3f(self.reflectance / np.pi * dr.maximum(wo.z, 0) * (si.wi.z > 0))

    def pdf(
        self, context: object, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: bool = True
    ) -> mi.Float:
        return mi.warp.square_to_cosine_hemisphere_pdf(wo)

    def sample(
        self, context: object, si: object, sample1: mi.Float, sample2: mi.Point2f, active: bool = True
    ) -> tuple:
        bs = dr.zeros(mi.BSDFSample3f, dr.width(sample2))
        bs.wo = mi.warp.square_to_cosine_hemisphere(sample2)
        bs.pdf = mi.warp.square_to_cosine_hemisphere_pdf(bs.wo)
        return bs, mi.Color3f(self.reflectance)

    def to_string(self) -> str:
        return "Silent[]"


def test_a_plugin_that_shows_nothing(counted, tmp_path):
    mi.register_bsdf("silent", Silent)
    for reflectance in (0.2, 0.7, 0.2):
        bsdf = mi.load_dict({"type": "silent", "reflectance": reflectance})
        assert factors_of(bsdf, "vase", folder=tmp_path).diffuse == pytest.approx([reflectance], rel=1e-5)
    assert counted.calls == 2


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "dielectric"},
        {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}},
    ],
)
def test_what_cannot_be_factored_leaves_no_file(bsdf, tmp_path):
    with pytest.raises(prt.PrtError, match="shape 'vase': BSDF"):
        factors_of(mi.load_dict(bsdf), "vase", folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_varying_parts_are_remembered(counted, tmp_path):
    for _ in range(2):
        found = factors_of(phong(diffuse_reflectance=bitmap(0.2)), "vase", folder=tmp_path)
        assert found.varying_diffuse
        assert not factors_of(phong(), "vase", folder=tmp_path).varying_diffuse
    assert counted.calls == 2


def changed(path: Path, how: str) -> None:
    data = bytearray(path.read_bytes())
    if how == "one bit":
        data[len(data) // 2] ^= 1
    path.write_bytes({"cut": data[:-500], "empty": b"", "text": b"no archive", "one bit": data}[how])


@pytest.mark.parametrize("how", ["cut", "empty", "text", "one bit"])
def test_damaged_files_are_replaced(how, counted, tmp_path):
    good = factors_of(phong(), "vase", folder=tmp_path)
    (path,) = tmp_path.iterdir()
    changed(path, how)
    for calls in (2, 2):
        again = factors_of(phong(), "vase", folder=tmp_path)
        assert counted.calls == calls
        assert np.array_equal(good.incident, again.incident)
    assert list(tmp_path.iterdir()) == [path]


def test_no_folder_is_no_reason_to_stop(counted, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.warns(prt.PrtWarning, match="cache of BRDF factors"):
        assert factors_of(phong(), "vase", folder=tmp_path / "file" / "below").terms == 4


def test_fewest_terms_for_a_target(counted, tmp_path):
    bsdf = phong(5.0)
    factors_of(bsdf, "vase", folder=tmp_path)
    error = measure_factor_error(counted.made(bsdf, "vase", 16, SMALL), bsdf, "vase", pairs=FEW.pairs).whole
    for target in (error[2], (error[7] + error[8]) / 2):
        found = factors_of(bsdf, "vase", target_error=float(target), folder=tmp_path)
        assert error[found.terms - 1] <= target < error[found.terms - 2]
    with pytest.warns(prt.PrtWarning, match=rf"shape 'vase': 16 factors .* {error[15] * 100:.1f}%") as seen:
        found = factors_of(bsdf, "vase", target_error=1e-4, folder=tmp_path)
    assert found.terms == 16 and len(seen) == 1 and counted.calls == 1


@pytest.mark.parametrize("terms", [0, 17])
def test_numbers_of_terms_that_are_none(terms, tmp_path):
    with pytest.raises(prt.PrtError, match="shape 'vase': .* give 1 to 16"):
        factors_of(phong(), "vase", terms, folder=tmp_path)
