"""Running a vector environment under check: every call is validated, every result is kept."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array, iterate
from numpy.typing import NDArray

from softmode.errors import EnvironmentCheckError
from softmode.vector_check.tensors import world_of
from softmode.vector_check.values import (
    as_numpy,
    check_flag,
    check_infos,
    check_kinds,
    check_metadata,
    check_observation,
    check_reward,
    check_spaces,
    equal,
    leaves,
    like,
    worlds,
)


@dataclass(frozen=True)
class Event:
    """What one call of reset or step returned, as NumPy copies, and what it really returned."""

    observation: list[Any]
    """Observation of each world."""
    reward: NDArray[Any]
    """Rewards, shape (num_envs,); zero for a reset."""
    terminated: NDArray[np.bool_]
    """Shape (num_envs,)."""
    truncated: NDArray[np.bool_]
    """Shape (num_envs,)."""
    infos: dict[str, Any]
    """Infos."""
    returned: object
    """The objects themselves."""
    is_step: bool
    """Whether it was a step."""

    @property
    def done(self) -> NDArray[np.bool_]:
        """Worlds whose episode ended, shape (num_envs,)."""
        return self.terminated | self.truncated

    def differs(self, other: Event, world: int, *, ignored: frozenset[str] = frozenset(), infos: bool = False) -> str:
        """Name the first part in which a world differs from the same world of another event, or return ""."""
        if not equal(self.observation[world], other.observation[world]):
            return "observation"
        for name in ("reward", "terminated", "truncated"):
            if not equal(getattr(self, name)[world : world + 1], getattr(other, name)[world : world + 1]):
                return name
        for key in (self.infos.keys() | other.infos.keys()) - ignored if infos else ():
            if not equal(self.infos.get(key), other.infos.get(key)):
                return f"infos[{key!r}]"
        return ""


class Subject:
    """A vector environment and the actions it is given; every call is checked against the rules on values.

    Args:
        env: The environment.
        steps: Steps of a reference run; actions are drawn once, from a copy of the action space.
        seed: Seed of the actions and first seed of the environment.
    """

    def __init__(self, env: VectorEnv, *, steps: int, seed: int) -> None:
        """Check the spaces and draw the actions."""
        check_spaces(env)
        self.mode: AutoresetMode = check_metadata(env)
        self.env, self.steps, self.seed = env, steps, seed
        self.num_envs = int(env.num_envs)
        self.composed = isinstance(env.unwrapped, SyncVectorEnv | AsyncVectorEnv)
        """Whether single environments are stepped one by one, by Gymnasium."""
        space = copy.deepcopy(env.action_space)
        space.seed(seed)
        self.actions = [space.sample() for _ in range(2 * steps + 16)]
        self._forms: dict[str, Any] = {}
        self._sample: object = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Event:
        """Reset and check what comes back."""
        returned = self.env.reset(seed=seed, options=options)
        if not isinstance(returned, tuple) or len(returned) != 2:
            raise EnvironmentCheckError(
                f"reset returned {type(returned).__name__}", rule="observations", hint="return (observation, infos)"
            )
        self._sample = next((array for _, array in leaves(returned[0])), None)
        batch, infos = map(as_numpy, returned)
        check_observation(self.env, batch, "reset")
        check_infos(self.num_envs, infos, self._forms)
        none = np.zeros(self.num_envs, np.bool_)
        zeros = np.zeros(self.num_envs)
        return Event(worlds(self.env, batch), zeros, none, none, infos, returned, False)

    def step(self, action: Any, *, lenient: int | None = None) -> Event:
        """Step and check what comes back; the values of world ``lenient`` may be anything."""
        given = like(copy.deepcopy(action), self._sample)
        returned = self.env.step(given)
        if not equal(as_numpy(given), as_numpy(action)) and lenient is None:
            raise EnvironmentCheckError(
                "step wrote into the action it was given", rule="no shared buffers", hint="copy actions before changes"
            )
        if not isinstance(returned, tuple) or len(returned) != 5:
            hint = "return (observation, reward, terminated, truncated, infos)"
            raise EnvironmentCheckError(f"step returned {type(returned).__name__}", rule="observations", hint=hint)
        batch, reward, terminated, truncated, infos = map(as_numpy, returned)
        check_observation(self.env, batch, "step", lenient)
        checked = reward
        if lenient is not None and isinstance(reward, np.ndarray) and reward.shape == (self.num_envs,):
            checked = reward.copy()
            checked[lenient] = 0.0
        check_reward(self.env, checked)
        check_flag(self.env, terminated, "terminated")
        check_flag(self.env, truncated, "truncated")
        check_kinds(returned[0], dict(zip(("reward", "terminated", "truncated"), returned[1:4], strict=True)))
        check_infos(self.num_envs, infos, self._forms)
        event = Event(worlds(self.env, batch), reward, terminated, truncated, infos, returned, True)
        if self.mode is AutoresetMode.SAME_STEP:
            self._check_final(event)
        return event

    def follow(self, event: Event) -> Event | None:
        """In DISABLED mode restart the finished worlds by ``reset_mask``."""
        if self.mode is not AutoresetMode.DISABLED or not event.done.any():
            return None
        return self.reset(options={"reset_mask": event.done.copy()})

    def run(
        self, count: int, *, seed: int | None = None, actions: list[Any] | None = None, overwrite: bool = False
    ) -> list[Event]:
        """Reset with a seed and step ``count`` times.

        Args:
            count: Number of steps.
            seed: Seed of the reset; None for the subject's.
            actions: Actions; None for the subject's.
            overwrite: Fill what was returned with other numbers before the next call.

        Returns:
            The reset, the steps, and in DISABLED mode the resets between them.
        """
        events = [self.reset(seed=self.seed if seed is None else seed)]
        for action in (actions or self.actions)[:count]:
            if overwrite:
                _overwrite(events[-1].returned)
            events.append(self.step(action))
            again = self.follow(events[-1])
            if again is not None:
                events.append(again)
        return events

    def replace_action(self, action: Any, world: int, item: Any) -> Any:
        """Return a batched action with one world's replaced."""
        items = list(iterate(self.env.action_space, action))
        items[world] = item
        space = self.env.single_action_space
        return concatenate(space, items, create_empty_array(space, self.num_envs))

    def action_of(self, action: Any, world: int) -> Any:
        """Return one world's action."""
        return list(iterate(self.env.action_space, action))[world]

    def other_action(self, action: Any, world: int) -> Any:
        """Return a batched action that differs in one world alone."""
        mine = self.action_of(action, world)
        for other in self.actions:
            item = self.action_of(other, world)
            if not equal(item, mine):
                return self.replace_action(action, world, item)
        return action

    def _check_final(self, event: Event) -> None:
        """Rule ``autoreset``, SAME_STEP: the ended episodes' last observations and infos are in the infos."""
        done = event.done
        for key in ("final_obs", "final_info"):
            mask = event.infos.get(f"_{key}", np.zeros(self.num_envs, np.bool_))
            if not np.array_equal(mask, done):
                world = int(np.flatnonzero(mask != done)[0])
                raise EnvironmentCheckError(
                    f"infos['_{key}'] is {bool(mask[world])} where an episode {'ended' if done[world] else 'goes on'}",
                    rule="autoreset",
                    world=world,
                    hint=f"in SAME_STEP mode put {key} into the infos of exactly the worlds that are done",
                )
        for world in np.flatnonzero(done):
            last = world_of(event.infos["final_obs"], int(world))
            if not self.env.single_observation_space.contains(last):
                message = f"infos['final_obs'] holds {last!r}, outside {self.env.single_observation_space}"
                hint = "put the last observation of the ended episode there"
                raise EnvironmentCheckError(message, rule="autoreset", world=int(world), hint=hint)
            if not isinstance(event.infos["final_info"], Mapping | np.ndarray):
                message = f"infos['final_info'] is a {type(event.infos['final_info']).__name__}"
                hint = "make it a dict of arrays with masks, as the infos are"
                raise EnvironmentCheckError(message, rule="autoreset", world=int(world), hint=hint)


def _overwrite(returned: object) -> None:
    """Write other numbers into everything that was returned and can be written."""
    for _, array in leaves(returned):
        if isinstance(array, np.ndarray):
            if array.flags.writeable and array.dtype != object:
                array[...] = ~array if array.dtype == np.bool_ else 77
        elif hasattr(array, "logical_not_") and hasattr(array, "detach"):
            flat = array.detach()
            flat.logical_not_() if str(flat.dtype) == "torch.bool" else flat.fill_(77)


def is_continuous(space: gym.Space) -> bool:
    """Whether an action is one array of floats."""
    return isinstance(space, gym.spaces.Box) and np.issubdtype(space.dtype, np.floating)
