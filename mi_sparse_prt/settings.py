"""The arguments of a precomputation, checked."""

from __future__ import annotations

from dataclasses import dataclass

from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.errors import PrtError

METHODS = ("brute_force", "sparse", "huang2010", "gather")
BASES = ("direction", "texel")


@dataclass(frozen=True)
class Settings:
    """What a matrix depends on besides the scene; the parameters of ``precompute``.

    Raises
    ------
    PrtError
        If a value makes no sense.
    """

    resolution: int
    method: str = "brute_force"
    basis: str = "direction"
    max_depth: int = 5
    spp: int = 16
    target_error: float | None = None
    seed: int = 0
    indirect_resolution: int | None = None
    strata: int = 2

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise PrtError(f"unknown method {self.method!r}; choose one of: {', '.join(METHODS)}")
        if self.method != "brute_force":
            if self.basis != "direction" and self.method != "gather":
                raise PrtError(f'method {self.method!r} works in the direction basis; set basis="direction"')
            if self.indirect_resolution not in (None, self.resolution):
                raise PrtError(
                    f"method {self.method!r} chooses the directions of the indirect light itself; "
                    "leave indirect_resolution out"
                )
            if self.target_error is not None and self.method == "huang2010":
                raise PrtError(
                    'method "huang2010" has the rates of the paper and aims at no target error; leave it out, '
                    'or set method="sparse"'
                )
        if self.basis not in BASES:
            raise PrtError(f"unknown basis {self.basis!r}; choose one of: {', '.join(BASES)}")
        for name, least in (("spp", 1), ("strata", 1), ("seed", 0), ("max_depth", -1)):
            value = getattr(self, name)
            if value != int(value) or value < least:
                raise PrtError(f"{name} is {value}; it must be a whole number of at least {least}")
        if self.max_depth < 2 and self.max_depth != -1:
            raise PrtError(f"max_depth is {self.max_depth}; 2 is direct light only, -1 is no limit")
        if self.target_error is not None and not self.target_error > 0:
            raise PrtError(f"target_error is {self.target_error}; it must be positive, 0.02 for 2%")
        if self.coarse.resolution > self.resolution:
            raise PrtError(
                f"indirect_resolution {self.indirect_resolution} is finer than the lighting's; "
                f"use at most {self.resolution}"
            )

    @property
    def coarse(self) -> CubemapLighting:
        """The cubemap on which indirect light is computed."""
        return CubemapLighting(
            self.resolution if self.indirect_resolution is None else self.indirect_resolution
        )

    @property
    def indirect_basis(self) -> str:
        """A coarse element stands for all directions in its texel, whatever the basis."""
        return self.basis if self.coarse.resolution == self.resolution else "texel"
