"""How gently the objects of a task are handled: peaks over all substeps of an episode, drops and slips, and limits."""

from __future__ import annotations

from typing import Any

import warp as wp

from softmode.deformables.model.declare import launch
from softmode.deformables.model.structs import filled
from softmode.envs import handling_kernels as kernels
from softmode.errors import ConfigError
from softmode.robots.jaws import ParallelJaw
from softmode.scenes.table_scene import TableScene

HANDLED = tuple(kernels.Handled.__members__)
"""Names of the figures."""


class Handling:
    """Figures of the episode of every world, kept on the device; `TableScene.after_substep` feeds them.

    The force is that of a link or finger on all soft bodies together, so what a finger presses on the table with is no
    part of it. Forces are looked at after every substep, deformation after every fourth, of which the last is one: it
    costs more. Strains and energies are those of the objects of the task (`Occupancy.slots`), at cubature points.

    Args:
        scene: The scene.
        friction: Column of the parameters that holds the objects' friction.
        strain_limit: Largest principal strain of a safe success.
        force_limit: Largest contact force of a safe success [N]; None for 15 N, or three times the force of each finger
            that holds the heaviest object's weight by friction, if that is more.
        care: What the reward loses for roughness, see `TaskConfig.care`.
        gentle: Column of that term of the reward, -1 for none.
        terminates: Whether a peak beyond its limit ends the episode.

    Attributes:
        handled: `HANDLED`, shape (world_count, 5): contact force [N], principal strain and energy density [J/m^3] at
            their peaks, and counts of drops and slips.
        safe: Whether the task is solved and no peak is above its limit.
        force_limit: The limit of each world [N].
        at_goal: Which objects may be let go where they are, a bit each; the task's `evaluate` writes it.
    """

    def __init__(
        self,
        scene: TableScene,
        friction: int,
        *,
        strain_limit: float,
        force_limit: float | None,
        care: float = 0.0,
        gentle: int = -1,
        terminates: bool = False,
    ) -> None:
        """Allocate the figures and watch the scene."""
        worlds, device = scene.world_count, scene.device
        self._device, self._worlds = device, worlds
        self._read = (scene.solver.tables.instances, scene.model.gravity)
        try:
            pads = ParallelJaw.of(scene.config.arm).friction
        except ConfigError:  # a robot without a gripper holds nothing
            pads = 1.0
        limit = -1.0 if force_limit is None else force_limit
        self._limits = (strain_limit, limit, pads, friction, care, gentle, int(terminates))
        self.handled = wp.zeros((worlds, len(HANDLED)), dtype=float, device=device)
        self.safe = wp.zeros(worlds, dtype=wp.bool, device=device)
        self.step_force, self.step_strain, self.force_limit, self.height = (
            wp.zeros(worlds, dtype=float, device=device) for _ in range(4)
        )
        self.at_goal = wp.zeros(worlds, dtype=int, device=device)
        self.held_slot, self.falling_slot = (wp.full(worlds, -1, dtype=int, device=device) for _ in range(2))
        self.grip = wp.zeros(worlds, dtype=wp.vec3, device=device)
        self._kept = filled(kernels.Handling, self)
        scene.after_substep = self.watch  # which keeps no scene: environments are freed by counting references

    def state_arrays(self) -> dict[str, wp.array]:
        """Return what an episode goes on from."""
        return {f"handling.{name}": getattr(self, name) for name in kernels.Handling.vars}

    def watch(self, scene: TableScene, substep: int) -> None:
        """Raise the peaks after a substep of the scene."""
        tables = scene.solver.tables
        fingers = (scene.model.body_world_start, tables.body_wrench, scene.finger_body)
        given = (int(substep == 0), *fingers, self.step_force, self.step_strain)
        launch(scene.device, kernels.watch_forces, scene.world_count, *given)
        if (scene.config.substeps - 1 - substep) % 4 == 0:
            dim = (scene.world_count, scene.occupancy.slots, tables.layout.point_max)
            bodies = (len(scene.objects), tables.instances, tables.basis, tables.arrays.q)
            launch(scene.device, kernels.watch_deformation, dim, *bodies, self.handled, self.step_strain)

    def judge(self, fresh: wp.array, state: Any, result: Any) -> None:
        """Take note of a control step that the task has judged, and say whether its success is safe.

        Args:
            fresh: Worlds whose step was a reset.
            state: `WorldState`.
            result: `StepResult`.
        """
        given = (fresh, *self._limits, state, result, *self._read, self._kept)
        launch(self._device, kernels.judge, self._worlds, *given)

    def forget(self, world_mask: wp.array) -> None:
        """Begin the episodes of the masked worlds."""
        launch(self._device, kernels.forget_handling, self._worlds, world_mask, self._kept)
