"""What SolverReduced and the joint solve report besides the state, as Newton's solver observables."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import newton
import warp as wp
from newton.solvers import SolverBase

from softmode.deformables.model.declare import WRENCH
from softmode.deformables.model.namespaces import NAMESPACE


class ReducedObservableKind(SolverBase.ObservableKind):
    """Names for ``solver.observables({...})``."""

    BODY_SOFT_CONTACT_F = "body_soft_contact_f"
    """Contact wrench of all soft bodies on every rigid body."""
    INSTANCE_CONTACT_F = "instance_contact_f"
    """Total contact force on every soft body."""


REDUCED_KINDS = frozenset({ReducedObservableKind.BODY_SOFT_CONTACT_F, ReducedObservableKind.INSTANCE_CONTACT_F})
"""What softmode reports."""
RIGID_KINDS = frozenset({SolverBase.ObservableKind.BODY_QDD, SolverBase.ObservableKind.BODY_PARENT_F})
"""What the joint solve passes on from its rigid solver."""


@dataclass(eq=False)
class ReducedObservables(SolverBase.Observables):
    """Arrays that a step fills, allocated by ``solver.observables``."""

    body_soft_contact_f: wp.array | None = SolverBase.Observables.field(  # noqa: RUF009
        dtype=WRENCH, frequency=newton.Model.AttributeFrequency.BODY
    )
    """Wrench about the centre of mass of each rigid body [N, N m], shape (body_count,)."""
    instance_contact_f: wp.array | None = SolverBase.Observables.field(  # noqa: RUF009
        dtype=wp.vec3d, frequency=f"{NAMESPACE}:instance"
    )
    """Force on each soft body [N], shape (instance_count,)."""


@dataclass(eq=False)
class CoupledObservables(ReducedObservables):
    """The same with Newton's own of the rigid solver, whose arrays the fields share."""

    rigid: SolverBase.Observables | None = field(default=None, init=False, repr=False)
    """The container that the rigid solver fills."""

    def select(self, kinds: Iterable[str]) -> "CoupledObservables":
        """Return a subset that shares the arrays; see ``SolverBase.Observables.select``."""
        chosen: Any = super().select(kinds)
        if self.rigid is not None:
            chosen.rigid = self.rigid.select(chosen.kinds & self.rigid.kinds)
        return chosen
