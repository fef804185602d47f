"""Operators as arrays with names, and back: what files keep of them."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from mi_sparse_prt.operators.by_depth import ByDepth
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.operators.dense import Dense
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility, RowSelection
from mi_sparse_prt.operators.fractional_visibility import FractionalVisibility
from mi_sparse_prt.operators.haar_rows import HaarRows
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.operators.operator import Masked, Operator
from mi_sparse_prt.operators.sparse_rows import SparseRows
from mi_sparse_prt.operators.sum import Sum
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.operators.visibility import Visibility

_KINDS: dict[str, type[Operator]] = {
    operator.kind: operator
    for operator in (
        ByDepth,
        Clustered,
        Dense,
        FactoredVisibility,
        FractionalVisibility,
        HaarRows,
        Interpolated,
        LowRank,
        Masked,
        MeanCosine,
        RowSelection,
        SparseRows,
        Sum,
        Upsampled,
        Visibility,
    )
}


def operator_arrays(operator: Operator, name: str) -> tuple[dict[str, str], dict[str, NDArray[Any]]]:
    """Kinds and arrays of an operator and of those nested in it, by names that begin with ``name``."""
    kinds, arrays = {name: operator.kind}, dict[str, NDArray[Any]]()
    for key, value in operator.arrays().items():
        if isinstance(value, Operator):
            more_kinds, more = operator_arrays(value, f"{name}.{key}")
            kinds, arrays = kinds | more_kinds, arrays | more
        else:
            arrays[f"{name}.{key}"] = value
    return kinds, arrays


def operator_from_arrays(
    name: str, kinds: dict[str, str], arrays: dict[str, NDArray[Any]], lighting: Any
) -> Operator:
    """The operator that ``operator_arrays`` gave under this name.

    Raises
    ------
    ValueError, KeyError
        If the arrays do not fit together or something is missing.
    """
    start = f"{name}."
    own = {key.removeprefix(start): a for key, a in arrays.items() if key.startswith(start)}
    nested = {key.removeprefix(start) for key in kinds if key.startswith(start)}
    values: dict[str, Any] = {key: value for key, value in own.items() if "." not in key}
    for key in nested:
        if "." not in key:
            values[key] = operator_from_arrays(f"{name}.{key}", kinds, arrays, lighting)
    return _KINDS[kinds[name]].from_arrays(values, lighting)
