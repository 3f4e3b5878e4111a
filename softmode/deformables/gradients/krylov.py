"""GMRES for the linear systems of all instances at once, preconditioned by the solver's float32 Cholesky factor.

Warp's own (`warp.optim.linear.gmres`) reaches the same gradients to 1e-12, but runs whole cycles, where a system here
stops after any vector: 15 products with H a step at its best cycle length instead of 4, and 3.2 times the time of
`backward` (8.3 against 2.6 ms a step of the bar of benchmarks/gradients.py on a core). It also goes on with all systems
until the worst has converged, so that a world of a batch would not have the bits of a single world.
"""

from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from softmode.deformables.gradients import krylov_kernels as kernels
from softmode.deformables.model.lane_kernels import vec8, vec8d
from softmode.deformables.solver.solver_reduced import SolverReduced

Apply = Callable[[wp.array, wp.array, wp.array], None]
"""Writes the product of the matrix and a direction: active worlds, direction, product."""


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
        self.device, count, length = solver.model.device, solver.instance_count, cycle_length
        k = kernels.Krylov()
        k.active, k.running, k.column, k.count = (self._zeros((count,), int) for _ in range(4))
        k.world_running, k.any_running = self._zeros((solver.world_count,), int), self._zeros((1,), int)
        k.target, k.error = (self._zeros((count,), wp.float64) for _ in range(2))
        k.basis = self._zeros((length + 1, *solver.functions), vec8d)
        k.triangle = self._zeros((count, length, length), wp.float64)
        k.rotation, k.tail = self._zeros((count, length), wp.vec2d), self._zeros((count, length + 1), wp.float64)
        k.search, k.product = (self._zeros(solver.functions, vec8d) for _ in range(2))
        k.factored, k.diagonal = solver.system.matrix, solver.system.diagonal
        k.pattern = solver.system.pattern
        k.work, k.rows = self._zeros(solver.functions, vec8), self._zeros((count, 3 * solver.stride), float)
        self._krylov = k

    @property
    def error(self) -> wp.array:
        """|b - A x| / |b| of the last solution, per instance."""
        return self._krylov.error

    @property
    def product_count(self) -> wp.array:
        """Products with A that the last solution took, per instance."""
        return self._krylov.count

    def solve(self, apply: Apply, right: wp.array, solution: wp.array, *, tolerance: float) -> None:
        """Solve until |b - A x| <= tolerance |b| or the restarts are used up.

        Args:
            apply: ``apply(active, direction, product)`` writes A direction to ``product`` in the worlds with a nonzero
                ``active``, shape (world_count,); its last call is with the solution.
            right: b, vec8d (instance_count, 3 block_count); driven functions are left out.
            solution: x, likewise; zero at driven functions.
            tolerance: Relative residual.
        """
        k = self._krylov
        every = wp.ones(self.solver.world_count, dtype=int, device=self.device)

        def clear() -> None:
            k.world_running.zero_()
            k.any_running.zero_()

        def begin(first: bool) -> None:
            clear()
            inputs = [self.solver.instances, wp.float64(tolerance), int(first), self.solver.team, right]
            self._launch(kernels.begin_cycle, inputs, [k, solution])

        def extend() -> None:
            apply(k.world_running, k.search, k.product)
            clear()
            inputs = [self.solver.instances, self.cycle_length, self.solver.team]
            self._launch(kernels.extend_cycle, inputs, [k, solution])

        begin(first=True)
        for _ in range(self.cycle_max):
            wp.capture_while(k.any_running, extend)
            apply(every, solution, k.product)
            begin(first=False)
            if not int(k.any_running.numpy()[0]):
                break

    def _zeros(self, shape: Sequence[int], dtype: type) -> Any:
        return wp.zeros(tuple(shape), dtype=dtype, device=self.device)

    def _launch(self, kernel: Callable[..., None], inputs: list[Any], outputs: Sequence[Any]) -> None:
        """Launch one team of threads per instance."""
        team = self.solver.team
        dim = (self.solver.instance_count, team)
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=list(outputs), block_dim=team, device=self.device)
