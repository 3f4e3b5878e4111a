"""The scripted policy of PlaceInBin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softmode.envs.scripted import Environment, ScriptedPolicy, Vector, bounded
from softmode.envs.scripted_grasp import ScriptedGrasp
from softmode.envs.tasks.place_in_bin.kernels import Metric
from softmode.envs.tasks.place_in_bin.task import PlaceInBin


class ScriptedPlace(ScriptedPolicy):
    """Grasp the toy, carry it over the rim to where the bin has most room, lower it, let go, rise.

    It is let go as soon as fingers or toy are about to meet what lies in the bin. A toy that slips on the way is
    grasped again where it comes to rest. Of several toys one is placed after another.

    Args:
        env: A PlaceInBin environment, wrapped or not.
        world: Which world of a vector environment.
        squeeze: Force of each finger as a multiple of the least that friction needs to carry the weight.
        speed: Tool travel per control step with the toy [m].

    Raises:
        ConfigError: If the environment is another one, or its actions are not tool steps.
    """

    CLEARANCE = 0.012
    """Between the rim and what is carried over it [m]."""
    GAP = 0.006
    """Between what lies in the bin and the finger tips or the toy when it is let go [m]."""
    NEAR = 0.006
    """Horizontal distance from the chosen place at which lowering begins [m]."""
    SPREAD = 0.02
    """By how much the fingers open to let go [m]."""
    RISE = 0.07
    """How far over the rim the tool ends [m]."""
    WALL = 0.045
    """Least distance of the chosen place from the walls [m]: room for the fingers."""

    task_class = PlaceInBin
    task: PlaceInBin

    def __init__(self, env: Environment, *, world: int = 0, squeeze: float = 5.0, speed: float = 0.010) -> None:
        """Remember the environment and plan nothing yet."""
        super().__init__(env, world=world)
        self._grasp, self._speed = ScriptedGrasp(env, self._carry, squeeze=squeeze, world=world), speed
        self.reset()

    def reset(self) -> None:
        """Forget the episode; call after ``env.reset``."""
        self._grasp.reset()
        self._place: Vector | None = None
        self._above = self._arrived = False
        self._opening: float | None = None
        self._grip = 0.0
        self._chosen = False

    @property
    def trouble(self) -> str:
        """Why no grasp fits any more where the object lies now; empty while one does."""
        return self._grasp.trouble

    def __call__(self, observation: object = None) -> NDArray[np.float32]:
        """Return the action for the present state."""
        if not self._chosen:
            self.target = self._grasp.target = self._next()
            self._chosen = True
        if self._opening is None:
            action = self._grasp()
            if not self._grasp.holds:
                self._place, self._above, self._arrived = None, False, False
            if not self._arrived:
                return action
            self._grip = float(action[-1])
        return self._let_go()

    def _is_inside(self, slot: int) -> bool:
        """Return whether an object of the world is in the bin."""
        x = self.scene.object_position.numpy()[self.world, slot].astype(float)
        aside = np.abs(x[:2] - self.task.rim[:2]) - self.task.half
        return bool((aside <= 0.0).all()) and x[2] <= self.task.highest

    def _next(self) -> int:
        """Return the first toy that is not in the bin, the first of all if they are."""
        first = self.world * self.task.state.stride
        slots = [i - first for i in self.scene.occupancy.instances_of(self.world)]
        return next((s for s in slots if s < self.scene.occupancy.slots and not self._is_inside(s)), 0)

    def _let_go(self) -> NDArray[np.float32]:
        """Open far enough, then rise; start again if the toy ended up beside the bin."""
        measured = float(self.scene.controller.opening.numpy()[self.world])
        if self._opening is None:
            self._opening = min(measured + self.SPREAD, self.arm.gripper.stroke)
        missing = self.task.rim[2] + self.RISE - self.tool[2]
        opened = measured > self._opening - 0.002
        if not opened:
            self._grip = min(self._grip + 0.1, 1.0)
        elif missing < 0.01 and self.task.metrics.numpy()[self.world, Metric.bin_distance] > 0.0:
            self.reset()
        return self.action(np.array([0.0, 0.0, np.clip(missing, 0.0, self._speed) * opened]), 0.0, self._grip)

    def _carry(self, centre: Vector) -> Vector:
        """Return the next move of the held toy: up, across once it clears the rim, down over its place."""
        points = self.surfaces()
        lowest = min(float(points[0][:, 2].min()), float(self.tool[2]) - 0.5 * self.arm.gripper.pad_size[2])
        if self._place is None:
            self._place = self._roomiest()
        aside = self._place - centre[:2]
        self._above = self._above or bool(np.linalg.norm(aside) < self.NEAR)
        up = self.task.rim[2] + self.CLEARANCE - lowest
        if self._above:
            inside = [x for x in points[1:] if self._over_bin(x.mean(axis=0))]
            top = max((float(x[:, 2].max()) for x in inside), default=self.task.config.bin.floor)
            up = top + self.GAP - lowest
            self._arrived = up > -0.002
        way = np.array([*aside, up])
        if not self._above and up > 0.004:
            way[:2] = 0.0
        return bounded(way, self._speed)

    def _roomiest(self) -> Vector:
        """Return the place in the bin that is farthest from the other objects."""
        task = self.task
        others = np.array([x.mean(axis=0)[:2] for x in self.surfaces()[1:] if self._over_bin(x.mean(axis=0))])
        span = [np.linspace(-1.0, 1.0, 9) * max(half - self.WALL, 0.0) for half in task.half]
        grid = np.stack(np.meshgrid(*span), axis=-1).reshape(-1, 2) + np.array(task.rim[:2])
        if not len(others):
            return np.array(task.rim[:2])
        away = np.linalg.norm(grid[:, None] - others[None], axis=2).min(axis=1)
        return grid[away.argmax()]

    def _over_bin(self, x: Vector) -> bool:
        """Return whether a point lies over the bin, walls included."""
        return bool((np.abs(x[:2] - self.task.rim[:2]) <= np.array(self.task.half) + self.task.wall).all())
