"""Losses without and with correspondences: how far particles are from a target, and the derivative.

Masses on a grid need no correspondence. The logarithm keeps heavy nodes from deciding all, and single particles from
being thrown out for a small gain (Xu, Song, Levin, Hyde 2025, eqs. (5) to (7)).
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from softmode.checks import require_choice, require_number
from softmode.errors import ConfigError
from softmode.mpm.adjoint_kernels import mass_to_grid_adjoint
from softmode.mpm.grid import Grid
from softmode.mpm.loss_kernels import log_mass_at_nodes, mass_at_nodes, position_at_particles
from softmode.mpm.particles import ParticleBody
from softmode.mpm.places import PlaceLoss
from softmode.mpm.simulation import MpmSimulation, ParameterBars, ParticleState, scatter_masses

MassLossKind = Literal["log", "squared"]


class MassLoss:
    """Distance of masses on a grid from those of a target.

    log: 1/2 sum_i (ln(m_i/s + 1) - ln(m*_i/s + 1))^2; squared: 1/2 sum_i (m_i - m*_i)^2 [kg^2].
    """

    def __init__(
        self,
        grid: Grid,
        target: ParticleBody,
        *,
        kind: MassLossKind = "log",
        mass_scale: float = 1.0,
        dtype: type = wp.float32,
        device: wp.DeviceLike = None,
    ) -> None:
        """Put the target on the grid.

        Args:
            grid: The grid.
            target: Particles that masses should come to.
            kind: Which distance.
            mass_scale: The mass s [kg] that a node's is compared with, of the logarithm.
            dtype: ``wp.float32`` or ``wp.float64``.
            device: Where to compute; Warp's preferred device when None.

        Raises:
            ConfigError: If a particle of the target lies outside of the grid, or the scale is not positive.
        """
        require_choice("kind", kind, get_args(MassLossKind))
        require_number("mass_scale", mass_scale, above=0.0, unit="kg")
        self.grid, self.kind, self.device = grid, kind, wp.get_device(device)
        vec = wp.vec3f if dtype is wp.float32 else wp.vec3d
        self._first = wp.array([grid.first], dtype=wp.vec3i, device=self.device)
        self._place = [vec(*grid.origin), dtype(grid.spacing), self._first]
        self._scale = dtype(mass_scale)
        self.dtype, self.mass_scale, self._vec = dtype, mass_scale, vec
        self._one = wp.full(1, 1.0, dtype=wp.float64, device=self.device)
        self._all = wp.full(1, 1, dtype=int, device=self.device)
        self.target_mass = wp.zeros((1, *grid.shape), dtype=dtype, device=self.device)
        """Masses that the nodes should come to [kg], (1, nx, ny, nz)."""
        self.aim(target)

    def aim(self, target: ParticleBody) -> None:
        """Take another target, in the same arrays.

        Raises:
            ConfigError: If one of its particles lies outside of the grid.
        """
        self.grid.require(target.positions, "target")
        self.target = target
        x = wp.array(target.positions[None], dtype=self._vec, device=self.device)
        wp.copy(self.target_mass, self._on_grid(x, wp.array(target.masses[None], dtype=self.dtype, device=self.device)))

    def place(self, grid: Grid, target: ParticleBody) -> None:
        """Take another part of the same nodes, and a target; graphs that were captured hold while the shape does.

        Raises:
            ConfigError: If one of the target's particles lies outside of the grid.
        """
        if grid.shape != self.grid.shape:
            self.target_mass = wp.zeros((1, *grid.shape), dtype=self.dtype, device=self.device)
        self.grid = grid
        self._first.assign([grid.first])
        self.aim(target)

    def evaluate(
        self, grid_mass: wp.array, loss: wp.array, grid_mass_bar: wp.array, active: wp.array | None = None
    ) -> None:
        """Write the loss of masses on the grid and its derivative by them.

        Args:
            grid_mass: Masses of the nodes [kg], (W, nx, ny, nz).
            loss: Where to write the losses, float64, (W,).
            grid_mass_bar: Where to write the derivatives [1/kg], (W, nx, ny, nz).
            active: Worlds that are compared, (W,), None for all; the others keep their derivatives, and have loss 0.
        """
        loss.zero_()
        if self.kind == "log":
            self.add_log(grid_mass, self._one, loss, grid_mass_bar, active)
        else:
            inputs = [grid_mass, self.target_mass, loss, grid_mass_bar, self._all if active is None else active]
            wp.launch(mass_at_nodes, grid_mass.shape, inputs=inputs, device=self.device)

    def add_log(
        self,
        grid_mass: wp.array,
        weight: wp.array,
        loss: wp.array,
        grid_mass_bar: wp.array,
        active: wp.array | None = None,
    ) -> None:
        """Add the logarithmic loss times a weight, and write its derivative; of active worlds alone."""
        inputs = [
            grid_mass,
            self.target_mass,
            self._scale,
            weight,
            loss,
            grid_mass_bar,
            self._all if active is None else active,
        ]
        wp.launch(log_mass_at_nodes, grid_mass.shape, inputs=inputs, device=self.device)

    def spread(self, x: wp.array, mass: wp.array, grid_mass_bar: wp.array, x_bar: wp.array, mass_bar: wp.array) -> None:
        """Turn derivatives by nodes into those by particles.

        Args:
            x: Positions [m], (W, N).
            mass: Masses [kg], (W, N).
            grid_mass_bar: Derivatives by the masses of the nodes, (W, nx, ny, nz).
            x_bar: What the derivatives by positions [1/m] are added to, (W, N).
            mass_bar: What those by masses [1/kg] are added to, (W, N).
        """
        inputs = [x, mass, *self._place, grid_mass_bar, x_bar, mass_bar]
        wp.launch(mass_to_grid_adjoint, x.shape, inputs=inputs, device=self.device)

    def after(self, simulation: MpmSimulation, loss: wp.array) -> None:
        """Write the loss of the particles after the last step of a simulation, and keep its derivative on the grid.

        Args:
            simulation: A simulation on the same grid, after :meth:`MpmSimulation.forward`.
            loss: Where to write the losses of its worlds, float64, (W,).
        """
        simulation.scatter_mass()
        self.evaluate(simulation.grid_mass, loss, simulation.grid_mass_bar, simulation.active)

    def gradient(
        self, simulation: MpmSimulation, places: PlaceLoss | None = None
    ) -> tuple[ParticleState, ParameterBars]:
        """Carry the loss of :meth:`after` back to a simulation's start.

        Args:
            simulation: That of :meth:`after`.
            places: What was added to it by :meth:`PlaceLoss.add`.

        Returns:
            What :meth:`MpmSimulation.backward` returns.
        """
        bar, parameters = simulation.bars()
        bar.zero()
        parameters.mass.zero_()
        if places is not None:
            places.spread(bar.x)
        self.spread(simulation.last.x, simulation.mass, simulation.grid_mass_bar, bar.x, parameters.mass)
        return simulation.backward()

    def value_and_gradient(self, points: ArrayLike, masses: ArrayLike) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the loss of particles, and its derivatives by their positions and masses.

        Args:
            points: Positions [m], shape (N, 3): particles, or surface samples of a reduced body.
            masses: Masses [kg], shape (N,).

        Returns:
            The loss, derivatives by positions [1/m] (N, 3) and by masses [1/kg] (N,).

        Raises:
            ConfigError: If a point lies outside of the grid.
        """
        x, mass = self._particles(points, masses)
        loss, _, bar = self._compared(x, mass)
        return loss, *self._spread_to(x, mass, bar)

    def target_gradient(self, points: ArrayLike, masses: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of the loss of particles by what the target is.

        Args:
            points: Positions [m], shape (N, 3), as of :meth:`value_and_gradient`.
            masses: Masses [kg], shape (N,).

        Returns:
            Derivatives by the positions [1/m] (M, 3) and masses [1/kg] (M,) of the target's particles.

        Raises:
            ConfigError: If a point lies outside of the grid.
        """
        _, grid_mass, bar = self._compared(*self._particles(points, masses))
        by_target = -bar.numpy()
        if self.kind == "log":
            # dL/dm = r / (m + s), dL/dm* = -r / (m* + s).
            by_target *= (grid_mass.numpy() + self.mass_scale) / (self.target_mass.numpy() + self.mass_scale)
        bar.assign(by_target)
        return self._spread_to(*self._particles(self.target.positions, self.target.masses), bar)

    def _particles(self, points: ArrayLike, masses: ArrayLike) -> tuple[wp.array, wp.array]:
        """Return particles on the device, one world of them."""
        found = np.asarray(points, dtype=np.float64)
        self.grid.require(found, "points")
        x = wp.array(found[None], dtype=self._vec, device=self.device)
        mass = wp.array(np.asarray(masses, dtype=np.float64)[None], dtype=self.dtype, device=self.device)
        if mass.shape != x.shape:
            raise ConfigError(f"masses: expected shape ({len(found)},), got {np.shape(masses)}")
        return x, mass

    def _compared(self, x: wp.array, mass: wp.array) -> tuple[float, wp.array, wp.array]:
        """Return the loss of one world of particles, their masses on the grid, and its derivatives by these."""
        grid_mass = self._on_grid(x, mass)
        loss, bar = wp.zeros(1, dtype=wp.float64, device=self.device), wp.zeros_like(grid_mass)
        self.evaluate(grid_mass, loss, bar)
        return float(loss.numpy()[0]), grid_mass, bar

    def _spread_to(self, x: wp.array, mass: wp.array, grid_mass_bar: wp.array) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives by positions and masses of one world of particles."""
        x_bar, mass_bar = wp.zeros_like(x), wp.zeros_like(mass)
        self.spread(x, mass, grid_mass_bar, x_bar, mass_bar)
        return x_bar.numpy()[0], mass_bar.numpy()[0]

    def scatter(self, x: wp.array, mass: wp.array, grid_mass: wp.array, active: wp.array | None = None) -> None:
        """Write the masses of the nodes [kg], (W, nx, ny, nz), of particles x [m] and masses [kg], (W, N)."""
        grid_mass.zero_()
        scatter_masses(x, mass, self._place, grid_mass, self._all if active is None else active)

    def _on_grid(self, x: wp.array, mass: wp.array) -> wp.array:
        grid_mass = wp.zeros((x.shape[0], *self.grid.shape), dtype=self.dtype, device=self.device)
        self.scatter(x, mass, grid_mass)
        return grid_mass


def position_loss(x: wp.array, mass: wp.array, target: wp.array, loss: wp.array, x_bar: wp.array) -> None:
    """Write 1/2 sum_p |x_p - x*_p|^2 [m^2] and its derivative; for particles that correspond.

    Args:
        x: Positions [m], (W, N).
        mass: Masses; particles without any do not count, (W, N).
        target: Positions x* [m], (1 or W, N).
        loss: Where to write the losses, float64, (W,).
        x_bar: Where to write the derivatives [m], (W, N).
    """
    loss.zero_()
    wp.launch(position_at_particles, x.shape, inputs=[x, mass, target, loss, x_bar], device=x.device)
