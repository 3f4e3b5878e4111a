"""The scripted policy of PressSoft."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softmode.envs.scripted import Environment, ScriptedPolicy
from softmode.envs.tasks.press_soft.kernels import Metric
from softmode.envs.tasks.press_soft.task import PressSoft


class ScriptedPress(ScriptedPolicy):
    """Go over the middle of the pad, down to it, and step by what the missing force asks for.

    The stiffness that a step of the command meets is that of the arm in series with the pad's, which is measured as
    force over indentation: k = 1 / (1 / k_arm + indentation / force).

    Args:
        env: A PressSoft environment, wrapped or not.
        world: Which world of a vector environment.
        gain: Share of the missing force that a step is to bring.

    Raises:
        ConfigError: If the environment is another one, or its actions are not tool steps.
    """

    LEAST_STIFFNESS = 300.0
    """Stiffness taken for a pad that is hardly touched [N/m]."""
    SLOW_HEIGHT = 0.004
    """Height over the pad from which the tool goes down slowly [m]."""
    TOUCH_STEP = 2.5e-4
    """Step at which the tool meets the pad [m]."""

    task_class = PressSoft
    task: PressSoft

    def __init__(self, env: Environment, *, world: int = 0, gain: float = 0.25) -> None:
        """Remember the environment and plan nothing yet."""
        super().__init__(env, world=world)
        self._gain = gain

    def __call__(self, observation: object = None) -> NDArray[np.float32]:
        """Return the action for the present state."""
        metrics = self.task.metrics.numpy()[self.world].astype(float)
        force, error = metrics[Metric.contact_force], metrics[Metric.force_error]
        aside = (self.centre - self.tool)[:2]
        step = np.zeros(3)
        step[:2] = 0.5 * aside
        if np.linalg.norm(aside) < 0.002 or force > 0.0:
            step[2] = -self._descent(force, -error, metrics[Metric.indentation])
        return self.action(step, 0.0, -1.0)

    def _descent(self, force: float, missing: float, indentation: float) -> float:
        """Return how far to go down [m]."""
        if force < 0.05:
            return max(0.2 * (-indentation - self.SLOW_HEIGHT), 0.0) + self.TOUCH_STEP
        pad = max(force / max(indentation, 1.0e-4), self.LEAST_STIFFNESS)
        return self._gain * missing * (1.0 / self.task.arm_stiffness + 1.0 / pad)
