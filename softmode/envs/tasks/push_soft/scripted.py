"""A scripted policy that pushes an object to a goal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softmode.envs.scripted import Environment, ScriptedPolicy, Vector, half_turn
from softmode.envs.tasks.push_soft.task import PushSoft
from softmode.robots.table_robot import tip_length


class ScriptedPush(ScriptedPolicy):
    """Push the object to its goal: go behind it, over it where it stands in the way, push, stop.

    The two fingers stand side by side across the way, a stable fork: an object that slips off the line is caught by
    the finger it slips towards. Yaw is left as it is.

    Args:
        env: A PushSoft environment, wrapped or not.
        world: Which world of a vector environment.
        speed: Tool travel per control step while pushing [m].

    Raises:
        ConfigError: If the environment is another one, or its actions are not tool steps.
    """

    CLEARANCE = 0.015
    """Gap between tool and object behind which pushing begins [m]."""
    DONE = 0.004
    """Distance from the goal at which pushing ends [m]."""
    AGAIN = 0.012
    """Distance from the goal at which it begins again [m]."""
    LATERAL = 0.010
    """How far the tool may be off the line through object and goal before it goes behind the object again [m]."""

    task_class = PushSoft
    task: PushSoft

    def __init__(self, env: Environment, *, world: int = 0, speed: float = 0.006) -> None:
        """Remember the environment and plan nothing yet."""
        super().__init__(env, world=world)
        self._speed = speed
        self.reset()

    def reset(self) -> None:
        """Forget the episode; call after ``env.reset``."""
        self._phase = "behind"
        self._yaw: float | None = None

    def __call__(self, observation: object = None) -> NDArray[np.float32]:
        """Return the action for the present state."""
        way, centre, tool, yaw = self.segment("object_goal"), self.centre, self.tool, self.yaw
        distance = float(np.linalg.norm(way))
        towards = way / max(distance, 1.0e-6)
        size = float(self.drawn("scale")[0])
        back, low = self.task.push_distance[self.world] * size, self.task.push_height
        offset = tool[:2] - centre[:2]
        along, across = float(offset @ towards), float(towards[0] * offset[1] - towards[1] * offset[0])
        step = self._speed
        if self._phase == "rest" and distance > self.AGAIN:
            self._phase = "behind"
        if self._phase == "push" and (distance < self.DONE or abs(across) > 3.0 * self.LATERAL):
            self._phase = "rest" if distance < self.AGAIN else "behind"
        if self._phase == "rest":
            return self._evenly(np.zeros(3), 0.0)
        if self._phase == "behind":
            if self._yaw is None or abs(along + back) > 2.0 * self.CLEARANCE:
                self._yaw = _across(towards, yaw)
            start = centre[:2] - (back + self.CLEARANCE) * towards
            move = self._way_behind(tool, np.array([*start, low]), along < 0.0 and -along > back, size)
            if np.linalg.norm(move) < self.LATERAL / 2.0 and abs(self._yaw - yaw) < 0.1:
                self._phase = "push"
            return self._evenly(move, self._yaw - yaw)
        # push: along the way, and back onto its line; gently at the end
        assert self._yaw is not None
        ahead = min(step, max(0.3 * (distance - 0.5 * self.DONE), 0.001))
        sideways = np.array([-towards[1], towards[0]]) * np.clip(-0.3 * across, -0.5 * step, 0.5 * step)
        if distance > 0.03:
            self._yaw = _across(towards, yaw)
        move = np.array([*(ahead * towards + sideways), low - tool[2]])
        return self._evenly(move, self._yaw - yaw)

    def _way_behind(self, tool: Vector, goal: Vector, is_behind: bool, size: float) -> Vector:
        """Return the move to the place behind the object: straight if it is free, else up, across and down."""
        above = 2.0 * self.soft.height * size + tip_length(self.arm) + 0.012
        move = goal - tool
        low = tool[2] < above - 0.005
        if (is_behind and low) or np.linalg.norm(move[:2]) < 0.006:
            return move
        return np.array([*((0.0, 0.0) if low else move[:2]), above - tool[2]])

    def _evenly(self, move: Vector, turn: float) -> NDArray[np.float32]:
        """Return the action for a move [m], shortened without a change of direction, and a turn [rad] of the tool."""
        action, steps = self.action(move, turn, 0.0), move / self.control.translation_scale
        action[:3] = steps / max(1.0, float(np.abs(steps).max()))
        return action


def _across(towards: Vector, yaw: float) -> float:
    """Return the tool yaw nearest to `yaw` [rad] at which the fingers stand side by side across a direction."""
    angle = float(np.arctan2(towards[1], towards[0]))
    return yaw + half_turn(angle - yaw)
