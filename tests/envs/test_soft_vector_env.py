"""Many worlds of a task: a broken world stays alone, options and pictures per world, refusals, a soak."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from softmode.deformables.model import status as bits
from softmode.envs.reward_kernels import EndReason
from softmode.envs.scripted import scripted_policy
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig, LiftSoftEnv
from softmode.errors import ConfigError
from tests.task_ids import IDS

ENV_ID = "softmode/LiftSoft-v0"


def make(num_envs: int, **options: Any) -> SoftVectorEnv:
    """Return LiftSoft's vector environment."""
    env = gym.make_vec(ENV_ID, num_envs=num_envs, **options)
    assert isinstance(env, SoftVectorEnv)
    return env


def actions(count: int, num_envs: int, seed: int = 0) -> np.ndarray:
    """Return random actions, shape (count, num_envs, 5)."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, num_envs, 5)).astype(np.float32)


def poison(env: SoftVectorEnv, world: int, part: str) -> None:
    """Make one world's object, or the velocity of its arm, not a number."""
    state = env.task.scene.state
    array = state.softmode.q if part == "object" else state.joint_qd
    values = array.numpy().copy()
    count = len(values) // env.num_envs
    values[world * count : (world + 1) * count] = np.nan
    array.assign(values)


def test_each_world_in_a_grasp_has_the_bits_of_the_single_environment() -> None:
    """Two worlds of other stiffness and Poisson's ratio lift; each equals the environment of its seed alone.

    So does its next episode, which begins where the scripted policies of both begin anew.
    """
    config, limit = LiftSoftConfig(poissons_ratio_range=(0.2, 0.49)), 62
    env = make(2, config=config, max_episode_steps=limit)
    policy = scripted_policy(env)
    observation, _ = env.reset(seed=0)
    observations, done, forces = [observation], [], []
    for _ in range(limit + 4):
        done.append(policy(observation))
        observation, *_ = env.step(done[-1])
        observations.append(observation)
        forces.append(np.linalg.norm(env.task.scene.finger_force.numpy(), axis=2))
    ratios = env.task.scene.model.softmode.poissons_ratio.numpy()
    env.close()
    assert (forces[limit - 1] > 1.0).all() and len(set(ratios)) == 2
    single = LiftSoftEnv(config=config)
    for i in range(2):
        observation, _ = single.reset(seed=i)
        for step, action in enumerate(done):
            np.testing.assert_array_equal(observations[step][i], observation, err_msg=f"world {i}, step {step}")
            observation, *_ = single.reset() if step == limit else single.step(action[i])
            np.testing.assert_array_equal(forces[step][i], np.linalg.norm(single.scene.finger_force.numpy()[0], axis=1))
        np.testing.assert_array_equal(observations[-1][i], observation)
    single.close()


@pytest.mark.parametrize(
    ("mode", "part"),
    [
        (AutoresetMode.NEXT_STEP, "object"),
        (AutoresetMode.SAME_STEP, "arm"),
        pytest.param(AutoresetMode.NEXT_STEP, "arm", marks=pytest.mark.rest),
        pytest.param(AutoresetMode.SAME_STEP, "object", marks=pytest.mark.rest),
    ],
)
def test_a_world_that_is_not_finite_is_reset_alone(mode: AutoresetMode, part: str) -> None:
    """NaN ends that world's episode as DIVERGED, the next one is sound, the others keep every bit."""
    env, broken, steps = make(3, autoreset_mode=mode, max_episode_steps=50), 1, 8
    runs: list[list[Any]] = []
    for poisoned in (False, True):
        env.reset(seed=3)
        run = []
        for step, action in enumerate(actions(steps, 3)):
            if poisoned and step == 3:
                poison(env, broken, part)
            run.append(env.step(action))
        runs.append(run)
    env.close()
    others = [0, 2]
    for clean, hurt in zip(*runs, strict=True):
        np.testing.assert_array_equal(clean[0][others], hurt[0][others])
        np.testing.assert_array_equal(clean[1][others], hurt[1][others])
        assert env.observation_space.contains(hurt[0]) and np.isfinite(hurt[1]).all()
    terminated = np.array([result[2] for result in runs[1]])
    assert terminated[3].tolist() == [False, True, False] and terminated.sum() == 1
    info = runs[1][3][4]
    reasons = info["final_info"]["end_reason"] if mode == AutoresetMode.SAME_STEP else info["end_reason"]
    assert reasons[broken] == EndReason.DIVERGED
    if mode == AutoresetMode.SAME_STEP:
        flag = bits.WORLD_NOT_FINITE if part == "object" else bits.WORLD_RIGID_NOT_FINITE
        assert info["final_info"]["solver_status"][broken] & flag
        names = info["final_info"]["solver_reasons"]
        assert bits.REASONS[flag] in names[broken]
        known = info["final_info"]["_solver_reasons"]
    else:
        assert info["solver_reasons"][broken] == bits.status_reasons(int(info["solver_status"][broken]))
        known = info["_solver_reasons"]
    assert known.tolist() == [False, True, False]
    assert all("solver_reasons" not in result[4] for result in runs[0])  # names only where there are any
    assert (runs[1][-1][0][broken] != 0.0).any() and runs[1][-1][4]["solver_status"][broken] == 0


def test_options_are_given_per_world_and_stay_where_the_mask_says() -> None:
    """Each world gets its own stiffness and place; a partial reset changes parameters of its worlds only."""
    env = make(3, autoreset_mode=AutoresetMode.DISABLED)
    moduli, places = np.array([1.0e5, 2.0e5, 4.0e5]), np.array([[0.42, 0.0], [0.45, 0.03], [0.47, -0.03]])
    _, info = env.reset(seed=0, options={"youngs_modulus": moduli, "position": places})
    np.testing.assert_allclose(info["parameters"]["youngs_modulus"], moduli)
    np.testing.assert_allclose(env.task.scene.object_position.numpy()[:, 0, :2], places, atol=1e-6)
    mask = np.array([False, True, False])
    _, info = env.reset(options={"reset_mask": mask, "youngs_modulus": 7.0e5})
    np.testing.assert_allclose(info["parameters"]["youngs_modulus"], [1.0e5, 7.0e5, 4.0e5])
    model = env.task.scene.model.softmode
    np.testing.assert_allclose(model.youngs_modulus.numpy(), [1.0e5, 7.0e5, 4.0e5])
    env.close()


def test_pictures_depth_and_segmentation_of_the_wrist_camera() -> None:
    """All image outputs lie in their spaces; the object is in the segmentation, nearer than a metre in the depth."""
    config = replace(LiftSoftConfig(), camera="wrist", image_size=48, image_outputs=("depth", "segmentation"))
    env = make(2, obs_type="pixels_agent_pos", config=config)
    observation, _ = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    labels = env.task.scene.cameras[48, 48].labels
    soft = observation["segmentation"] == labels.index("splats/0")
    assert soft.mean() > 0.005
    assert 0.01 < observation["depth"][soft].mean() < 1.0
    assert len(np.unique(observation["pixels"][0].reshape(-1, 3), axis=0)) > 20
    assert env.state_observation.shape == (2, 80)
    env.close()


def test_beam_of_isaac_lab_is_lifted_in_its_own_size() -> None:
    """The preset has the beam's mass, and its density and ratio as parameters."""
    env = make(1, preset="beam")
    _, info = env.reset(seed=0)
    scene = env.task.scene
    mass = scene.soft.body.volume * info["parameters"]["density"][0]
    assert mass == pytest.approx(0.30 * 0.04 * 0.04 * 1000.0, rel=0.02)
    assert info["parameters"]["poissons_ratio"][0] == pytest.approx(0.3)
    env.close()


@pytest.mark.parametrize(
    "given",
    [
        {"num_envs": 0},
        {"num_envs": 2.5},
        {"obs_type": "touch"},
        {"device": "cuda:7"},
        {"output": "jax"},
        {"autoreset_mode": "sometimes"},
        {"max_episode_steps": 0},
        {"processes": 0},
        {"processes": 2, "output": "torch"},
        {"preset": "rock"},
        {"preset": "beam", "config": LiftSoftConfig()},
        {"config": {"image_size": 64}},
    ],
)
def test_what_cannot_be_is_refused_by_name(given: dict[str, Any]) -> None:
    """Arguments are checked before anything is built."""
    with pytest.raises(ConfigError, match=next(iter(given))):
        make(**{"num_envs": 2, **given})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["LiftSoft", "PushSoft", "PressSoft"])
def test_soak(name: str) -> None:
    """A hundred thousand random steps: every number finite, every end has a reason, worlds go on."""
    env = gym.make_vec(IDS[name], num_envs=16)
    env.reset(seed=0)
    ends = 0
    for step in range(100_000 // 16):
        action = np.random.default_rng(step).uniform(-1.0, 1.0, env.action_space.shape or ()).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        assert np.isfinite(observation).all() and np.isfinite(reward).all()
        assert ((info["end_reason"] > EndReason.TIME_LIMIT) == terminated).all()
        assert (info["end_reason"] != EndReason.DIVERGED).all()
        ends += int((terminated | truncated).sum())
    assert ends >= 16 * (100_000 // 16 // 200)
    env.close()
