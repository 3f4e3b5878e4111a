"""Scatters by cell, and that of masses alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import warp as wp

from softmode.mpm.cell_kernels import Cells, scatter_cell_masses
from softmode.mpm.step_kernels import mass_to_grid

FILLS_GPU = 30_000
"""Fewer particles do not fill a GPU: two threads scatter each (8 to 10 % of a morph's time)."""
CELL_SHARE = 4
"""Particles for each group of threads that serves cells: there are about eight in a cell, or less where bodies part."""


class CellLists:
    """Lists of the particles of each cell, built anew by every scatter."""

    def __init__(self, worlds: int, count: int, shape: Sequence[int], device: wp.Device) -> None:
        """Make room for the particles of all worlds on a grid.

        Args:
            worlds: Number of worlds W.
            count: Particles N of each.
            shape: Nodes along x, y, z.
            device: Where the particles are.
        """
        self._groups = max(1, count // CELL_SHARE)
        with wp.ScopedDevice(device):
            self.lists = Cells()
            self.lists.head = wp.zeros((worlds, math.prod(shape)), dtype=int)
            self.lists.after, self.lists.used = (wp.zeros((worlds, count), dtype=int) for _ in range(2))
            self.lists.count = wp.zeros(worlds, dtype=int)

    def clear(self) -> None:
        """Forget all particles."""
        self.lists.head.fill_(-1)
        self.lists.count.zero_()

    def launch(self, kernel: Callable[..., object], inputs: list[object]) -> None:
        """Launch a kernel with 64 threads for the nodes of each cell."""
        worlds = self.lists.count.shape[0]
        inputs = [self.lists, *inputs, self._groups]
        wp.launch(kernel, (worlds, self._groups, 64), inputs=inputs, device=self.lists.count.device)


def scatter_masses(
    x: wp.array,
    mass: wp.array,
    place: Sequence[object],
    grid_mass: wp.array,
    active: wp.array,
    cells: CellLists | None = None,
) -> None:
    """Add the masses of particles to those of the nodes, which must be zero.

    Args:
        x: Positions [m], (W, N).
        mass: Masses [kg], (W, N).
        place: Origin and spacing of the grid, in the type of the particles.
        grid_mass: Masses of the nodes [kg], (W, nx, ny, nz).
        active: Worlds that take part, (W,), or one entry for all.
        cells: Where to string particles on cells of this grid; None scatters them one by one.
    """
    grid_mass.zero_()
    lanes = 8 if wp.get_device(x.device).is_cuda and x.size < FILLS_GPU else 1
    if cells is not None:
        cells.clear()
    shape = (x.shape[0], 1 if cells else lanes, x.shape[1])
    inputs = [x, mass, *place, grid_mass, active, 0 if cells else lanes, cells.lists if cells else Cells()]
    wp.launch(mass_to_grid, shape, inputs=inputs, device=x.device)
    if cells is not None:
        cells.launch(scatter_cell_masses, [x, mass, *place, grid_mass])
