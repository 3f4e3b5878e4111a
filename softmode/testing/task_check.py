"""`check_task`: does a task keep Gymnasium's rules, replay, observe its state alone, and can it be solved?"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from softmode.checks import require_number
from softmode.envs.catalogue import env_class, registered_id
from softmode.envs.scripted import scripted_policy
from softmode.errors import ConfigError, EnvironmentCheckError
from softmode.learning.intervals import wilson_interval
from softmode.testing.assertions import assert_replays
from softmode.testing.episode import play_episode, soft_base
from softmode.vector_check import check_vector_env
from softmode.vector_check.tensors import world_of
from softmode.vector_check.values import equal

_STEPS = 20


@dataclass(frozen=True, kw_only=True)
class TaskCheck:
    """One check of a task."""

    name: str
    """What was checked."""
    passed: bool | None
    """Whether it holds; None if it could not be checked."""
    note: str
    """What was found, or why nothing was."""


def check_task(name: str, *, episodes: int = 5, **options: Any) -> list[TaskCheck]:
    """Check an environment of softmode's, or one of your own that is made of a softmode task.

    Gymnasium's checker on the single environment and `check_vector_env` on the vector one; world i of many against the
    single environment with its seed, bit for bit; a random episode replayed from its state, bit for bit; each segment
    of the observation recomputed in another environment from the state; how often the scripted policy succeeds.

    Args:
        name: Id of the environment, or module:id.
        episodes: Scripted episodes to play.
        options: Keyword arguments of the environments, such as `robot` or `config`.

    Returns:
        A check each, all of them, also after one that fails.

    Raises:
        ConfigError: If there is no such environment, or it is not made of a softmode task.
    """
    require_number("episodes", episodes, at_least=1, hint="give a count like 5")
    env_class(name)
    env = gym.make(registered_id(name), **options)
    checks: dict[str, Callable[[], tuple[bool | None, str]]] = {
        "Gymnasium's checker": lambda: _gymnasium(env),
        "vector checker": lambda: _vector(name, options),
        "world i of many": lambda: _worlds(name, env, options),
        "replay": lambda: _replay(env),
        "observation from the state": lambda: _segments(env),
        "scripted policy": lambda: _scripted(env, episodes),
    }
    found = []
    try:
        for what, check in checks.items():
            try:
                passed, note = check()
            except (AssertionError, EnvironmentCheckError, ConfigError) as error:
                passed, note = False, str(error).partition("\n")[0]
            found.append(TaskCheck(name=what, passed=passed, note=note))
    finally:
        env.close()
    return found


def _gymnasium(env: gym.Env) -> tuple[bool, str]:
    """Run Gymnasium's checker; what it warns of is noted."""
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        check_env(env.unwrapped, skip_render_check=True)
    lines = {str(one.message).partition("\n")[0] for one in told}
    return True, "; ".join(sorted(lines)) or "no warnings"


def _vector(name: str, options: dict[str, Any]) -> tuple[bool, str]:
    """Run the vector checker."""
    make = _vector_maker(name, options)
    report = check_vector_env(lambda count: make(count, max_episode_steps=8), steps=_STEPS)
    skipped = "".join(f"; skipped {rule}: {why}" for rule, why in report.skipped.items())
    return True, f"{len(report.checked)} rules{skipped}"


def _vector_maker(name: str, given: dict[str, Any]) -> Callable[..., Any]:
    """Return what makes the vector environment of a number of worlds."""
    env_class(name, vector=True)
    return lambda count, **options: gym.make_vec(registered_id(name), num_envs=count, **given, **options)


def _worlds(name: str, env: gym.Env, options: dict[str, Any]) -> tuple[bool, str]:
    """Compare each world of three with the single environment."""
    many, single = _vector_maker(name, options)(3), env.unwrapped
    try:
        many.action_space.seed(0)
        actions = [many.action_space.sample() for _ in range(_STEPS)]
        first, _ = many.reset(seed=7)
        rows = [first, *(many.step(action)[0] for action in actions)]
    finally:
        many.close()
    for world in range(3):
        observation, _ = single.reset(seed=7 + world)
        alone = [observation, *(single.step(action[world])[0] for action in actions)]
        for number, (row, one) in enumerate(zip(rows, alone, strict=True)):
            if not equal(world_of(row, world), one):
                return False, f"world {world} of 3 differs from the single environment after {number} steps"
    return True, f"3 worlds, {_STEPS} steps, bit for bit"


def _replay(env: gym.Env) -> tuple[bool, str]:
    """Play a random episode twice."""
    played = play_episode(env, "random", 0, max_steps=_STEPS)
    assert_replays(played)
    return True, f"{len(played.steps)} random steps, bit for bit"


def _segments(env: gym.Env) -> tuple[bool, str]:
    """Observe the state of a random episode again, in an environment that has seen nothing else."""
    play_episode(env, "random", 1, max_steps=_STEPS)
    base = soft_base(env)
    twin = base.twin()
    try:
        twin.task.write_observation()
        off = twin.task.observation.numpy()[0] != base.task.observation.numpy()[0]
    finally:
        twin.close()
    wrong = [name for name, (columns, _) in base.task.segments.items() if off[columns].any()]
    if wrong:
        return False, f"{', '.join(wrong)} depend on what the state does not hold; see Task.state_arrays"
    return True, f"{len(base.task.segments)} segments"


def _scripted(env: gym.Env, episodes: int) -> tuple[bool | None, str]:
    """Count the successes of the scripted policy."""
    try:
        scripted_policy(env)
    except ConfigError as error:
        return None, str(error)
    won = sum(play_episode(env, "scripted", seed).success for seed in range(episodes))
    low, high = wilson_interval(won, episodes)
    return won > 0, f"{won} of {episodes} episodes (95 %: {low:.0%} to {high:.0%})"
