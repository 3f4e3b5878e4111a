"""The API contract of every registered environment: single, vector, in worker processes, and one against the other.

Each task gets the checks that single environments need and one combination of output and autoreset mode; the slow tier
runs all combinations.
"""

from __future__ import annotations

import functools
import pickle
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.env_match import check_environments_match
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

import softmode
from softmode.envs import check_vector_env
from softmode.envs.check import RULES, VALUES

TASKS = list(softmode.ENVIRONMENTS)
COMBINATIONS = [(mode, output) for output in ("numpy", "torch") for mode in AutoresetMode]
LIMIT = 4
"""Control steps of an episode."""
ALL = [(task, *combination) for task in TASKS for combination in COMBINATIONS]
FAST = [(task, *COMBINATIONS[index % len(COMBINATIONS)]) for index, task in enumerate(TASKS)]

each_task = pytest.mark.parametrize("task", TASKS)


def name_of(value: Any) -> str:
    """Name a parameter."""
    return value.name if isinstance(value, AutoresetMode) else str(value).removeprefix("softmode/")


@pytest.fixture(scope="module")
def single() -> Iterator[Callable[[str], gym.Env]]:
    """Return a function from a task to its environment, made once."""
    made = []

    @functools.cache
    def make(task: str) -> gym.Env:
        made.append(gym.make(task, render_mode="rgb_array"))
        return made[-1]

    yield make
    for env in made:
        env.close()


# -- single -----------------------------------------------------------------------------------------------------------


@each_task
def test_gymnasium_checker(single: Callable[[str], gym.Env], task: str) -> None:
    """`gymnasium.utils.env_checker.check_env` has nothing to say, and warns of nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # Gymnasium's
        check_env(single(task).unwrapped, skip_render_check=True)


@each_task
def test_stable_baselines_checker(single: Callable[[str], gym.Env], task: str) -> None:
    """So has that of Stable-Baselines3, goal environments and `compute_reward` included."""
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(single(task).unwrapped, warn=True, skip_render_check=True)


@each_task
def test_spec_and_pickle(single: Callable[[str], gym.Env], task: str) -> None:
    """Both entry points and a time limit are registered, and the single environment travels as what it is made from."""
    spec = gym.spec(task)
    assert spec.entry_point and spec.vector_entry_point and spec.max_episode_steps
    assert not spec.additional_wrappers and not spec.nondeterministic
    pickled = pickle.dumps(single(task).unwrapped)
    assert len(pickled) < 20_000


# -- vector -----------------------------------------------------------------------------------------------------------


def checked(task: str, mode: AutoresetMode, output: str, **kwargs: Any) -> None:
    """Check a vector environment; every rule can be, and none is skipped."""
    if output == "torch":
        pytest.importorskip("torch")

    def make(count: int) -> gym.vector.VectorEnv:
        return gym.make_vec(task, num_envs=count, autoreset_mode=mode, output=output, max_episode_steps=LIMIT, **kwargs)

    report = check_vector_env(make, num_envs=2, steps=LIMIT + 3)
    assert not report.skipped and not report.notes
    assert set(report.checked) == {*RULES, *VALUES, "batch size", "close"}


@pytest.mark.parametrize(("task", "mode", "output"), FAST, ids=name_of)
def test_vector_checker(task: str, mode: AutoresetMode, output: str) -> None:
    """`check_vector_env` finds no broken rule and skips none."""
    checked(task, mode, output)


@pytest.mark.slow
@pytest.mark.parametrize(("task", "mode", "output"), [case for case in ALL if case not in FAST], ids=name_of)
def test_vector_checker_in_all_modes(task: str, mode: AutoresetMode, output: str) -> None:
    """The same for every autoreset mode and output."""
    checked(task, mode, output)


@pytest.mark.slow
@each_task
@pytest.mark.parametrize(
    ("mode", "output"), [(AutoresetMode.NEXT_STEP, "torch"), (AutoresetMode.SAME_STEP, "numpy")], ids=name_of
)
def test_vector_checker_with_pictures(task: str, mode: AutoresetMode, output: str) -> None:
    """The same where observations are a Dict of a picture and proprioception."""
    checked(task, mode, output, obs_type="pixels_agent_pos")


@pytest.mark.slow
@each_task
def test_vector_checker_in_processes(task: str) -> None:
    """The same where processes share the worlds."""
    checked(task, AutoresetMode.NEXT_STEP, "numpy", processes=2)


@each_task
def test_a_vector_of_one_is_the_single_environment(single: Callable[[str], gym.Env], task: str) -> None:
    """`check_environments_match` finds the same spaces, bits and infos in a vector of one, without its first axis.

    The single environment's infos hold all that the vector's do, and the solver's flags by name.
    """
    vector = OfOne(gym.make_vec(task, num_envs=1))
    check_environments_match(vector, single(task), num_steps=6, info_comparison="superset")


class OfOne(gym.Env):
    """The only world of a vector environment."""

    def __init__(self, env: gym.vector.VectorEnv) -> None:
        """Take over the spaces of one world."""
        self.env = env
        self.action_space, self.observation_space = env.single_action_space, env.single_observation_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Reset."""
        observation, infos = self.env.reset(seed=seed, options=options)
        return first(observation), first(infos)

    def step(self, action: Any) -> Any:
        """Step."""
        observation, reward, terminated, truncated, infos = self.env.step(action[None])
        return first(observation), float(reward[0]), bool(terminated[0]), bool(truncated[0]), first(infos)


def first(tree: Any) -> Any:
    """Return world 0 of a tree of arrays, without masks, numbers as Python's own."""
    if isinstance(tree, dict):
        return {key: first(value) for key, value in tree.items() if not (key.startswith("_") and key[1:] in tree)}
    return tree[0].item() if tree.ndim == 1 else tree[0]


# -- worker processes -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("context", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
@pytest.mark.parametrize("task", TASKS[:1])
def test_worker_processes(task: str, context: str) -> None:
    """`AsyncVectorEnv` over the single environment gives the bits of the native one."""
    workers = AsyncVectorEnv([functools.partial(made, task)] * 2, context=context, shared_memory=True)
    native = gym.make_vec(task, num_envs=2)
    try:
        np.testing.assert_array_equal(workers.reset(seed=3)[0], native.reset(seed=3)[0])
        native.action_space.seed(0)
        for _ in range(4):
            action = native.action_space.sample()
            theirs, ours = workers.step(action), native.step(action)
            np.testing.assert_array_equal(theirs[0], ours[0])
            np.testing.assert_allclose(theirs[1], ours[1], rtol=1e-6)
    finally:
        workers.close()
        native.close()


def made(task: str) -> gym.Env:
    """Make an environment in a worker."""
    import softmode  # noqa: F401  (a spawned process has registered nothing)

    return gym.make(task)
