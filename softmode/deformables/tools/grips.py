"""Grips: parts of a soft body that are taken hold of, moved and let go while a captured step runs.

A grip is made of pins (see ``authoring``) whose slots are in the model from the start, idle and at no cost; taking hold
writes their rest points and basis rows into the solver's tables. A grip that *holds* is stiff and keeps the shape that
the part has when it is taken; one that *pulls* is one point on a damped spring.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_fields, require_number
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.model.authoring import add_pins
from softmode.deformables.model.namespaces import soft
from softmode.deformables.model.tables import allocate
from softmode.deformables.solver.solver_base import ReducedSolver, require_reduced
from softmode.deformables.tools import grip_kernels as kernels
from softmode.errors import ConfigError

Array = NDArray[np.float64]
_IDENTITY = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class GripOptions:
    """How stiff grips are; they follow the body's material, mass and the gravity of the moment."""

    pull_stiffness: float = 0.25
    """Stiffness of a grip that pulls, over E times the body's size."""
    pull_rate: float = 250.0
    """It is no stiffer than the mass times the square of this [1/s],"""
    pull_sag: float = 0.05
    """but stiff enough to carry the weight at this fraction of the size. Its damping is critical for the mass."""
    pull_force: float = 0.1
    """Largest force of a pull, over E times the size squared; the weight over `pull_sag` comes on top."""
    hold_stiffness: float = 60.0
    """Stiffness of a grip that holds, over E times the body's size,"""
    hold_sag: float = 1.0e-4
    """but stiff enough to carry the weight at this fraction of the size."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_fields(self, vars(self), above=0.0)


@dataclass(frozen=True, kw_only=True)
class Grip:
    """What is held."""

    rest_points: Array
    """Rest points of the body, at its scale 1, in the body frame [m], shape (n, 3)."""
    rows: Array
    """Functions at these points, shape (n, function_count)."""
    offsets: Array
    """Where they are to be, relative to the grip's position and before it turns [m], shape (n, 3)."""
    pulls: bool
    """Whether it is a damped spring; else it holds."""


def add_grip_slots(builder: newton.ModelBuilder, instance: int, count: int) -> None:
    """Keep pins of a body free for grips; call it before the next body is added, and after the body's own pins.

    Args:
        builder: Builder that holds the instance.
        instance: Index from :func:`softmode.deformables.model.authoring.add_reduced_body`.
        count: Points that may be gripped at a time, over all grips.

    Raises:
        ConfigError: If the count is below 1.
    """
    require_number("count", count, at_least=1, hint="give the points gripped at a time")
    add_pins(builder, instance, np.zeros((count, 3)), stiffness=0.0)


class Grips:
    """The grips of one instance; make it before the step is captured, and `apply` it before every physics step.

    What takes hold, moves or lets go is called between launches of the captured graph. A reset of the solver does not
    let go. Idle slots cost nothing: they lie behind the pins that the instance counts.

    Args:
        solver: A :class:`softmode.deformables.solver.solver_reduced.SolverReduced`, or a solver that couples one.
        instance: Index of the instance in the model.
        slot_count: What :func:`add_grip_slots` was given.
        grip_max: Grips at a time.
        options: How stiff they are.

    Raises:
        ConfigError: If the last pins of the instance are not that many slots.
    """

    def __init__(
        self,
        solver: ReducedSolver,
        instance: int,
        *,
        slot_count: int,
        grip_max: int = 66,
        options: GripOptions | None = None,
    ) -> None:
        """Find the slots and take them out of use."""
        self.solver = require_reduced(solver)
        self._view, self._tables = solver.view, solver.tables
        layout, instances, device = self._view.layout, self._view.instances, solver.model.device
        self.instance, self.slot_count, self.grip_max = instance, slot_count, grip_max
        pins = int(instances.pin_count.numpy()[instance]) if 0 <= instance < layout.instance_count else 0
        if not 0 < slot_count <= pins:
            raise ConfigError(
                f"instance {instance} has {pins} pins, not {slot_count} slots", hint="call add_grip_slots for it"
            )
        self.first_slot = pins - slot_count
        self.body: ReducedBody = layout.bodies[layout.asset[instance]]
        first = int(instances.pin_start.numpy()[instance]) + self.first_slot
        if solver.parameters.pin_stiffness.numpy()[first : first + slot_count].any():
            raise ConfigError("the last pins of the instance are no slots", hint="add slots after its other pins")
        self.strength = kernels.GripStrength()
        for name, value in vars(options or GripOptions()).items():
            setattr(self.strength, name, float(value))
        axes, turns = {"": "grip", "remaining": "1", "grip offset share": "slot"}, ("rotation", "goal_rotation")
        sizes, identity = {"grip": grip_max, "slot": slot_count}, np.tile(_IDENTITY, (grip_max, 1))
        self.table = allocate(kernels.GripTable, axes, sizes, device, given=dict.fromkeys(turns, identity))
        self._held: dict[int, Grip] = {}
        self._write_slots()

    # -- in the step --------------------------------------------------------------------------------------------------

    def apply(self, state: newton.State, control: newton.Control, dt: float) -> None:
        """Move the grips and say where their points shall be at the end of the step from `state`; capturable.

        Args:
            state: State that the step starts from.
            control: Control of the step; it carries the targets.
            dt: Physics step [s].
        """
        t, first = self._tables, (self.instance, self.first_slot, self._view.layout.first_pin_row)
        t.launch(kernels.move_grips, self.grip_max, self.table)
        bodies, out = (t.instances, t.basis), (t.parameters.pin_stiffness, soft(control).pin_target)
        now = (wp.float64(dt), soft(state).q, self.table)
        gravity = t.model.gravity
        t.launch(kernels.write_pins, self.slot_count, *bodies, gravity, self.strength, *first, *now, *out)

    # -- between launches ---------------------------------------------------------------------------------------------

    @property
    def held(self) -> dict[int, Grip]:
        """The grips by number, in the order of their slots."""
        return dict(self._held)

    def take(self, rest_points: ArrayLike, state: newton.State, *, pulls: bool = False) -> int:
        """Take hold of points of the body where they are now.

        Args:
            rest_points: In the body frame, at scale 1 [m], shape (n, 3); they share the grip's stiffness.
            state: The present state.
            pulls: Whether the grip pulls, one point on a damped spring, or holds.

        Returns:
            Number of the grip. Its position is the mean of the points.

        Raises:
            ConfigError: If the points are not finite, or more than there is room for, or there are too many grips.
        """
        X = np.asarray(rest_points, dtype=np.float64)
        if X.ndim != 2 or X.shape[1] != 3 or not len(X) or not np.isfinite(X).all() or (pulls and len(X) != 1):
            raise ConfigError(f"rest_points must be finite, shape (n > 0, 3), one for a pull, got {X.shape}")
        left = self.slot_count - sum(len(grip.offsets) for grip in self._held.values())
        if len(self._held) >= self.grip_max or len(X) > left:
            raise ConfigError(f"no room for a grip of {len(X)} points, {left} are left", hint="let go of another")
        rows = self._rows(X)
        x = X + rows @ self._coordinates(state)
        centre = x.mean(axis=0)
        return self._hold(Grip(rest_points=X, rows=rows, offsets=x - centre, pulls=pulls), centre, _IDENTITY)

    def restore(self, grip: Grip, position: ArrayLike, rotation: Sequence[float] = _IDENTITY) -> int:
        """Take a grip up again on this body, which may be another build of the same asset.

        Args:
            grip: What `held` had.
            position: Its position [m], shape (3,).
            rotation: Its rotation, quaternion (x, y, z, w).

        Returns:
            Number of the grip.
        """
        grip = replace(grip, rows=self._rows(grip.rest_points))
        return self._hold(grip, np.asarray(position, float), rotation)

    def let_go(self, grip: int) -> None:
        """Let go of a grip.

        Raises:
            ConfigError: If there is none of that number.
        """
        self._checked(grip)
        del self._held[grip]
        self._write_slots()

    def let_go_all(self) -> None:
        """Let go of everything."""
        self._held.clear()
        self._write_slots()

    def aim(self, grip: int, position: ArrayLike, rotation: Sequence[float] | None = None) -> None:
        """Say where a grip shall be at the end of the frame.

        Args:
            grip: Its number.
            position: Where [m], shape (3,).
            rotation: How it is turned since it was taken, quaternion (x, y, z, w); None leaves the goal as it is.

        Raises:
            ConfigError: If there is none of that number.
        """
        self._checked(grip)
        self.table.goal_position[grip : grip + 1].assign(np.asarray(position, np.float64)[None])
        if rotation is not None:
            self.table.goal_rotation[grip : grip + 1].assign(np.asarray(rotation, np.float64)[None])

    def begin_frame(self, step_count: int) -> None:
        """Let the next so many steps take the grips to their goals."""
        self.table.remaining.fill_(step_count)

    # -- reading ------------------------------------------------------------------------------------------------------

    def pose(self, grip: int, *, goal: bool = False) -> tuple[Array, Array]:
        """Return where a grip is, or shall be: position [m] (3,) and quaternion (x, y, z, w), (4,)."""
        self._checked(grip)
        table = self.table
        place, turn = (table.goal_position, table.goal_rotation) if goal else (table.position, table.rotation)
        return place.numpy()[grip].astype(np.float64), turn.numpy()[grip].astype(np.float64)

    def points(self, grip: int, state: newton.State) -> Array:
        """Return where the points of a grip are [m], shape (n, 3)."""
        held = self._checked(grip)
        return held.rest_points + held.rows @ self._coordinates(state)

    def targets(self, grip: int) -> Array:
        """Return where the points of a grip should be [m], shape (n, 3)."""
        held = self._checked(grip)
        position, (x, y, z, w) = self.pose(grip)
        axis = np.array([x, y, z])
        cross = np.cross(axis, held.offsets)
        return position + held.offsets + 2.0 * (w * cross + np.cross(axis, cross))

    def force(self, grip: int) -> Array:
        """Return the force of a grip on the body at the end of the last step [N], shape (3,)."""
        first = self.first_slot
        for number, held in self._held.items():
            if number == grip:
                rows = self._view.constraints.force[self.instance]
                return rows.numpy()[first : first + len(held.offsets)].sum(axis=0)
            first += len(held.offsets)
        self._checked(grip)
        return np.zeros(3)

    # -- inside -------------------------------------------------------------------------------------------------------

    def _checked(self, grip: int) -> Grip:
        if grip not in self._held:
            raise ConfigError(f"there is no grip {grip}", hint=f"there are {sorted(self._held)}")
        return self._held[grip]

    def _coordinates(self, state: newton.State) -> Array:
        """Return the reduced coordinates of the instance [m], shape (n, 3)."""
        start = int(self._view.instances.function_start.numpy()[self.instance])
        q = soft(state).q[start : start + self.body.function_count]
        return q.numpy().astype(np.float64)

    def _rows(self, rest_points: Array) -> Array:
        """Return the functions at rest points, shape (n, function_count), as the solver's float32 has them."""
        return self.body.evaluate(rest_points)[0].astype(np.float32).astype(np.float64)

    def _hold(self, grip: Grip, position: Array, rotation: Sequence[float]) -> int:
        """Put a grip where it starts, at rest, under the first number that is free; return that."""
        number = next(g for g in range(self.grip_max) if g not in self._held)
        self._held[number] = grip
        table, turn = self.table, np.asarray(rotation, np.float64)[None]
        for arrays, value in (
            ((table.position, table.goal_position), position[None]),
            ((table.rotation, table.goal_rotation), turn),
        ):
            for array in arrays:
                array[number : number + 1].assign(value)
        self._write_slots()
        return number

    def _write_slots(self) -> None:
        """Write the points of all grips, one after another, into the tables of pins."""
        table = self.table
        kind = np.zeros(self.grip_max, np.int32)
        owner, share = np.zeros(self.slot_count, np.int32), np.zeros(self.slot_count, np.float32)
        rest, offset = np.zeros((self.slot_count, 3)), np.zeros((self.slot_count, 3))
        rows = np.zeros((self.slot_count, self.body.function_count), np.float32)
        at = 0
        for number, grip in self._held.items():
            mine = slice(at, at + len(grip.offsets))
            kind[number] = int(kernels.PULL) if grip.pulls else int(kernels.HOLD)
            owner[mine], share[mine] = number, 1.0 / len(grip.offsets)
            rest[mine], offset[mine] = grip.rest_points, grip.offsets
            rows[mine] = grip.rows
            at = mine.stop
        for array, values in ((table.kind, kind), (table.grip, owner), (table.share, share), (table.offset, offset)):
            array.assign(values)
        self.solver.write_pins(self.instance, self.first_slot, rows, rest, self.first_slot + at)
