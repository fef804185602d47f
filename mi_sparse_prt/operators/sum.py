"""The sum of operators with the same rows and columns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import Bits
from mi_sparse_prt.emission.space import EmissionSpace
from mi_sparse_prt.operators.operator import Floats, Ids, Operator


@dataclass(frozen=True)
class Sum(Operator):
    """A + B + ...; one channel stands for three where others have three.

    Attributes
    ----------
    terms : tuple of Operator
        At least one.
    """

    kind: ClassVar[str] = "sum"
    terms: tuple[Operator, ...]

    @property
    def shape(self) -> tuple[int, int, int]:
        n, m, _ = self.terms[0].shape
        return n, m, max(term.shape[2] for term in self.terms)

    @property
    def nbytes(self) -> int:
        return sum(term.nbytes for term in self.terms)

    def rows(self, ids: Ids) -> Floats:
        return add(term.rows(ids) for term in self.terms)

    def columns(self, ids: Ids) -> Floats:
        return add(term.columns(ids) for term in self.terms)

    def elements(self, ids: Ids, texels: Ids) -> Floats:
        return add(term.elements(ids, texels) for term in self.terms)

    def relight(self, lighting: Floats) -> Floats:
        return add(term.relight(lighting) for term in self.terms)

    def combined(self, words: NDArray[np.integer], signs: Floats) -> Floats:
        return reduce(np.add, (term.combined(words, signs) for term in self.terms))

    def apply(self, x: Floats) -> Floats:
        return _add_channels([term.apply(x) for term in self.terms])

    def adjoint(self, y: Floats) -> Floats:
        return _add_channels([term.adjoint(y) for term in self.terms])

    def masked(self, points: NDArray[np.int64], open: Bits) -> Sum:
        return Sum(tuple(term.masked(points, open) for term in self.terms))

    def take(self, ids: Ids) -> Sum:
        return Sum(tuple(term.take(ids) for term in self.terms))

    def arrays(self) -> dict[str, NDArray[Any] | Operator]:
        return {f"term_{i}": term for i, term in enumerate(self.terms)}

    @classmethod
    def from_arrays(cls, arrays: dict[str, Any], lighting: EmissionSpace) -> Self:
        terms = tuple(arrays[f"term_{i}"] for i in range(len(arrays)))
        if len({term.shape[:2] for term in terms}) != 1:
            raise ValueError("terms of a sum do not fit together")
        return cls(terms)


def add(arrays: Any) -> Floats:
    """The sum of new arrays (..., 1 or 3), of which the larger ones are written to."""

    def added(a: Floats, b: Floats) -> Floats:
        larger, smaller = (a, b) if a.shape[-1] >= b.shape[-1] else (b, a)
        larger += smaller
        return larger

    return reduce(added, arrays)


def _add_channels(products: list[Floats]) -> Floats:
    """``add`` of products (..., 1 or 3, k)."""
    return np.moveaxis(add(np.moveaxis(product, 1, 2) for product in products), 2, 1)
