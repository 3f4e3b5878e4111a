"""A scripted policy that bends a post into a shape."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.envs.tasks.shape_soft.task import ShapeSoft
from softmode.errors import ConfigError


class ScriptedShape:
    """Bend the post: turn the open fingers into the direction of the bend, press until the free end is where it should.

    Args:
        env: A ShapeSoft environment, wrapped or not.
        speed: Greatest tool travel per control step [m].
        gain: Share of the free end's error that a control step removes.

    Raises:
        ConfigError: If the environment is another one, or its actions are not tool steps.
    """

    def __init__(self, env: Any, *, speed: float = 0.005, gain: float = 0.25) -> None:
        """Remember the environment."""
        base = env.unwrapped
        if not isinstance(getattr(base, "task", None), ShapeSoft) or base.config.scene.control.mode != "pose_delta":
            raise ConfigError(
                "this scripted policy plays ShapeSoft in pose_delta mode only",
                hint="make the environment with control_mode='pose_delta'",
            )
        self.env = base
        self._speed, self._gain = speed, gain
        rest = base.scene.soft.body.surface_points[base.task.points][:, 2]
        self._end = rest > rest.max() - 0.02
        self.reset()

    def reset(self) -> None:
        """Forget the episode; call after ``env.reset``."""
        self._turned = False

    def __call__(self, observation: Any = None) -> NDArray[np.float32]:
        """Return the action for the present state."""
        task, scene, arm = self.env.task, self.env.scene, self.env.config.scene.arm
        seen, drawn = task.observation.numpy()[0].astype(float), task.table.values.numpy()[0].astype(float)
        desired, achieved = (
            seen[task.segments[name][0]].reshape(-1, 3)[self._end, :2].mean(axis=0)
            for name in ("desired_goal", "achieved_goal")
        )
        tool = scene.controller.target_position.numpy()[0].astype(float)
        yaw = float(scene.controller.target_yaw.numpy()[0])
        # the fingers close along the tool's y axis
        direction = drawn[task.table.column("goal") + 1] - 0.5 * np.pi
        turn = float(np.remainder(direction - yaw + 0.5 * np.pi, np.pi) - 0.5 * np.pi)
        foot = drawn[task.table.columns("position")]
        if not self._turned:
            move = foot - tool[:2]
            self._turned = bool(np.linalg.norm(move) < 0.001 and abs(turn) < 0.03)
        else:
            move = self._gain * (desired - achieved)
        move = move * min(1.0, self._speed / max(float(np.linalg.norm(move)), 1.0e-9))
        options = self.env.config.scene.control
        step = np.append(move, np.clip(arm.home_position[2] - tool[2], -self._speed, self._speed))
        grip = 2.0 * arm.home_opening / arm.gripper.stroke - 1.0
        spin = np.clip(turn / options.rotation_scale, -1.0, 1.0)
        return np.array([*np.clip(step / options.translation_scale, -1.0, 1.0), spin, grip], np.float32)
