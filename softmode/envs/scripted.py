"""Scripted policies: what those of all tasks share, and which one an environment's task has."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from softmode.envs.reward_kernels import TOUCH_FORCE
from softmode.envs.soft_env import SoftEnv
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.envs.task import Task
from softmode.errors import ConfigError
from softmode.objects.soft_object import SoftObject

Vector = NDArray[np.float64]
Environment = gym.Env | gym.vector.VectorEnv
_POLICIES = {
    "LiftSoft": "lift_soft.scripted:ScriptedLift",
    "PushSoft": "push_soft.scripted:ScriptedPush",
    "PressSoft": "press_soft.scripted:ScriptedPress",
    "PlaceInBin": "place_in_bin.scripted:ScriptedPlace",
    "RopeRoute": "rope_route.scripted:ScriptedRope",
    "ShapeSoft": "shape_soft.scripted:ScriptedShape",
}


class ScriptedPolicy:
    """A policy that reads the simulation, not the observation; called with an observation it returns an action.

    Args:
        env: An environment, wrapped or not, with the task that the policy plays.
        world: Which world of a vector environment, all of whose worlds live in this process.

    Raises:
        ConfigError: If the environment is another one, or its actions are not tool steps.
    """

    task_class: ClassVar[type[Task]] = Task
    """The task that it plays."""

    def __init__(self, env: Environment, *, world: int = 0) -> None:
        """Remember the environment."""
        base = env.unwrapped
        task = base.task if isinstance(base, (SoftEnv, SoftVectorEnv)) else None
        if not isinstance(task, self.task_class) or task.config.scene.control.mode != "pose_delta":
            raise ConfigError(
                f"this scripted policy plays {self.task_class.__name__} in pose_delta mode only",
                hint="make the environment with control_mode='pose_delta'",
            )
        self.task, self.scene, self.world = task, task.scene, world
        self.arm, self.control = task.config.scene.arm, task.config.scene.control
        self.target = 0
        """Which object of the world it is about."""

    def reset(self) -> None:
        """Forget the episode; call after ``env.reset``."""

    def __call__(self, observation: object = None) -> NDArray[np.float32]:
        """Return the action for the present state."""
        raise NotImplementedError

    # -- reading ------------------------------------------------------------------------------------------------------

    @property
    def tool(self) -> Vector:
        """Commanded position of the tool [m]."""
        return self.scene.controller.target_position.numpy()[self.world].astype(float)

    @property
    def measured(self) -> Vector:
        """Measured position of the tool [m]."""
        return self.scene.controller.tool_pose.numpy()[self.world, :3].astype(float)

    @property
    def yaw(self) -> float:
        """Commanded yaw of the tool [rad]."""
        return float(self.scene.controller.target_yaw.numpy()[self.world])

    @property
    def soft(self) -> SoftObject:
        """The object that it is about."""
        return self.scene.occupancy.objects_of(self.world)[self._order[0]]

    @property
    def _order(self) -> list[int]:
        """The objects that are there by their places in `Occupancy.objects_of`, the one that it is about first."""
        there = self.scene.occupancy.instances_of(self.world)
        first = there.index(self.world * self.task.state.stride + self.target)
        return [first, *(k for k in range(len(there)) if k != first)]

    @property
    def centre(self) -> Vector:
        """Centre of mass of the object [m]."""
        return self.scene.object_position.numpy()[self.world, self.target].astype(float)

    @property
    def velocity(self) -> Vector:
        """Its velocity [m/s]."""
        return self.scene.object_velocity.numpy()[self.world, self.target].astype(float)

    @property
    def finger_forces(self) -> Vector:
        """Force on each finger [N]."""
        return np.linalg.norm(self.scene.finger_force.numpy()[self.world], axis=1)

    @property
    def weaker_force(self) -> np.floating:
        """Force on the finger that feels less [N]."""
        return self.finger_forces.min()

    def segment(self, name: str) -> Vector:
        """Return a segment of the observation vector."""
        return self.task.observation.numpy()[self.world, self.task.segments[name][0]].astype(float)

    def drawn(self, name: str) -> Vector:
        """Return a parameter of the episode."""
        return self.task.table.values.numpy()[self.world, self.task.table.columns(name)].astype(float)

    def material(self, name: str) -> float:
        """Return a property of the object: of its material, or its scale."""
        return float(self.task.materials.values[name].numpy()[self.world * self.task.state.stride + self.target])

    def surfaces(self) -> list[Vector]:
        """Return the surface samples of every object that is there [m], each of shape (N, 3), the object's first."""
        starts = self.task.state.particle_start.numpy()[list(self.scene.occupancy.instances_of(self.world))]
        points, things = self.scene.state.particle_q.numpy(), self.scene.occupancy.objects_of(self.world)
        return [points[starts[k] : starts[k] + things[k].body.surface_count].astype(float) for k in self._order]

    # -- acting -------------------------------------------------------------------------------------------------------

    def action(self, move: Vector, turn: float, grip: float) -> NDArray[np.float32]:
        """Return an action.

        Args:
            move: Way of the tool [m], clipped to what a control step allows.
            turn: Turn of the tool [rad], clipped likewise.
            grip: Entry of the gripper, 1 open, -1 squeezing.
        """
        spin = np.clip(turn / self.control.rotation_scale, -1.0, 1.0)
        return np.array([*np.clip(move / self.control.translation_scale, -1.0, 1.0), spin, grip], np.float32)

    def entry(self, opening: float) -> float:
        """Return the gripper's entry that asks for an opening [m]."""
        gripper = self.arm.gripper
        lead = self.control.squeeze_lead * 2.0 * gripper.force_limit / gripper.drive_stiffness
        return float(np.clip(2.0 * (opening + lead) / (gripper.stroke + lead) - 1.0, -1.0, 1.0))

    def regulated(self, grip: float, wanted: float, *, closing: float, holding: float) -> float:
        """Return the gripper's next entry: it closes while the weaker finger feels too little, and opens otherwise.

        It does not close on what presses on the other finger alone, such as a rope that is caught at a peg.

        Args:
            grip: The last entry.
            wanted: Force of each finger [N].
            closing: Greatest change while a finger touches nothing.
            holding: Greatest change while both touch.
        """
        forces = self.finger_forces
        force = forces.min()
        error = np.clip((wanted - force) / wanted, -1.0, 1.0 if forces.max() < 3.0 * wanted else 0.0)
        return float(np.clip(grip - (closing if force < TOUCH_FORCE else holding) * error, -1.0, 1.0))


def bounded(way: Vector, longest: float) -> Vector:
    """Return a way, shortened to a length [m] if it is longer."""
    return way * min(1.0, longest / max(float(np.linalg.norm(way)), 1.0e-9))


def half_turn(angle: float) -> float:
    """Return an angle [rad] in -pi/2..pi/2 that differs by half turns: fingers may change sides."""
    return float(np.remainder(angle + 0.5 * np.pi, np.pi) - 0.5 * np.pi)


def scripted_policy(env: Environment) -> Callable[[Any], Any]:
    """Return the scripted policy of an environment: called with an observation it returns an action.

    That of a vector environment returns one action per world, each what it would be in an environment of its own.

    Args:
        env: An environment, wrapped or not; all worlds of a vector environment live in this process.

    Raises:
        ConfigError: If its task has none, or it takes other actions than tool steps.
    """
    base = env.unwrapped
    kind = type(getattr(base, "task", None))
    own = getattr(kind, "scripted_policy", None)
    if own is not None:
        return own(env)
    for parent in kind.__mro__:
        if parent.__name__ in _POLICIES:
            module, _, name = _POLICIES[parent.__name__].partition(":")
            policy = getattr(importlib.import_module(f"softmode.envs.tasks.{module}"), name)
            return scripted_worlds(policy)(env)
    hint = f"there is one for {', '.join(_POLICIES)}; a task of yours may set scripted_policy"
    raise ConfigError(f"there is no scripted policy for {kind.__name__}", hint=hint)


def scripted_worlds(policy: type[ScriptedPolicy]) -> Callable[[Any], Callable[[Any], Any]]:
    """Return what `Task.scripted_policy` of a task of your own is: the policy of an environment, single or vector.

    Args:
        policy: Class of the policy of one world.
    """

    def make(env: Environment) -> Callable[[Any], Any]:
        """Return the policy of an environment."""
        base = env.unwrapped
        return ScriptedWorlds(base, policy) if isinstance(base, SoftVectorEnv) else policy(env)

    return make


class ScriptedWorlds:
    """A scripted policy in every world of a vector environment; it notices by itself when an episode begins.

    Args:
        env: The environment.
        policy: Class of the policy.
    """

    def __init__(self, env: SoftVectorEnv, policy: type[ScriptedPolicy]) -> None:
        """Make a policy per world."""
        self._task = env.task
        self._policies = [policy(env, world=world) for world in range(env.num_envs)]

    def __call__(self, observation: object = None) -> NDArray[np.float32]:
        """Return the actions for the present state, shape (num_envs, action_size)."""
        for policy, elapsed in zip(self._policies, self._task.episodes.elapsed.numpy(), strict=True):
            if elapsed == 0:
                policy.reset()
        return np.stack([policy() for policy in self._policies])
