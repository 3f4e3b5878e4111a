"""How near, or how deep, the surfaces of soft bodies are to rigid shapes."""

import logging

import newton
import numpy as np
from numpy.typing import NDArray

from softmode.deformables.contact.dents import contact_dents
from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
from softmode.deformables.solver.solver_reduced import SolverReduced


def rigid_gaps(solver: SolverReduced | SolverCoupledReduced) -> NDArray[np.float64]:
    """Return the gaps between surface samples and the rigid shapes that they are near [m], shape (N,).

    Negative where the skin, a sample with its dent, is inside a shape. They are those of the last step's contacts, of
    all worlds.
    """
    contacts = solver.view.constraints
    used = np.arange(contacts.shape.shape[1]) < contacts.count.numpy()[:, None]
    touching = used & (contacts.shape.numpy() >= 0)
    start = np.einsum("nek,nek->ne", contacts.normal.numpy(), contacts.offset.numpy()) + contacts.lead.numpy()
    return (start + contact_dents(contacts))[touching]


def start_overlaps(
    solver: SolverReduced | SolverCoupledReduced, state: newton.State, dt: float, *, least: float = 1.0e-3
) -> tuple[str, ...]:
    """Return what starts inside something else: for each soft body the deepest such place, as a sentence.

    Reads from the device; state and status stay as they are.

    Args:
        solver: The solver.
        state: The state, before a step is taken.
        dt: The step that comes [s].
        least: Depth of a surface sample from which on it counts [m].
    """
    reduced = solver.reduced if isinstance(solver, SolverCoupledReduced) else solver
    status = solver.status.numpy()
    reduced.begin(state, None, dt)
    reduced.detect(state, None, dt, prescribed=True)
    solver.status.assign(status)
    samples, pairs, labels = reduced.view.samples, reduced.view.pairs, reduced.model.shape_label
    place, shape, gap = samples.position.numpy(), samples.shape.numpy(), samples.gap.numpy()
    radius = reduced.parameters.contact_radius.numpy()  # by which a surface stands out from the body's
    layout, counts = reduced.view.layout, reduced.view.instances.sample_count.numpy()
    told, names = [], [f"soft body {i} ({layout.bodies[b].name!r})" for i, b in enumerate(layout.asset)]
    for i, count in enumerate(counts):
        own = slice(0, int(count))
        if not count:  # a slot without an object
            continue
        found = [(np.where(shape[i, own] >= 0, gap[i, own] + radius[i], 0.0), shape[i, own], labels)]
        if pairs is not None and pairs.near.numpy()[i]:
            other = pairs.other.numpy()[i, own]
            found.append(
                (np.where((other >= 0) & (other != i), pairs.gap.numpy()[i, own] + radius[i], 0.0), other, names)
            )
        for depth, what, known in found:
            s, k = np.unravel_index(depth.argmin(), depth.shape)
            if depth[s, k] < -least:
                at = ", ".join(f"{x:.3f}" for x in place[i, s])
                told.append(f"{names[i]} starts {-1e3 * depth[s, k]:.1f} mm deep in {known[what[s, k]]}, at ({at}) m")
    return tuple(told)


def warn_of_overlaps(solver: SolverReduced | SolverCoupledReduced, state: newton.State, dt: float) -> tuple[str, ...]:
    """Write what `start_overlaps` finds to the log "softmode", and return it."""
    told = start_overlaps(solver, state, dt)
    for line in told:
        logging.getLogger("softmode").warning("%s; it will be pushed out: place it elsewhere", line)
    return told
