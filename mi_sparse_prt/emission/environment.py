"""Equirectangular HDR images as light from infinitely far away: reading, checking and rotating them.

Orientation is that of Mitsuba's `envmap`: y is up; a direction d of the environment's own frame lies at
u = atan2(d.x, -d.z) / 2 pi (mod 1) and v = acos(d.y) / pi, u along a row, v = 0 at the top. Pixel (row, col) of an
image of h x w pixels is the cell [row, row + 1) / h x [col, col + 1) / w of that square, so the cells tile the sphere
and every pixel has an exact solid angle.

Mitsuba 3.9.1's `envmap` agrees horizontally (pixel centres at (col + 1/2) / w) but interpolates vertically from pole to
pole: its row centres are at v = row / (h - 1), not (row + 1/2) / h. The same file seen through `envmap` is therefore
stretched by up to half a pixel at the poles (nothing at the horizon) and blurred by one pixel.
"""

from __future__ import annotations

import copy
import os
import warnings
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.emission.equirectangular import pixel_solid_angles
from mi_sparse_prt.io.image_file import read_bitmap

SUFFIXES = (".exr", ".hdr", ".pfm")


class Environment:
    """Radiance that arrives from every direction, constant over each pixel of an equirectangular image.

    Parameters
    ----------
    pixels : (h, w, 3) array
        Linear RGB radiance, w = 2 h within a tenth. Negative values are clamped to zero with a `PrtWarning`.
    rotation : (3, 3) array, optional
        World from environment frame; the identity by default.
    source : str
        What error messages call the image: its path.

    Attributes
    ----------
    pixels : (h, w, 3) float32
        Clamped radiance, in the environment's own frame.
    rotation : (3, 3) float64
        A world direction is `rotation @ direction_of_environment`.
    report : dict
        `source`, `width`, `height`, and what the clamped values were: `negative_pixels` (pixels with a negative
        channel), `negative_pixel_share`, `negative_energy_share` (their part of the absolute energy: the sum of
        absolute radiance x solid angle over all channels).

    Raises
    ------
    PrtError
        If the image has NaN or infinite pixels or not the shape above, or `rotation` is not a rotation.
    """

    def __init__(
        self, pixels: ArrayLike, rotation: ArrayLike | None = None, source: str = "environment"
    ) -> None:
        pixels = np.array(pixels, dtype=np.float32)  # [h, w, rgb], a copy of our own
        _check_shape(pixels, source)
        _check_finite(pixels, source)
        self.report: dict[str, Any] = {"source": source, "width": pixels.shape[1], "height": pixels.shape[0]}
        self.report |= _clamp_negative(pixels, source)
        self.pixels: NDArray[np.float32] = pixels
        self.rotation: NDArray[np.float64] = np.eye(3) if rotation is None else _check_rotation(rotation)

    @property
    def solid_angles(self) -> NDArray[np.floating]:
        """Exact solid angle of every pixel, (h, w), in steradians; they sum to 4 pi."""
        return pixel_solid_angles(*self.pixels.shape[:2])

    def rotated(self, rotation: ArrayLike) -> Environment:
        """The same light turned in the world; no pixel is touched.

        Parameters
        ----------
        rotation : float or (3, 3) array
            Degrees about +y, counter-clockwise seen from above (Mitsuba's `rotate(axis=[0, 1, 0], angle)`), or a
            rotation matrix. It applies after the rotation the environment already has.

        Raises
        ------
        PrtError
            If a matrix is not 3 x 3, orthonormal and of determinant 1 within 1e-4.
        """
        turn = _rotation_about_up(float(rotation)) if np.ndim(rotation) == 0 else _check_rotation(rotation)  # type: ignore[arg-type]
        turned = copy.copy(self)
        turned.rotation = turn @ self.rotation
        return turned

    def __repr__(self) -> str:
        return f"Environment({self.report['source']!r}, {self.report['width']} x {self.report['height']})"


def load_environment(path: str | os.PathLike[str]) -> Environment:
    """Read an equirectangular HDR image (.exr, .hdr or .pfm; any float width, RGB or grey, alpha is dropped).

    Parameters
    ----------
    path : path
        The file. See the module's docstring for its orientation and how it compares with Mitsuba's `envmap`.

    Returns
    -------
    Environment
        Its `report` tells what had to be clamped.

    Raises
    ------
    PrtError
        One line that names the file: missing, unknown suffix, not readable, channels that are no RGB or grey,
        not about twice as wide as high, or NaN or infinite pixels (their number and the first one).

    Warns
    -----
    PrtWarning
        If pixels were negative: how many, and their share of the image's energy.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise PrtError(
            f"{path}: not an HDR image by its name; give a file that ends in {', '.join(SUFFIXES)}"
        )
    return Environment(_rgb_of(read_bitmap(path, "export it again"), path), source=str(path))


def emitter_of(environment: Environment) -> mi.Emitter:
    """An environment as a Mitsuba emitter, ``envmap``."""
    to_world = np.eye(4)
    to_world[:3, :3] = environment.rotation
    return mi.load_dict(
        {
            "type": "envmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(environment.pixels)),
            "to_world": mi.ScalarTransform4f(to_world),
        }
    )


def environment_of(emitter: mi.Emitter, height: int = 256) -> Environment:
    """What an environment emitter of a scene shines, as an image of (height, 2 height) pixels: at their centres."""
    return Environment(radiance_of(emitter, height))


def radiance_of(emitter: mi.Emitter, height: int) -> NDArray[np.float32]:
    """What an environment emitter shines at the centres of (height, 2 height, 3) pixels; it may be negative."""
    theta, phi = (np.pi * (np.arange(n) + 0.5) / height for n in (height, 2 * height))
    x, z = np.sin(theta)[:, None] * np.sin(phi), -np.sin(theta)[:, None] * np.cos(phi)
    towards = np.stack(np.broadcast_arrays(x, np.cos(theta)[:, None], z)).reshape(3, -1)
    si = dr.zeros(mi.SurfaceInteraction3f, towards.shape[1])
    si.wi = -mi.Vector3f(np.ascontiguousarray(towards, np.float32))
    radiance = np.array(emitter.eval(si))
    every = np.broadcast_to(radiance, (3, towards.shape[1])).T
    return every.reshape(height, 2 * height, 3).astype(np.float32)


def _rgb_of(bitmap: mi.Bitmap, path: Path) -> NDArray[np.float32]:
    """(h, w, 3) linear RGB of a bitmap, without conversion of its values."""
    formats = mi.Bitmap.PixelFormat
    pixels = np.array(bitmap, dtype=np.float32)
    pixels = pixels.reshape(*pixels.shape[:2], -1)  # [h, w, channel], also of grey bitmaps
    if bitmap.pixel_format() in (formats.RGB, formats.RGBA):
        return pixels[..., :3]
    if bitmap.pixel_format() in (formats.Y, formats.YA):
        return np.repeat(pixels[..., :1], 3, axis=2)
    channels = ", ".join(sorted(field.name for field in bitmap.struct_()))
    raise PrtError(f"{path}: has the channels {channels}; export an RGB or grey image")


def _check_shape(pixels: NDArray[np.float32], source: str) -> None:
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
        raise PrtError(f"{source}: pixels have shape {pixels.shape}; an environment is (height, width, 3)")
    height, width = pixels.shape[:2]
    if abs(width / height - 2) > 0.2:
        raise PrtError(
            f"{source}: {width} x {height} pixels; an equirectangular image is twice as wide as high, "
            "convert other layouts first"
        )


def _check_finite(pixels: NDArray[np.float32], source: str) -> None:
    bad = ~np.isfinite(pixels).all(axis=2)  # [h, w]
    if bad.any():
        row, col = np.argwhere(bad)[0]
        raise PrtError(
            f"{source}: {bad.sum()} of {bad.size} pixels are NaN or infinite, the first at row {row}, column {col} "
            f"{pixels[row, col].tolist()}; repair the image"
        )


def _clamp_negative(pixels: NDArray[np.float32], source: str) -> dict[str, Any]:
    """Clamp in place; returns the report's entries and warns when there was anything to clamp."""
    negative = (pixels < 0).any(axis=2)  # [h, w]
    share = 0.0
    if negative.any():
        solid_angles = pixel_solid_angles(*pixels.shape[:2])
        lost = np.einsum("hwc,hw->", np.minimum(pixels, 0), solid_angles)
        share = float(-lost / np.einsum("hwc,hw->", np.abs(pixels), solid_angles))
        np.maximum(pixels, 0, out=pixels)
        warnings.warn(
            f"{source}: {negative.sum()} pixels ({negative.mean():.2%}) were negative and are clamped to 0; "
            f"they had {share:.2%} of the image's energy",
            PrtWarning,
            stacklevel=4,
        )
    return {
        "negative_pixels": int(negative.sum()),
        "negative_pixel_share": float(negative.mean()),
        "negative_energy_share": share,
    }


def _rotation_about_up(degrees: float) -> NDArray[np.float64]:
    if not np.isfinite(degrees):
        raise PrtError(f"rotation by {degrees} degrees: give a finite angle")
    sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    if degrees % 90 == 0:  # exact, so that quarter turns permute faces and nothing else
        sine, cosine = np.round(sine), np.round(cosine)
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def _check_rotation(matrix: ArrayLike) -> NDArray[np.float64]:
    matrix = np.array(matrix, dtype=np.float64)
    if matrix.shape != (3, 3):
        raise PrtError(f"rotation has shape {matrix.shape}; give degrees about y or a 3 x 3 matrix")
    error = np.abs(matrix @ matrix.T - np.eye(3)).max()
    if not error < 1e-4:
        raise PrtError(f"rotation matrix is not orthonormal (off by {error:.2g}); it may not scale or shear")
    if np.linalg.det(matrix) < 0:
        raise PrtError("rotation matrix has determinant -1: it mirrors; flip one of its axes")
    u, _, vt = np.linalg.svd(matrix)
    return u @ vt  # the nearest rotation: matrices often come in float32
