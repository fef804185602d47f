"""Light told apart by how many surfaces it met before it arrived."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from mi_sparse_prt.operators.operator import Ids, Operator
from mi_sparse_prt.operators.sum import Sum


@dataclass(frozen=True)
class ByDepth(Sum):
    """The sum of light that met one surface, two, and so on.

    ``max_depth`` leaves light fewer of them where a camera's ray met some as well, mirrors or glass.

    Attributes
    ----------
    terms : tuple of Operator
        Of light that met 1, 2, ... surfaces between the sky and the points of the rows.
    """

    kind: ClassVar[str] = "by_depth"

    @property
    def by_depth(self) -> tuple[Operator, ...]:
        return self.terms

    def take(self, ids: Ids) -> ByDepth:
        return ByDepth(tuple(term.take(ids) for term in self.terms))
