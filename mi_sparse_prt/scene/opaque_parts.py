"""Parts of cut-out surfaces that certainly let no light pass.

A ray that meets a leaf has to ask how opaque it is just there, and to go on; one that meets anything opaque is done. So
triangles under an opacity texture are cut into four, and these again, and what lies where all texels around are opaque
is put with all other surfaces that block light. What is left is asked as before.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.scene.mitsuba_meshes import build_mitsuba_mesh
from mi_sparse_prt.scene.traversal import children
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh

DEPTH = 2  # how often triangles are cut into four
MOST = 1 << 20  # parts
OPAQUE = 1 - 1e-4

_QUARTERS = np.array(
    [
        [[2, 0, 0], [1, 1, 0], [1, 0, 1]],
        [[1, 1, 0], [0, 2, 0], [0, 1, 1]],
        [[1, 0, 1], [0, 1, 1], [0, 0, 2]],
        [[1, 1, 0], [0, 1, 1], [1, 0, 1]],
    ]
) / np.float64(2)  # [quarter, corner, corner of the whole]


class _Opacity(NamedTuple):
    """An opacity texture.

    Attributes
    ----------
    to_uv : (3, 3) float64
        From a mesh's texture coordinates to the image's, 0 to 1 across it.
    repeats : bool
        Beside itself, beyond 0 and 1.
    veiled, opaque : (height + 3, width + 3) int64
        How many texels are not opaque, and how many are, above and left of each place of the image with one more texel
        all around.
    """

    to_uv: NDArray[np.float64]
    repeats: bool
    veiled: NDArray[np.int64]
    opaque: NDArray[np.int64]


def opaque_part(shape: mi.Mesh) -> mi.Mesh | None:
    """Triangles, for rays that ask for nothing but hits, where the mask of a mesh is opaque; None if that is not known.

    Parameters
    ----------
    shape : mi.Mesh
        Whose BSDF may be a ``mask`` with a ``bitmap`` for its opacity, over a BSDF that no light goes straight through.
    """
    opacity = _opacity_of(shape.bsdf()) if shape.has_vertex_texcoords() else None
    if opacity is None:
        return None
    faces = np.array(shape.faces_buffer()).reshape(-1, 3)
    places = np.array(shape.vertex_positions_buffer(), np.float64).reshape(-1, 3)[faces]
    coordinates = np.array(shape.vertex_texcoords_buffer(), np.float64).reshape(-1, 2)[faces]
    left = np.concatenate([places, coordinates @ opacity.to_uv[:2, :2].T + opacity.to_uv[:2, 2]], axis=2)
    parts, count = [np.zeros((0, 3, 5))], 0
    for depth in range(DEPTH + 1):
        veiled, opaque = _texels_under(opacity, left[..., 3:])
        parts.append(left[veiled == 0])
        count += len(parts[-1])
        left = left[(veiled > 0) & (opaque > 0)]
        if depth == DEPTH or count + 4 * len(left) > MOST:
            break
        left = np.einsum("qcw,twk->tqck", _QUARTERS, left).reshape(-1, 3, 5)
    return _mesh_of(np.concatenate(parts)[..., :3]) if count else None


def _mesh_of(corners: NDArray[np.float64]) -> mi.Mesh:
    """Of triangles (k, 3, 3), which share no vertices: to find those alike takes longer than rays to them do."""
    positions = corners.reshape(-1, 3).astype(np.float32)
    triangles = np.arange(len(positions), dtype=np.int32).reshape(-1, 3)
    mesh = TriangleMesh("", positions, np.zeros_like(positions), triangles)
    return build_mitsuba_mesh(mesh, mi.load_dict({"type": "diffuse"}))


def _opacity_of(bsdf: mi.BSDF) -> _Opacity | None:
    """What can be known about the opacity of a BSDF, or None."""
    if bsdf.class_name() != "MaskBSDF":
        return None
    inside = dict(children(bsdf))
    texture, covered = inside["opacity"], inside["nested_bsdf"]
    if not texture.class_name().startswith("BitmapTexture") or mi.has_flag(
        covered.flags(), mi.BSDFFlags.Null
    ):
        return None
    values = mi.traverse(texture)
    image, to_uv = np.array(values["data"]), np.array(values["to_uv"].matrix, np.float64)
    if image.dtype.kind == "u":  # as the file has it
        image = image / np.iinfo(image.dtype).max
    if min(image.shape[:2]) < 2 or np.linalg.det(to_uv[:2, :2]) == 0:
        return None
    is_opaque = np.pad(image.min(axis=2) >= OPAQUE, 1)  # what is beyond is not known
    repeats = _repeats(texture, to_uv, image.shape[:2])
    if repeats:
        is_opaque = np.pad(is_opaque[1:-1, 1:-1], 1, mode="wrap")
    veiled, opaque = (kind.astype(np.int32) for kind in (~is_opaque, is_opaque))
    sums = (np.pad(one.cumsum(0).cumsum(1), ((1, 0), (1, 0))) for one in (veiled, opaque))
    return _Opacity(to_uv, repeats, *sums)


def _repeats(texture: mi.Texture, to_uv: NDArray[np.float64], size: tuple[int, int]) -> bool:
    """Whether all texels of an image (height, width) are found again to its right and below it."""
    y, x = np.mgrid[: size[0], : size[1]]
    places, values = (np.column_stack([x.ravel(), y.ravel()]) + 0.5) / size[::-1], []
    si = dr.zeros(mi.SurfaceInteraction3f, len(places))
    for beyond in ((0, 0), (1, 0), (0, 1)):
        uv = np.linalg.solve(to_uv[:2, :2], (places + beyond - to_uv[:2, 2]).T)
        si.uv = mi.Point2f(np.ascontiguousarray(uv, np.float32))
        values.append(np.array(texture.eval_1(si)))
    return all(np.allclose(values[0], other, atol=2e-3) for other in values[1:])


def _texels_under(opacity: _Opacity, uv: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """How many texels (t,) that triangles (t, 3, 2) may look up are not opaque, and how many are.

    Of triangles that reach beyond the image some are unknown, which count as both.
    """
    size = np.array(opacity.veiled.shape)[::-1] - 3  # without those around
    low, high = uv.min(axis=1), uv.max(axis=1)
    if opacity.repeats:
        shift = np.floor(low)
        low, high = low - shift, high - shift
    # texels lie at half numbers, and values between are interpolated; rounding may lead a little farther
    first, last = (np.floor(low * size - 0.52) + 1).astype(np.int64), np.floor(high * size + 0.52) + 1
    inside = (first >= 0).all(axis=1) & (last <= size + 1).all(axis=1)
    a = np.clip(first, 0, size + 1)
    b = np.clip(last, 0, size + 1).astype(np.int64) + 1

    def count(sums: NDArray[np.int64]) -> NDArray[np.int64]:
        return (
            sums[b[:, 1], b[:, 0]] - sums[a[:, 1], b[:, 0]] - sums[b[:, 1], a[:, 0]] + sums[a[:, 1], a[:, 0]]
        )

    unknown = (~inside).astype(np.int64)
    return count(opacity.veiled) + unknown, count(opacity.opaque) + unknown
