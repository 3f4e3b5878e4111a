"""How the scripted policies take hold of an object."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.deformables.reduction.body_modes import surface_modes
from softmode.envs.reward_kernels import TOUCH_FORCE
from softmode.envs.scripted import Environment, ScriptedPolicy, Vector, bounded
from softmode.errors import GraspError
from softmode.objects.soft_object import SoftObject
from softmode.robots.grasp_planner import Grasp, plan_grasps
from softmode.robots.jaws import ParallelJaw
from softmode.robots.table_robot import TableRobot


@functools.lru_cache(maxsize=64)
def _modes(thing: SoftObject) -> Vector:
    """Return the elastic modes at an object's surface samples, the same for all worlds that have it."""
    return surface_modes(thing.body)


class ScriptedGrasp(ScriptedPolicy):
    """Take the object: align above it, go down, close until it is held, move on with it, try again if it slips.

    The grasp is the best that :func:`softmode.robots.plan_grasps` finds where the object is. The squeeze is regulated
    on the measured finger forces, because one opening means another force for every stiffness. An object that topples
    or rolls is waited for, and planned anew where it comes to rest; a failed attempt is followed by the next best one.

    Args:
        env: An environment in pose_delta mode.
        way: From the centre of the held object [m] to its next move [m], both of shape (3,).
        squeeze: Force of each finger as a multiple of the least that friction needs to carry the weight.
        least_force: But at least this force [N].
        world: Which world of a vector environment.
    """

    CLEARANCE = 0.08
    """Height above the grasp from which the gripper goes down [m]."""
    DESCENT = 0.010
    """Way of the tool per control step while it goes down [m]."""
    STILL = 0.02
    """Speed of the object's centre of mass under which it counts as at rest [m/s]."""
    MOVED = 0.004
    """Displacement of its centre of mass that calls for a new plan [m]."""
    PATIENCE = 30
    """Control steps after which closing goes on to the lift, or is given up."""

    def __init__(
        self,
        env: Environment,
        way: Callable[[Vector], Vector],
        *,
        squeeze: float = 5.0,
        least_force: float = 1.5,
        world: int = 0,
    ) -> None:
        """Remember the environment and plan nothing yet."""
        super().__init__(env, world=world)
        self.trouble = ""
        """Why no grasp fits any more where the object lies now; empty while one does."""
        self._way, self._squeeze, self._least_force = way, squeeze, least_force
        self._jaw = ParallelJaw.of(self.arm)
        self.reset()

    def reset(self) -> None:
        """Forget the episode; call after ``env.reset``."""
        self._attempts, self._grip, self.trouble = 0, 1.0, ""
        self._grasp: Grasp | None = None
        self._again()

    def _again(self) -> None:
        """Begin an attempt: the next plan is made where the object comes to rest."""
        self._start("align")
        self._planned_at = np.full(3, np.inf)

    @property
    def holds(self) -> bool:
        """Whether the object is held and moved."""
        return self._phase == "lift"

    def _start(self, phase: str) -> None:
        """Enter a phase."""
        self._phase, self._elapsed, self._count = phase, 0, 0

    def __call__(self, observation: object = None) -> NDArray[np.float32]:
        """Return the action for the present state.

        Raises:
            GraspError: If no grasp of the object fits when the episode begins; nothing has moved then.
        """
        centre, tool, force = self.centre, self.tool, self.weaker_force
        still = np.linalg.norm(self.velocity) < self.STILL
        waits = self._phase in ("align", "descend")
        moved = waits and bool(np.linalg.norm(centre - self._planned_at) > self.MOVED)
        if moved and (still or self._grasp is None):
            self._grasp, self._planned_at, moved = self._plan(), centre, False
            self._start("align")
        if self._grasp is None:
            return self.action(np.zeros(3), 0.0, 1.0)
        place, turn = np.array(self._grasp.position), self._grasp.yaw - self.yaw
        self._elapsed += 1
        goal = place
        if self._phase == "align" or moved:
            self._grip = self.entry(self._grasp.opening)
            above = place + np.array([0.0, 0.0, self.CLEARANCE])
            low = tool[2] < above[2] - 0.02  # after a failed grasp: straight up first
            goal = np.array([*tool[:2], above[2]]) if low or moved else above
            if still and not moved and self._aligned(place, turn):
                self._start("descend")
        elif self._phase == "descend":
            goal = tool + bounded(place - tool, self.DESCENT)
            self._count += np.linalg.norm(place - tool) < 0.001
            if self._count > 4:
                self._start("close")
            elif self._elapsed > self.PATIENCE:  # something stands in the way
                goal = self._lost(tool)
        elif self._phase == "close":
            self._regulate(holding=0.02)
            wanted = self._wanted_force()
            self._count += force > 0.7 * wanted
            # What is very soft yields on and on: what carries it is enough.
            if self._count > 12 or (self._elapsed > self.PATIENCE and force > 0.5 * self._needed_force()):
                self._start("lift")
            elif self._elapsed > self.PATIENCE:
                goal = self._lost(tool)
        else:
            self._count = self._count + 1 if force < TOUCH_FORCE else 0
            self._regulate(holding=0.012)
            goal = tool + self._way(centre)
            if self._count > 8:
                goal = self._lost(tool)
        return self.action(goal - tool, turn, self._grip)

    def _aligned(self, place: Vector, turn: float) -> bool:
        """Return whether command and arm are above the grasp, turned and open as it asks for."""
        pose, opening = self.measured, float(self.scene.controller.opening.numpy()[self.world])
        aside = max(float(np.linalg.norm((place - x)[:2])) for x in (self.tool, pose))
        return (
            aside < 0.002
            and abs(turn) < 0.02
            and abs(opening - (self._grasp.opening if self._grasp else opening)) < 0.003
        )

    def _lost(self, tool: Vector) -> Vector:
        """Begin the next attempt; return where the tool stays meanwhile [m]."""
        self._attempts += 1
        self._again()
        return tool

    def _plan(self) -> Grasp | None:
        """Choose a grasp where the object is, another one after every failed attempt; None if none fits any more."""
        body, scale = self.soft.body, self.material("scale")
        points = self.surfaces()
        turn = Rotation.align_vectors(points[0] - points[0].mean(0), body.surface.points - body.surface.points.mean(0))[
            0
        ]
        stiffness = self.material("youngs_modulus") * scale
        modes = np.einsum("ab,sbm->sam", turn.as_matrix(), _modes(self.soft)) / np.sqrt(stiffness)
        try:
            found = plan_grasps(
                points[0],
                turn.apply(body.surface.normals),
                body.surface.areas * scale**2,
                self._jaw,
                friction=self._friction(),
                force=self._wanted_force(),
                weight=self._weight(),
                centre=self.centre,
                modes=modes,
                lowest=self.control.workspace_lower[2],
                obstacles=np.concatenate(points[1:]) if points[1:] else None,
                yaw=self.yaw,
            )
        except GraspError as error:
            if self._attempts or np.isfinite(self._planned_at).all():
                self.trouble = error.message
                return None
            raise
        self.trouble = ""
        found = [held for grasp in found if (held := self._held(grasp)) is not None] or found
        return found[self._attempts % len(found)]

    def _held(self, grasp: Grasp) -> Grasp | None:
        """Return a grasp that the arm reaches from above, with half a turn where it must; None if it does not."""
        if not isinstance(self.arm, TableRobot):
            return grasp
        place = np.array(grasp.position)
        yaw = self.arm.turn_at(np.array([place, [*place[:2], place[2] + self.CLEARANCE]]), grasp.yaw)
        return None if yaw is None else replace(grasp, yaw=yaw)

    def _weight(self) -> float:
        """Return the weight of the object [N]."""
        volume = self.soft.body.volume * self.material("scale") ** 3
        return self.material("density") * volume * 9.81

    def _friction(self) -> float:
        """Return the friction coefficient between object and pads."""
        return float(np.sqrt(self.material("friction") * self.arm.gripper.friction))

    def _needed_force(self) -> float:
        """Force of each finger that carries the weight by friction with a margin [N]."""
        return self._squeeze * 0.5 * self._weight() / max(self._friction(), 1.0e-3)

    def _wanted_force(self) -> float:
        """Force of each finger that is aimed at [N]."""
        return max(self._needed_force(), self._least_force)

    def _regulate(self, *, holding: float) -> None:
        """Close while the weaker finger feels too little, open while it feels too much."""
        self._grip = self.regulated(self._grip, self._wanted_force(), closing=0.06, holding=holding)
