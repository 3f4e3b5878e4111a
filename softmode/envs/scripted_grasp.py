"""How the scripted policies take hold of an object."""

from __future__ import annotations

from collections.abc import Callable

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from softmode.envs.reward_kernels import TOUCH_FORCE
from softmode.envs.scripted_base import ScriptedPolicy, Vector


class ScriptedGrasp(ScriptedPolicy):
    """Take the object: align above it, go down, close until it is held, move on with it, try again if it slips.

    The grasp yaw is the one across the object's narrowest horizontal extent that needs the least turn of the wrist. The
    squeeze is regulated on the measured finger forces, because one opening means another force for every stiffness.
    An object that topples or rolls is waited for, and planned anew where it comes to rest.

    Args:
        env: An environment of one world in pose_delta mode.
        way: From the centre of the held object [m] to its next move [m], both of shape (3,).
        squeeze: Force of each finger as a multiple of the least that friction needs to carry the weight.
        least_force: But at least this force [N].
    """

    PALM_GAP = 0.004
    """Gap between the object's top and the palm [m]."""
    CLEARANCE = 0.08
    """Height above the grasp from which the gripper goes down [m]."""
    STILL = 0.02
    """Speed of the object's centre of mass under which it counts as at rest [m/s]."""
    MOVED = 0.004
    """Displacement of its centre of mass that calls for a new plan [m]."""
    PATIENCE = 60
    """Control steps after which closing without a grip is given up."""

    def __init__(
        self, env: gym.Env, way: Callable[[Vector], Vector], *, squeeze: float = 5.0, least_force: float = 1.5
    ) -> None:
        """Remember the environment and plan nothing yet."""
        super().__init__(env)
        self._way, self._squeeze, self._least_force = way, squeeze, least_force
        self.reset()

    def reset(self) -> None:
        """Forget the episode; call after ``env.reset``."""
        self._start("align")
        self._grip = 1.0
        self._grasp: tuple[Vector, float] | None = None
        self._planned_at = np.full(3, np.inf)

    @property
    def holds(self) -> bool:
        """Whether the object is held and moved."""
        return self._phase == "lift"

    def _start(self, phase: str) -> None:
        """Enter a phase."""
        self._phase, self._elapsed, self._count = phase, 0, 0

    def __call__(self, observation: object = None) -> NDArray[np.float32]:
        """Return the action for the present state."""
        centre, tool, force = self.centre, self.tool, self.weaker_force
        still = np.linalg.norm(self.scene.object_velocity.numpy()[0, 0]) < self.STILL
        if self._phase in ("align", "descend") and np.linalg.norm(centre - self._planned_at) > self.MOVED:
            self._grasp, self._planned_at = self._plan(), centre
            self._start("align")
        assert self._grasp is not None
        place, yaw = self._grasp
        turn = yaw - self.yaw
        self._elapsed += 1
        goal = place
        if self._phase == "align":
            above = place + np.array([0.0, 0.0, self.CLEARANCE])
            low = tool[2] < above[2] - 0.02  # after a failed grasp: straight up first
            goal = np.array([*tool[:2], above[2]]) if low else above
            if still and np.linalg.norm((place - tool)[:2]) < 0.002 and abs(turn) < 0.02:
                self._start("descend")
        elif self._phase == "descend":
            self._count += np.linalg.norm(place - tool) < 0.001
            if self._count > 4:
                self._start("close")
        elif self._phase == "close":
            self._regulate()
            self._count += force > 0.7 * self._wanted_force()
            if self._count > 12:
                self._start("lift")
            elif self._elapsed > self.PATIENCE:
                self.reset()
                goal = tool
        else:
            self._count = self._count + 1 if force < TOUCH_FORCE else 0
            self._regulate()
            goal = tool + self._way(centre)
            if self._count > 8:
                self.reset()
                goal = tool
        return self.action(goal - tool, turn, self._grip)

    def _plan(self) -> tuple[Vector, float]:
        """Choose grasp point and yaw from the surface samples."""
        scene, gripper = self.scene, self.arm.gripper
        points = scene.state.particle_q.numpy()[: scene.soft.body.surface_count].astype(float)
        top, bottom = points[:, 2].max(), points[:, 2].min()
        depth = min(0.5 * gripper.pad_size[2], 0.5 * (top - bottom))
        centre = self.centre
        # at the height of the centre of mass, unless the palm would press on the top
        under_palm = top - (gripper.finger_length - 0.5 * gripper.pad_size[2]) + self.PALM_GAP
        height = max(centre[2], bottom + depth, under_palm, self.control.workspace_lower[2])
        near = points[np.abs(points[:, 2] - height) < 0.5 * gripper.pad_size[2]]
        best: tuple[float, float, Vector] | None = None
        for yaw in np.linspace(-0.5 * np.pi, 0.5 * np.pi, 36, endpoint=False):
            forward, sideways = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
            along, across = near[:, :2] @ forward, near[:, :2] @ sideways
            cost = np.ptp(across) + 0.004 * abs(yaw)
            if best is None or cost < best[0]:
                middle = 0.5 * (across.max() + across.min())
                under = np.clip(centre[:2] @ forward, along.min(), along.max())
                best = (cost, float(yaw), under * forward + middle * sideways)
        assert best is not None
        return np.array([*best[2], height]), best[1]

    def _wanted_force(self) -> float:
        """Force of each finger that carries the weight by friction with a margin [N]."""
        scene = self.scene.config
        weight = scene.material.density * self.scene.soft.body.volume * 9.81
        friction = np.sqrt(scene.material.friction * scene.arm.gripper.friction)
        return max(self._squeeze * 0.5 * weight / friction, self._least_force)

    def _regulate(self) -> None:
        """Close while the weaker finger feels too little, open while it feels too much."""
        self._grip = self.regulated(self._grip, self._wanted_force(), closing=0.06, holding=0.012)
