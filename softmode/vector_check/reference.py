"""The run that all rules on behaviour compare with."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from softmode.errors import EnvironmentCheckError
from softmode.vector_check.episodes import Event, Subject
from softmode.vector_check.tensors import Tensor, host_array
from softmode.vector_check.values import equal, leaves

REFUSALS = (ValueError, TypeError, AssertionError, gym.error.Error)
"""Types of error that refuse an argument; others are crashes."""

DEPTH = 5
"""Steps that a run goes on after a disturbance."""

MASK_HINT = "reset only the worlds of options['reset_mask'] and return the others' present observations"
"""Remedy for a wrong `reset_mask`."""


class Skip(Exception):
    """A rule cannot be checked on this environment; the message says why."""


class Reference:
    """A run of an environment, made once.

    Args:
        subject: The environment.
        max_episode_steps: Time limit; None where there is none.
        exchangeable: Whether world i of ``reset(seed=s)`` is world 0 of ``reset(seed=s + i)``.
        ignored: Keys of infos that may differ from run to run, such as wall-clock times.
    """

    def __init__(
        self, subject: Subject, *, max_episode_steps: int | None, exchangeable: bool, ignored: frozenset[str]
    ) -> None:
        """Make the reference run."""
        self.subject, self.limit, self.exchangeable, self.ignored = subject, max_episode_steps, exchangeable, ignored
        self.events = subject.run(subject.steps)
        """Its events; whatever was returned is kept."""
        self.copies = [[(path, bits(array)) for path, array in leaves(event.returned)] for event in self.events]
        self.steps = [event for event in self.events if event.is_step]
        done = [index for index, event in enumerate(self.steps) if event.done.any()]
        self.first_end = done[0] if done else None
        """Index of the first step that ends an episode."""

    def compare(self, events: list[Event], rule: str, what: str, hint: str) -> None:
        """Compare a whole run with the reference."""
        for index, (mine, other) in enumerate(zip(self.events, events, strict=False)):
            for world in range(self.subject.num_envs):
                part = mine.differs(other, world, ignored=self.ignored, infos=True)
                if part:
                    raise EnvironmentCheckError(
                        f"{part} of call {index} differs in {what}", rule=rule, world=world, hint=hint
                    )

    def same_worlds(
        self,
        mine: Event,
        other: Event,
        rule: str,
        what: str,
        hint: str,
        *,
        without: int | None = None,
        same: bool = False,
    ) -> None:
        """Compare two events world by world: the observations, and with ``same`` rewards and flags as well."""
        for world in range(self.subject.num_envs):
            if world == without:
                continue
            part = mine.differs(other, world) if same else ""
            if part or not equal(mine.observation[world], other.observation[world]):
                raise EnvironmentCheckError(
                    f"{what} changes its {part or 'observation'}", rule=rule, world=world, hint=hint
                )


def bits(array: ArrayLike | Tensor) -> bytes:
    """Return an array's content."""
    return np.asarray(host_array(array) if isinstance(array, Tensor) else array).tobytes()
