"""What every method returns: the parts of a matrix, and an account of what was evaluated for them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from mi_sparse_prt.operators.fractional_visibility import FractionalVisibility
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.operators.visibility import Visibility


@dataclass
class MethodResult:
    """MethodResult of a matrix.

    Attributes
    ----------
    direct, indirect : Part or None
    elements_evaluated : int
        Elements (vertex, direction) at which anything was evaluated, direct or indirect.
    elements : dict
        ``direct`` and ``indirect``: how many elements of each part were evaluated.
    rays : dict
        ``direct``: shadow rays; ``indirect_paths``.
    skipped : list of str
        Sentences.
    sampling : dict
        Of methods that leave elements out: per mesh, how many vertices and directions were taken.
    """

    direct: Visibility | MeanCosine | FractionalVisibility | Interpolated
    indirect: Upsampled | Interpolated | LowRank | None
    elements_evaluated: int
    elements: dict[str, int]
    rays: dict[str, int]
    skipped: list[str] = field(default_factory=list)
    sampling: dict[str, Any] = field(default_factory=dict)
