"""Sensors of contact: forces on links, pressure on soft surfaces, wrenches of attachments.

All read the point constraints of the solver's last step: ``update()`` after a step launches kernels on preallocated
arrays, reads nothing back and may be captured with the step. Sums run in a fixed order, so that the readings of a
world do not depend on the others. A reset of the solver clears what the next ``update()`` reads.

Forces are the means over the step, of the time at its end; points and levers are those of its start, where the solver
applies them. Frames are the world's.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from fnmatch import fnmatchcase

import numpy as np
import warp as wp

from softmode.deformables.model.tables import allocate, host
from softmode.deformables.solver.attachments import Attachment
from softmode.deformables.solver.solver_base import ReducedSolver, require_reduced
from softmode.deformables.solver.step_view import StepView
from softmode.deformables.tools import sensing_kernels as kernels
from softmode.errors import ConfigError


class ContactSensor:
    """Contact of rigid bodies ("links") with soft bodies, after the model of ``newton.sensors.SensorContact``.

    ``*_matrix`` are per link and soft body, shape (world_count, link_count, soft_count); ``total_*`` of all soft bodies
    of the world, shape (world_count, link_count). Attachments are no contact, see :class:`ForceTorqueSensor`: with
    them, ``total_force`` and ``total_torque`` make up the solver's ``body_wrench``.

    Args:
        solver: A :class:`softmode.deformables.solver.solver_reduced.SolverReduced`, or a solver that couples one.
        bodies: Which links: label patterns ("*/finger_*") or indices of rigid bodies in the builder of one world; -1
            is the world, all fixed shapes together. Default: every rigid body of a world.
        soft: Which soft bodies have a column: indices from
            :func:`softmode.deformables.model.authoring.add_reduced_body`. Default: all of a world.

    Attributes:
        bodies: Index of each link in its world.
        soft: Index of the soft body of each column.
        force_matrix, total_force: Force on the link [N], vec3.
        force_matrix_friction, total_force_friction: Its tangential part [N], vec3.
        torque_matrix, total_torque: Torque about the link's centre of mass [N m], vec3; about the origin for the world.
        position_matrix, total_position: Centre of pressure [m], the mean position weighted by normal force, vec3; zero
            without contact.
        normal_matrix, total_normal: Mean normal out of the link weighted by normal force, a unit vec3; zero without
            contact.
        area_matrix, total_area: Area of the patch [m^2]: of the surface samples that are pressed.

    Raises:
        ConfigError: If nothing matches, an index does not exist in some world, or one is given twice.
    """

    def __init__(
        self,
        solver: ReducedSolver,
        bodies: str | Sequence[str | int] | None = None,
        *,
        soft: Sequence[int] | None = None,
    ) -> None:
        """Find the links and allocate the readings."""
        self._tables, self._view = require_reduced(solver).tables, solver.view
        device, worlds = solver.model.device, solver.world_count
        starts, count = _body_ranges(solver)
        labels = solver.model.body_label[starts[0] : starts[0] + count]
        self.bodies = _matching(labels, bodies)
        self.soft = _soft_bodies(self._view, soft)
        local = np.array(self.bodies)[None]
        self._link_body = wp.array(np.where(local < 0, -1, local + starts[:, None]), dtype=int, device=device)
        self._soft = wp.array(self.soft, dtype=int, device=device)
        links = len(self.bodies)
        self._matrix = _readings((worlds, links, len(self.soft)), device)
        self._total = _readings((worlds, links, 1), device)
        matrix, total = self._matrix, self._total
        self.force_matrix, self.force_matrix_friction = matrix.force, matrix.friction
        self.torque_matrix, self.position_matrix = matrix.torque, matrix.position
        self.normal_matrix, self.area_matrix = matrix.normal, matrix.area
        shape = (worlds, links)
        self.total_force, self.total_force_friction = total.force.reshape(shape), total.friction.reshape(shape)
        self.total_torque, self.total_position = total.torque.reshape(shape), total.position.reshape(shape)
        self.total_normal, self.total_area = total.normal.reshape(shape), total.area.reshape(shape)

    def update(self) -> None:
        """Read the contacts of the last step."""
        dim = (*self.total_force.shape, len(self.soft) + 1)
        given = (self._link_body, self._soft, self._matrix, self._total)
        self._tables.launch(kernels.read_contacts, dim, *self._view.last_step(), *given)


class SurfacePressure:
    """Pressure on the surface samples of a soft body, and its contact with everything.

    sum_k s^2 area_k (pressure_k normal_k + traction_k) = total_force, s the body's scale. Where two soft bodies touch,
    each sample of either finds the surface of the other: what it presses there between samples counts for the nearest
    that faces it. Contact of the body with itself puts no force on it and is not sensed.

    Args:
        solver: As for :class:`ContactSensor`.
        soft: Index from :func:`softmode.deformables.model.authoring.add_reduced_body`.

    Attributes:
        pressure: Normal force over area [Pa] per sample, shape (world_count, sample_count).
        traction: Friction force over area [Pa] on the sample, vec3, shape (world_count, sample_count).
        normal: Direction of the normal force on the sample, into the body, shape (world_count, sample_count); zero
            where nothing presses.
        area: Area of each sample of the asset [m^2], NumPy, shape (sample_count,); a body of scale s has s^2 of it.
        total_force: Contact force on the body [N], vec3, shape (world_count,), as all that follow.
        total_force_friction: Its tangential part [N].
        total_torque: Its torque about the body's centre of mass [N m].
        total_position: Centre of pressure [m]; zero without contact.
        total_normal: Mean normal into the body, weighted by normal force; zero without contact.
        total_area: Area of the contact patch [m^2], the sum of the areas with pressure > 0.

    Raises:
        ConfigError: If a world has no such soft body, or worlds differ in it.
    """

    def __init__(self, solver: ReducedSolver, soft: int = 0) -> None:
        """Allocate the samples."""
        self._tables, self._view = require_reduced(solver).tables, solver.view
        view = self._view
        (self.soft,) = _soft_bodies(view, [soft])
        layout, device, worlds = view.layout, solver.model.device, solver.world_count
        assets = layout.asset[layout.instance_start[:-1] + soft]
        if np.ptp(assets):
            raise ConfigError(f"soft body {soft} is not the same in every world", hint="replicate one builder")
        self.area = layout.bodies[assets[0]].surface.areas.copy()
        shape = (worlds, len(self.area))
        self._normal_force, self._friction = (wp.zeros(shape, dtype=wp.vec3d, device=device) for _ in range(2))
        self._surface_normal = None if view.pairs is None else view.pairs.surface_normal
        self._sample = wp.zeros((worlds, view.constraint_max), dtype=int, device=device)
        self.pressure = wp.zeros(shape, dtype=float, device=device)
        self.traction, self.normal = (wp.zeros(shape, dtype=wp.vec3, device=device) for _ in range(2))
        self._patch = patch = _readings((worlds, 1, 1), device)
        self.total_force, self.total_force_friction = patch.force.reshape(worlds), patch.friction.reshape(worlds)
        self.total_torque, self.total_position = patch.torque.reshape(worlds), patch.position.reshape(worlds)
        self.total_normal, self.total_area = patch.normal.reshape(worlds), patch.area.reshape(worlds)

    def update(self) -> None:
        """Read the contacts of the last step."""
        view, launch = self._view, self._tables.launch
        step, sums = (*view.last_step(), self.soft), (self._normal_force, self._friction)
        for array in sums:
            array.zero_()
        surface = (view.samples.position, self._surface_normal, self._sample)
        launch(kernels.find_samples, self._sample.shape, *step, *surface)
        launch(kernels.gather_pressure, self._sample.shape[0], *step, self._sample, *sums, self._patch)
        bodies, out = (view.instances, view.basis, view.instance_start), (self.pressure, self.traction, self.normal)
        launch(kernels.spread_pressure, self.pressure.shape, *bodies, self.soft, *sums, *out)


class ForceTorqueSensor:
    """Wrench that soft parts put on what holds them: a force-torque sensor in the glue of each attachment.

    Args:
        solver: As for :class:`ContactSensor`.
        attachments: What :func:`softmode.deformables.solver.attachments.attach` returned.

    Attributes:
        force: Force on the link or the world [N], vec3, shape (world_count, attachment_count); zero while released.
        torque: Its torque [N m] about the centre of mass of the link, about the origin for the world; likewise.

    Raises:
        ConfigError: If there is no attachment, or a world has no such soft body or pins.
    """

    def __init__(self, solver: ReducedSolver, attachments: Sequence[Attachment]) -> None:
        """Allocate the readings."""
        self._tables, self._view = require_reduced(solver).tables, solver.view
        view = self._view
        self.attachments = tuple(attachments)
        if not self.attachments:
            raise ConfigError("attachments is empty", hint="pass what attach returned")
        _soft_bodies(view, sorted({a.instance for a in self.attachments}))
        pins = view.instances.pin_count.numpy()
        for a in self.attachments:
            if (pins[view.layout.instance_start[:-1] + a.instance] < a.first + a.count).any():
                raise ConfigError(
                    f"soft body {a.instance} has no pins {a.first}..{a.first + a.count - 1}",
                    hint="pass attachments of this model",
                )
        device, shape = solver.model.device, (solver.world_count, len(self.attachments))
        self._where = [
            wp.array([getattr(a, name) for a in self.attachments], dtype=int, device=device)
            for name in ("instance", "first", "count")
        ]
        self.force, self.torque = (wp.zeros(shape, dtype=wp.vec3, device=device) for _ in range(2))

    def update(self) -> None:
        """Read the pins of the last step."""
        given = (*self._view.last_step(), *self._where, self.force, self.torque)
        self._tables.launch(kernels.read_attachments, self.force.shape, *given)


def _readings(shape: tuple[int, int, int], device: wp.Device) -> kernels.Readings:
    """Return readings of zero."""
    return allocate(
        kernels.Readings, "world link soft", dict(zip(("world", "link", "soft"), shape, strict=True)), device
    )


def _body_ranges(solver: ReducedSolver) -> tuple[np.ndarray, int]:
    """Return the first rigid body of each world, and how many every world has at least."""
    model, worlds = solver.model, solver.world_count
    if worlds == 1:
        return np.zeros(1, int), model.body_count
    starts = host(model.body_world_start)[: worlds + 1]
    return starts[:-1], int(np.diff(starts).min())


def _matching(labels: Sequence[str], wanted: str | Sequence[str | int] | None) -> tuple[int, ...]:
    """Return the indices of the bodies that label patterns or indices choose, in the order given."""
    if wanted is None:
        wanted = range(len(labels))
    chosen: list[int] = []
    for item in [wanted] if isinstance(wanted, str) else wanted:
        if isinstance(item, str):
            found = [b for b, label in enumerate(labels) if fnmatchcase(label, item)]
            if not found:
                near = difflib.get_close_matches(item, labels, cutoff=0.3) or list(labels[:8])
                raise ConfigError(f"no rigid body matches {item!r}", hint=f"there are for example {near}")
            chosen += found
        elif not -1 <= item < len(labels):
            raise ConfigError(f"bodies: {item} lies outside -1..{len(labels) - 1}", hint="count within one world")
        else:
            chosen.append(int(item))
    if not chosen:
        raise ConfigError("bodies chooses no rigid body", hint="pass -1 for the fixed shapes of the world")
    if len(set(chosen)) < len(chosen):
        raise ConfigError(f"bodies chooses one rigid body twice: {chosen}")
    return tuple(chosen)


def _soft_bodies(view: StepView, wanted: Sequence[int] | None) -> tuple[int, ...]:
    """Return the indices of soft bodies that exist in every world."""
    least = view.bodies_per_world()
    chosen = tuple(range(least)) if wanted is None else tuple(int(s) for s in wanted)
    if not chosen or len(set(chosen)) < len(chosen) or min(chosen) < 0 or max(chosen) >= least:
        raise ConfigError(
            f"soft must hold different indices in 0..{least - 1}, got {list(chosen)}", hint="count within one world"
        )
    return chosen
