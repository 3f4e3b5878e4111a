"""Where the presets stop Newton's iteration in a grasp, beside an iteration that goes on to rounding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softmode.envs.presets import RL_SOLVER, rl_scene
from softmode.envs.tasks.lift_soft.scripted import ScriptedLift
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig, LiftSoftEnv
from softmode.scenes import motion_of

CONVERGED = replace(RL_SOLVER, tolerance=1.0e-9, force_tolerance=1.0e-9, iteration_max=100)


def grasp(solver: object, seed: int, modulus: float, steps: int) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Return finger forces [N] and coordinates [m] after a scripted lift, and the iterations of each step."""
    env = LiftSoftEnv(config=LiftSoftConfig(scene=replace(rl_scene(), solver=solver)))
    observation, info = env.reset(seed=seed, options={"youngs_modulus": modulus})
    policy, iterations = ScriptedLift(env), []
    for _ in range(steps):
        observation, *_, info = env.step(policy(observation))
        iterations.append(int(env.scene.solver.reduced.iteration.numpy()[0]))
    result = np.array(info["finger_force"]), np.array(motion_of(env.scene).q[0]), iterations
    env.close()
    return result


@pytest.mark.parametrize(("seed", "modulus"), [(0, 2.0e4), (1, 2.0e5), (2, 2.0e6)])
def test_forces_and_motion_are_those_of_a_converged_step(seed: int, modulus: float) -> None:
    """After 60 control steps forces agree to 0.5 % and the body to 0.1 mm, for fewer iterations."""
    force, q, iterations = grasp(RL_SOLVER, seed, modulus, 60)
    force_converged, q_converged, more = grasp(CONVERGED, seed, modulus, 60)
    assert force_converged.min() > 1.0  # the object is held
    np.testing.assert_allclose(force, force_converged, rtol=5.0e-3)
    assert np.abs(q - q_converged).max() < 1.0e-4
    assert np.mean(iterations) < np.mean(more)


def test_a_long_hold_does_not_creep() -> None:
    """Twenty more seconds of holding move the body by less than 0.1 mm."""
    env = LiftSoftEnv()
    observation, _ = env.reset(seed=0, options={"youngs_modulus": 2.0e5})
    policy = ScriptedLift(env)
    for k in range(750):
        observation, *_ = env.step(policy(observation))
        if k == 249:
            before = np.array(motion_of(env.scene).q[0])
    after = np.array(motion_of(env.scene).q[0])
    env.close()
    assert np.abs(after - before).max() < 1.0e-4
