"""Terms that a task is made of: rewards, observations, ends, events and curricula as small kernels, with their weights.

As in the managers of Isaac Lab and mjlab, a configuration names functions and weights; `TermTask` runs them. A function
is a Warp kernel over the worlds. Its arguments are found by their names:

- ``out``: what it writes, of shape (worlds,), or (worlds, size) for an observation;
- a name in ``params``;
- ``drawn_NAME``, ``column_NAME``, ``metric_NAME``: the first column of a parameter, of a part of the observation, or a
  figure's;
- ``memory``: what the term keeps from step to step in an episode, shape (worlds,);
- ``state`` (`WorldState`), and any array or number that the task, its configuration, its scene or the controller has
  under that name, such as ``object_position``, ``tool_pose``, ``metrics``, ``goal_tolerance``.
"""

from __future__ import annotations

import importlib
import operator
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self, cast

import warp as wp

from softmode.checks import require_choice, require_number
from softmode.envs.end_reason import EndReason
from softmode.envs.observation import Segment
from softmode.envs.task_config import TaskConfig
from softmode.errors import ConfigError

OUTS: dict[str, tuple[type, int] | None] = {
    "RewardTerm": (wp.float32, 1),
    "MetricTerm": (wp.float32, 1),
    "ObservationTerm": (wp.float32, 2),
    "TerminationTerm": (wp.bool, 1),
    "SuccessTerm": (wp.bool, 1),
    "CurriculumTerm": (wp.float32, 1),
    "EventTerm": None,
}
"""Number and dimensions of ``out``."""


def argument_types(kernel: wp.Kernel) -> dict[str, Any]:
    """Return the declared types of a kernel's arguments by name; those of arrays have `ndim` and `dtype`."""
    return {arg.label: arg.type for arg in kernel.adj.args}


def _kernel(module: str, name: str) -> wp.Kernel:
    """Return a kernel by its place."""
    return operator.attrgetter(name)(importlib.import_module(module))


@dataclass(frozen=True)
class Term:
    """A kernel and its numbers."""

    function: wp.Kernel
    """Kernel over the worlds."""
    params: Mapping[str, float | int] = field(default_factory=dict, kw_only=True)
    """Arguments of the kernel by name."""
    memory: float | None = field(default=None, kw_only=True)
    """What ``memory`` holds at the start of an episode; None for a term without."""

    def __post_init__(self) -> None:
        """Check the kernel.

        Raises:
            ConfigError: If it is none, or its ``out`` has the wrong shape.
        """
        kind = type(self).__name__
        if not isinstance(self.function, wp.Kernel):
            raise ConfigError(
                f"{kind}: function is a {type(self.function).__name__}", hint="give a function with @wp.kernel"
            )
        wanted, types = OUTS[kind], argument_types(self.function)
        if wanted is None:
            return
        dtype, ndim = wanted
        out, shape = types.get("out"), "(worlds,)" if ndim == 1 else "(worlds, size)"
        if (getattr(out, "ndim", 0), getattr(out, "dtype", None)) != (ndim, dtype):
            declared = f"wp.array{'' if ndim == 1 else '2d'}[{'wp.bool' if dtype is wp.bool else 'float'}]"
            raise ConfigError(
                f"{kind}: {self.function.key} must write out, shape {shape}", hint=f"declare it as out: {declared}"
            )

    def __deepcopy__(self, memo: object) -> Self:
        """Return itself: it is a value, and kernels cannot be copied."""
        return self

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields, the kernel by its place."""
        function = cast(Any, self.function.func)
        return {**vars(self), "function": (function.__module__, function.__qualname__)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Find the kernel again."""
        vars(self).update({**state, "function": _kernel(*state["function"])})


@dataclass(frozen=True)
class RewardTerm(Term):
    """A part of the reward: ``weight`` times what the kernel writes."""

    weight: float = field(default=1.0, kw_only=True)
    """Factor; negative for a cost."""

    def __post_init__(self) -> None:
        """Check the weight."""
        super().__post_init__()
        require_number("weight", self.weight)


@dataclass(frozen=True)
class MetricTerm(Term):
    """A figure in info, a function of the state alone; rewards and observations may read it."""


@dataclass(frozen=True)
class ObservationTerm(Term):
    """A part of the observation, a function of the state alone."""

    size: int = field(default=1, kw_only=True)
    """How many numbers."""
    low: float | tuple[float, ...] = field(default=-2.0, kw_only=True)
    """Bound below, in the unit of the quantity."""
    high: float | tuple[float, ...] = field(default=2.0, kw_only=True)
    """Bound above."""
    part: Literal["goal", "object"] = field(default="object", kw_only=True)
    """"goal" is seen beside pixels, "object" with state observations only."""

    def __post_init__(self) -> None:
        """Check size and part."""
        super().__post_init__()
        require_number("size", self.size, at_least=1)
        require_choice("part", self.part, ("goal", "object"))
        for name in ("low", "high"):
            bound = getattr(self, name)
            if isinstance(bound, tuple) and len(bound) != self.size:
                raise ConfigError(
                    f"ObservationTerm: {name} has {len(bound)} numbers, size is {self.size}",
                    hint="give a number, or one for each",
                )


@dataclass(frozen=True)
class TerminationTerm(Term):
    """A failure that ends the episode."""

    reason: EndReason = field(default=EndReason.FAILED, kw_only=True)
    """What ``info["end_reason"]`` says."""


@dataclass(frozen=True)
class SuccessTerm(Term):
    """When the goal is met."""

    hold_steps: int = field(default=1, kw_only=True)
    """Control steps in a row that make a success."""

    def __post_init__(self) -> None:
        """Check the count."""
        super().__post_init__()
        require_number("hold_steps", self.hold_steps, at_least=1)


@dataclass(frozen=True)
class EventTerm(Term):
    """What happens to worlds beside the physics: the kernel writes to arrays that it names."""

    mode: Literal["reset", "step"] = field(default="reset", kw_only=True)
    """"reset": after the draws of an episode, in the worlds of ``world_mask``; "step": before each control step."""

    def __post_init__(self) -> None:
        """Check the mode."""
        super().__post_init__()
        require_choice("mode", self.mode, ("reset", "step"))


@dataclass(frozen=True)
class CurriculumTerm(Term):
    """A range of draws that begins easy: the kernel writes the next episode's level, 0 easy to 1 the whole range.

    It may read ``level`` and ``success``, both of the episode that ended. Every world has a level of its own, 0 after a
    seed, so that episodes depend on seeds alone.
    """

    parameter: str = field(kw_only=True)
    """What is drawn."""
    easy_low: tuple[float, ...] = field(kw_only=True)
    """Its least value at level 0."""
    easy_high: tuple[float, ...] = field(kw_only=True)
    """Its largest value there."""


@dataclass(frozen=True, kw_only=True)
class Terms:
    """All terms of a task by name; rewards and figures keep their order."""

    metrics: Mapping[str, MetricTerm] = field(default_factory=dict)
    """Figures."""
    observations: Mapping[str, ObservationTerm] = field(default_factory=dict)
    """Parts of the observation."""
    rewards: Mapping[str, RewardTerm] = field(default_factory=dict)
    """Parts of the reward."""
    terminations: Mapping[str, TerminationTerm] = field(default_factory=dict)
    """Failures; of several the last counts."""
    events: Mapping[str, EventTerm] = field(default_factory=dict)
    """Events."""
    curricula: Mapping[str, CurriculumTerm] = field(default_factory=dict)
    """Curricula."""
    success: SuccessTerm | None = None
    """When the task is solved."""

    def __post_init__(self) -> None:
        """Check that every term stands where its kind belongs."""
        for group, kind in _KINDS.items():
            for name, term in getattr(self, group).items():
                if not isinstance(term, kind):
                    raise ConfigError(f"{group}[{name!r}] is a {type(term).__name__}", hint=f"give a {kind.__name__}")

    def weighted(self, **weights: float) -> Terms:
        """Return the same terms with other weights of rewards, by name.

        Raises:
            ConfigError: If there is no such reward.
        """
        unknown = sorted(set(weights) - set(self.rewards))
        if unknown:
            raise ConfigError(f"there is no reward {unknown[0]!r}", hint=f"there are: {', '.join(self.rewards)}")
        rewards = {name: replace(term, weight=weights.get(name, term.weight)) for name, term in self.rewards.items()}
        return replace(self, rewards=rewards)

    def segments(self, part: str) -> tuple[Segment, ...]:
        """Return the observation terms of a part as segments."""
        chosen = ((name, term) for name, term in self.observations.items() if term.part == part)
        return tuple(Segment(name, term.size, term.low, term.high) for name, term in chosen)


_KINDS: dict[str, type[Term]] = {
    "metrics": MetricTerm,
    "observations": ObservationTerm,
    "rewards": RewardTerm,
    "terminations": TerminationTerm,
    "events": EventTerm,
    "curricula": CurriculumTerm,
}


@dataclass(frozen=True, kw_only=True)
class TermConfig(TaskConfig):
    """A configuration with terms, for `TermTask`."""

    terms: Terms = field(default_factory=Terms)
    """What the task is made of."""
