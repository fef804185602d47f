"""R for glossy surfaces: in-out factors of their BRDFs ([HR10] eq. 2 and 3).

Radiance that leaves point x towards w_o is ``rho_x B(x) + sum_k g_k(w_o) B_k(x)``: the diffuse part of its BRDF, and
the coefficients ``B_k = T_k L``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.read_only import read_only
from mi_sparse_prt.reflection.brdf_factors import BrdfFactors, DirectionGrid
from mi_sparse_prt.reflection.reflection import Floats, Ids, Reflection


@dataclass(frozen=True)
class InOutFactors(Reflection):
    """Diffuse parts and outgoing factors.

    Attributes
    ----------
    albedo : (n, 3) float32
        Of the diffuse part.
    tangents, normals : (n, 3) float32, world
    material : (n,) int64
        Number of a point's BRDF among ``factors``, -1 if it is diffuse.
    factors : tuple of BrdfFactors
    harmonics : int, optional
        Their incident factors are spherical harmonics up to this order, which serve any BRDF.
    """

    kind: ClassVar[str] = "in_out_factors"
    albedo: Floats
    tangents: Floats
    normals: Floats
    material: NDArray[np.int64]
    factors: tuple[BrdfFactors, ...]
    harmonics: int | None = None

    @property
    def terms(self) -> int:
        return max(factors.terms for factors in self.factors)

    @cached_property
    def glossy(self) -> NDArray[np.int64]:
        return np.flatnonzero(self.material >= 0)

    @cached_property
    def mean_lobes(self) -> Floats:
        tables = np.stack([self._view_means(factors, 1) for factors in self.factors])
        return tables[self.material[self.glossy]]

    @cached_property
    def row_weights(self) -> Floats:
        """(rows, 3), by which an error of a row counts: of the radiance that it makes, root mean square over views."""
        tables = np.stack([self._view_means(factors, 2) for factors in self.factors])
        lobes = np.sqrt(tables[self.material[self.glossy]])
        return np.concatenate([self.albedo, lobes.reshape(-1, 3)])

    @property
    def importance(self) -> Floats:
        squares = np.square(self.albedo).mean(axis=1)
        for number, factors in enumerate(self.factors):
            # a white diffuse one takes up cos / pi, whose squared norm is 2 / (3 pi)
            incident = np.square(factors.incident) @ factors.grid.solid_angles * (1.5 * np.pi)
            lobes = self._view_means(factors, 2).mean(axis=1)[: factors.terms]
            squares[self.material == number] += incident @ lobes
        return np.sqrt(squares).astype(np.float32)

    def squares(self, points: slice) -> tuple[NDArray[np.int64], Floats]:
        rows, squares = np.arange(points.start, points.stop)[:, None], np.square(self.albedo[points])[:, None]
        number = int(self.material[points.start])
        if number < 0:
            return rows, squares
        first = int(np.searchsorted(self.glossy, points.start))
        terms = self._term_rows(np.arange(first, first + len(rows)))
        lobes = np.broadcast_to(self._view_means(self.factors[number], 2), (len(rows), self.terms, 3))
        return np.concatenate([rows, terms], axis=1), np.concatenate([squares, lobes], axis=1)

    def gram(self, points: Ids) -> Floats:
        albedo, material = self.albedo[points].astype(np.float64), self.material[points]
        if not len(points) or material[0] < 0:
            return np.square(self.albedo[points])[:, None, None]
        result = np.empty((len(points), 1 + self.terms, 1 + self.terms, 3), np.float32)
        for number in np.unique(material):
            own, factors = material == number, self.factors[number]
            lobes = np.zeros((self.terms, 3, len(factors.grid.solid_angles)))
            lobes[: factors.terms] = factors.outgoing
            weights = factors.grid.solid_angles * factors.grid.directions[:, 2] / np.pi
            result[own, 0, 0] = albedo[own] ** 2
            result[own, 0, 1:] = result[own, 1:, 0] = albedo[own][:, None] * (lobes @ weights)
            result[own, 1:, 1:] = np.einsum("kcw,lcw,w->klc", lobes, lobes, weights, optimize=True)
        return result

    def _view_means(self, factors: BrdfFactors, power: int) -> Floats:
        """Means (K, 3) of a power of g_k over views, by their cosine."""
        weights = factors.grid.solid_angles * factors.grid.directions[:, 2] / np.pi
        result = np.zeros((self.terms, 3), np.float32)
        result[: factors.terms] = (factors.outgoing.astype(np.float64) ** power) @ weights  # [term, channel]
        return result

    def radiance(self, incident: Floats, outgoing: Floats) -> Floats:
        """Radiance that leaves points.

        Parameters
        ----------
        incident : (rows, 3) float32
            Of all points.
        outgoing : (n, 3) float32, world
            Of any length but 0.

        Returns
        -------
        (n, 3) float32
            0 below the surface.
        """
        radiance = self.albedo * incident[: len(self.albedo)]
        # all read-only: the kernels are compiled once, whether arrays were computed or read
        directions = read_only(np.ascontiguousarray(outgoing, np.float32))
        normals, light = read_only(self.normals), read_only(np.ascontiguousarray(incident, np.float32))
        for (points, rows), factors in zip(self._lit_rows, self.factors, strict=True):
            grid = factors.grid
            _add_lobes(
                radiance,
                (points, rows),
                light,
                (read_only(self.tangents), normals, directions),
                read_only(factors.outgoing).reshape(*factors.outgoing.shape[:2], grid.heights, grid.azimuths),
            )
        _leave_above(radiance, normals, directions)
        return radiance

    @cached_property
    def _lit_rows(self) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """For each BRDF its points, and their first rows of terms."""
        found = []
        for number in range(len(self.factors)):
            points = np.flatnonzero(self.material == number)
            found.append((points, len(self.albedo) + np.searchsorted(self.glossy, points) * self.terms))
        return found

    def take(self, points: Ids) -> InOutFactors:
        names = ("albedo", "tangents", "normals", "material")
        return replace(self, **{name: getattr(self, name)[points] for name in names})

    def arrays(self) -> dict[str, NDArray[Any]]:
        names = ("albedo", "tangents", "normals", "material")
        own = {name: getattr(self, name) for name in names}
        return own | {
            f"factors_{number}_{name}": getattr(factors, name)
            for number, factors in enumerate(self.factors)
            for name in ("diffuse", "incident", "outgoing")
        }

    def attributes(self) -> dict[str, Any]:
        return {
            "factors": [
                {
                    "heights": f.grid.heights,
                    "azimuths": f.grid.azimuths,
                    "varying_diffuse": f.varying_diffuse,
                }
                for f in self.factors
            ],
            "harmonics": self.harmonics,
        }

    @classmethod
    def from_arrays(cls, attributes: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> InOutFactors:
        factors = tuple(
            _read_factors(number, known, arrays) for number, known in enumerate(attributes["factors"])
        )
        albedo, tangents, normals, material = (
            arrays[name] for name in ("albedo", "tangents", "normals", "material")
        )
        n = len(albedo)
        if not factors or (n and not -1 <= material.min() <= material.max() < len(factors)):
            raise ValueError("vertices and their BRDFs do not fit together")
        if not albedo.shape == tangents.shape == normals.shape == (n, 3) or material.shape != (n,):
            raise ValueError("vertices and their tangents do not fit together")
        return cls(albedo, tangents, normals, material, factors, attributes.get("harmonics"))


def _read_factors(number: int, known: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> BrdfFactors:
    grid = DirectionGrid(known["heights"], known["azimuths"])
    names = ("diffuse", "incident", "outgoing")
    diffuse, incident, outgoing = (arrays[f"factors_{number}_{name}"] for name in names)
    size, (terms, channels) = grid.heights * grid.azimuths, outgoing.shape[:2]
    if (
        incident.shape != (terms, size)
        or outgoing.shape[2] != size
        or len(diffuse) not in (1, 3)
        or channels not in (1, 3)
    ):
        raise ValueError(f"factors of BRDF {number} do not fit together")
    return BrdfFactors(grid, diffuse, incident, outgoing, bool(known["varying_diffuse"]))


@numba.njit(parallel=True, fastmath=True, cache=True)
def _add_lobes(
    radiance: Floats,
    which: tuple[NDArray[np.int64], NDArray[np.int64]],
    incident: Floats,
    frame: tuple[Floats, Floats, Floats],
    lobes: Floats,
) -> None:
    """Add to radiance (n, 3) what leaves some points by the terms of one BRDF.

    ``which``: the points, and their first rows of terms in ``incident`` (rows, 3). ``frame``: tangents, normals and
    outgoing directions of all points. ``lobes`` (terms, 1 or 3, heights, azimuths), looked up as by
    ``DirectionGrid.interpolate``.
    """
    points, first_rows = which
    tangents, normals, outgoing = frame
    terms, channels, heights, azimuths = lobes.shape
    for p in numba.prange(len(points)):
        i = points[p]
        tx, ty, tz = tangents[i]
        nx, ny, nz = normals[i]
        ox, oy, oz = outgoing[i]
        length = np.sqrt(ox * ox + oy * oy + oz * oz)
        z = (nx * ox + ny * oy + nz * oz) / length
        if z <= 0:
            continue
        x = tx * ox + ty * oy + tz * oz
        y = (ny * tz - nz * ty) * ox + (nz * tx - nx * tz) * oy + (nx * ty - ny * tx) * oz
        theta = np.arccos(min(z, np.float32(1))) * (heights / (0.5 * np.pi)) - 0.5
        phi = np.arctan2(y, x) * (azimuths / (2 * np.pi)) - 0.5
        row, column = int(np.floor(theta)), int(np.floor(phi))
        a, b = np.float32(theta - row), np.float32(phi - column)
        upper, lower = max(row, 0), min(row + 1, heights - 1)
        left, right = column % azimuths, (column + 1) % azimuths
        for k in range(terms):
            for c in range(3):
                lobe = lobes[k, c % channels]
                above = lobe[upper, left] + b * (lobe[upper, right] - lobe[upper, left])
                below = lobe[lower, left] + b * (lobe[lower, right] - lobe[lower, left])
                radiance[i, c] += (above + a * (below - above)) * incident[first_rows[p] + k, c]


@numba.njit(parallel=True, fastmath=True, cache=True)
def _leave_above(radiance: Floats, normals: Floats, outgoing: Floats) -> None:
    """Let nothing leave points below their surface."""
    for i in numba.prange(len(radiance)):
        z = normals[i, 0] * outgoing[i, 0] + normals[i, 1] * outgoing[i, 1] + normals[i, 2] * outgoing[i, 2]
        for c in range(3):
            if z <= 0:
                radiance[i, c] = 0
