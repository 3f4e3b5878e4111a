"""Why a lift failed: an episode is made for every reason."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from softmode.envs.tasks.lift_soft.log import LiftLog
from softmode.envs.tasks.lift_soft.scripted import ScriptedLift
from softmode.envs.tasks.lift_soft.task import LiftSoftEnv

OPEN = np.array([0.0, 0.0, 0.0, 0.0, 1.0], np.float32)
Play = Callable[[ScriptedLift, dict[str, Any]], NDArray[np.float32]]


def story(env: LiftSoftEnv, play: Play, steps: int = 100) -> tuple[str, dict[str, Any], float]:
    """Play an episode; return the reason, the last info, and when the last step with both fingers on it was [s]."""
    env.reset(seed=0, options={"youngs_modulus": 2.0e5})
    policy, log, info, held = ScriptedLift(env), LiftLog(env.config), {"object_height": 0.0}, 0.0
    for step in range(steps):
        *_, terminated, _, info = env.step(play(policy, info))
        log.record(info)
        if (info["finger_force"] > 0.02).all():
            held = (step + 1) / env.config.scene.control_hz
        if terminated:
            break
    return log.reason(info), info, held


def until(met: Callable[[ScriptedLift, dict[str, Any]], bool], then: NDArray[np.float32] = OPEN) -> Play:
    """Play the script until something is met, and one action from then on."""
    over = False

    def play(policy: ScriptedLift, info: dict[str, Any]) -> NDArray[np.float32]:
        nonlocal over
        over = over or met(policy, info)
        return then if over else policy()

    return play


def seconds(reason: str) -> float:
    """Return the time that a reason tells [s]."""
    return float(reason.partition(" at ")[2].partition(" s")[0])


def test_never_touched(lift: LiftSoftEnv) -> None:
    """An arm that rests touches nothing."""
    assert story(lift, lambda policy, info: OPEN, 20)[0] == "never touched"


def test_slipped_when_let_go_on_the_table(lift: LiftSoftEnv) -> None:
    """Fingers that open before they rise: slipped, in the step after the last touch of both."""
    reason, _, held = story(lift, until(lambda policy, info: policy.weaker_force > 1.0), 60)
    assert reason.startswith("slipped at ")
    assert seconds(reason) == pytest.approx(held + 1.0 / 30.0, abs=0.06)


def test_dropped_when_let_go_in_the_air(lift: LiftSoftEnv) -> None:
    """Fingers that open five centimetres up: dropped."""
    reason, info, held = story(lift, until(lambda policy, info: info["object_height"] > 0.05))
    assert reason.startswith("dropped at ") and not info["is_success"]
    assert seconds(reason) == pytest.approx(held + 1.0 / 30.0, abs=0.06)


def test_dropped_off_the_table(lift: LiftSoftEnv) -> None:
    """What is let go beyond the edge falls off, which ends the episode."""
    env = lift
    env.reset(seed=0)

    def play(policy: ScriptedLift, info: dict[str, Any]) -> NDArray[np.float32]:
        if info["object_height"] > 0.08 and not gone:
            q, body = env.scene.state.softmode.q, env.scene.soft.body
            q.assign(body.affine(np.eye(3), (1.2, 0.0, 0.1)))
            gone.append(True)
        return OPEN if gone else policy()

    gone: list[bool] = []
    reason, info, _ = story(env, play, 150)
    assert info["end_reason"] == 3 and reason.startswith("dropped at ") and reason.endswith("off the table")


def test_goal_not_reached(lift: LiftSoftEnv) -> None:
    """An object that is held still below its goal: how far it is from it."""

    def play(policy: ScriptedLift, info: dict[str, Any]) -> NDArray[np.float32]:
        action = policy()
        return action * [0.0, 0.0, 0.0, 0.0, 1.0] if info["object_height"] > 0.03 else action

    reason, info, _ = story(lift, play, 90)
    assert reason == f"goal not reached: {100.0 * info['goal_distance']:.1f} cm away, 3.0 cm allowed"
    assert info["goal_distance"] > 0.03


def test_held_but_not_lifted(lift: LiftSoftEnv) -> None:
    """Fingers that close and stay."""

    def play(policy: ScriptedLift, info: dict[str, Any]) -> NDArray[np.float32]:
        return policy() * [1.0, 1.0, 1.0 - (policy.weaker_force > 1.0), 1.0, 1.0]

    assert story(lift, play, 60)[0] == "held but not lifted"
