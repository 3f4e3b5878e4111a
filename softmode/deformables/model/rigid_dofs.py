"""The joint dofs that are unknowns of the reduced solve, and where they stand in Newton's arrays."""

from typing import Any

import newton
import numpy as np
import warp as wp

from softmode.deformables.model.struct_kernels import Rigid


class RigidDofs:
    """Joint dofs that take part in the solve: per world r = dt * joint velocity and its quadratic model.

    Empty (``count_max`` 0) while rigid bodies move as prescribed; ``coupling`` fills one in.
    """

    def __init__(
        self, model: newton.Model, world_count: int, counts: np.ndarray, dof_start: np.ndarray, *, row_max: int = 0
    ) -> None:
        """Allocate for ``counts`` dofs per world, the first at ``dof_start``, and ``row_max`` constraint rows."""
        device = model.device
        self.count_max, self.row_max = int(counts.max(initial=0)), row_max
        size = max(self.count_max, 1)
        self.count = wp.array(counts, dtype=int, device=device)
        self.dof_count = wp.array(counts, dtype=int, device=device)
        """Joint dofs of a world, shape (world_count,); ``count`` is 0 while they take no part."""
        self.dof_start = wp.array(dof_start, dtype=int, device=device)
        self.inertia = wp.zeros((world_count, size, size), dtype=wp.float64, device=device)
        self.predicted = wp.zeros((world_count, size), dtype=wp.float64, device=device)
        self.r = wp.zeros_like(self.predicted)
        self.trial = wp.zeros_like(self.predicted)
        self.gradient = wp.zeros_like(self.predicted)
        self.direction = wp.zeros_like(self.predicted)
        self.matrix = wp.zeros_like(self.inertia)
        self.pivot_floor = wp.zeros_like(self.predicted)
        self.pivot_min = wp.zeros_like(self.predicted)
        articulation, link = _link_table(model)
        start, count = _articulation_dofs(model)
        self.body_articulation = wp.array(articulation, dtype=int, device=device)
        self.body_link = wp.array(link, dtype=int, device=device)
        self.articulation_dof_start = wp.array(start, dtype=int, device=device)
        self.articulation_dof_count = wp.array(count, dtype=int, device=device)
        links, dofs = model.max_joints_per_articulation, model.max_dofs_per_articulation
        shape = (max(model.articulation_count, 1), max(6 * links, 6), max(dofs, 1))
        self.jacobian = wp.zeros(shape, dtype=float, device=device)
        self.row_count = wp.zeros(world_count, dtype=int, device=device)
        rows = (world_count, max(row_max, 1))
        for name in ("row_kind", "row_size"):
            setattr(self, name, wp.zeros(rows, dtype=int, device=device))
        for name in ("row_start", "row_stiffness", "row_limit", "row_change", "row_energy", "row_force"):
            setattr(self, name, wp.zeros(rows, dtype=wp.float64, device=device))
        self.row_jacobian = wp.zeros((*rows, size), dtype=float, device=device)
        self.row_coupling = wp.zeros((*rows, size), dtype=wp.float64, device=device)
        self.table = Rigid()
        """The same arrays as the kernels take them."""
        for name in Rigid.vars:
            setattr(self.table, name, getattr(self, name))


def _articulation_dofs(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the first joint dof and the dof count of every articulation."""
    if model.articulation_count == 0:
        return np.zeros(1, int), np.zeros(1, int)
    joint_start = model.articulation_start.numpy()[: model.articulation_count]
    joint_end = model.articulation_end.numpy()[: model.articulation_count]
    dof = np.append(model.joint_qd_start.numpy()[: model.joint_count], model.joint_dof_count)
    return dof[joint_start], dof[joint_end] - dof[joint_start]


def _link_table(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the articulation of every rigid body and its row block in that articulation's Jacobian."""
    articulation = np.full(max(model.body_count, 1), -1)
    link = np.zeros(max(model.body_count, 1), int)
    if model.articulation_count:
        child = model.joint_child.numpy()
        starts, ends = model.articulation_start.numpy(), model.articulation_end.numpy()
        for a in range(model.articulation_count):
            for joint in range(int(starts[a]), int(ends[a])):
                articulation[child[joint]] = a
                link[child[joint]] = joint - starts[a]
    return articulation, link
