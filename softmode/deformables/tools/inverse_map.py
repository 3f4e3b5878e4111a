"""`InverseMap`: from places in the world back to rest points of a deformed body.

A lattice of rest points is moved by the kernels that move splats. Every frame a grid over the moved lattice gets the
rest points of its nodes: each cell of the lattice is six tetrahedra, which hold the nodes, and Newton's iteration on
the lattice does the rest. Rays read the grid; points start from it.

The paper's warp (Feng et al. 2024, equations 19 to 21) starts from the nearest integrator point instead. As printed its
matrix is grad u + grad F d / 2, which is zero at rest; it must be F + grad F d / 2.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from softmode.checks import require_number
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.contact.dents import dent_weights
from softmode.deformables.model.declare import launch
from softmode.deformables.model.namespaces import soft
from softmode.deformables.skinning.skin_splats import SkinSplats
from softmode.deformables.skinning.skinning_kernels import vec6
from softmode.deformables.solver.solver_base import ReducedSolver, require_reduced
from softmode.deformables.tools import inverse_map_kernels as kernels
from softmode.errors import ConfigError

Array = NDArray[np.float64]
Flags = NDArray[np.int32]
Within = Callable[[Array], NDArray[np.bool_]]

OUTSIDE, FOUND, FOLDED = 0, 1, 2
"""Flags of a point: not in the body; its rest point is known; the body is folded or inverted there, one of several
rest points is given."""
MARGIN = 2
"""Cells of the lattice around the body."""


class InverseMap:
    """Rest points of places in the world, for one body in every world.

    Places are those that one sees: they have the dents of contact in, as splats have them (`dent_weights`). Arrays have
    the world as first axis. `update`, `move` and `find` are capturable after a first time.

    Args:
        solver: Solver that holds the body; None for states of a body on their own.
        body: Index of the body in its world; a `ReducedBody` where there is no solver.
        nodes: Nodes of the lattice along the longest edge of the body, without those around it.
        cells: Edge of the grid of rest points, which has cells^3 nodes at most.
        within: Tells which rest points (N, 3) of the body frame are to be found; the body itself if None. Whole cells
            of the lattice are taken, and their neighbours.
        turns: Keep the rotation of F at the nodes of the grid too.
        world_count: Number of states where there is no solver.
        device: Warp device where there is no solver.

    Raises:
        ConfigError: If there is no such body, or a number is out of range.
    """

    def __init__(
        self,
        solver: ReducedSolver | None,
        body: int | ReducedBody = 0,
        *,
        nodes: int = 24,
        cells: int = 36,
        within: Within | None = None,
        turns: bool = False,
        world_count: int = 1,
        device: wp.DeviceLike = None,
    ) -> None:
        """Lay the lattice and evaluate the body on it once."""
        require_number("nodes", nodes, at_least=4, at_most=128)
        require_number("cells", cells, at_least=8, at_most=256)
        if isinstance(body, ReducedBody):
            if solver is not None:
                raise ConfigError("a solver and a body were given", hint="give the index of the body in its world")
            self.body, starts = body, np.arange(world_count) * body.function_count
            samples = np.arange(world_count) * body.surface_count
            self.device = wp.get_device(device)
        else:
            held = require_reduced(solver)
            layout, self.device = held.view.layout, held.model.device
            instances = layout.instance_start[:-1] + body
            if not 0 <= body or (instances >= layout.instance_start[1:]).any():
                raise ConfigError(f"no world has a body {body}", hint="count the bodies of a world from 0")
            self.body = layout.bodies[layout.asset[instances[0]]]
            data = held.parameters
            starts, samples = (array.numpy()[instances] for array in (data.function_start, data.particle_start))
        self.world_count = worlds = len(starts)
        self._start, self._samples = (
            wp.array(np.ascontiguousarray(first, np.int32), dtype=int, device=self.device)
            for first in (starts, samples)
        )
        low, high = self.body.bounds
        edge = float((high - low).max()) / (nodes - 1)
        size = np.ceil((high - low) / edge - 1e-6).astype(int) + 1 + 2 * MARGIN
        origin = 0.5 * (low + high) - 0.5 * edge * (size - 1)
        axes = [origin[d] + edge * np.arange(size[d]) for d in range(3)]
        rest = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        cell, core = self._cells(rest, size, edge, within)
        value, gradient = continued_basis(self.body, rest)
        still = np.zeros((len(rest), 3, 3))
        dents = dent_weights(self.body, rest)
        seen: Any = {"near": dents.samples, "share": dents.weights, "sample_count": self.body.surface_count}
        self._skin = SkinSplats(rest, still, value, gradient, device=self.device, **seen)
        array: Any = lambda shape, kind: wp.zeros(shape, dtype=kind, device=self.device)  # noqa: E731
        wanted = np.zeros(len(rest), dtype=np.int32)
        wanted[cell] = 1
        self.lattice = lattice = kernels.Lattice()
        lattice.low, lattice.edge, lattice.size = wp.vec3(*origin), edge, wp.vec3i(*size.tolist())
        lattice.core_count = core
        lattice.node, lattice.bend = array((worlds, len(rest)), wp.vec3), array((worlds, len(rest), 3), wp.vec3)
        lattice.cell = wp.array(cell.astype(np.int32), dtype=int, device=self.device)
        lattice.wanted = wp.array(wanted, dtype=int, device=self.device)
        self._spread = array((worlds, len(rest)), vec6)
        room = (worlds, cells**3)
        self.grid = grid = kernels.RestGrid()
        """Rest points over the moved body, for kernels."""
        grid.low, grid.edge, grid.size = array(worlds, wp.vec3), array(worlds, float), array(worlds, wp.vec3i)
        grid.bound, grid.owner = array((worlds, 2), wp.vec3), array((*room, 2), int)
        grid.rest, grid.flag = array(room, wp.vec3), array(room, int)
        grid.turn = array(room if turns else (0, 0), wp.quat)

    def _cells(
        self, rest: Array, size: NDArray[np.int64], edge: float, within: Within | None
    ) -> tuple[NDArray[np.intp], int]:
        """Return the lowest node of each cell that holds something, then of their neighbours, and the first count."""
        shape = tuple(int(n) - 1 for n in size)
        held = within or self.body.holds
        lowest = np.arange(len(rest)).reshape(size)[:-1, :-1, :-1]
        first = rest[lowest.ravel()]
        # Eight places in each cell, so that what is thinner than a cell is seen.
        full = np.zeros(len(first), dtype=bool)
        for corner in np.ndindex(2, 2, 2):
            full |= held(first + edge * (0.25 + 0.5 * np.array(corner)))
        if not full.any():
            raise ConfigError("within: holds no cell of the lattice", hint="give rest points of the body frame")
        core = full.reshape(shape)
        near: Any = ndimage.binary_dilation(core, np.ones((3, 3, 3)))
        return np.concatenate([lowest[core], lowest[near & ~core]]), int(core.sum())

    # -- on the device ------------------------------------------------------------------------------------------------

    def update(self, state: newton.State) -> None:
        """Follow the body to where a state of the model has it."""
        self.move(soft(state).q, soft(state).dent)

    def move(self, q: wp.array, dent: wp.array | None = None) -> None:
        """Follow the coordinates q of all bodies [m], flat vec3d, and the dents of their samples [m], flat vec3."""
        lattice, grid, device, worlds = self.lattice, self.grid, self.device, self.world_count
        self._skin.launch(q, self._start, lattice.node, self._spread, dent=dent, sample_start=self._samples)
        cells = (worlds, lattice.cell.shape[0])
        launch(device, kernels.bend_lattice, lattice.node.shape, lattice)
        launch(device, kernels.clear_bound, worlds, grid)
        launch(device, kernels.find_bound, cells, lattice, grid)
        launch(device, kernels.fit_grid, worlds, grid)
        launch(device, kernels.clear_grid, grid.rest.shape, grid)
        launch(device, kernels.own_nodes, cells, lattice, grid)
        launch(device, kernels.fill_grid, grid.rest.shape, lattice, grid, 1)

    def find(self, points: wp.array, rest_out: wp.array, flag_out: wp.array) -> None:
        """Write the rest points of places in the world.

        Args:
            points: Places [m], vec3, shape (world_count, N).
            rest_out: Rest points in the body frame [m], like `points`; the place itself where none was found.
            flag_out: `OUTSIDE`, `FOUND` or `FOLDED`, int, like `points`.

        Raises:
            ConfigError: If the shapes do not belong together.
        """
        shapes = {array.shape for array in (points, rest_out, flag_out)}
        if len(shapes) != 1 or points.ndim != 2 or points.shape[0] != self.world_count:
            raise ConfigError(f"shapes {sorted(shapes)}, expected three of ({self.world_count}, N)")
        tolerance = 1e-3 * float(self.lattice.edge)
        launch(
            self.device, kernels.find_rest, points.shape, self.lattice, self.grid, points, tolerance, rest_out, flag_out
        )

    # -- on the host --------------------------------------------------------------------------------------------------

    def rest_points(
        self, points: ArrayLike, *, world: int = 0, q: ArrayLike | None = None, dent: ArrayLike | None = None
    ) -> tuple[Array, Flags]:
        """Return the rest points of places in one world, read back.

        Args:
            points: Places [m], shape (N, 3).
            world: Which world.
            q: Coordinates of the body there, as last given to `update` [m], shape (n, 3): one Newton step on the body's
                own functions is added, x <- X - F(X)^-1 (x(X) - place), which the lattice only interpolates.
            dent: Dents of its surface samples there, for that step [m], shape (surface_count, 3); None for none.

        Returns:
            Rest points in the body frame [m], shape (N, 3), the place itself where there is none; flags, shape (N,).

        Raises:
            ConfigError: If points are not finite or of another shape.
        """
        x = np.asarray(points, dtype=np.float64)
        if x.ndim != 2 or x.shape[1] != 3 or not np.isfinite(x).all():
            raise ConfigError(f"points: expected finite positions of shape (N, 3), got shape {x.shape}")
        everywhere = np.broadcast_to(x.astype(np.float32), (self.world_count, *x.shape))
        place = wp.array(np.ascontiguousarray(everywhere), dtype=wp.vec3, device=self.device)
        rest, flag = wp.zeros_like(place), wp.zeros(place.shape, dtype=int, device=self.device)
        self.find(place, rest, flag)
        found, flags = rest.numpy()[world].astype(np.float64), flag.numpy()[world]
        if q is not None and (known := flags != OUTSIDE).any():
            target = x[known]
            if dent is not None:
                left = dent_weights(self.body, found[known])
                given = np.asarray(dent, dtype=np.float64)[left.samples]
                target = target - np.einsum("nk,nkd->nd", left.weights, given)
            found[known] = true_step(self.body, np.asarray(q, dtype=np.float64), found[known], target)
        return np.where(flags[:, None] == OUTSIDE, x, found), flags

    def signed_distance(self, points: ArrayLike, field: Callable[[Array], ArrayLike], *, world: int = 0) -> Array:
        """Return signed distances of places to the deformed body, from a field of its rest state.

        To first order d = phi(X) / |F^-T grad phi(X)|, by differences over the moved places: exact on the surface.

        Args:
            points: Places [m], shape (N, 3).
            field: Signed distance at rest points of the body frame, (N, 3) to (N,) [m].
            world: Which world.

        Returns:
            Distances [m], negative inside, infinite where no rest point was found, shape (N,).
        """
        x = np.asarray(points, dtype=np.float64)
        step = 0.1 * float(self.lattice.edge)
        moved = np.concatenate([x, *(x + sign * step * axis for axis in np.eye(3) for sign in (1.0, -1.0))])
        rest, flags = self.rest_points(moved, world=world)
        value = np.where(flags == OUTSIDE, np.nan, np.asarray(field(rest), dtype=np.float64)).reshape(7, -1)
        ahead, behind = value[1::2], value[2::2]
        both = np.where(np.isnan(ahead), value[0], ahead) - np.where(np.isnan(behind), value[0], behind)
        width = step * (2.0 - np.isnan(ahead) - np.isnan(behind))
        slope = np.linalg.norm(both / np.maximum(width, 1e-30), axis=0)
        return np.where(np.isnan(value[0]), np.inf, value[0] / np.maximum(slope, 1e-6))

    def pick(
        self, origin: ArrayLike, direction: ArrayLike, field: Callable[[Array], ArrayLike], *, world: int = 0
    ) -> tuple[Array, Array] | None:
        """Return where a ray first meets the surface phi = 0 of the deformed body, and the rest point there.

        Args:
            origin: Where it starts [m], shape (3,).
            direction: Where it goes, of any length, shape (3,).
            field: Function of rest points of the body frame, (N, 3) to (N,), negative inside.
            world: Which world.

        Returns:
            Place and rest point [m], each of shape (3,); None if it misses.
        """
        start, ahead = np.asarray(origin, dtype=np.float64), np.asarray(direction, dtype=np.float64)
        ahead = ahead / np.linalg.norm(ahead)
        low, high = cast("Array", self.grid.bound.numpy()[world].astype(np.float64))
        middle, reach = 0.5 * (low + high) - start, 0.5 * float(np.linalg.norm(high - low))
        step = 0.25 * float(self.lattice.edge)
        along = np.arange(max(middle @ ahead - reach, 0.0), middle @ ahead + reach + step, step)
        if not len(along):
            return None

        def depth(t: Array) -> Array:
            rest, flags = self.rest_points(start + t[:, None] * ahead, world=world)
            return np.where(flags == OUTSIDE, np.inf, np.asarray(field(rest), dtype=np.float64))

        inside = np.flatnonzero(depth(along) < 0.0)
        if not len(inside):
            return None
        near = along[inside[0]] - (step if inside[0] else 0.0)
        for _ in range(3):  # eleven places at a time: to a thousandth of the step
            places = np.linspace(near, near + step, 11)
            near, step = places[max(int(np.argmax(depth(places) < 0.0)) - 1, 0)], 0.1 * step
        place = start + (near + step) * ahead
        return place, self.rest_points(place[None], world=world)[0][0]


def continued_basis(body: ReducedBody, points: Array) -> tuple[Array, Array]:
    """Return functions (N, n) and gradients (N, n, 3) at points, continued smoothly outside the body.

    A body's own continuation has a kink where its kernels end, of which an interpolation across its surface would see
    half. Here it is a parabola from the point half of the way to that end, by the gradients there and further in.
    """
    ratio, centre = body.raw.reach(points)
    ratio = 2.0 * ratio
    inner = np.where((ratio > 1.0)[:, None], centre + (points - centre) / np.maximum(ratio, 1.0)[:, None], points)
    value, gradient = body.evaluate(inner)
    far = np.flatnonzero(ratio > 1.0)
    step = points[far] - inner[far]
    length = np.linalg.norm(step, axis=1)
    back = np.minimum(length, np.linalg.norm(inner[far] - centre[far], axis=1))
    ahead = step / length[:, None]
    bend = (gradient[far] - body.evaluate(inner[far] - back[:, None] * ahead)[1]) / back[:, None, None]
    value[far] += np.einsum("pki,pi->pk", gradient[far] + 0.5 * length[:, None, None] * bend, step)
    gradient[far] += length[:, None, None] * bend
    return value, gradient


def true_step(body: ReducedBody, q: Array, rest: Array, places: Array) -> Array:
    """Return rest points (N, 3) after a Newton step on x(X) = X + sum_k b_k(X) q_k towards places (N, 3) [m]."""
    value, gradient = body.evaluate(rest)
    f = np.eye(3) + np.einsum("pkd,ki->pid", gradient, q)
    return rest - np.linalg.solve(f, (rest + value @ q - places)[..., None])[..., 0]
