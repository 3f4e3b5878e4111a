"""How near, or how deep, the surfaces of soft bodies are to rigid shapes."""

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
