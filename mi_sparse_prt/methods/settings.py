"""The arguments of a precomputation, checked."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.methods.plan import BY_NAME, TOGETHER, Plan
from mi_sparse_prt.solvers.specular import SpecularOptions

METHODS = ("auto", *BY_NAME)
BASES = ("direction", "texel")
SPP = 16
TARGET = 0.02  # error to aim at, where none is given
AUTO_TERMS = "auto"


@dataclass(frozen=True)
class Settings:
    """What a matrix depends on besides the scene; the parameters of ``precompute``.

    Raises
    ------
    PrtError
        If a value makes no sense.
    """

    resolution: int
    method: str | Plan = "auto"
    basis: str = "direction"
    max_depth: int = 5
    spp: int | None = None
    target_error: float | None = None
    seed: int = 0
    indirect_resolution: int | None = None
    strata: int = 2
    terms: int | str = 0
    harmonics: int | None = None
    measurement: str = "vertices"
    max_seconds: float = 300.0
    specular_error: float | None = None

    def __post_init__(self) -> None:
        if isinstance(self.method, str) and self.method not in METHODS:
            raise PrtError(f"unknown method {self.method!r}; choose one of: {', '.join(METHODS)}")
        if self.plan is not None:
            self._check_plan(self.plan)
        if self.target_error is not None and self.method == "huang2010":
            raise PrtError(
                'method "huang2010" has the rates of the paper and aims at no target error; leave it out, '
                'or set method="sparse"'
            )
        if self.basis not in BASES:
            raise PrtError(f"unknown basis {self.basis!r}; choose one of: {', '.join(BASES)}")
        for name, least in (("samples", 1), ("strata", 1), ("seed", 0), ("max_depth", -1)):
            value = getattr(self, name)
            name = "spp" if name == "samples" else name
            if value != int(value) or value < least:
                raise PrtError(f"{name} is {value}; it must be a whole number of at least {least}")
        if self.max_depth < 2 and self.max_depth != -1:
            raise PrtError(f"max_depth is {self.max_depth}; 2 is direct light only, -1 is no limit")
        for name in ("target_error", "specular_error"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise PrtError(f"{name} is {value}; it must be positive, 0.02 for 2%")
        if not self.max_seconds > 0:
            raise PrtError(f"max_seconds is {self.max_seconds}; it must be positive, 300 for five minutes")
        self._check_terms()
        if self.measurement != "vertices" and self._needs_vertices:
            raise PrtError(
                f"method {self._name!r} is for the vertices of meshes; at pixels leave it out, or set "
                'method="gather" or "brute_force"'
            )
        if CubemapLighting(self.element_resolution).resolution > self.resolution:
            raise PrtError(
                f"indirect_resolution {self.indirect_resolution} is finer than the lighting's; "
                f"use at most {self.resolution}"
            )

    def _check_terms(self) -> None:
        if isinstance(self.terms, str):
            if self.terms != AUTO_TERMS:
                raise PrtError(f'terms is {self.terms!r}; it must be a whole number or "{AUTO_TERMS}"')
        elif self.terms != int(self.terms) or self.terms < 0:
            raise PrtError(f'terms must be at least 0, not {self.terms}; "{AUTO_TERMS}" finds a good number')
        if self.view_dependent and self.why_no_terms is not None:
            raise PrtError(self.why_no_terms)

    @property
    def why_no_terms(self) -> str | None:
        """Why glossy surfaces cannot have terms by this method, in this basis or at these points; None if they can."""
        if self.measurement != "vertices":
            return "terms of glossy surfaces are for the vertices of meshes; at pixels leave them out"
        plan = self.method if isinstance(self.method, Plan) else BY_NAME.get(self.method)
        if (
            plan is None
            or plan.direct not in TOGETHER
            and (plan.direct != "exact" or plan.indirect == "gather" or self.basis != "texel")
        ):
            return None
        return (
            f"terms of glossy surfaces need one bit or share per texel, which method {self._name!r} does not give; "
            'leave the method out, or set method="gather"'
        )

    @property
    def _needs_vertices(self) -> bool:
        """Whether the method compares points with their neighbours on a mesh."""
        return self.plan is not None and self.plan.direct in ("consensus", *TOGETHER)

    @property
    def specular(self) -> SpecularOptions:
        """How light that arrives by way of mirrors and glass is looked for."""
        half = (self.target_error or TARGET) / math.sqrt(2)  # of the squared error
        return SpecularOptions(error=half)

    @property
    def view_dependent(self) -> bool:
        """Whether terms of glossy surfaces are asked for, by their number."""
        return self.terms not in (0, AUTO_TERMS) or self.harmonics is not None

    @property
    def _name(self) -> str:
        return self.method if isinstance(self.method, str) else "Plan"

    def _check_plan(self, plan: Plan) -> None:
        name = self._name
        basis = {"exact": self.basis, "edges": "texel", "adaptive": "texel"}.get(plan.direct, "direction")
        if self.basis != basis:
            raise PrtError(f'method {name!r} works in the {basis} basis; set basis="{basis}"')
        if plan.indirect != "paths" and self.indirect_resolution not in (None, self.resolution):
            raise PrtError(
                f"method {name!r} chooses the directions of the indirect light itself; leave indirect_resolution out"
            )

    @property
    def plan(self) -> Plan | None:
        """The plan that the method stands for, None if it is to be chosen."""
        if isinstance(self.method, Plan):
            return self.method
        plan = BY_NAME.get(self.method)
        return None if plan is None else self.with_shares(plan)

    def with_shares(self, plan: Plan) -> Plan:
        """A plan of finite elements; terms in the texel basis need shares of texels, pixels are nearer by them."""
        needed = (self.view_dependent or self.measurement != "vertices") and self.basis == "texel"
        needed = needed and plan.indirect == "gather"
        return replace(plan, direct="edges") if needed else plan

    def of(self, plan: Plan) -> Settings:
        """These, with the samples and the resolution of the indirect light that a plan has."""
        resolution = (plan.resolution or self.indirect_resolution) if plan.indirect == "paths" else None
        return replace(self, spp=plan.spp or self.samples, indirect_resolution=resolution)

    @property
    def samples(self) -> int:
        """Paths per element, where nothing else says how many."""
        return SPP if self.spp is None else self.spp

    @property
    def element_resolution(self) -> int:
        """Of the cubemap on which indirect light is computed."""
        return self.resolution if self.indirect_resolution is None else self.indirect_resolution
