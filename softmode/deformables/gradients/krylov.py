"""GMRES for the linear systems of all instances at once, preconditioned by the solver's float32 Cholesky factor.

Warp's own (`warp.optim.linear.gmres`) reaches the same gradients to 1e-12, but runs whole cycles, where a system here
stops after any vector: 15 products with H a step at its best cycle length instead of 4, and 3.2 times the time of
`backward` (8.3 against 2.6 ms a step of the bar of benchmarks/gradients.py on a core). It also goes on with all systems
until the worst has converged, so that a world of a batch would not have the bits of a single world.
"""

from collections.abc import Callable

import warp as wp

from softmode.deformables.gradients import krylov_kernels as kernels
from softmode.deformables.model.tables import allocate
from softmode.deformables.solver.solver_reduced import SolverReduced

Apply = Callable[[wp.array, wp.array, wp.array], None]
"""Writes the product of the matrix and a direction: active worlds, direction, product."""

_AXES = {
    "": "instance",
    "world_running": "world",
    "any_running": "1",
    "basis": "vector instance unknown",
    "triangle": "instance length length",
    "rotation": "instance length",
    "tail": "instance vector",
    "search product work": "instance unknown",
    "rows": "instance number",
}


class Gmres:
    """Solves A x = b for every instance of a solver, A given by its products.

    Args:
        solver: Solver whose layout the vectors have and whose factor, as it stands at ``solve``, is the preconditioner.
        cycle_length: Krylov vectors kept before a restart.
        cycle_max: Restarts at most.
    """

    def __init__(self, solver: SolverReduced, *, cycle_length: int, cycle_max: int) -> None:
        """Allocate everything once."""
        self.solver, self.cycle_length, self.cycle_max = solver, cycle_length, cycle_max
        tables = solver.tables
        sizes = {
            "instance": solver.instance_count,
            "world": solver.world_count,
            "unknown": 3 * tables.layout.block_count,
            "number": 3 * tables.layout.stride,
            "length": cycle_length,
            "vector": cycle_length + 1,
        }
        given = {"systems": tables.system.table}
        self._krylov = allocate(kernels.Krylov, _AXES, sizes, solver.model.device, given=given)

    @property
    def error(self) -> wp.array:
        """|b - A x| / |b| of the last solution, per instance."""
        return self._krylov.error

    def solve(self, apply: Apply, right: wp.array, solution: wp.array, *, tolerance: float) -> None:
        """Solve until |b - A x| <= tolerance |b| or the restarts are used up.

        Args:
            apply: ``apply(active, direction, product)`` writes A direction to ``product`` in the worlds with a nonzero
                ``active``, shape (world_count,); its last call is with the solution.
            right: b, vec8d (instance_count, 3 block_count); driven functions are left out.
            solution: x, likewise; zero at driven functions.
            tolerance: Relative residual.
        """
        k, t, count = self._krylov, self.solver.tables, self.solver.instance_count
        every = wp.ones(self.solver.world_count, dtype=int, device=self.solver.model.device)

        def clear() -> None:
            k.world_running.zero_()
            k.any_running.zero_()

        def begin(first: bool) -> None:
            clear()
            given = (wp.float64(tolerance), int(first), t.team, right)
            t.launch_teams(kernels.begin_cycle, count, t.instances, *given, k, solution)

        def extend() -> None:
            apply(k.world_running, k.search, k.product)
            clear()
            t.launch_teams(kernels.extend_cycle, count, t.instances, self.cycle_length, t.team, k, solution)

        begin(first=True)
        for _ in range(self.cycle_max):
            wp.capture_while(k.any_running, extend)
            apply(every, solution, k.product)
            begin(first=False)
            if not int(k.any_running.numpy()[0]):
                break
