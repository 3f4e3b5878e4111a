"""The scripted policy of PressSoft."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.envs.tasks.press_soft.task import PressSoft
from softmode.errors import ConfigError


class ScriptedPress:
    """Go over the middle of the pad, down to it, and step by what the missing force asks for.

    The stiffness that a step of the command meets is that of the arm in series with the pad's, which is measured as
    force over indentation: k = 1 / (1 / k_arm + indentation / force).

    Args:
        env: A PressSoft environment, wrapped or not.
        gain: Share of the missing force that a step is to bring.

    Raises:
        ConfigError: If the environment is another one, or its actions are not tool steps.
    """

    ARM_STIFFNESS = 3.0e3
    """Vertical stiffness of arm and drives at the tool [N/m]."""
    LEAST_STIFFNESS = 300.0
    """Stiffness taken for a pad that is hardly touched [N/m]."""
    SLOW_HEIGHT = 0.004
    """Height over the pad from which the tool goes down slowly [m]."""

    TOUCH_STEP = 2.5e-4
    """Step at which the tool meets the pad [m]."""

    def __init__(self, env: Any, *, gain: float = 0.25) -> None:
        """Remember the environment."""
        base = env.unwrapped
        if not isinstance(getattr(base, "task", None), PressSoft) or base.config.scene.control.mode != "pose_delta":
            raise ConfigError(
                "the scripted policy plays PressSoft in pose_delta mode only",
                hint="make the environment with control_mode='pose_delta'",
            )
        self.env, self._gain = base, gain

    def reset(self) -> None:
        """Do nothing: the action depends on the present state alone."""

    def __call__(self, observation: Any = None) -> NDArray[np.float32]:
        """Return the action for the present state."""
        task = self.env.task
        force, error, indentation, _ = task.metrics.numpy()[0].astype(float)
        tool = task.scene.controller.target_position.numpy()[0].astype(float)
        aside = task.scene.object_position.numpy()[0, 0, :2].astype(float) - tool[:2]
        step = np.zeros(3)
        step[:2] = 0.5 * aside
        if np.linalg.norm(aside) < 0.002 or force > 0.0:
            step[2] = -self._descent(force, -error, indentation)
        scale = self.env.config.scene.control.translation_scale
        return np.array([*np.clip(step / scale, -1.0, 1.0), 0.0, -1.0], np.float32)

    def _descent(self, force: float, missing: float, indentation: float) -> float:
        """Return how far to go down [m]."""
        if force < 0.05:
            return max(0.2 * (-indentation - self.SLOW_HEIGHT), 0.0) + self.TOUCH_STEP
        pad = max(force / max(indentation, 1.0e-4), self.LEAST_STIFFNESS)
        return self._gain * missing * (1.0 / self.ARM_STIFFNESS + 1.0 / pad)
