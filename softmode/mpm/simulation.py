"""MpmSimulation: particles stepped forward, and derivatives of a loss carried back."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_number
from softmode.deformables.reduction.static_response import lame_parameters
from softmode.errors import ConfigError, SolverDiverged
from softmode.mpm.adjoint_kernels import grid_to_particles_adjoint, move_grid_adjoint, particles_to_grid_adjoint
from softmode.mpm.grid import Grid
from softmode.mpm.options import COURANT_LIMIT, MpmOptions
from softmode.mpm.particles import ParticleBody
from softmode.mpm.plastic_kernels import return_to_yield, return_to_yield_adjoint
from softmode.mpm.shape_kernels import add_wrenches, collide_grid, collide_grid_adjoint, find_inside
from softmode.mpm.shapes import GridShapes
from softmode.mpm.step_kernels import (
    LEFT_GRID,
    clear_failures,
    grid_to_particles,
    mass_to_grid,
    move_grid,
    particle_volumes,
    particles_to_grid,
)

Array = NDArray[np.float64]

TYPES = {"float32": (wp.float32, wp.vec3f, wp.mat33f), "float64": (wp.float64, wp.vec3d, wp.mat33d)}
LEAST_MASS = 1.0e-12
"""A node with less than this part of the lightest particle's mass stands still. A threshold in kg costs momentum."""
REASONS = {
    1: "left the grid",
    2: "was turned inside out (det F <= 0)",
    3: "has no finite position",
    4: "began inside of a shape",
}
FILLS_GPU = 30_000
"""Fewer particles do not fill a GPU: two threads scatter each (8 to 10 % of a morph's time)."""
FEW_PARTICLES = 0.5
"""Particles per cell under which a body falls apart into unconnected clumps."""


def scatter_masses(x: wp.array, mass: wp.array, place: Sequence[object], grid_mass: wp.array, active: wp.array) -> None:
    """Add the masses of particles to those of the nodes.

    Args:
        x: Positions [m], (W, N).
        mass: Masses [kg], (W, N).
        place: Origin and spacing of the grid, in the type of the particles, and its first node.
        grid_mass: Masses of the nodes [kg], (W, nx, ny, nz).
        active: Worlds that take part, (W,), or one entry for all.
    """
    lanes = 8 if wp.get_device(x.device).is_cuda and x.size < FILLS_GPU else 1
    shape = (x.shape[0], lanes, x.shape[1])
    wp.launch(mass_to_grid, shape, inputs=[x, mass, *place, grid_mass, active, lanes], device=x.device)


@dataclass(frozen=True, kw_only=True, eq=False)
class ParticleState:
    """Particles of all worlds at one time, or what a loss asks of them."""

    x: wp.array
    """Positions [m], (W, N)."""
    v: wp.array
    """Velocities [m/s], (W, N)."""
    C: wp.array
    """Affine velocity [1/s], (W, N)."""
    F: wp.array
    """Deformation gradient, (W, N)."""

    @property
    def arrays(self) -> tuple[wp.array, wp.array, wp.array, wp.array]:
        """x, v, C and F."""
        return self.x, self.v, self.C, self.F

    def copy_from(self, other: ParticleState) -> None:
        """Take another state's values."""
        for mine, value in zip(self.arrays, other.arrays, strict=True):
            wp.copy(mine, value)

    def zero(self) -> None:
        """Set all to zero."""
        for array in self.arrays:
            array.zero_()


@dataclass(frozen=True, kw_only=True, eq=False)
class ParameterBars:
    """Derivatives of a loss by what does not move."""

    control: wp.array
    """By the controls, (L, W, N)."""
    mass: wp.array
    """By the masses [1/kg], (W, N); rest volumes stay."""
    mu: wp.array
    """By mu [1/Pa], (W, N)."""
    lam: wp.array
    """By lambda [1/Pa], (W, N)."""
    yield_stress: wp.array
    """By the yield stress [1/Pa], (W, N)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _MovedGrid:
    """The grid in a step."""

    mass: wp.array
    """Masses of the nodes [kg], (W, nx, ny, nz)."""
    velocity: wp.array
    """Velocities that particles gather [m/s], (W, nx, ny, nz)."""
    free_velocity: wp.array
    """Those before shapes act; the same array without shapes."""


class MpmSimulation:
    """A run of a fixed number of steps: forward, and backward for derivatives.

    Worlds are independent; those with fewer particles are padded with particles without mass. All launches are on one
    device and can be captured in a graph.
    """

    def __init__(
        self,
        bodies: ParticleBody | Sequence[ParticleBody],
        options: MpmOptions | None = None,
        *,
        step_count: int = 10,
        layer_count: int = 1,
        shapes: GridShapes | None = None,
        keep_grids: bool = False,
        device: wp.DeviceLike = None,
    ) -> None:
        """Put bodies at rest on the grid.

        Args:
            bodies: One body for each world.
            options: How particles are stepped.
            step_count: Number of steps T.
            layer_count: Number of controls L. Each acts in the first of its T / L steps; F keeps what it did.
            shapes: Rigid shapes that act on the grid.
            keep_grids: Whether the grids of all steps are kept for the gradient, where the memory limit allows, not
                computed again. To the same bits on a CPU.
            device: Where to compute; Warp's preferred device when None.

        Raises:
            ConfigError: If a particle lies outside of the grid, sound crosses most of a cell in a step, particles are
                too few for their cells, energies differ between worlds, or shapes are on another device, of worlds
                that there are not, thinner than a cell, or hold particles.
        """
        self.options = options or MpmOptions()
        self.bodies = (bodies,) if isinstance(bodies, ParticleBody) else tuple(bodies)
        require_number("step_count", step_count, at_least=1)
        require_number("layer_count", layer_count, at_least=1, at_most=step_count)
        if not self.bodies:
            raise ConfigError("bodies: expected one or more")
        models = {body.material.model for body in self.bodies}
        if len(models) > 1:
            raise ConfigError(f"bodies: expected one energy for all worlds, got {sorted(m.name for m in models)}")
        grid = self.options.grid
        for body in self.bodies:
            grid.require(body.positions, "bodies")
        self.device = wp.get_device(device)
        self.step_count, self.layer_count = step_count, layer_count
        self.world_count, self.count = len(self.bodies), max(body.count for body in self.bodies)
        self._lanes = 2 if self.device.is_cuda and self.world_count * self.count < FILLS_GPU else 1
        self._model = int(models.pop())
        self._real, self._vec, self._mat = TYPES[self.options.precision]
        self.mass = self._array(self._padded([body.masses for body in self.bodies]), self._real)
        lame = [
            [body.material.youngs_modulus * c for c in lame_parameters(body.material.poissons_ratio)]
            for body in self.bodies
        ]
        self.mu, self.lam = (self._array(np.tile([[c[k]] for c in lame], self.count), self._real) for k in (0, 1))
        limits = [np.full(body.count, body.yield_stress or 0.0) for body in self.bodies]
        self.yield_stress = self._array(self._padded(limits), self._real)
        """Yield stress [Pa], (W, N); 0 where particles are elastic."""
        self._plastic = any(body.yield_stress is not None for body in self.bodies)
        self.coupled = False
        """Whether a `SolverCoupledParticles` steps it."""
        self.volume = self._zeros(self._real, self.world_count, self.count)
        self.shapes = shapes
        self.impulse = self._zeros(
            wp.spatial_vectord, step_count, self.world_count, 0 if shapes is None else shapes.model.shape_count
        )
        """What each step gave to each shape of the model [N s] and [N m s], about the centre of mass of its body or, of
        a shape without one, about the origin; (T, W, shapes)."""
        self.failure = self._zeros(int, self.world_count, 4)
        """Failures of a world: how many, and the first one's kind, step and particle; (W, 4)."""
        self.active = self._zeros(int, self.world_count)
        """Which worlds take part in :meth:`forward`, (W,): the others keep their states and failures. All do at first;
        with shapes, or where not all states are kept, all must."""
        self.active.fill_(1)
        self._least = self._real(LEAST_MASS * min(float(body.masses.min()) for body in self.bodies))
        self._controls = self._zeros(self._mat, layer_count + 1, self.world_count, self.count)
        self.control = cast(wp.array, self._controls[:layer_count])
        """Controls A, (L, W, N)."""
        limit = self.options.memory_limit
        per_state = 4 * (24 if self.options.precision == "float32" else 48) * self.world_count * self.count
        fits = per_state * (step_count + 1) <= limit
        self._chunk = step_count if fits else max(1, math.isqrt(step_count))
        marks = 0 if fits else math.ceil(step_count / self._chunk)
        needed = per_state * (self._chunk + 1 + marks)
        if needed > limit:
            raise ConfigError(
                f"memory_limit: {step_count} steps of {self.world_count} x {self.count} particles need "
                f"{needed:.3g} bytes, {limit:.3g} are allowed",
                hint="allow more, or take fewer steps or particles",
            )
        self._states_bytes, self._may_keep_grids = needed, keep_grids and not marks
        self._first_node = wp.array([grid.first], dtype=wp.vec3i, device=self.device)
        self._allocate_grid()
        self._states = [self._state() for _ in range(self._chunk + 1)]
        self._marks = [self._state() for _ in range(marks)]
        self._bars: tuple[list[ParticleState], ParameterBars] | None = None
        self.start(
            self._padded([body.positions for body in self.bodies]),
            F=np.tile(np.eye(3), (self.world_count, self.count, 1, 1)),
        )
        self._find_volumes()
        if shapes is not None:
            self._check_shapes(shapes)

    def _zeros(self, dtype: type, *shape: int) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)

    def _array(self, values: ArrayLike, dtype: type) -> wp.array:
        real = np.float32 if self.options.precision == "float32" else np.float64
        return wp.array(np.asarray(values, dtype=real), dtype=dtype, device=self.device)

    def _padded(self, rows: Sequence[Array]) -> Array:
        """Stack arrays of different length (N_w, ...), filled up with zeros or their first point."""
        found = np.zeros((len(rows), self.count, *rows[0].shape[1:]))
        for world, row in enumerate(rows):
            found[world, : len(row)] = row
            if row.ndim > 1:
                found[world, len(row) :] = row[0]
        return found

    def _grid_bytes(self, grid: Grid) -> tuple[float, float]:
        """Return what a grid takes with all worlds: always, and once more for each step whose grid is kept."""
        real = 4.0 if self.options.precision == "float32" else 8.0
        per_step = (4.0 if self.shapes is None else 7.0) * real * self.world_count * math.prod(grid.shape)
        return per_step + 10.0 * real * self.world_count * math.prod(grid.shape), per_step

    def _allocate_grid(self) -> None:
        """Make the arrays of the nodes."""
        grid = self.options.grid
        nodes = (self.world_count, *grid.shape)
        self.grid_mass = self._zeros(self._real, *nodes)
        """Masses of the nodes after the last step, once :meth:`scatter_mass` ran [kg]."""
        self.grid_mass_bar = self._zeros(self._real, *nodes)
        four = wp.types.vector(4, self._real)
        # Momentum and mass of a node lie side by side: one operation adds to both. Who reads the sums clears them.
        self._scattered, self._grid_bar = self._zeros(four, *nodes), self._zeros(four, *nodes)
        kept = self._states_bytes + self.step_count * self._grid_bytes(grid)[1]
        self._keeps_grids = self._may_keep_grids and kept <= self.options.memory_limit
        self._grids = [self._moved_grid(nodes) for _ in range(self.step_count if self._keeps_grids else 1)]

    def require_memory(self, grid: Grid) -> None:
        """Raise unless states and a grid fit into the memory limit.

        Raises:
            ConfigError: If they do not.
        """
        needed, limit = self._states_bytes + self._grid_bytes(grid)[0], self.options.memory_limit
        if needed > limit:
            raise ConfigError(
                f"memory_limit: states and a grid of {' x '.join(map(str, grid.shape))} nodes need {needed:.3g} bytes, "
                f"{limit:.3g} are allowed",
                hint="allow more, take larger cells, or keep particles together with more damping",
            )

    def place_grid(self, grid: Grid) -> bool:
        """Take another part of the same nodes: one with another ``first`` or ``shape``. States stay.

        Returns:
            Whether arrays of nodes are other ones now, so that graphs that were captured are void.

        Raises:
            ConfigError: If the grid has other nodes, or does not fit into the memory limit.
        """
        before = self.options.grid
        if (grid.spacing, grid.origin) != (before.spacing, before.origin):
            raise ConfigError(
                "grid: expected the spacing and origin of the grid at hand", hint="change first and shape"
            )
        self.require_memory(grid)
        self.options = replace(self.options, grid=grid)
        self._first_node.assign([grid.first])
        if grid.shape != before.shape:
            self._allocate_grid()
            return True
        # What is zero is not written again: nothing of the former place may be left.
        for moved in self._grids:
            for array in (moved.mass, moved.velocity, moved.free_velocity):
                array.zero_()
        for array in (self.grid_mass, self.grid_mass_bar, self._scattered, self._grid_bar):
            array.zero_()
        return False

    def _moved_grid(self, nodes: tuple[int, ...]) -> _MovedGrid:
        velocity = self._zeros(self._vec, *nodes)
        free = velocity if self.shapes is None else self._zeros(self._vec, *nodes)
        return _MovedGrid(mass=self._zeros(self._real, *nodes), velocity=velocity, free_velocity=free)

    def _state(self) -> ParticleState:
        shape = (self.world_count, self.count)
        kinds = {"x": self._vec, "v": self._vec, "C": self._mat, "F": self._mat}
        return ParticleState(**{name: self._zeros(kind, *shape) for name, kind in kinds.items()})

    @property
    def first(self) -> ParticleState:
        """The state before the first step."""
        return self._marks[0] if self._marks else self._states[0]

    @property
    def last(self) -> ParticleState:
        """The state after the last step of :meth:`forward`."""
        return self._states[self.step_count - (len(self._marks) - 1) * self._chunk if self._marks else self.step_count]

    @property
    def keeps_states(self) -> bool:
        """Whether memory allows to keep the states of all steps."""
        return not self._marks

    def states(self) -> list[ParticleState]:
        """Return the states before and after every step.

        Raises:
            ConfigError: If memory did not allow to keep them.
        """
        if self._marks:
            raise ConfigError("memory_limit: not all states were kept", hint="allow more, or take fewer steps")
        return self._states

    def start(
        self,
        x: ArrayLike | None = None,
        v: ArrayLike | None = None,
        C: ArrayLike | None = None,
        F: ArrayLike | None = None,
    ) -> None:
        """Set the state before the first step; what is None stays.

        Args:
            x: Positions [m], shape (W, N, 3).
            v: Velocities [m/s], shape (W, N, 3).
            C: Affine velocities [1/s], shape (W, N, 3, 3).
            F: Deformation gradients, shape (W, N, 3, 3).
        """
        for name, value in (("x", x), ("v", v), ("C", C), ("F", F)):
            if value is not None:
                target = getattr(self.first, name)
                wp.copy(target, self._array(value, target.dtype))

    def forward(self) -> None:
        """Take all steps."""
        wp.launch(clear_failures, self.world_count, inputs=[self.failure, self.active], device=self.device)
        if not self._marks:
            self._run(0)
            return
        for chunk in range(len(self._marks)):
            self._states[0].copy_from(self._marks[chunk])
            end = self._run(chunk)
            if chunk + 1 < len(self._marks):
                self._marks[chunk + 1].copy_from(self._states[end])

    def find_velocities(self, step: int) -> wp.array:
        """Compute again the velocities that the grid had in a step of :meth:`forward`, (W, nx, ny, nz) [m/s].

        Raises:
            ConfigError: If memory did not allow to keep all states.
        """
        return self._move_grid(step, self.states()[step]).velocity

    def scatter_mass(self, state: ParticleState | None = None) -> None:
        """Put the masses of the particles on the grid: those after the last step, or of another state."""
        self.grid_mass.zero_()
        self._scatter_mass((state or self.last).x)

    def bars(self) -> tuple[ParticleState, ParameterBars]:
        """Return what a loss writes before :meth:`backward`: bars of the last state, and those of the masses."""
        states, parameters = self._gradients()
        return states[0], parameters

    def backward(self) -> tuple[ParticleState, ParameterBars]:
        """Carry the bars of the last state back, after :meth:`forward`.

        Returns:
            Derivatives by the first state, and by what does not move.

        Raises:
            ConfigError: If a robot's solver steps it: the start of a step is overwritten by its end.
        """
        if self.coupled:
            raise ConfigError(
                "backward: there are no derivatives across the steps of a robot's solver",
                hint="simulate the particles alone, with shapes that move as given",
            )
        states, parameters = self._gradients()
        for bar in (parameters.control, parameters.mu, parameters.lam, parameters.yield_stress):
            bar.zero_()
        now = 0
        for chunk in reversed(range(max(len(self._marks), 1))):
            if chunk < len(self._marks) - 1:
                self._states[0].copy_from(self._marks[chunk])
                self._run(chunk)
            for step in reversed(range(self._steps_in(chunk))):
                self._step_back(
                    chunk * self._chunk + step,
                    self._states[step],
                    self._states[step + 1],
                    states[now],
                    states[1 - now],
                    parameters,
                )
                now = 1 - now
        return states[now], parameters

    def check(self) -> None:
        """Raise if a particle failed in the last run; reads back from the device.

        Raises:
            SolverDiverged: Naming world, step and particle.
        """
        found = self.failure.numpy()
        bad = np.flatnonzero(found[:, 0])
        if len(bad):
            world = bad[0]
            _, kind, step, particle = found[world]
            hint, told = "take smaller steps, more damping or a weaker control", ""
            if kind == LEFT_GRID:
                count = self.bodies[world].count
                x = np.asarray(self.last.x.numpy()[world, :count], dtype=np.float64)
                out = count - int(self.options.grid.holds(x).sum())
                told = f"; {out} of {count} are outside, where they stand still and weigh nothing"
                hint = "take a larger grid (Grid.around(..., room=)), more damping, a weaker control or slower shapes"
            what = f"particle {particle} {REASONS[int(kind)]}{told}"
            raise SolverDiverged(f"world {world}, step {step}: {what}", hint=hint)

    def wrenches(self) -> Array:
        """Return the mean wrench of the last run on each shape of the model [N] and [N m], shape (W, shapes, 6)."""
        return self.impulse.numpy().sum(axis=0) / (self.step_count * self.options.dt)

    def add_wrenches(self, state: newton.State) -> None:
        """Add the mean wrench of the last run, over all worlds, to the forces on the bodies of a state (``body_f``)."""
        if self.shapes is not None and state.body_f is not None:
            model = self.shapes.model
            duration = wp.float64(self.step_count * self.options.dt)
            inputs = [self.impulse, duration, model.shape_body, state.body_f]
            wp.launch(add_wrenches, model.shape_count, inputs=inputs, device=self.device)

    def _check_shapes(self, shapes: GridShapes) -> None:
        """Raise unless shapes can act on the grid and no particle begins in one."""
        if shapes.model.device != self.device:
            raise ConfigError(f"shapes: are on {shapes.model.device}, particles on {self.device}")
        if shapes.worlds.max() >= self.world_count:
            raise ConfigError(f"shapes: of world {shapes.worlds.max()}, there are {self.world_count} worlds")
        shapes.require_wide(self.options.grid.spacing)
        self._launch(find_inside, [shapes.obstacles, self.first.x, self.mass, self.failure])
        found = self.failure.numpy().copy()
        self.failure.zero_()
        for world in np.flatnonzero(found[:, 0]):
            raise ConfigError(
                f"bodies: {found[world, 0]} particles of world {world} begin inside of a shape, the first is "
                f"{found[world, 3]}",
                hint="move the body or the shape",
            )

    def _gradients(self) -> tuple[list[ParticleState], ParameterBars]:
        """Return bars, allocated when first asked for."""
        if self._bars is None:
            shape = (self.world_count, self.count)
            self._control_bars = self._zeros(self._mat, self.layer_count + 1, *shape)
            parameters = ParameterBars(
                control=cast(wp.array, self._control_bars[: self.layer_count]),
                mass=self._zeros(self._real, *shape),
                mu=self._zeros(self._real, *shape),
                lam=self._zeros(self._real, *shape),
                yield_stress=self._zeros(self._real, *shape),
            )
            self._fs_bar = self._zeros(self._mat, *shape)
            self._bars = ([self._state(), self._state()], parameters)
        return self._bars

    def _find_volumes(self) -> None:
        """Find rest volumes, and check what follows from them."""
        if self.options.rest_volume == "grid":
            self._scatter_mass(self.first.x)
            self._launch(particle_volumes, [self.first.x, self.mass, self.grid_mass, *self.place, self.volume])
        else:
            volumes = self._padded([body.masses / body.material.density for body in self.bodies])
            wp.copy(self.volume, self._array(volumes, self._real))
        dx, dt = self.options.grid.spacing, self.options.dt
        mass, volume = self.mass.numpy(), self.volume.numpy()
        for world, body in enumerate(self.bodies):
            density = mass[world, : body.count] / volume[world, : body.count]
            mu, lam = (body.material.youngs_modulus * c for c in lame_parameters(body.material.poissons_ratio))
            courant = dt * math.sqrt((lam + 2.0 * mu) / float(density.min())) / dx
            if courant > COURANT_LIMIT:
                raise ConfigError(
                    f"dt: sound crosses {courant:.2g} cells in a step, at most {COURANT_LIMIT} are stable",
                    hint=f"take dt <= {COURANT_LIMIT * dt / courant:.2g} s, larger cells, or a softer material",
                )
            per_cell = dx**3 / float(np.median(volume[world, : body.count]))
            if per_cell < FEW_PARTICLES:
                raise ConfigError(
                    f"bodies: {per_cell:.2g} particles per cell, at least {FEW_PARTICLES} hold together",
                    hint="take a smaller spacing of the particles or larger cells",
                )

    @property
    def place(self) -> list[object]:
        """Origin, spacing and first node of the grid, as kernels read them."""
        grid = self.options.grid
        return [self._vec(*grid.origin), self._real(grid.spacing), self._first_node]

    def _launch(self, kernel: Callable[..., object], inputs: list[object]) -> None:
        wp.launch(kernel, (self.world_count, self.count), inputs=inputs, device=self.device)

    def _scatter(self, kernel: Callable[..., object], inputs: list[object]) -> None:
        shape = (self.world_count, self._lanes, self.count)
        wp.launch(kernel, shape, inputs=[*inputs, self._lanes], device=self.device)

    def _scatter_mass(self, x: wp.array) -> None:
        scatter_masses(x, self.mass, self.place, self.grid_mass, self.active)

    def _at_nodes(self, kernel: Callable[..., object], inputs: list[object]) -> None:
        wp.launch(kernel, self.grid_mass.shape, inputs=inputs, device=self.device)

    def _obstacles(self, step: int, grid: _MovedGrid) -> list[object]:
        """Return what both kernels of the shapes read."""
        assert self.shapes is not None
        time = wp.float32(step * self.options.dt)
        return [self.shapes.obstacles, grid.mass, self._least, *self.place, time]

    def _steps_in(self, chunk: int) -> int:
        return min(self._chunk, self.step_count - chunk * self._chunk)

    def _run(self, chunk: int) -> int:
        """Take the steps of a chunk from the first of the kept states; return how many."""
        steps = self._steps_in(chunk)
        for k in range(steps):
            self._step(chunk * self._chunk + k, self._states[k], self._states[k + 1])
        return steps

    def _layer(self, step: int) -> int:
        """Return the control that acts in a step, or the row of zeros after the last."""
        layer = step * self.layer_count // self.step_count
        begins = step == 0 or (step - 1) * self.layer_count // self.step_count != layer
        return layer if begins else self.layer_count

    def _control_at(self, step: int) -> wp.array:
        return cast(wp.array, self._controls[self._layer(step)])

    def _particles(self, state: ParticleState, step: int) -> list[object]:
        """Return what both transfers to the grid read."""
        material = int(self.options.control == "material")
        o = self.options
        return [
            state.x,
            state.v,
            state.C,
            state.F,
            self._control_at(step),
            self.mass,
            self.volume,
            self.mu,
            self.lam,
            self._model,
            material,
            *self.place,
            self._real(o.dt),
            self._real(o.damping),
        ]

    def _move_grid(self, step: int, state: ParticleState) -> _MovedGrid:
        """Compute the velocities of the grid in a step."""
        grid = self._grids[step if self._keeps_grids else 0]
        inputs = [*self._particles(state, step), self._scattered, self.failure, step, self.active]
        self._scatter(particles_to_grid, inputs)
        push = self._vec(*(g * self.options.dt for g in self.options.gravity))
        self._at_nodes(move_grid, [self._scattered, self._least, push, grid.mass, grid.velocity, self.active])
        if self.shapes is not None:
            wp.copy(grid.free_velocity, grid.velocity)
            received = cast(wp.array, self.impulse[step : step + 1])
            received.zero_()
            self._at_nodes(collide_grid, [*self._obstacles(step, grid), grid.velocity, received])
        return grid

    def _step(self, step: int, now: ParticleState, then: ParticleState) -> None:
        """Take one step: particles to grid, grid, grid to particles."""
        o = self.options
        grid = self._move_grid(step, now)
        self._launch(
            grid_to_particles,
            [
                now.x,
                now.F,
                self._control_at(step),
                self.mass,
                int(o.control == "material"),
                grid.velocity,
                *self.place,
                self._real(o.dt),
                self._real(o.smoothing),
                then.x,
                then.v,
                then.C,
                then.F,
                self.failure,
                step,
                self.active,
            ],
        )

        if self._plastic:
            self._launch(return_to_yield, [*self._strengths, self.active, then.F])

    @property
    def _strengths(self) -> list[object]:
        """Return what both kernels of plasticity read of the particles."""
        return [self.mass, self.mu, self.lam, self.yield_stress, self._model]

    def _step_back(
        self,
        step: int,
        now: ParticleState,
        then: ParticleState,
        bar_then: ParticleState,
        bar: ParticleState,
        parameters: ParameterBars,
    ) -> None:
        """Carry the bars of a step's result to its start. A grid that was not kept is computed again."""
        o = self.options
        grid = self._grids[step] if self._keeps_grids else self._move_grid(step, now)
        if self._plastic:
            tried = [now.F, self._control_at(step), then.C, int(o.control == "material")]
            tried += [self._real(o.dt), self._real(o.smoothing), *self._strengths, bar_then.F]
            self._launch(return_to_yield_adjoint, [*tried, parameters.mu, parameters.lam, parameters.yield_stress])
        self._scatter(
            grid_to_particles_adjoint,
            [
                now.x,
                now.F,
                self._control_at(step),
                then.C,
                self.mass,
                int(o.control == "material"),
                grid.velocity,
                *self.place,
                self._real(o.dt),
                self._real(o.smoothing),
                bar_then.x,
                bar_then.v,
                bar_then.C,
                bar_then.F,
                self._scattered,
                bar.x,
                self._fs_bar,
                bar.F,
            ],
        )
        if self.shapes is not None:
            self._at_nodes(collide_grid_adjoint, [*self._obstacles(step, grid), grid.free_velocity, self._scattered])
        push = self._vec(*(g * o.dt for g in o.gravity))
        inputs = [grid.mass, grid.free_velocity, self._least, push, self._scattered, self._grid_bar]
        self._at_nodes(move_grid_adjoint, inputs)
        control_bar = cast(wp.array, self._control_bars[self._layer(step)])
        self._launch(
            particles_to_grid_adjoint,
            [
                *self._particles(now, step),
                self._grid_bar,
                self._fs_bar,
                bar.x,
                bar.v,
                bar.C,
                bar.F,
                control_bar,
                parameters.mass,
                parameters.mu,
                parameters.lam,
            ],
        )
