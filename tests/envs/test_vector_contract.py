"""The API contract of every registered environment: single, vector, in worker processes, and one against the other.

Every task is checked once, in one kind of observation, and its worlds once, in one combination of output and autoreset
mode. `make test-rest` and the slow tier have the other kinds and combinations.
"""

from __future__ import annotations

import functools
import multiprocessing
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
from softmode.envs.spec import env_spec
from softmode.envs.tasks.lift_soft.task import LiftSoftEnv
from softmode.vector_check import RULES, VALUES
from softmode.vector_check.values import as_numpy, equal
from tests.envs.conftest import MakeEnv
from tests.task_ids import IDS

TASKS = list(softmode.ENVIRONMENTS)
OBSERVED = {"LiftSoft": "pixels_agent_pos", "PushSoft": "pixels"}
"""What the checked environment of a task returns, if not its state."""
COMBINATIONS = [(mode, output) for output in ("numpy", "torch") for mode in AutoresetMode]
LIMIT = 4
"""Control steps of an episode."""


def name_of(value: Any) -> str:
    """Name a parameter; an id by its task."""
    return value.name if isinstance(value, AutoresetMode) else str(value).removeprefix("softmode/").rpartition("-v")[0]


each_task = pytest.mark.parametrize("task", TASKS, ids=name_of)
each_task_observed = pytest.mark.parametrize(
    ("task", "obs_type"),
    [
        *((name, OBSERVED.get(name, "state")) for name in map(name_of, TASKS)),
        *(
            pytest.param(*other, marks=pytest.mark.rest)
            for other in (("LiftSoft", "state"), ("LiftSoft", "pixels"), ("PushSoft", "state"))
        ),
    ],
)


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


@each_task_observed
def test_gymnasium_checker(make_env: MakeEnv, task: str, obs_type: str) -> None:
    """`gymnasium.utils.env_checker.check_env` has nothing to say, and warns of nothing.

    To render, and to close, it makes other environments; all tasks render and close alike, so once will do.
    """
    again = task != "PressSoft"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make_env(task, obs_type).unwrapped, skip_render_check=again, skip_close_check=again)


@each_task_observed
def test_stable_baselines_checker(make_env: MakeEnv, task: str, obs_type: str) -> None:
    """Neither has that of Stable-Baselines3, goal environments and `compute_reward` included."""
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(make_env(task, obs_type).unwrapped, warn=True, skip_render_check=obs_type == "state")


@each_task
def test_spec_and_pickle(make_env: MakeEnv, task: str) -> None:
    """Both entry points and a time limit are registered, and the single environment travels as what it is made from."""
    spec = gym.spec(task)
    assert spec.entry_point and spec.vector_entry_point and spec.max_episode_steps
    assert not spec.additional_wrappers and not spec.nondeterministic
    env: Any = make_env(name_of(task)).unwrapped
    assert len(pickle.dumps(env)) < 20_000
    told = env_spec(task, config=env.config)  # ... and without being made it is known what it observes
    assert (told.observation_space, told.action_space) == (env.observation_space, env.action_space)
    assert (told.agent_size, told.fps) == (env.task.layout.agent_size, env.metadata["render_fps"])


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
def test_the_last_world_is_the_single_environment(
    make_env: MakeEnv, vector: Callable[[str], gym.vector.VectorEnv], task: str
) -> None:
    """`check_environments_match` finds the same spaces, bits and infos in the second of two worlds.

    The single environment's infos hold all that the vector's do, the solver's flags by name too.
    """
    steps = LIMIT - 1  # an episode that ends would go on in the vector
    worlds, single = LastWorld(vector(task)), make_env(name_of(task))
    check_environments_match(worlds, single, num_steps=steps, info_comparison="superset")


class LastWorld(gym.Env):
    """The last world of a vector environment as a single one; the others draw other episodes, and get other actions."""

    def __init__(self, env: gym.vector.VectorEnv) -> None:
        """Take over the spaces of one world."""
        self.env = env
        self.action_space, self.observation_space = env.single_action_space, env.single_observation_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Reset."""
        seeds = None if seed is None else [seed + k for k in reversed(range(self.env.num_envs))]
        return one(as_numpy(self.env.reset(seed=seeds, options=options)))

    def step(self, action: Any) -> Any:
        """Step."""
        signs = np.where(np.arange(self.env.num_envs) == self.env.num_envs - 1, 1.0, -1.0)
        return one(as_numpy(self.env.step((signs[:, None] * action).astype(np.float32))))


def one(tree: Any, world: int = -1) -> Any:
    """Return a world of a tree of arrays, without masks and ends of episodes, numbers as Python's own."""
    if isinstance(tree, tuple):
        return tuple(one(part, world) for part in tree)
    if isinstance(tree, dict):
        keys = [key for key in tree if not (key.startswith("_") and key[1:] in tree)]
        return {key: one(tree[key], world) for key in keys if key not in ("final_obs", "final_info")}
    return tree[world].item() if tree.ndim == 1 and tree.dtype != object else tree[world]


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
    fresh = [ours[4]["end_reason"], *(ours[4]["reward_terms"][name] for name in one(theirs[4]["reward_terms"]))]
    assert not np.any(fresh)  # beside final_info are the infos of the new episodes
    assert equal(ours[0], then.step(action)[0])
    action = same.action_space.sample()
    assert equal(same.step(action)[0], then.step(action)[0])


# -- worker processes -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("context", "task", "obs_type"),
    [
        ("fork", "LiftSoft", "state"),
        ("forkserver", "PushSoft", "pixels"),
        pytest.param("spawn", "LiftSoft", "state", marks=pytest.mark.slow),
    ],
)
def test_worker_processes(make_env: MakeEnv, context: str, task: str, obs_type: str) -> None:
    """`AsyncVectorEnv` over the single environment gives the bits of the environment in this process, which has played.

    "forkserver" and "spawn" start a fresh process, which has other hashes and addresses; the first from one that has
    imported the simulator and does not initialise it, since Warp's threads survive no fork.
    """
    multiprocessing.set_forkserver_preload(["mujoco_warp", LiftSoftEnv.__module__])
    single = make_env(task, obs_type)
    # "softmode:" imports the package, which a spawned process has not.
    factory = functools.partial(gym.make, f"softmode:{IDS[task]}", obs_type=obs_type)
    workers = AsyncVectorEnv([factory], context=context)
    try:
        assert equal(one(workers.reset(seed=3)[0]), single.reset(seed=3)[0])
        workers.action_space.seed(0)
        for _ in range(8):
            action = workers.action_space.sample()
            theirs, ours = workers.step(action), single.step(action[0])
            assert equal(one(theirs[0]), ours[0])
            assert theirs[1][0] == ours[1]
    finally:
        workers.close()
