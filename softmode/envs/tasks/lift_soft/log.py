"""Why a lift failed, from what every step's info tells."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from softmode.envs.reward_kernels import TOUCH_FORCE, EndReason
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig

LIFTED = 0.01
"""Rise of the object's centre from which it counts as lifted [m]."""


class LiftLog:
    """The story of an episode of LiftSoft: when fingers touched, held and lost the object.

    Args:
        config: The task's configuration.
    """

    def __init__(self, config: LiftSoftConfig) -> None:
        """Begin an episode."""
        self._dt, self._tolerance = 1.0 / config.scene.control_hz, config.goal_tolerance
        self._step = 0
        self._touched = self._held = self._lifted = False
        self._lost: tuple[str, int] | None = None

    def record(self, info: Mapping[str, Any]) -> None:
        """Take note of the info of a step."""
        self._step += 1
        touching = np.asarray(info["finger_force"]) > TOUCH_FORCE
        held = bool(touching.all())
        self._touched |= bool(touching.any())
        if held:
            self._lost = None
        elif self._held:
            self._lost = ("dropped" if self._lifted else "slipped", self._step)
        self._lifted = held and (self._lifted or info["object_height"] > LIFTED)
        self._held = held

    def reason(self, info: Mapping[str, Any]) -> str:
        """Return why the episode failed, given its last info; times count from its start [s]."""
        ended = EndReason(int(info["end_reason"]))
        if ended not in (EndReason.RUNNING, EndReason.TIME_LIMIT, EndReason.DROPPED):
            return ended.name.lower()
        if not self._touched:
            return "never touched"
        if self._lost is not None or ended == EndReason.DROPPED:
            what, step = self._lost or ("dropped", self._step)
            off = ", then fell off the table" if ended == EndReason.DROPPED else ""
            return f"{what} at {step * self._dt:.1f} s{off}"
        if not self._held:
            return "touched by one finger only"
        if not self._lifted:
            return "held but not lifted"
        return f"goal not reached: {1e2 * info['goal_distance']:.1f} cm away, {1e2 * self._tolerance:.1f} cm allowed"
