"""The scripted policy of RopeRoute."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softmode.envs.reward_kernels import TOUCH_FORCE
from softmode.envs.scripted import Environment, ScriptedPolicy, Vector, bounded
from softmode.envs.tasks.rope_route.task import RopeRoute


class ScriptedRope(ScriptedPolicy):
    """Grasp the rope near its end, lead it past every peg on its side, bring the end to the goal and keep it there.

    The fingers close across the rope. If it slips, it is grasped again where it lies.

    Args:
        env: A RopeRoute environment, wrapped or not.
        world: Which world of a vector environment.
        squeeze: Force of each finger [N].

    Raises:
        ConfigError: If the environment is another one, or its actions are not tool steps.
    """

    CLEARANCE = 0.03
    """Height over the rope from which the gripper goes down [m]."""
    BESIDE = 0.065
    """Distance at which the tool passes a peg's axis [m]."""
    NEAREST = 0.06
    """Least distance from an axis that it has passed, unless its goal is nearer [m]: the rope is caught there."""
    LEAD = 0.006
    """Way of the tool per control step while it leads the rope [m]."""
    RISE = 0.006
    """Height by which the rope's end is lifted while it is led [m]."""

    task_class = RopeRoute
    task: RopeRoute

    def __init__(self, env: Environment, *, world: int = 0, squeeze: float = 3.0) -> None:
        """Remember the environment and plan nothing yet."""
        super().__init__(env, world=world)
        self._squeeze = squeeze
        self.reset()

    def reset(self) -> None:
        """Forget the episode; call after ``env.reset``."""
        self._phase, self._count, self._grip, self._passed = "align", 0, 0.0, 0

    def __call__(self, observation: object = None) -> NDArray[np.float32]:
        """Return the action for the present state."""
        task, control, tool, force = self.task, self.control, self.tool, self.weaker_force
        axis = task.axis.numpy()[self.world].astype(float)
        point = int(task.grasp_points[self.scene.occupancy.rows[self.world]])
        grasp, end = axis[point], axis[-1]
        lowest = control.workspace_lower[2]
        along = end - axis[point - 2]
        yaw = float(np.arctan2(along[1], along[0]))
        yaw -= np.pi * np.round((yaw - 0.5 * np.pi) / np.pi)  # fingers may change sides
        turn = yaw - self.yaw
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
            self._regulate()
            self._count += force > 0.7 * self._squeeze
            if self._count > 5:
                self._enter("lead")
        else:
            self._count = self._count + 1 if force < TOUCH_FORCE else 0
            self._regulate()
            goal = np.array([*self._next(tool, end), lowest + self.RISE])
            if self._count > 5:
                self.reset()
                goal = tool
        return self.action(bounded(goal - tool, fastest), 0.0 if self._phase == "lead" else turn, self._grip)

    def _enter(self, phase: str) -> None:
        """Enter a phase."""
        self._phase, self._count = phase, 0

    def _next(self, tool: Vector, end: Vector) -> Vector:
        """Return where the tool goes next: to the next peg's side, at last to where the end is at the goal."""
        sides, goal = self.segment("side"), self.segment("goal")
        pegs = [np.array(peg.position[:2]) for peg in self.task.config.pegs]
        there, fraction = tool[:2] + goal - end[:2], 0.3
        for k in range(self._passed, len(pegs)):
            beside = pegs[k] + np.array([sides[k] * self.BESIDE, 0.0])
            if np.linalg.norm(beside - tool[:2]) > 0.01:
                there, fraction = beside, 1.0
                break
            self._passed += 1
        place: Vector = tool[:2] + bounded(fraction * (there - tool[:2]), self.LEAD)
        for axis in pegs[: self._passed]:
            away, nearest = place - axis, min(self.NEAREST, float(np.linalg.norm(there - axis)))
            place = axis + away * max(1.0, nearest / float(np.linalg.norm(away)))
        return place

    def _regulate(self) -> None:
        """Close while the weaker finger feels too little, open while it feels too much."""
        self._grip = self.regulated(self._grip, self._squeeze, closing=0.1, holding=0.02)
