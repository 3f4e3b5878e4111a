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
from softmode.envs.check.values import as_numpy, equal

TASKS = list(softmode.ENVIRONMENTS)
COMBINATIONS = [(mode, output) for output in ("numpy", "torch") for mode in AutoresetMode]
LIMIT = 4
"""Control steps of an episode."""

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


@pytest.fixture(scope="module")
def vector() -> Iterator[Callable[[str], gym.vector.VectorEnv]]:
    """Return a function from a task to two worlds of it, made once, in the task's combination of mode and output."""
    made = []

    @functools.cache
    def make(task: str) -> gym.vector.VectorEnv:
        mode, output = COMBINATIONS[TASKS.index(task) % len(COMBINATIONS)]
        if output == "torch":
            pytest.importorskip("torch")
        made.append(gym.make_vec(task, num_envs=2, autoreset_mode=mode, output=output, max_episode_steps=LIMIT))
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


@each_task
def test_vector_checker(vector: Callable[[str], gym.vector.VectorEnv], task: str) -> None:
    """`check_vector_env` finds no broken rule, and skips none that it can check on an environment already made."""
    report = check_vector_env(vector(task), steps=LIMIT + 2)
    assert set(report.skipped) == {"batch size", "close"} and not report.notes
    assert set(report.checked) == {*RULES, *VALUES}


def checked(task: str, mode: AutoresetMode, output: str, **kwargs: Any) -> None:
    """Check a vector environment and the vector of one; every rule can be, and none is skipped."""
    if output == "torch":
        pytest.importorskip("torch")

    def make(count: int) -> gym.vector.VectorEnv:
        return gym.make_vec(task, num_envs=count, autoreset_mode=mode, output=output, max_episode_steps=LIMIT, **kwargs)

    report = check_vector_env(make, num_envs=2, steps=LIMIT + 3)
    assert not report.skipped and not report.notes
    assert set(report.checked) == {*RULES, *VALUES, "batch size", "close"}


@pytest.mark.slow
@each_task
@pytest.mark.parametrize(("mode", "output"), COMBINATIONS, ids=name_of)
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
def test_world_0_is_the_single_environment(
    single: Callable[[str], gym.Env], vector: Callable[[str], gym.vector.VectorEnv], task: str
) -> None:
    """`check_environments_match` finds the same spaces, bits and infos in the first of two worlds.

    The single environment's infos hold all that the vector's do, the solver's flags by name too.
    """
    steps = LIMIT - 1  # an episode that ends would go on in the vector
    check_environments_match(FirstWorld(vector(task)), single(task), num_steps=steps, info_comparison="superset")


class FirstWorld(gym.Env):
    """World 0 of a vector environment as a single one; the others get the same actions."""

    def __init__(self, env: gym.vector.VectorEnv) -> None:
        """Take over the spaces of one world."""
        self.env = env
        self.action_space, self.observation_space = env.single_action_space, env.single_observation_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Reset."""
        return first(as_numpy(self.env.reset(seed=seed, options=options)))

    def step(self, action: Any) -> Any:
        """Step."""
        return first(as_numpy(self.env.step(np.tile(action, (self.env.num_envs, 1)))))


def first(tree: Any) -> Any:
    """Return world 0 of a tree of arrays, without masks and ends of episodes, numbers as Python's own."""
    if isinstance(tree, tuple):
        return tuple(map(first, tree))
    if isinstance(tree, dict):
        keys = [key for key in tree if not (key.startswith("_") and key[1:] in tree)]
        return {key: first(tree[key]) for key in keys if key not in ("final_obs", "final_info")}
    return tree[0].item() if tree.ndim == 1 and tree.dtype != object else tree[0]


def stacked(observations: Any) -> Any:
    """Return the observations of worlds as those of an environment of all of them, a dict of arrays or an array."""
    if isinstance(observations[0], dict):
        return {key: np.stack([one[key] for one in observations]) for key in observations[0]}
    return np.stack(observations)


@pytest.mark.parametrize("task", [TASKS[0], *(pytest.param(task, marks=pytest.mark.slow) for task in TASKS[1:])])
def test_the_end_is_the_same_in_both_autoreset_modes(task: str) -> None:
    """What NEXT_STEP returns at the end of an episode is SAME_STEP's final_obs and final_info, and so it goes on."""
    same, then = (
        gym.make_vec(task, num_envs=2, autoreset_mode=mode, max_episode_steps=LIMIT)
        for mode in (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP)
    )
    same.reset(seed=0)
    then.reset(seed=0)
    same.action_space.seed(0)
    for _ in range(LIMIT):
        action = same.action_space.sample()
        ours, theirs = same.step(action), then.step(action)
    for part in (1, 2, 3):
        np.testing.assert_array_equal(ours[part], theirs[part])
    assert ours[3].all()
    assert equal(stacked(ours[4]["final_obs"]), theirs[0])
    assert equal(ours[4]["final_info"], theirs[4])
    fresh = [ours[4]["end_reason"], *(ours[4]["reward_terms"][name] for name in first(theirs[4]["reward_terms"]))]
    assert not np.any(fresh)  # beside final_info are the infos of the new episodes
    assert equal(ours[0], then.step(action)[0])
    action = same.action_space.sample()
    assert equal(same.step(action)[0], then.step(action)[0])


# -- worker processes -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("context", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
@pytest.mark.parametrize("task", TASKS[:1])
def test_worker_processes(single: Callable[[str], gym.Env], task: str, context: str) -> None:
    """`AsyncVectorEnv` over the single environment gives the bits of the environment in this process."""
    workers = AsyncVectorEnv([functools.partial(made, task)], context=context)
    try:
        np.testing.assert_array_equal(workers.reset(seed=3)[0][0], single(task).reset(seed=3)[0])
        workers.action_space.seed(0)
        for _ in range(4):
            action = workers.action_space.sample()
            theirs, ours = workers.step(action), single(task).step(action[0])
            np.testing.assert_array_equal(theirs[0][0], ours[0])
            assert theirs[1][0] == ours[1]
    finally:
        workers.close()


def made(task: str) -> gym.Env:
    """Make an environment in a worker."""
    import softmode  # noqa: F401  (a spawned process has registered nothing)

    return gym.make(task)
