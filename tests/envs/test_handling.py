"""How gently objects are handled: peaks over the substeps, limits, drops, and where they stand in infos."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import warp as wp

import softmode  # noqa: F401  (registers the environments)
from softmode.envs.handling_kernels import DROP, GENTLE, LEAST_FORCE, MARGIN, ROUGHEST, principal_strain
from softmode.envs.reward_kernels import EndReason
from softmode.envs.scripted import scripted_policy
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig, LiftSoftEnv
from softmode.envs.tasks.place_in_bin.task import PlaceInBinConfig
from softmode.errors import ConfigError
from softmode.learning.config_values import split_config

DOWN = np.array([0.0, 0.0, -1.0, 0.0, -1.0], np.float32)


@wp.kernel
def strains_of(G: wp.array[wp.mat33], out: wp.array[float]):
    """Evaluate the principal strain."""
    out[wp.tid()] = principal_strain(G[wp.tid()])


def strain_of(F: np.ndarray) -> np.ndarray:
    """Return max |s - 1| of the singular values s of F, shape (..., 3, 3)."""
    return np.abs(np.linalg.svd(F, compute_uv=False) - 1.0).max(axis=-1)


def body_strain(env: LiftSoftEnv) -> float:
    """Return the largest principal strain of the object now."""
    body, q = env.scene.soft.body, env.scene.state.softmode.q.numpy()
    F = np.eye(3) + np.einsum("ka,pkb->pab", q[: body.function_count], body.cubature.grad_basis)
    return float(strain_of(F).max())


def test_principal_strains_are_those_of_the_singular_values() -> None:
    """Max |s_i - 1| of F = I + G, in float32: near rest to a few of its digits, also of pure turns and double roots."""
    random = np.random.default_rng(0)
    turns = np.linalg.qr(random.normal(size=(40, 3, 3)))[0]
    turns *= np.linalg.det(turns)[:, None, None]
    stretches = np.eye(3) * random.uniform(0.5, 1.6, (40, 3))[:, None]
    given = np.concatenate([turns, turns @ stretches, np.eye(3) + 0.2 * random.normal(size=(40, 3, 3)), [np.eye(3)]])
    found = wp.zeros(len(given), dtype=float, device="cpu")
    G = wp.array((given - np.eye(3)).astype(np.float32), dtype=wp.mat33, device="cpu")
    wp.launch(strains_of, dim=len(given), inputs=[G, found], device="cpu")
    np.testing.assert_allclose(found.numpy(), strain_of(given), atol=2e-3, rtol=1e-3)
    assert found.numpy()[-1] == 0.0


def test_peaks_hold_what_every_step_shows(lift: LiftSoftEnv) -> None:
    """Peaks never fall, are at least the force and strain at the end of each step and near those; a reset forgets."""
    lift.reset(seed=2, options={"youngs_modulus": 5.0e4})
    policy, before, ends, strains = scripted_policy(lift), np.zeros(3), [], []
    names = ("peak_force", "peak_strain", "peak_energy_density")
    for _ in range(60):
        *_, info = lift.step(policy())
        now = np.array([info[name] for name in names])
        assert (now >= before).all()
        before = now
        ends.append(np.linalg.norm(lift.scene.finger_force.numpy()[0], axis=1).max())
        strains.append(body_strain(lift))
    assert max(ends) <= before[0] < 1.3 * max(ends)
    assert max(strains) - 1e-4 <= before[1] < 1.3 * max(strains)
    assert before[2] > 0.5 * 5.0e4 * 0.3 * before[1] ** 2  # of a uniaxial state, with room
    assert info["drops"] == info["slips"] == 0.0
    _, info = lift.reset(seed=2)
    assert all(info[name] == 0.0 for name in (*names, "drops", "slips")) and not info["is_safe_success"]


def test_a_hand_that_lands_is_felt_beyond_the_bounds_of_observations(lift: LiftSoftEnv) -> None:
    """Driven down at full speed, closed fingers press with more than the limit; on the bare table with nothing."""
    position = (0.45, 0.0)
    lift.reset(seed=0, options={"position": position, "youngs_modulus": 1.0e6})
    for _ in range(25):
        *_, info = lift.step(DOWN)
    assert info["peak_force"] > lift.task.handling.force_limit.numpy()[0]
    lift.reset(seed=0, options={"position": (0.38, 0.22)})
    for _ in range(25):
        *_, info = lift.step(DOWN)
    assert info["peak_force"] < 0.1


def test_the_limit_of_a_heavy_object_is_what_holds_it(lift: LiftSoftEnv) -> None:
    """15 N, or three times m g / (2 mu) where that is more."""
    body, pads = lift.scene.soft.body, lift.config.scene.arm.gripper.friction
    for density in (250.0, 8.0e3):
        lift.reset(seed=0, options={"density": density, "friction": 0.5, "youngs_modulus": 1.0e6})
        lift.step(np.zeros(5, np.float32))
        holds = 0.5 * body.volume * density * 9.81 / np.sqrt(0.5 * pads)
        limit = lift.task.handling.force_limit.numpy()[0]
        assert limit == pytest.approx(max(float(LEAST_FORCE), float(MARGIN) * holds), rel=2e-3)


def test_an_object_that_is_let_go_has_dropped(lift: LiftSoftEnv) -> None:
    """Lifted and let go it counts as dropped once, however long it lies."""
    observation, _ = lift.reset(seed=0)
    policy, info = scripted_policy(lift), {"object_height": 0.0}
    while info["object_height"] < 2.0 * float(DROP):
        *_, info = lift.step(policy(observation))
    for _ in range(20):
        *_, info = lift.step(np.array([0.0, 0.0, 0.0, 0.0, 1.0], np.float32))
    assert info["drops"] == 1.0


def test_a_success_beyond_the_limit_is_not_safe() -> None:
    """Worlds of one seed: the scripted lift is a success and, with a limit of 3 N, not a safe one.

    Where rough hands end an episode, it ends there, as a failure, be the object at its goal or not.
    """
    safe: list[Any] = []
    for limit, ends in ((None, False), (3.0, False), (3.0, True), (1.0e3, True)):
        given = {"force_limit": limit, "terminate_when_rough": ends, "autoreset_mode": "SameStep"}
        envs: Any = gym.make_vec("softmode/LiftSoft-v0", num_envs=1, **given)
        policy = scripted_policy(envs)
        envs.reset(seed=0)
        ended = np.zeros(1, bool)
        while not ended.any():
            _, _, terminated, truncated, infos = envs.step(policy())
            ended = terminated | truncated
            if limit == 1.0e3 and infos["is_success"].all():
                envs.task.handling.handled.fill_(2.0 * limit)
        final = infos["final_info"]
        if ends:
            assert terminated.all() and final["end_reason"][0] == EndReason.ROUGH and not final["is_success"].any()
            assert limit < final["peak_force"][0] <= (safe[1][1] if limit == 3.0 else 2.0 * limit)
            envs.close()
            continue
        assert final["is_success"].all() and final["_is_safe_success"].all() and infos["peak_force"] == 0.0
        safe.append((bool(final["is_safe_success"][0]), float(final["peak_force"][0])))
        envs.close()
    assert [value for value, _ in safe] == [True, False] and safe[0][1] == safe[1][1] > 3.0


def test_care_costs_what_is_beyond_half_of_a_limit(lift: LiftSoftEnv) -> None:
    """A step's term is -care (u - 1/2), u the greater of force and strain relative to their limits, in blow and hold.

    Without care it is zero, and tasks without the term refuse it.
    """
    env = LiftSoftEnv(care=4.0)
    for task, care in ((env, 4.0), (lift, 0.0)):
        handling, costs = task.task.handling, []
        task.reset(seed=0, options={"position": (0.45, 0.0), "youngs_modulus": 1.0e6})
        for k in range(40):
            *_, info = task.step(DOWN if k < 25 else np.array([0.0, 0.0, 1.0, 0.0, -1.0], np.float32))
            force, limit = handling.step_force.numpy()[0], handling.force_limit.numpy()[0]
            used = max(force / limit, handling.step_strain.numpy()[0] / 0.3)
            costs.append(np.clip(used - float(GENTLE), 0.0, float(ROUGHEST)))
            assert info["reward_terms"]["gentle"] == pytest.approx(-care * costs[-1], rel=1e-4, abs=1e-5)
        assert max(costs) > 1.0 and 0.0 in costs
    env.close()
    with pytest.raises(ConfigError, match="PressSoft has no term 'gentle'"):
        gym.make("softmode/PressSoft-v0", care=1.0)


@pytest.mark.parametrize("given", [{"force_limit": 0.0}, {"care": -1.0}, {"strain_limit": -0.1}])
def test_limits_that_cannot_be_are_refused(given: dict[str, float]) -> None:
    """A limit is above zero and a share between 0 and 1; the message names it."""
    with pytest.raises(ConfigError, match=next(iter(given))):
        LiftSoftConfig(**given)


def test_the_preset_has_weak_fingers_and_an_end_and_a_dict_beside_it_holds_what_differs() -> None:
    """`gentle` of both tasks that have the term; in a dict fields of parts change one by one, the others stay."""
    for task in (LiftSoftConfig, PlaceInBinConfig):
        config = task.preset("gentle")
        assert config.terminate_when_rough and config.care == 0.5
        assert config.scene.control.squeeze_lead == 0.1 < task().scene.control.squeeze_lead
    differs = {"scale_range": [0.8, 1.2], "scene": {"control": {"squeeze_lead": 0.2}}}
    given, rest = split_config("softmode/PlaceInBin-v1", {"preset": "gentle", "config": differs, "seconds": 4.0})
    stronger = replace(config.scene, control=replace(config.scene.control, squeeze_lead=0.2))
    assert given == replace(config, scale_range=(0.8, 1.2), scene=stronger) and rest == {"seconds": 4.0}
    with pytest.raises(ConfigError, match="has no preset 'rough'"):
        split_config("softmode/PlaceInBin-v1", {"preset": "rough", "config": differs})
