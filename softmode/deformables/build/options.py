"""BuildOptions: how a body is reduced."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from softmode.checks import require_number
from softmode.deformables.body.rkpm import KernelName
from softmode.deformables.build.functions import RANK_TOLERANCE
from softmode.errors import ConfigError

HandleName = Literal["affine", "quadratic"]


@dataclass(frozen=True, kw_only=True)
class BuildOptions:
    """How a body is reduced."""

    mode_count: int = 8
    """Skinning eigenmodes beside the constant handle; up to 4 (mode_count + 1) functions."""
    kernel_count: int = 400
    """Reproducing kernels; 400 give the first 16 eigenvalues of a box to 0.3 % in about 0.1 s."""
    kernel: KernelName = "cubic"
    """Bell of the reproducing kernels."""
    handles: HandleName = "affine"
    """What an eigenmode carries: (X, Y, Z, 1), or all ten monomials up to degree two."""
    static_responses: bool = True
    """On a body with regions: nine more weights, one function each, from its response to unit body forces."""
    response_derivatives: int = 12
    """Likewise, up to 18 from the second order of that response; a beam that bends far needs them, and then needs few
    eigenmodes: with 2 modes and 87 unknowns it is as accurate as with 16 and 189."""
    poissons_ratio: float = 0.4
    """Poisson's ratio of the responses; any other can be simulated, but the nearer it is the better."""
    rank_tolerance: float = RANK_TOLERANCE
    """Raw functions that add less than this fraction of mass (of the scaled Gram matrix) to the others are dropped,
    0 < tolerance <= 1e-2; on a body with regions it is at most 1e-7. Less keeps more, also noise: on an object with
    symmetries the cubature's force error grows. Clamps that the build does not know gain by 1e-8."""
    cubature_count: int | None = 384
    """Points at which a step evaluates stress; None keeps all. Measured force errors at 256 points: 0.4-0.6 % (box,
    sphere, beam), 1.5 % (bear, robot); at 384: 0.2-0.3 % and 0.8 %. A held body has more functions: 1-7 % at 384,
    while its lowest elastic eigenvalues err by 1 % or less. Beyond 100 functions allow six points for each: 384 make a
    held plate 40:1 of 132 functions 6 % too soft, 768 3 %. `provenance` has the body's own errors, of the forces also
    at smaller counts."""
    seed: int = 0
    """Seed of every random choice of the build."""

    def __post_init__(self) -> None:
        """Check ranges."""
        require_number("mode_count", self.mode_count, at_least=1)
        if self.kernel_count <= self.mode_count + 4:
            raise ConfigError(f"kernel_count: expected more than mode_count + 4, got {self.kernel_count}")
        if self.cubature_count is not None:
            require_number("cubature_count", self.cubature_count, at_least=8)
        require_number("rank_tolerance", self.rank_tolerance, above=0.0, at_most=1.0e-2)
        if self.handles not in get_args(HandleName):
            raise ConfigError(f"handles: expected one of {get_args(HandleName)}, got {self.handles!r}")
        require_number("response_derivatives", self.response_derivatives, at_least=0, at_most=18)
        require_number("poissons_ratio", self.poissons_ratio, at_least=0.0, below=0.5)
