"""A scripted policy that bends a post into a shape."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softmode.envs.scripted import Environment, ScriptedPolicy, bounded, half_turn
from softmode.envs.tasks.shape_soft.task import ShapeSoft


class ScriptedShape(ScriptedPolicy):
    """Bend the post: turn the open fingers into the direction of the bend, press until the free end is where it should.

    Args:
        env: A ShapeSoft environment, wrapped or not.
        world: Which world of a vector environment.
        speed: Greatest tool travel per control step [m].
        gain: Share of the free end's error that a control step removes.

    Raises:
        ConfigError: If the environment is another one, or its actions are not tool steps.
    """

    task_class = ShapeSoft
    task: ShapeSoft

    def __init__(self, env: Environment, *, world: int = 0, speed: float = 0.005, gain: float = 0.25) -> None:
        """Remember the environment and plan nothing yet."""
        super().__init__(env, world=world)
        self._speed, self._gain = speed, gain
        self.reset()

    def reset(self) -> None:
        """Forget the episode; call after ``env.reset``."""
        self._turned = False

    def _ends(self) -> list[NDArray[np.bool_]]:
        """Return which points are at the free end, of the target and of the post."""
        task, row = self.task, self.scene.occupancy.rows[self.world]
        bent = self.soft.body.surface.points[task.points_of_choices[row]]
        return [rest[:, 2] > rest[:, 2].max() - 0.02 for rest in (task.goal_rests[row], bent)]

    def __call__(self, observation: object = None) -> NDArray[np.float32]:
        """Return the action for the present state."""
        desired, achieved = (
            self.segment(name).reshape(-1, 3)[end, :2].mean(axis=0)
            for name, end in zip(("desired_goal", "achieved_goal"), self._ends(), strict=True)
        )
        tool, arm = self.tool, self.arm
        # the fingers close along the tool's y axis
        turn = half_turn(self.drawn("goal")[1] - 0.5 * np.pi - self.yaw)
        foot = self.drawn("position")
        if not self._turned:
            move = foot - tool[:2]
            self._turned = bool(np.linalg.norm(move) < 0.001 and abs(turn) < 0.03)
        else:
            move = self._gain * (desired - achieved)
        move = bounded(move, self._speed)
        step = np.append(move, np.clip(arm.home_position[2] - tool[2], -self._speed, self._speed))
        grip = 2.0 * arm.home_opening / arm.gripper.stroke - 1.0
        return self.action(step, turn, grip)
