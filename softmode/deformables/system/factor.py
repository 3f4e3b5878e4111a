"""Storage and launches of batched linear systems: block Cholesky factorisation and solve, see ``factor_kernels``.

On CUDA large systems are factored and solved by the whole device, see ``panel_kernels``.
"""

import numpy as np
import warp as wp

from softmode.deformables.model.declare import Kernel, launch, launch_teams
from softmode.deformables.model.lane_kernels import LANES, TEAM, pad, vec8
from softmode.deformables.model.tables import allocate
from softmode.deformables.system import factor_kernels as kernels
from softmode.deformables.system import panel_kernels as panels
from softmode.deformables.system.panel_kernels import PANEL, PANEL_TEAM, SOLVE_TEAM

PANEL_UNKNOWNS = 256
"""Unknowns from which on the whole CUDA device shares the systems instead of a block of threads each."""


class BlockCholesky:
    """Storage and launches of ``system_count`` equal-sized systems [A | B].

    Args:
        system_world: World of each system, shape (system_count,); systems of inactive worlds are left alone.
        size: N, a multiple of 8.
        column_count: Right-hand columns wanted; padded to a multiple of 8.
        device: Warp device.
        part_count: Equal parts that a system is made of; ``relation`` says which are related.
        by_panels: Whether the whole device shares the systems, panel by panel; None leaves it to size and device.
    """

    def __init__(
        self,
        system_world: wp.array,
        size: int,
        column_count: int,
        device: wp.Device,
        part_count: int = 1,
        *,
        by_panels: bool | None = None,
    ) -> None:
        """Allocate everything once."""
        self.system_count, self.size, self.device = system_world.shape[0], size, device
        each = np.tile(np.eye(part_count, dtype=np.int32), (self.system_count, 1, 1))
        self.pattern = wp.array(each, dtype=int, device=device)
        """Which parts are related where they are placed, upper triangle; the diagonal says which exist, the first."""
        self.relation = wp.zeros_like(self.pattern)
        """The same by number, symmetric; the diagonal says which parts exist. For ``order_parts``."""
        self.place = wp.array(np.tile(np.arange(part_count), (self.system_count, 1)), dtype=int, device=device)
        """Where each part is placed in the system."""
        width = size + pad(column_count)
        self.matrix = wp.zeros((self.system_count, size, width // LANES), dtype=vec8, device=device)
        shape = (self.system_count, size, width)
        self.scalars = wp.array(ptr=self.matrix.ptr, dtype=float, shape=shape, device=device, copy=False)
        """The same memory as ``matrix``, number by number."""
        self.team, self.width, self.unit = 1, LANES, self.matrix
        if wp.get_device(device).is_cuda:
            self.team, self.width, self.unit = min(-(-width // TEAM) * TEAM, 8 * TEAM), 1, self.scalars
        self._factor = wp.overload(kernels.factor, {"unit": self.unit})
        given = {"world": system_world, "matrix": self.matrix, "scalars": self.scalars, "pattern": self.pattern}
        sizes = {"system": self.system_count, "row": size, "block": size // LANES}
        axes = {"indefinite": "system", "diagonal right": "system row", "solution bounds": "system block"}
        self.table = allocate(kernels.Systems, axes, sizes, device, given=given)
        """All of it, for kernels."""
        self.indefinite = self.table.indefinite
        cuda = wp.get_device(device).is_cuda
        self._panel_threads = (PANEL_TEAM, SOLVE_TEAM) if cuda else (1, 1)
        self.by_panels = cuda and size >= PANEL_UNKNOWNS if by_panels is None else by_panels

    @property
    def by_panels(self) -> bool:
        """Whether the whole device shares the systems; may be set, for comparisons."""
        return self._by_panels

    @by_panels.setter
    def by_panels(self, value: bool) -> None:
        self._by_panels = value
        room = self.system_count if value else 1
        self._corner = wp.zeros((room, PANEL, PANEL), dtype=float, device=self.device)

    def order_parts(self) -> None:
        """Choose ``place`` for the parts related by ``relation``; complete both that and ``pattern`` by the fill."""
        launch(self.device, kernels.order_parts, self.system_count, self.relation, self.place, self.pattern)

    def factor(self, active: wp.array) -> None:
        """Replace [A | B] by [U | U^-T B] in the active worlds; only the upper triangle of A is read.

        Sets ``indefinite`` where a pivot had to be raised by more than rounding.
        """
        if self.by_panels:
            self._factor_panels(active)
        else:
            self._launch(self._factor, active, self.team, self.width, self.unit, self.table)

    def _factor_panels(self, active: wp.array) -> None:
        """Factor panel by panel."""
        team, count, width = self._panel_threads[0], self.system_count, self.scalars.shape[2]
        for first in range(0, self.size, PANEL):
            given = (active, first, team, self._corner, self.table)
            groups = -(-(width - first - LANES) // PANEL)  # parts that do not exist may leave a panel eight rows
            launch(self.device, panels.factor_panel, (count, groups, team), *given, block_dim=team)
            high, wide = (max(-(-(end - first - PANEL) // PANEL), 0) for end in (self.size, width))
            tiles = max(high * wide - high * (high - 1) // 2, 1)  # one at least puts the panel's square in its place
            launch(self.device, panels.subtract_panel, (count, tiles, team), *given, block_dim=team)

    def _solve_panels(self, active: wp.array, column: int, tail: wp.array, tail_count: int) -> None:
        """Substitute back panel by panel."""
        team, count = self._panel_threads[1], self.system_count
        begin = (active, column, tail, tail_count, self.table)
        launch(self.device, panels.begin_substitution, (count, self.size), *begin, block_dim=team)
        for first in reversed(range(0, self.size, PANEL)):
            groups = max(first // PANEL, 1)
            given = (active, first, team, self.table)
            launch(self.device, panels.substitute_panel, (count, groups, team), *given, block_dim=team)

    def solve(self, active: wp.array, column: int, tail: wp.array, tail_count: int) -> wp.array:
        """Return x of U x = y - Y tail, shape (system_count, N / 8) of 8-vectors.

        Args:
            active: Whether each world's systems are solved, shape (world_count,).
            column: Right-hand column y.
            tail: Unknowns already known, shape (world_count, tail_count); Y are the first right-hand columns.
            tail_count: How many.
        """
        if self.by_panels:
            self._solve_panels(active, column, tail, tail_count)
        else:
            self._launch(kernels.solve, active, column, self.team, tail, tail_count, self.table)
        return self.table.solution

    def _launch(self, kernel: Kernel, *arguments: object) -> None:
        """Launch one team per system."""
        launch_teams(self.device, kernel, self.system_count, self.team, *arguments)
