"""What lives in a model beside its reduced bodies: rigid bodies that could move, and deformables of Newton's own."""

import warnings

import newton
import numpy as np

from softmode.deformables.model.layout import Layout
from softmode.deformables.model.namespaces import soft
from softmode.deformables.model.tables import host


def movable_bodies(model: newton.Model) -> tuple[str, ...]:
    """Return the labels of the rigid bodies that can move: dynamic ones with a degree of freedom, or with no joint.

    Bodies of one label, as worlds have them, are named once.
    """
    if not model.body_count:
        return ()
    moves, jointed = np.zeros(model.body_count, bool), np.zeros(model.body_count, bool)
    kinematic = (host(model.body_flags)[: model.body_count] & int(newton.BodyFlags.KINEMATIC)) != 0
    joints: list[tuple[int, int, int]] = []
    if model.joint_count:
        parents, children, starts = (host(a) for a in (model.joint_parent, model.joint_child, model.joint_qd_start))
        dofs = np.diff(np.append(starts[: model.joint_count], model.joint_dof_count))
        joints = list(zip(parents, children, dofs, strict=True))
    for parent, child, freedom in joints:  # parents come first
        jointed[child] = True
        moves[child] |= not kinematic[child] and (freedom > 0 or (parent >= 0 and moves[parent]))
    return tuple(dict.fromkeys(str(model.body_label[b]) for b in np.flatnonzero(moves | ~(jointed | kinematic))))


def warn_still_bodies(model: newton.Model) -> None:
    """Warn of rigid bodies that could move in a model whose solver steps soft bodies alone."""
    labels = movable_bodies(model)
    if labels:
        warnings.warn(
            f"{listed(labels)} could move, and SolverReduced moves soft bodies alone: they stay where state_in has "
            "them; use SolverCoupledReduced, or add_body(is_kinematic=True) for a body that you move yourself",
            UserWarning,
            stacklevel=3,
        )


def warn_foreign_deformables(model: newton.Model, layout: Layout) -> None:
    """Warn of deformables of a model that are no reduced bodies, and say which solvers of Newton step them."""
    found = foreign_deformables(model, layout)
    if found:
        warnings.warn(
            f"softmode's solvers step reduced bodies alone; {'; '.join(found)}: take that step between the same "
            "states, before this solver's; contact between the two is not found",
            UserWarning,
            stacklevel=3,
        )


def foreign_deformables(model: newton.Model, layout: Layout) -> list[str]:
    """Return a phrase for each kind of deformable that is no reduced body, with what steps it."""
    free = host(model.particle_mass)[: model.particle_count] > 0.0  # room for larger bodies has none
    for start, asset in zip(soft(model).particle_start.numpy(), layout.asset, strict=True):
        free[start : start + layout.bodies[asset].surface_count] = False
    if not free.any():
        return []
    found = []
    for what, count, index, solvers in (
        ("tetrahedra", model.tet_count, model.tet_indices, "SolverVBD or SolverXPBD"),
        ("triangles of cloth", model.tri_count, model.tri_indices, "SolverVBD, SolverStyle3D or SolverXPBD"),
        ("springs", model.spring_count, model.spring_indices, "SolverXPBD or SolverSemiImplicit"),
    ):
        if not count:
            continue
        corners = host(index).reshape(count, -1)
        own = free[corners].any(axis=1)  # triangles of a tetrahedron's surface are no cloth
        if own.any():
            found.append(f"{own.sum()} {what} wait for newton.solvers.{solvers}")
        free[corners.reshape(-1)] = False
    if free.any():
        found.append(f"{free.sum()} loose particles wait for newton.solvers.SolverImplicitMPM or SolverXPBD")
    return found


def listed(labels: tuple[str, ...], most: int = 4) -> str:
    """Return labels as a list for people."""
    more = f" and {len(labels) - most} more" if len(labels) > most else ""
    return "rigid " + ("body " if len(labels) == 1 else "bodies ") + ", ".join(map(repr, labels[:most])) + more
