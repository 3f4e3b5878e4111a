"""The scripted policy of RopeRoute."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.envs.tasks.rope_route.task import RopeRoute
from softmode.errors import ConfigError


class ScriptedRope:
    """Grasp the rope near its end, lead it past every peg on its side, bring the end to the goal and keep it there.

    The fingers close across the rope. If it slips, it is grasped again where it lies.

    Args:
        env: A RopeRoute environment, wrapped or not.
        squeeze: Force of each finger [N].

    Raises:
        ConfigError: If the environment is another one, or its actions are not tool steps.
    """

    CLEARANCE = 0.03
    """Height over the rope from which the gripper goes down [m]."""
    BESIDE = 0.05
    """Distance at which the tool passes a peg's axis [m]."""
    LEAD = 0.007
    """Way of the tool per control step while it leads the rope [m]."""
    RISE = 0.006
    """Height by which the rope's end is lifted while it is led [m]."""

    def __init__(self, env: Any, *, squeeze: float = 4.0) -> None:
        """Remember the environment."""
        base = env.unwrapped
        if not isinstance(getattr(base, "task", None), RopeRoute) or base.config.scene.control.mode != "pose_delta":
            raise ConfigError(
                "the scripted policy plays RopeRoute in pose_delta mode only",
                hint="make the environment with control_mode='pose_delta'",
            )
        self.env, self._squeeze = base, squeeze
        self.reset()

    def reset(self) -> None:
        """Forget the episode; call after ``env.reset``."""
        self._phase, self._count, self._grip, self._passed = "align", 0, 0.0, 0

    def __call__(self, observation: Any = None) -> NDArray[np.float32]:
        """Return the action for the present state."""
        task, control = self.env.task, self.env.config.scene.control
        controller = task.scene.controller
        axis = task.axis.numpy()[0].astype(float)
        tool = controller.target_position.numpy()[0].astype(float)
        force = np.linalg.norm(task.scene.finger_force.numpy()[0], axis=1)
        grasp, end = axis[task.grasp_point], axis[-1]
        lowest = control.workspace_lower[2]
        along = end - axis[task.grasp_point - 2]
        yaw = float(np.arctan2(along[1], along[0]))
        yaw -= np.pi * np.round((yaw - 0.5 * np.pi) / np.pi)  # fingers may change sides
        turn = yaw - float(controller.target_yaw.numpy()[0])
        goal, fastest = np.array([*grasp[:2], lowest]), control.translation_scale
        if self._phase == "align":
            goal[2] += self.CLEARANCE
            if np.linalg.norm((grasp - tool)[:2]) < 0.002 and abs(turn) < 0.03:
                self._enter("descend")
        elif self._phase == "descend":
            self._count += tool[2] - lowest < 0.001
            if self._count > 3:
                self._enter("close")
        elif self._phase == "close":
            goal = tool
            self._squeezed(force)
            self._count += force.min() > 0.7 * self._squeeze
            if self._count > 5:
                self._enter("lead")
        else:
            self._count = self._count + 1 if force.min() < 0.02 else 0
            self._squeezed(force)
            goal, fastest = np.array([*self._next(tool, end), lowest + self.RISE]), self.LEAD
            if self._count > 5:
                self.reset()
                goal = tool
        move = way_to(goal, tool, fastest) / control.translation_scale
        spin = 0.0 if self._phase == "lead" else np.clip(turn / control.rotation_scale, -1.0, 1.0)
        return np.array([*np.clip(move, -1.0, 1.0), spin, self._grip], np.float32)

    def _enter(self, phase: str) -> None:
        """Enter a phase."""
        self._phase, self._count = phase, 0

    def _next(self, tool: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the tool is to go: beside the next peg, at last to where the end is at the goal."""
        task = self.env.task
        observation = task.observation.numpy()[0].astype(float)
        sides, goal = (observation[task.segments[name][0]] for name in ("side", "goal"))
        pegs = [np.array(peg.position[:2]) for peg in task.config.pegs]
        while self._passed < len(pegs):
            beside = pegs[self._passed] + np.array([sides[self._passed] * self.BESIDE, 0.0])
            if np.linalg.norm(beside - tool[:2]) > 0.01:
                return beside
            self._passed += 1
        return tool[:2] + 0.3 * (goal - end[:2])

    def _squeezed(self, force: NDArray[np.floating]) -> None:
        """Close while the weaker finger feels too little, open while it feels too much."""
        error = np.clip((self._squeeze - force.min()) / self._squeeze, -1.0, 1.0)
        rate = 0.1 if force.min() < 0.02 else 0.02
        self._grip = float(np.clip(self._grip - rate * error, -1.0, 1.0))


def way_to(goal: NDArray[np.float64], place: NDArray[np.float64], fastest: float) -> NDArray[np.float64]:
    """Return the way to a goal, no longer than `fastest` [m]."""
    way = goal - place
    return way * min(1.0, fastest / max(float(np.linalg.norm(way)), 1.0e-9))
