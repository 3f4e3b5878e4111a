"""The joint dofs that are unknowns of the reduced solve, and where they stand in Newton's arrays."""

from typing import Any

import newton
import numpy as np
import warp as wp

from softmode.deformables.model.struct_kernels import Rigid
from softmode.deformables.model.tables import allocate, host

_AXES = {
    "": "world dof",
    "count dof_start row_count": "world",
    "inertia matrix": "world dof dof",
    "row_jacobian row_coupling": "world row dof",
    "row_kind row_size row_start row_stiffness row_limit row_change row_energy row_force": "world row",
    "jacobian": "articulation twist link_dof",
}


class RigidDofs:
    """Joint dofs that take part in the solve: per world r = dt * joint velocity and its quadratic model.

    Empty (``count_max`` 0) while rigid bodies move as prescribed; ``coupling`` fills one in.

    Args:
        model: Finalised model.
        world_count: Number of worlds.
        counts: Dofs per world.
        dof_start: The first joint dof of each world.
        row_max: Constraint rows per world at most.
        given: Arrays of :class:`softmode.deformables.model.struct_kernels.Rigid` that say which dofs move a body, where
            these are not those of the model's articulations.
    """

    def __init__(
        self,
        model: newton.Model,
        world_count: int,
        counts: np.ndarray,
        dof_start: np.ndarray,
        *,
        row_max: int = 0,
        given: dict[str, np.ndarray] | None = None,
    ) -> None:
        """Allocate the table."""
        self.count_max, self.row_max = int(counts.max(initial=0)), row_max
        sizes = {
            "world": world_count,
            "dof": self.count_max,
            "row": row_max,
            "articulation": model.articulation_count,
            "twist": max(6 * model.max_joints_per_articulation, 6),
            "link_dof": model.max_dofs_per_articulation,
        }
        given = {"count": counts, "dof_start": dof_start, **(given or _moved_by_articulations(model))}
        self.table = allocate(Rigid, _AXES, sizes, model.device, given=given)
        self.dof_count = wp.clone(self.table.count)
        """Joint dofs of a world, shape (world_count,); ``table.count`` is 0 while they take no part."""

    @classmethod
    def prescribed(cls, model: newton.Model) -> "RigidDofs":
        """Return the dofs of a model whose rigid bodies all move as prescribed: none."""
        none = np.zeros(max(model.world_count, 1), int)
        return cls(model, len(none), none, none)


def _moved_by_articulations(model: newton.Model) -> dict[str, Any]:
    """Return which dofs of which articulation move each rigid body."""
    articulation, link = np.full(max(model.body_count, 1), -1), np.zeros(max(model.body_count, 1), int)
    first, count = np.zeros(1, int), np.zeros(1, int)
    if model.articulation_count:
        child, starts, ends = (host(a) for a in (model.joint_child, model.articulation_start, model.articulation_end))
        starts, ends = starts[: model.articulation_count], ends[: model.articulation_count]
        for a, (start, end) in enumerate(zip(starts, ends, strict=True)):
            articulation[child[start:end]] = a
            link[child[start:end]] = np.arange(end - start)
        dof = np.append(host(model.joint_qd_start)[: model.joint_count], model.joint_dof_count)
        first, count = dof[starts], dof[ends] - dof[starts]
    return {
        "body_articulation": articulation,
        "body_link": link,
        "articulation_dof_start": first,
        "articulation_dof_count": count,
    }
