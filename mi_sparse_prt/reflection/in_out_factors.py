"""R for glossy surfaces: in-out factors of their BRDFs ([HR10] eq. 2 and 3).

Radiance that leaves point x towards w_o is ``rho_x B(x) + sum_k g_k(w_o) B_k(x)``: the diffuse part of its BRDF, and
the coefficients ``B_k = T_k L``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.reflection.brdf_factors import BrdfFactors, DirectionGrid
from mi_sparse_prt.reflection.frames import frames
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
            Unit vectors.

        Returns
        -------
        (n, 3) float32
            0 below the surface.
        """
        n, turn = len(self.albedo), frames(self.tangents, self.normals)
        terms = np.zeros((n, self.terms, 3), np.float32)
        terms[self.glossy] = incident[n:].reshape(-1, self.terms, 3)
        radiance = self.albedo * incident[:n]
        for number, factors in enumerate(self.factors):
            own = np.flatnonzero(self.material == number)
            local = np.einsum("nij,nj->ni", turn[own], outgoing[own])
            g = factors.grid.interpolate(factors.outgoing, local)  # [term, channel, vertex]
            lobes = np.broadcast_to(g, (len(g), 3, len(own)))
            radiance[own] += np.einsum("kcn,nkc->nc", lobes, terms[own][:, : len(g)])
        above = np.einsum("nd,nd->n", outgoing, self.normals) > 0
        return np.where(above[:, None], radiance, 0).astype(np.float32)

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
                    "followed": f.followed,
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
    flags = bool(known["varying_diffuse"]), bool(known.get("followed", False))
    return BrdfFactors(grid, diffuse, incident, outgoing, *flags)
