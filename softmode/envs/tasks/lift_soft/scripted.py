"""The scripted policy of LiftSoft."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softmode.envs.scripted import Environment, ScriptedPolicy, Vector, bounded
from softmode.envs.scripted_grasp import ScriptedGrasp
from softmode.envs.tasks.lift_soft.task import LiftSoft


class ScriptedLift(ScriptedPolicy):
    """Grasp the object (:class:`ScriptedGrasp`), lift it to the goal, try again if it slips.

    Args:
        env: A LiftSoft environment, wrapped or not.
        world: Which world of a vector environment.
        squeeze: Force of each finger as a multiple of the least that friction needs to carry the weight.
        least_force: But at least this force [N]; stiff objects touch the fingers with few samples and turn out of less.

    Raises:
        ConfigError: If the environment is another one, or its actions are not tool steps.
    """

    AVERAGED = 0.1
    """Share of a control step in the average of where the object hangs."""

    task_class = LiftSoft
    task: LiftSoft

    def __init__(self, env: Environment, *, world: int = 0, squeeze: float = 5.0, least_force: float = 6.0) -> None:
        """Remember the environment and plan nothing yet."""
        super().__init__(env, world=world)
        self._grasp = ScriptedGrasp(env, self._way, squeeze=squeeze, least_force=least_force, world=world)
        self.reset()

    def reset(self) -> None:
        """Forget the episode; call after ``env.reset``."""
        self._grasp.reset()
        self._hang: Vector | None = None

    @property
    def trouble(self) -> str:
        """Why no grasp fits any more where the object lies now; empty while one does."""
        return self._grasp.trouble

    def __call__(self, observation: object = None) -> NDArray[np.float32]:
        """Return the action for the present state."""
        action = self._grasp()
        if not self._grasp.holds:
            self._hang = None
        return action

    def _way(self, centre: Vector) -> Vector:
        """Return the next move of a held object: up first, sideways once it is clear of the table.

        Where it hangs from the tool is averaged: following its swing would feed it.
        """
        offset = centre - self.tool
        self._hang = offset if self._hang is None else self._hang + self.AVERAGED * (offset - self._hang)
        way = self.segment("goal") - self.tool - self._hang
        way[:2] *= float(centre[2] - self.soft.height > 0.02)
        return bounded(way, 0.008)
