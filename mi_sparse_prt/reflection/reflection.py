"""R: how the incident light of a point becomes radiance that leaves it ([Leh07] 2.4, [HR10] eq. 2 and 3)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Ids = NDArray[np.integer]


class Reflection(ABC):
    """What leaves n points, from incident rows: first the unit-albedo row of each point, then rows of terms.

    Attributes
    ----------
    kind : str
        Its name in files.
    albedo : (n, 3) float32
        Of the diffuse part of each point.
    terms : int
        K, terms of a glossy point; 0 where all are diffuse.
    glossy : (n_g,) int64
        Points that have terms, ascending.
    mean_lobes : (n_g, K, 3) float32
        The mean of g_k over outgoing directions, by their cosine: what term k adds to radiosity / pi.
    """

    kind: ClassVar[str]
    albedo: Floats

    @property
    @abstractmethod
    def terms(self) -> int: ...

    @property
    @abstractmethod
    def glossy(self) -> NDArray[np.int64]: ...

    @property
    @abstractmethod
    def mean_lobes(self) -> Floats: ...

    @property
    @abstractmethod
    def importance(self) -> Floats:
        """What points (n,) make of light from one direction: root mean square, 1 if diffuse and white."""

    @abstractmethod
    def squares(self, points: slice) -> tuple[NDArray[np.int64], Floats]:
        """How much rows count in the squared error of radiance.

        Parameters
        ----------
        points : slice
            With the same number of terms each.

        Returns
        -------
        rows : (n, 1 + terms) int64
            Of each point.
        squares : (n, 1 + terms, 3) float32
            Means of the squared outgoing weights over views, by their cosine.
        """

    @abstractmethod
    def gram(self, points: Ids) -> Floats:
        """Means of products of outgoing weights over views, by their cosine.

        With incident errors e (R, 3) of a point's rows, the mean squared error of its radiance is ``e^T gram e``.

        Parameters
        ----------
        points : (k,) integers
            With the same number of rows R each.

        Returns
        -------
        (k, R, R, 3) float32
        """

    @abstractmethod
    def take(self, points: Ids) -> Self:
        """Of some points, in this order."""

    @abstractmethod
    def arrays(self) -> dict[str, NDArray[Any]]:
        """What files keep, beside ``attributes``."""

    @abstractmethod
    def attributes(self) -> dict[str, Any]:
        """JSON as it is."""

    @classmethod
    @abstractmethod
    def from_arrays(cls, attributes: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Self:
        """From what ``attributes`` and ``arrays`` gave; ValueError or KeyError if these do not fit together."""

    @property
    def row_count(self) -> int:
        """Incident rows of all points."""
        return len(self.albedo) + len(self.glossy) * self.terms

    def rows_of(self, points: Ids) -> NDArray[np.int64]:
        """All incident rows of some points: their unit-albedo rows, then all their terms."""
        chosen = np.asarray(points).astype(np.int64)
        if not self.terms:
            return chosen
        terms = self._term_rows(np.searchsorted(self.glossy, chosen[np.isin(chosen, self.glossy)]))
        return np.concatenate([chosen, terms.ravel()])

    def rows_of_each(self, points: Ids, count: int) -> NDArray[np.int64]:
        """Rows (k, count) of points which have so many: 1, or 1 + terms."""
        chosen = np.asarray(points).astype(np.int64)
        if count == 1:
            return chosen[:, None]
        terms = self._term_rows(np.searchsorted(self.glossy, chosen))
        return np.concatenate([chosen[:, None], terms], axis=1)

    def radiosity(self, incident: Floats, points: Ids | None = None) -> Floats:
        """Radiosity / pi of points, which is the radiance of a diffuse one.

        Parameters
        ----------
        incident : (rows, ..., 1 or 3) float32
            Of all points, or of ``rows_of(points)``; colour channels come last.
        points : (k,) integers, optional

        Returns
        -------
        (k, ..., 3) float32
        """
        some = np.arange(len(self.albedo)) if points is None else np.asarray(points)
        between = (1,) * (incident.ndim - 2)
        result = self.albedo[some].reshape(len(some), *between, 3) * incident[: len(some)]
        if self.terms:
            here = np.flatnonzero(np.isin(some, self.glossy))
            lobes = self.mean_lobes[np.searchsorted(self.glossy, some[here])]
            terms = incident[len(some) :].reshape(len(here), self.terms, *incident.shape[1:])
            for k in range(self.terms):
                result[here] += lobes[:, k].reshape(len(here), *between, 3) * terms[:, k]
        return result

    def radiosity_adjoint(self, outgoing: Floats) -> Floats:
        """The transpose of ``radiosity`` for all points: (n, 3, k) to incident rows (rows, 3, k)."""
        diffuse = self.albedo[:, :, None] * outgoing
        if not self.terms:
            return diffuse
        terms = (
            self.mean_lobes[..., None] * outgoing[self.glossy][:, None]
        )  # [glossy point, term, channel, k]
        return np.concatenate([diffuse, terms.reshape(-1, *outgoing.shape[1:])])

    def _term_rows(self, which: Ids) -> NDArray[np.int64]:
        """Rows (n, terms) of glossy points by their number among these."""
        first = len(self.albedo) + np.asarray(which).astype(np.int64) * self.terms
        return first[:, None] + np.arange(self.terms)


@dataclass(frozen=True)
class Diffuse(Reflection):
    """Lambertian reflection: one incident row per point.

    Attributes
    ----------
    albedo : (n, 3) float32
    """

    kind: ClassVar[str] = "diffuse"
    albedo: Floats

    @property
    def terms(self) -> int:
        return 0

    @property
    def glossy(self) -> NDArray[np.int64]:
        return np.zeros(0, np.int64)

    @property
    def mean_lobes(self) -> Floats:
        return np.zeros((0, 0, 3), np.float32)

    @property
    def importance(self) -> Floats:
        return np.sqrt(np.square(self.albedo).mean(axis=1))

    def squares(self, points: slice) -> tuple[NDArray[np.int64], Floats]:
        return np.arange(points.start, points.stop)[:, None], np.square(self.albedo[points])[:, None]

    def gram(self, points: Ids) -> Floats:
        return np.square(self.albedo[points])[:, None, None]

    def take(self, points: Ids) -> Diffuse:
        return replace(self, albedo=self.albedo[points])

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"albedo": self.albedo}

    def attributes(self) -> dict[str, Any]:
        return {}

    @classmethod
    def from_arrays(cls, attributes: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Diffuse:
        if arrays["albedo"].shape[1:] != (3,):
            raise ValueError("albedo has other channels than red, green and blue")
        return cls(arrays["albedo"])
