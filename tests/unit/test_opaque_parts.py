"""Parts of cut-out surfaces that certainly let no light pass."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import T, build, problem_at

import mi_sparse_prt as prt
from mi_sparse_prt.scene.opaque_parts import OPAQUE, opaque_part
from mi_sparse_prt.solvers.direct_rays import DirectSolver

TEXELS = 40
QUADS = 12  # along a side of the square


def blots(kind: str) -> np.ndarray:
    """(40, 40, channels) opacity: smooth spots that are cut off above and below."""
    y, x = np.mgrid[:TEXELS, :TEXELS] / TEXELS
    wave = np.sin(2 * np.pi * (2 * x + y)) + np.sin(2 * np.pi * (x - 2 * y)) + 0.8 * np.cos(2 * np.pi * 3 * x)
    opacity = np.clip(3 * wave, 0, 1)[..., None]
    if kind == "colour":  # opaque where all channels are
        opacity = np.concatenate([opacity, np.roll(opacity, 3, 0), opacity], axis=2)
    return (255 * opacity + 0.5).astype(np.uint8) if kind == "bytes" else opacity.astype(np.float32)


def sheet(kind: str = "float", covered: dict | None = None, **texture: object) -> mi.Mesh:
    """A square of 2 x 2, whose texture coordinates are its places from -1 to 1."""
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(blots(kind)), "raw": True} | texture
    bsdf = {"type": "mask", "opacity": bitmap, "covered": covered or {"type": "diffuse"}}
    side = np.linspace(-1, 1, QUADS + 1, dtype=np.float32)
    corners = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    first = (np.arange(QUADS)[:, None] * (QUADS + 1) + np.arange(QUADS)).reshape(-1, 1)
    faces = np.concatenate([first + [0, 1, QUADS + 2], first + [0, QUADS + 2, QUADS + 1]])
    mesh = mi.Mesh(
        "sheet",
        len(corners),
        len(faces),
        props=_properties(bsdf),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
    )
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = (
        np.column_stack([corners, np.zeros(len(corners))]).astype(np.float32).ravel()
    )
    parameters["vertex_texcoords"] = corners.ravel()
    parameters["faces"] = faces.ravel().astype(np.uint32)
    parameters.update()
    return mesh


def _properties(bsdf: dict) -> mi.Properties:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    return properties


@pytest.mark.parametrize(
    ("kind", "texture", "least"),
    [
        ("float", {}, 0.4),
        ("bytes", {"filter_type": "nearest"}, 0.4),
        ("colour", {"to_uv": T().rotate([0, 0, 1], 30).scale([0.7, 0.3, 1])}, 0.4),
        ("float", {"wrap_mode": "clamp", "to_uv": T().translate([0.4, 0.1, 0]).scale([0.3, 0.5, 1])}, 0.2),
        ("float", {"wrap_mode": "mirror", "to_uv": T().scale([0.4, 0.4, 1])}, 0.1),
    ],
    ids=["repeated", "nearest", "turned", "clamped", "mirrored"],
)
def test_where_parts_lie_the_mask_is_opaque(kind, texture, least):
    """
    Rationale: a part that lets light pass would darken what is behind it, and nobody would look there again.
    Expected: at 200 thousand random places of the parts Mitsuba finds the mask opaque, at all of them. They cover two
        fifths at least of what is opaque in a grid of places of the square; less of it is known where the image does
        not repeat and the square reaches beyond it: to the right and below (half as much), all around (a quarter).
    Result: 46 to 58%; 32 and 15%.
    """
    if "to_uv" in texture:
        texture = texture | {
            "to_uv": mi.ScalarTransform3f(np.delete(np.delete(texture["to_uv"].matrix, 2, 0), 2, 1))
        }
    shape = sheet(kind, **texture)
    part = opaque_part(shape)
    corners = np.array(part.vertex_positions_buffer()).reshape(-1, 3, 3)
    rng = np.random.default_rng(1)
    which = rng.integers(len(corners), size=200_000)
    weights = rng.dirichlet([1, 1, 1], size=len(which))
    places = np.einsum("nc,nck->nk", weights, corners[which])
    assert np.all(_opacity(shape, places[:, :2]) >= OPAQUE)
    y, x = np.mgrid[-0.995:1:0.01, -0.995:1:0.01]
    every = float((_opacity(shape, np.column_stack([x.ravel(), y.ravel()])) >= OPAQUE).mean()) * 4
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    print(f"{areas.sum() / every:.3f} of what is opaque, in {len(corners)} parts")
    assert areas.sum() > least * every


def _opacity(shape: mi.Mesh, uv: np.ndarray) -> np.ndarray:
    """1 less what the mask lets pass."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv, si.wi = mi.Point2f(uv.T.astype(np.float32)), mi.Vector3f(0, 0, 1)
    return 1 - np.array(shape.bsdf().eval_null_transmission(si))[0]


def test_of_what_is_not_known_there_are_no_parts():
    """A texture that is no image, one number, and a mask over what lets light pass itself."""
    assert opaque_part(sheet(covered={"type": "thindielectric"})) is None
    for opacity in ({"type": "checkerboard"}, 0.5, 1.0):
        shape = sheet()
        assert opaque_part(shape) is not None
        shape.set_bsdf(mi.load_dict({"type": "mask", "opacity": opacity, "covered": {"type": "diffuse"}}))
        assert opaque_part(shape) is None


def test_a_small_hole_at_the_edge_of_a_clamped_image_goes_on_beyond_it():
    """
    Rationale: an image that is opaque at all but a few texels seems to repeat, whatever it does; where it is clamped,
        a hole at its edge is a slit without end, and the square reaches as far as one image beyond each side.
    Expected: no part lies over the slit: at 200 thousand random places of the parts Mitsuba finds the mask opaque.
        An image that is opaque everywhere repeats: parts are nine tenths of the square at least.
    """
    rng = np.random.default_rng(2)
    for holes in (1, 0):
        image = np.ones((TEXELS, TEXELS, 1), np.float32)
        image[20 : 20 + holes, -holes:] = 1 - holes
        shape = sheet(bitmap=mi.Bitmap(image), wrap_mode="clamp", to_uv=_scaled(1.5))
        corners = np.array(opaque_part(shape).vertex_positions_buffer()).reshape(-1, 3, 3)
        places = np.einsum(
            "nc,nck->nk", rng.dirichlet([1, 1, 1], 200_000), corners[rng.integers(len(corners), size=200_000)]
        )
        assert np.all(_opacity(shape, places[:, :2]) >= OPAQUE)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    print(f"{areas.sum() / 4:.3f}")
    assert areas.sum() > 0.9 * 4


def _scaled(by: float) -> mi.ScalarTransform3f:
    return mi.ScalarTransform3f(np.diag([by, by, 1.0]))


def test_light_under_leaves_is_the_same(monkeypatch):
    """
    Rationale: rays that meet a part are done; all others are asked as before.
    Expected: of twelve sheets over each other and a ground, what is seen of all texels with parts is what is seen
        without them, but for one of a thousand elements (rays that meet two surfaces within the offset at which
        rays go on), and the same on average within 0.2%.
    Result: 4e-6 of elements differ, means by as much.
    """
    y, x = np.mgrid[-1:1:64j, -1:1:64j]
    ring = np.clip(8 * (np.hypot(x, y) - 0.1), 0, 1) * np.clip(8 * (1.3 - np.hypot(x, y)), 0, 1)
    ring = ring[..., None].astype(np.float32)
    leaves = {
        f"leaf_{k}": {
            "type": "rectangle",
            "to_world": T().translate([0.1 * k, 0, 0.2 + 0.05 * k]).rotate([1, k % 3, 0], 15 * (k % 4)),
            "bsdf": {
                "type": "mask",
                "opacity": {"type": "bitmap", "bitmap": mi.Bitmap(ring), "raw": True},
                "covered": {"type": "twosided", "bsdf": {"type": "diffuse"}},
            },
        }
        for k in range(12)
    }
    ground = {"type": "rectangle", "to_world": T().scale(2), "bsdf": {"type": "diffuse"}}
    found = []
    for parts in (opaque_part, lambda _: None):
        monkeypatch.setattr("mi_sparse_prt.scene.scene.opaque_part", parts)
        scene = build(0.25, ground=ground, **leaves)
        assert (scene.blocking_surfaces.mitsuba.shapes()[-1].face_count() > 10) == (parts is opaque_part)
        problem = replace(problem_at(scene, prt.CubemapLighting(8), None, "texel", 6), specular_apart=True)
        found.append(DirectSolver(problem, 2, 5).rows_of_shares(np.arange(scene.n_vertices, dtype=np.uint32)))
    with_parts, without = (f[f >= 0].astype(float) for f in found)
    print(np.mean(with_parts != without), with_parts.mean() / without.mean())
    assert np.mean(with_parts != without) < 1e-3
    assert with_parts.mean() == pytest.approx(without.mean(), rel=2e-3)
