"""What can be chosen: how the direct and how the indirect light of a matrix are evaluated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.solvers.adaptive_strata import Strata

DIRECT = ("exact", "consensus", "edges", "adaptive", "sparse", "huang2010")
INDIRECT = ("none", "gather", "sparse", "paths", "huang2010")
TOGETHER = ("sparse", "huang2010")  # evaluate both parts at the same elements
PARAMETERS = {
    "none": (),
    "gather": ("rays", "tolerance", "averaged"),
    "sparse": ("dense", "spp"),
    "paths": ("resolution", "spp"),
    "huang2010": ("spp",),
}


@dataclass(frozen=True)
class Plan:
    """One way to evaluate a matrix.

    Parameters
    ----------
    direct : {"exact", "consensus", "edges", "adaptive", "sparse", "huang2010"}
        Rays for every element above the horizon; rays where neighbouring vertices disagree
        (``methods.consensus_visibility``); a ray for every texel's centre, and more along edges of visibility
        (``solvers.texel_edges``); one or four rays in every texel, and more where these disagree
        (``solvers.adaptive_strata``); or as the method of that name does. ``"exact"`` is for both bases, ``"edges"``
        and ``"adaptive"`` for the texel basis, the others are for the direction basis.
    indirect : {"none", "gather", "sparse", "paths", "huang2010"}
        Left out; finite elements; or paths, for the elements of a method or for all. Light that cannot be there is
        left out under any plan.
    rays, tolerance : int, float
        Of ``"gather"``: rays per vertex, and the relative error of the first bounce that a low rank may cost.
    averaged : bool
        Of ``"gather"``: whether the noise of rays is averaged out along surfaces (``reconstruction.gather_noise``).
    dense : float, optional
        Of ``"sparse"``: the share of the vertices that is dense, about a fifth if not given.
    resolution, spp : int, optional
        Of ``"paths"``: texels along an edge of the indirect light's cubemap, and paths per element (also of
        ``"sparse"`` and ``"huang2010"``). If not given, those of ``precompute``.
    strata : Strata, optional
        Of ``"adaptive"``: rays per axis in all texels, and in those that are seen in part; 2 and 4 if not given.

    Raises
    ------
    PrtError
        If there is no such plan.
    """

    direct: str
    indirect: str = "none"
    rays: int = 256
    tolerance: float = 0.03
    averaged: bool = True
    dense: float | None = None
    resolution: int | None = None
    spp: int | None = None
    strata: Strata | None = None

    def __post_init__(self) -> None:
        for what, value, known in (
            ("direct", self.direct, DIRECT),
            ("indirect", self.indirect, INDIRECT),
        ):
            if value not in known:
                raise PrtError(f"plan: unknown {what} {value!r}; choose one of: {', '.join(known)}")
        if self.strata is not None and min(self.strata) < 1:
            raise PrtError(f"plan: {self.strata}: both must be at least 1")
        if (self.direct in TOGETHER or self.indirect in TOGETHER) and self.direct != self.indirect:
            raise PrtError(
                f"plan: {self.direct!r} direct light does not go with {self.indirect!r} indirect light; "
                'combine "exact", "consensus", "edges" or "adaptive" with "none", "gather" or "paths"'
            )

    @property
    def parameters(self) -> dict[str, Any]:
        """Those that this plan depends on."""
        names = PARAMETERS[self.indirect] + (("strata",) if self.direct == "adaptive" else ())
        found = {name: getattr(self, name) for name in names}
        if self.strata is not None and "strata" in found:
            found["strata"] = self.strata._asdict()
        return found

    def report(self) -> dict[str, Any]:
        """As JSON has it."""
        return {"direct": self.direct, "indirect": self.indirect, "parameters": self.parameters}


BY_NAME = {
    "brute_force": Plan("exact", "paths"),
    "gather": Plan("exact", "gather"),
    "sparse": Plan("sparse", "sparse"),
    "huang2010": Plan("huang2010", "huang2010"),
}
GATHER = ((64, 0.06), (256, 0.03), (1024, 0.015), (4096, 0.008))  # rays and tolerance, ever finer
DENSE = (0.05, 0.1, 0.2, 0.4, 0.8)  # shares of the vertices, ever more
EFFORTS = {
    "gather": tuple(Plan("exact", "gather", rays, tolerance) for rays, tolerance in GATHER),
    "sparse": tuple(Plan("sparse", "sparse", dense=share) for share in DENSE),
}
