"""Scripted policies: what a task's demonstrations look like; they read the simulation, not the observation."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.envs.scripted_grasp import ScriptedGrasp
from softmode.envs.tasks.lift_soft.task import LiftSoft
from softmode.errors import ConfigError


def scripted_policy(env: Any) -> Any:
    """Return the scripted policy of an environment: called with an observation it returns an action.

    Args:
        env: An environment of one world, wrapped or not.

    Raises:
        ConfigError: If its task has none, or it takes other actions than tool steps.
    """
    from softmode.envs.tasks.place_in_bin.scripted import ScriptedPlace
    from softmode.envs.tasks.place_in_bin.task import PlaceInBin
    from softmode.envs.tasks.press_soft.scripted import ScriptedPress
    from softmode.envs.tasks.press_soft.task import PressSoft
    from softmode.envs.tasks.push_soft.scripted import ScriptedPush
    from softmode.envs.tasks.push_soft.task import PushSoft
    from softmode.envs.tasks.rope_route.scripted import ScriptedRope
    from softmode.envs.tasks.rope_route.task import RopeRoute
    from softmode.envs.tasks.shape_soft.scripted import ScriptedShape
    from softmode.envs.tasks.shape_soft.task import ShapeSoft

    policies = {
        LiftSoft: ScriptedLift,
        PushSoft: ScriptedPush,
        PressSoft: ScriptedPress,
        PlaceInBin: ScriptedPlace,
        RopeRoute: ScriptedRope,
        ShapeSoft: ScriptedShape,
    }
    task = getattr(env.unwrapped, "task", None)
    own = getattr(type(task), "scripted_policy", None)
    if own is not None:
        return own(env)
    for kind, policy in policies.items():
        if isinstance(task, kind):
            return policy(env)
    known = ", ".join(kind.__name__ for kind in policies)
    raise ConfigError(
        f"there is no scripted policy for {env}",
        hint=f"there is one for {known}; a task of yours may set scripted_policy",
    )


class ScriptedLift:
    """Grasp the object (:class:`ScriptedGrasp`), lift it to the goal, try again if it slips.

    Args:
        env: A LiftSoft environment, wrapped or not.
        squeeze: Force of each finger as a multiple of the least that friction needs to carry the weight.
        least_force: But at least this force [N]; stiff objects touch the fingers with few samples and turn out of less.

    Raises:
        ConfigError: If the environment is another one, or its actions are not tool steps.
    """

    def __init__(self, env: Any, *, squeeze: float = 5.0, least_force: float = 6.0) -> None:
        """Remember the environment and plan nothing yet."""
        base = env.unwrapped
        if not isinstance(getattr(base, "task", None), LiftSoft) or base.config.scene.control.mode != "pose_delta":
            raise ConfigError(
                "the scripted policy plays LiftSoft in pose_delta mode only",
                hint="make the environment with control_mode='pose_delta'",
            )
        self._task: LiftSoft = base.task
        self._grasp = ScriptedGrasp(base, self._way, squeeze=squeeze, least_force=least_force)

    def reset(self) -> None:
        """Forget the episode; call after ``env.reset``."""
        self._grasp.reset()

    def __call__(self, observation: Any = None) -> NDArray[np.float32]:
        """Return the action for the present state."""
        return self._grasp()

    def _way(self, centre: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the next move of a held object: up first, sideways once it is clear of the table."""
        task = self._task
        way = task.observation.numpy()[0, task.segments["goal"][0]] - centre
        way[:2] *= float(centre[2] - task.scene.soft.height > 0.02)
        return way * min(1.0, 0.008 / max(float(np.linalg.norm(way)), 1.0e-9))
