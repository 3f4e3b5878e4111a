"""Scripted policies: what a task's demonstrations look like; they read the simulation, not the observation."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.envs.lift_soft import LiftSoftEnv
from softmode.errors import ConfigError


class ScriptedLift:
    """Lift the object: align above it, go down, close until it is held, lift to the goal, try again if it slips.

    The grasp yaw is the one across the object's narrowest horizontal extent that needs the least turn of the wrist. The
    squeeze is regulated on the measured finger forces, because one opening means another force for every stiffness.

    Args:
        env: A LiftSoft environment, wrapped or not.
        squeeze: Force of each finger as a multiple of the least that friction needs to carry the weight.
    """

    def __init__(self, env: Any, *, squeeze: float = 5.0) -> None:
        """Remember the environment and plan nothing yet."""
        base = env.unwrapped
        if not isinstance(base, LiftSoftEnv) or base.config.scene.control.mode != "pose_delta":
            raise ConfigError(
                "the scripted policy plays LiftSoft in pose_delta mode only",
                hint="make the environment with control_mode='pose_delta'",
            )
        self.env = base
        self._squeeze = squeeze
        self.reset()

    def reset(self) -> None:
        """Forget the episode; call after ``env.reset``."""
        self._phase = "align"
        self._grip = 1.0
        self._grasp: tuple[NDArray[np.float64], float] | None = None
        self._wait = 0
        self._lost = 0

    def __call__(self, observation: Any = None) -> NDArray[np.float32]:
        """Return the action for the present state."""
        scene = self.env.scene
        if self._grasp is None:
            self._grasp = self._plan()
        place, yaw = self._grasp
        options = self.env.config.scene.control
        tool = scene.controller.target_position.numpy()[0].astype(float)
        turn = yaw - float(scene.controller.target_yaw.numpy()[0])
        force = np.linalg.norm(scene.finger_force.numpy()[0], axis=1)
        goal = place + [0.0, 0.0, 0.08]
        if self._phase == "align":
            if np.linalg.norm((goal - tool)[:2]) < 0.002 and abs(turn) < 0.02:
                self._phase = "descend"
        elif self._phase == "descend":
            goal = place
            if np.linalg.norm(place - tool) < 0.001:
                self._wait += 1
            if self._wait > 4:
                self._phase = "close"
        elif self._phase == "close":
            goal = place
            self._grip = self._regulated(force)
            self._wait += 1 if force.min() > 0.7 * self._wanted_force() else 0
            if self._wait > 12:
                self._phase = "lift"
        else:
            self._lost = self._lost + 1 if force.min() < 0.02 else 0
            if self._lost > 8:
                self.reset()
                return np.array([0.0, 0.0, 1.0, 0.0, 1.0], np.float32)
            self._grip = self._regulated(force)
            rise = self.env.config.goal_height - self.env._height()
            goal = tool + [0.0, 0.0, np.clip(rise, -0.008, 0.008)]
        move = np.clip((goal - tool) / options.translation_scale, -1.0, 1.0)
        spin = np.clip(turn / options.rotation_scale, -1.0, 1.0)
        return np.array([*move, spin, self._grip], np.float32)

    def _plan(self) -> tuple[NDArray[np.float64], float]:
        """Choose grasp point and yaw from the surface samples."""
        scene, gripper = self.env.scene, self.env.config.scene.arm.gripper
        points = scene.state.particle_q.numpy().astype(float)
        top, bottom = points[:, 2].max(), points[:, 2].min()
        depth = min(0.5 * gripper.pad_size[2], 0.5 * (top - bottom))
        centre_of_mass = scene.object_position.numpy()[0].astype(float)
        heavy = centre_of_mass[:2]
        height = max(centre_of_mass[2], bottom + depth, self.env.config.scene.control.workspace_lower[2])
        near = points[np.abs(points[:, 2] - height) < 0.5 * gripper.pad_size[2]]
        best: tuple[float, float, NDArray[np.float64]] | None = None
        for yaw in np.linspace(-0.5 * np.pi, 0.5 * np.pi, 36, endpoint=False):
            across = near[:, :2] @ np.array([-np.sin(yaw), np.cos(yaw)])
            along = near[:, :2] @ np.array([np.cos(yaw), np.sin(yaw)])
            width = np.ptp(across)
            cost = width + 0.004 * abs(yaw)
            if best is None or cost < best[0]:
                middle = 0.5 * (across.max() + across.min())
                centre = np.clip(heavy @ np.array([np.cos(yaw), np.sin(yaw)]), along.min(), along.max())
                place = centre * np.array([np.cos(yaw), np.sin(yaw)]) + middle * np.array([-np.sin(yaw), np.cos(yaw)])
                best = (cost, float(yaw), place)
        assert best is not None
        return np.array([*best[2], height]), best[1]

    def _wanted_force(self) -> float:
        """Force of each finger that carries the weight by friction with a margin [N]."""
        scene = self.env.config.scene
        weight = scene.material.density * self.env.scene.soft.body.volume * 9.81
        friction = np.sqrt(scene.material.friction * scene.arm.gripper.friction)
        return max(self._squeeze * 0.5 * weight / friction, 1.5)

    def _regulated(self, force: NDArray[np.floating]) -> float:
        """Close while the weaker finger feels too little, open while it feels too much."""
        wanted = self._wanted_force()
        error = np.clip((wanted - force.min()) / wanted, -1.0, 1.0)
        rate = 0.06 if force.min() < 0.02 else 0.012
        return float(np.clip(self._grip - rate * error, -1.0, 1.0))
