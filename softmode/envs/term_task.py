"""A task that is made of terms: their kernels, launched in the captured step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from softmode.envs import term_kernels as kernels
from softmode.envs.observation import Segment
from softmode.envs.task import Task
from softmode.envs.task_kernels import forget
from softmode.envs.terms import CurriculumTerm, EventTerm, Term, TermConfig, Terms, argument_types
from softmode.errors import ConfigError


class TermTask(Task):
    """A task whose configuration has `Terms`.

    Its reward terms, figures, failures and success are those of the terms; before another task in the list of bases,
    it keeps that task's observation and figures, and replaces its reward and success.
    """

    config: Any
    config_class = TermConfig

    def __init__(self, config: Any, **options: Any) -> None:
        """Take the names over and build the task."""
        terms: Terms = config.terms
        self.term_names = tuple(terms.rewards)  # type: ignore[misc]  # of this task, not of its class
        self.metric_names = (*type(self).metric_names, *terms.metrics)  # type: ignore[misc]
        super().__init__(config, **options)

    @property
    def made_of(self) -> Terms:
        """The terms."""
        return self.config.terms

    def goal_segments(self) -> tuple[Segment, ...]:
        """Add the observation terms of the goal."""
        return (*super().goal_segments(), *self.made_of.segments("goal"))

    def object_segments(self) -> tuple[Segment, ...]:
        """Add those of the object."""
        return (*super().object_segments(), *self.made_of.segments("object"))

    def build(self) -> None:
        """Find the arguments of every kernel."""
        super().build()
        terms, worlds = self.made_of, self.world_count
        self._memories: dict[str, tuple[wp.array, float]] = {}
        self._levels: dict[str, wp.array] = {}
        self._calls: dict[str, list[tuple[wp.Kernel, list[Any]]]] = {}

        def zeros(*shape: int, dtype: type = float) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=self.device)

        self._values = zeros(max(len(terms.rewards), 1), worlds)
        self._weights = wp.array(
            [float(term.weight) for term in terms.rewards.values()], dtype=float, device=self.device
        )
        self._figures = {name: zeros(worlds) for name in terms.metrics}
        self._broken = {name: zeros(worlds, dtype=wp.bool) for name in terms.terminations}
        self._met = zeros(worlds, dtype=wp.bool)
        self._next_levels = {name: zeros(worlds) for name in terms.curricula}
        self._easy = {name: self._easy_range(name, term) for name, term in terms.curricula.items()}
        outs: dict[str, Mapping[str, wp.array]] = {
            "metrics": self._figures,
            "observations": {name: self.observation[:, self.segments[name][0]] for name in terms.observations},  # type: ignore[dict-item]
            "rewards": {name: self._values[k] for k, name in enumerate(terms.rewards)},  # type: ignore[dict-item]
            "terminations": self._broken,
            "curricula": self._next_levels,
        }
        for name in terms.curricula:
            self._levels[name] = zeros(worlds)
        for group, made in outs.items():
            for name, term in getattr(terms, group).items():
                self._bind(group, name, term, {"out": made[name]})
        for name, term in terms.events.items():
            self._bind(term.mode, name, term, {})
        if terms.success is not None:
            self._bind("success", "success", terms.success, {"out": self._met})

    def _easy_range(self, name: str, term: CurriculumTerm) -> tuple[wp.array, wp.array]:
        """Return the easy range of a curriculum."""
        parameter = self.table.parameters.get(term.parameter)
        if parameter is None:
            raise ConfigError(
                f"curricula[{name!r}]: nothing is drawn as {term.parameter!r}",
                hint=f"use one of {', '.join(self.table.parameters)}",
            )
        for bound in (term.easy_low, term.easy_high):
            if len(bound) != parameter.size or not np.isfinite(bound).all():
                raise ConfigError(
                    f"curricula[{name!r}]: easy_low and easy_high must hold {parameter.size} numbers, got {bound}",
                    hint=f"give tuples like {parameter.low}",
                )
        low, high = (wp.array(bound, dtype=float, device=self.device) for bound in (term.easy_low, term.easy_high))
        return low, high

    def _bind(self, group: str, name: str, term: Term, given: dict[str, Any]) -> None:
        """Find the arguments of a term's kernel by their names.

        Raises:
            ConfigError: If one is unknown or has another type.
        """
        where = f"term {name!r} of {group}"
        given = {**given, **term.params}
        if term.memory is not None:
            memory = wp.full(self.world_count, term.memory, dtype=float, device=self.device)
            self._memories[f"{group}_{name}"] = memory, term.memory
            given["memory"] = memory
        if isinstance(term, CurriculumTerm):
            given["level"] = self._levels[name]
        if isinstance(term, EventTerm) and term.mode == "step":
            given["world_mask"] = None  # it would be that of the last reset
        labels = argument_types(term.function)
        unused = sorted(set(term.params) - set(labels))
        if unused:
            raise ConfigError(
                f"{where}: {term.function.key} takes no {unused[0]!r}", hint=f"it takes {', '.join(labels)}"
            )
        arguments = []
        for label, kind in labels.items():
            value = given[label] if label in given else self._named(label)
            if value is None:
                raise ConfigError(
                    f"{where}: {term.function.key} takes {label!r}, which is nothing that the task has",
                    hint="give it in params, or see softmode.envs.terms for the names that are known",
                )
            _check_type(where, label, kind, value)
            arguments.append(value)
        self._calls.setdefault(group, []).append((term.function, arguments))

    def _named(self, label: str) -> Any:
        """Return what an argument of a name is, None if there is nothing."""
        kind, _, name = label.partition("_")
        if kind == "drawn" and name in self.table.parameters:
            return self.table.column(name)
        if kind == "column" and name in self.segments:
            return self.column(name)
        if kind == "metric" and name in self.metric_names:
            return self.metric_names.index(name)
        scene, known = self.scene, {"parameters": self.table.values}
        if label in known:
            return known[label]
        sources = (self, self.config, scene, self.config.scene.control, scene.controller, scene.soft, scene.state)
        for source in (*sources, scene.state.softmode):  # type: ignore[attr-defined]
            value = getattr(source, label, None)
            if value is not None and not callable(value):
                return value
        return None

    def _run(self, group: str) -> None:
        """Launch the kernels of a group."""
        for function, arguments in self._calls.get(group, ()):
            self.launch(function, arguments)

    def _draw(self) -> None:
        """Draw, set the levels of curricula, and let the events of the start happen."""
        super()._draw()
        self._run("curricula")
        for name, term in self.made_of.curricula.items():
            table, parameter = self.table, self.table.parameters[term.parameter]
            inputs = [self.scene.world_mask, self.episode, self._next_levels[name], table.column(term.parameter)]
            inputs += [parameter.size, table.low, table.high, table.kind, *self._easy[name]]
            self.launch(kernels.advance_level, inputs, [self._levels[name], table.values])
        self._run("reset")

    def clear(self) -> None:
        """Set the memories of terms back."""
        super().clear()
        for memory, start in self._memories.values():
            self.launch(forget, [self.scene.world_mask, start], [memory])

    def before_step(self) -> None:
        """Let the events of a step happen."""
        super().before_step()
        self._run("step")

    def observe(self) -> None:
        """Write figures, then observations."""
        super().observe()
        self._run("metrics")
        for name, values in self._figures.items():
            self.launch(kernels.write_metric, [values, self.metric_names.index(name)], [self.result])
        self._run("observations")

    def evaluate(self) -> None:
        """Write the reward's terms, failures and success."""
        self._run("rewards")
        self.launch(kernels.weigh, [self._values, self._weights], [self.terms])
        self._run("terminations")
        for name, term in self.made_of.terminations.items():
            self.launch(kernels.fail, [self._broken[name], int(term.reason)], [self.result])
        self._run("success")
        if self.made_of.success is not None:
            self.launch(kernels.hold, [self._met, self.made_of.success.hold_steps], [self.result])

    def state_arrays(self) -> dict[str, wp.array]:
        """Add memories and levels."""
        memories = {f"memory_{name}": memory for name, (memory, _) in self._memories.items()}
        return {
            **super().state_arrays(),
            **memories,
            **{f"level_{name}": level for name, level in self._levels.items()},
        }


def _check_type(where: str, label: str, kind: Any, value: Any) -> None:
    """Raise ConfigError unless a value fits the type of a kernel's argument."""
    if hasattr(kind, "ndim"):
        fits = isinstance(value, wp.array) and value.ndim == kind.ndim and value.dtype is kind.dtype
        wanted = f"array of {kind.ndim} dimensions of {kind.dtype.__name__}"
        got = f"{value.ndim} dimensions of {value.dtype.__name__}" if isinstance(value, wp.array) else repr(value)
    elif kind in (float, wp.float32, int, wp.int32, bool, wp.bool):
        whole = kind in (int, wp.int32, bool, wp.bool)
        fits = isinstance(value, int | np.integer) or (not whole and isinstance(value, float | np.floating))
        wanted, got = "whole number" if whole else "number", repr(value)
    else:
        return  # a struct or a vector: Warp checks it at the launch
    if not fits:
        raise ConfigError(f"{where}: {label} is declared as {wanted}, the task's is {got}", hint="declare it like that")
