"""What every method returns: the operators of a matrix, and an account of what was evaluated for them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.solvers.specular import SpecularLight


@dataclass
class MethodResult:
    """MethodResult of a matrix.

    Attributes
    ----------
    direct : Operator or None
        None where only light that surfaces reflect is asked for: of lamps, which pictures sample themselves.
    indirect : Operator or None
    elements_evaluated : int
        Elements (vertex, direction) at which anything was evaluated, direct or indirect.
    elements : dict
        ``direct`` and ``indirect``: how many elements of each part were evaluated.
    rays : dict
        ``direct``: shadow rays; ``indirect_paths``; of lamps ``photons``; ...
    specular : SpecularLight or None
        Light by way of mirrors and glass alone, where that is an operator of its own.
    skipped : list of str
        Sentences.
    sampling : dict
        Of methods that leave elements out: per mesh, how many vertices and directions were taken.
    radiosity : dict
        Of finite elements: ``ranks`` per channel, ``bounces``, and of glossy scenes ``noise_of_rays`` (relative L2, in
        the first bounce, before it is averaged) and ``error_of_rays`` (at most so much of the matrix's error can more
        rays take away).
    dense : (k,) int64 or None
        Vertices whose rows were sampled themselves, ascending, of methods that make other rows from these.
    spp : int or None
        Paths of an element, at least, where paths of lamps are traced.
    """

    direct: Operator | None
    indirect: Operator | None
    elements_evaluated: int
    elements: dict[str, int]
    rays: dict[str, int]
    specular: SpecularLight | None = None
    skipped: list[str] = field(default_factory=list)
    sampling: dict[str, Any] = field(default_factory=dict)
    radiosity: dict[str, Any] = field(default_factory=dict)
    dense: NDArray[np.int64] | None = None
    spp: int | None = None
