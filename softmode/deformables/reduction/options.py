"""BuildOptions: how a body is reduced."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from softmode.checks import require_choice, require_number
from softmode.deformables.body.rkpm import KernelName
from softmode.deformables.reduction.cubature import MANY_POSES, POSE_COUNT
from softmode.deformables.reduction.functions import RANK_TOLERANCE
from softmode.errors import ConfigError

HandleName = Literal["affine", "quadratic", "local", "qgmls"]

DEFAULT_POISSONS_RATIO = 0.4
"""Poisson's ratio that a body is built for when none is given: that of `Material`."""
KERNEL_COUNT = 1000
"""Kernels of functions that are chosen by elastic energy."""
EIGENMODE_KERNEL_COUNT = 400
"""Kernels of FreeForm's functions."""
MANY_POINTS = 4000
"""Quadrature points from which on there may be as many kernels as that, four for each; fewer points take five each."""
KERNEL_LEAST = 60
"""The fewest kernels where none are asked for."""
EIGENMODE_COUNT = 8
"""Skinning eigenmodes where FreeForm's functions are asked for without a number."""
FUNCTION_COUNT = 48
"""Functions where neither a number nor an accuracy is given."""
VARIED_RATIOS = (0.3, 0.45, 0.49)
"""Ratios that functions are made for where Poisson's ratio varies."""
LOCAL_COUNT = 16
"""Local handles, or kernels of Q-GMLS, where no number is given."""
FUNCTION_LEAST = 10
"""The fewest functions: with all quadratic fields the first bending is free."""
FUNCTION_LIMIT = 120
"""The most functions that `BuildOptions.accuracy` may lead to."""
CUBATURE_COUNT = 384
"""Cubature points where no number is given. Fewer are a choice of speed over forces, and stay as they are."""


@dataclass(frozen=True, kw_only=True)
class BuildOptions:
    """How a body is reduced.

    By default a body has 48 functions that are chosen by elastic energy, also with regions. `function_count` or
    `accuracy` change how many. `mode_count`, or `handles` of "affine" or "quadratic", ask for FreeForm's functions
    instead: eigenmodes times affine or quadratic motion, and on a body with regions static responses. `handles` of
    "local" or "qgmls" take the place of the eigenmodes: with a number of functions, or an accuracy, these are chosen
    among them by elastic energy; without, the body has them all.
    """

    function_count: int | None = None
    """Scalar functions n, chosen by elastic energy; the body has 3 n unknowns. None takes 48, or follows `accuracy`."""
    accuracy: float | None = None
    """Largest relative error of the first six frequencies against the whole space that the functions are chosen from,
    for instance 0.02: free ones, or those of the held body. The fewest functions that reach it are taken, up to 120,
    and those that contribute as much as the last of them: symmetric bodies have clusters of such functions."""
    poissons_ratio: float | tuple[float, ...] | None = None
    """Poisson's ratio that the functions are made for; None means that of the material that an object is loaded with,
    else 0.4. Any other can be simulated, but functions made for 0.4 are 28 % too stiff in a plate of 0.49. Several,
    such as (0.3, 0.45, 0.49), serve a ratio that varies, and want 60 functions. Static responses use the mean."""
    mode_count: int | None = None
    """Skinning eigenmodes beside the constant handle, of FreeForm's functions; up to 4 (mode_count + 1) functions."""
    handles: HandleName | None = None
    """What such an eigenmode carries: (X, Y, Z, 1) of "affine" ones, or all ten monomials up to degree two of
    "quadratic" ones; None means "affine". "local": ten monomials times weights that are local, along paths through the
    material. "qgmls": PIE-NeRF's functions, ten for each kernel, of bodies without regions, for comparison."""
    local_count: int | None = None
    """Local handles, or kernels of "qgmls", at least 2; None takes 16."""
    add_kernels: Sequence[tuple[ArrayLike, float]] = ()
    """Further ones, where more local motion is wanted: pairs of a place [m], in the coordinates of the asset, and a
    radius [m]."""
    kernel_count: int | None = None
    """Reproducing kernels. None takes 1000 where functions are chosen by elastic energy: corners and crossings need
    them (a cross is 7 % too stiff with 400, 4 % with 1000). FreeForm's functions take 400, which give the first 16
    eigenvalues of a box to 0.3 %. Below 4,000 quadrature points None takes a fifth of them at most, and with regions
    fewer where kernels would be narrower than 1.3 cells: these move between the points and cost no energy (a bar of
    1,000 points and 1,000 kernels was 38 % too soft, with 200 kernels it is 2.5 %)."""
    kernel: KernelName = "cubic"
    """Bell of the reproducing kernels."""
    static_responses: bool = True
    """FreeForm's functions, on a body with regions: nine more weights, one function each, from its response to unit
    body forces. Functions chosen by elastic energy have these in any case."""
    response_derivatives: int = 12
    """Likewise, up to 18 from the second order of that response; a beam that bends far needs them, and then needs few
    eigenmodes: with 2 modes and 87 unknowns it is as accurate as with 16 and 189."""
    rank_tolerance: float = RANK_TOLERANCE
    """Of FreeForm's functions those that add less than this fraction of mass (of the scaled Gram matrix) to the others
    are dropped, 0 < tolerance <= 1e-2; on a body with regions, or with local handles, it is at most 1e-7."""
    cubature_count: int | None = CUBATURE_COUNT
    """Points at which a step evaluates stress, or fewer where these fit the forces to rounding; None keeps all. Beyond
    100 functions allow six points for each: 384 make a held plate 40:1 of 132 functions 6 % too soft, 768 3 %.
    `provenance` has the body's own errors, of the forces also at smaller counts."""
    cubature_error: float | None = 0.03
    """Relative error of the forces on held-out poses. Where `cubature_count` is 384 or more and leaves a larger one,
    points are fitted to three times as many poses, and if that is not enough, half as many points are added, or as many
    again. None leaves it at the first fit."""
    seed: int = 0
    """Seed of every random choice of the build."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if self.mode_count is not None:
            require_number("mode_count", self.mode_count, at_least=1)
        if self.handles is not None:
            require_choice("handles", self.handles, get_args(HandleName))
        if self.function_count is not None:
            require_number("function_count", self.function_count, at_least=FUNCTION_LEAST)
        if self.accuracy is not None:
            require_number("accuracy", self.accuracy, above=0.0, below=1.0)
        if self.handles in ("local", "qgmls"):
            require_number("local_count", self.local, at_least=2)
            object.__setattr__(self, "add_kernels", _checked(self.add_kernels))
        elif self.local_count is not None or len(self.add_kernels):
            raise ConfigError(
                "local_count, add_kernels: there are no local handles", hint="ask for them by handles='local'"
            )
        if self.local and self.mode_count is not None:
            raise ConfigError(
                f"mode_count: handles={self.handles!r} have no eigenmodes",
                hint="give local_count for the handles, function_count for the functions chosen among theirs",
            )
        if self.chosen and not (self.static_responses and self.response_derivatives == 12):
            raise ConfigError(
                "static_responses, response_derivatives: functions chosen by elastic energy have what they need",
                hint="leave them out, or ask for FreeForm's functions by mode_count",
            )
        asked = [name for name in ("function_count", "accuracy") if getattr(self, name) is not None]
        if asked and (not self.chosen or len(asked) == 2):
            others = [name for name in ("mode_count", "handles") if getattr(self, name) is not None]
            raise ConfigError(
                f"{' and '.join([*asked, *others])}: give one kind",
                hint="function_count or accuracy choose functions by elastic energy; mode_count and handles ask for "
                "FreeForm's eigenmodes",
            )
        if self.kernel_count is not None and self.kernel_count <= (self.mode_count or 0) + 4:
            raise ConfigError(f"kernel_count: expected more than mode_count + 4, got {self.kernel_count}")
        if self.cubature_count is not None:
            require_number("cubature_count", self.cubature_count, at_least=8)
        if self.cubature_error is not None:
            require_number("cubature_error", self.cubature_error, above=0.0, below=1.0)
        require_number("rank_tolerance", self.rank_tolerance, above=0.0, at_most=1.0e-2)
        require_number("response_derivatives", self.response_derivatives, at_least=0, at_most=18)
        if self.poissons_ratio == ():
            raise ConfigError("poissons_ratio: no values", hint="give one ratio or more, or None")
        for ratio in self.poissons_ratios:
            require_number("poissons_ratio", ratio, at_least=0.0, below=0.5)

    def with_functions(self, count: int) -> BuildOptions:
        """Return these options with another number of functions, chosen by elastic energy."""
        handles = self.handles if self.local else None
        return replace(self, function_count=count, accuracy=None, mode_count=None, handles=handles)

    def for_ratio(self, poissons_ratio: float) -> BuildOptions:
        """Return these options for a material's Poisson's ratio, unless they name one.

        Functions made for 0 serve a ratio below.
        """
        if self.poissons_ratio is not None or poissons_ratio == DEFAULT_POISSONS_RATIO:
            return self
        return replace(self, poissons_ratio=max(poissons_ratio, 0.0))

    def for_varied_ratio(self) -> BuildOptions:
        """Return these options for a Poisson's ratio that varies: several ratios, and a quarter more functions.

        Options that name a ratio, or whose functions are not chosen by elastic energy, stay as they are.
        """
        if self.poissons_ratio is not None or not self.chosen:
            return self
        count = None if self.accuracy is not None else (self.function_count or FUNCTION_COUNT) * 5 // 4
        return replace(self, poissons_ratio=VARIED_RATIOS, function_count=count)

    def kernels(self, point_count: int) -> int:
        """Return how many kernels a body of so many quadrature points has at most."""
        if self.kernel_count is not None:
            return self.kernel_count
        most = KERNEL_COUNT if self.chosen or self.local else EIGENMODE_KERNEL_COUNT
        few = max(point_count // 5, KERNEL_LEAST)
        return most if point_count >= MANY_POINTS else min(most, few)

    def cubature_trials(self, point_count: int) -> tuple[tuple[int, int], ...]:
        """Return numbers of cubature points and training poses to try in turn, of so many quadrature points."""
        if self.cubature_count is None or self.cubature_count >= point_count:
            return ((point_count, POSE_COUNT),)
        first = self.cubature_count
        if self.cubature_error is None or first < CUBATURE_COUNT:
            return ((first, POSE_COUNT),)
        counts = first, min(first * 3 // 2, point_count), min(first * 2, point_count)
        return (first, POSE_COUNT), *((count, MANY_POSES) for count in counts)

    @property
    def local(self) -> int:
        """Number of local handles, or of kernels of Q-GMLS; 0 where none are asked for."""
        if self.handles not in ("local", "qgmls"):
            return 0
        return LOCAL_COUNT if self.local_count is None else self.local_count

    @property
    def chosen(self) -> bool:
        """Whether functions are chosen by elastic energy."""
        if self.handles in ("local", "qgmls"):
            return self.function_count is not None or self.accuracy is not None
        return self.mode_count is None and self.handles is None

    @property
    def poissons_ratios(self) -> tuple[float, ...]:
        """The ratios that the functions are made for."""
        given = DEFAULT_POISSONS_RATIO if self.poissons_ratio is None else self.poissons_ratio
        return given if isinstance(given, tuple) else (given,)

    @property
    def mean_ratio(self) -> float:
        """Their mean: the ratio of what is made once for all of them, and to which a field is relative."""
        return float(np.mean(self.poissons_ratios))


def _checked(added: Sequence[tuple[ArrayLike, float]]) -> tuple[tuple[tuple[float, ...], float], ...]:
    """Return places and radii as numbers.

    Raises:
        ConfigError: If they are none.
    """
    found = []
    for pair in added:
        try:
            place, radius = pair
            place = tuple(np.asarray(place, dtype=np.float64).tolist())
        except (TypeError, ValueError):
            place, radius = (), 0.0
        require_number("add_kernels: radius", radius, above=0.0)
        if len(place) != 3 or not np.isfinite(place).all():
            raise ConfigError(f"add_kernels: expected pairs of a place (3,) and a radius, got {pair!r}")
        found.append((place, float(radius)))
    return tuple(found)
