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
from softmode.mpm.step_kernels import mass_to_grid

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
        grid.require(target.positions, "target")
        self.grid, self.kind, self.device = grid, kind, wp.get_device(device)
        vec = wp.vec3f if dtype is wp.float32 else wp.vec3d
        self._place = [vec(*grid.origin), dtype(grid.spacing)]
        self._scale = dtype(mass_scale)
        self._dtype, self._vec = dtype, vec
        self._target = self._on_grid(
            wp.array(target.positions[None], dtype=vec, device=self.device),
            wp.array(target.masses[None], dtype=dtype, device=self.device),
        )

    def evaluate(self, grid_mass: wp.array, loss: wp.array, grid_mass_bar: wp.array) -> None:
        """Write the loss of masses on the grid and its derivative by them.

        Args:
            grid_mass: Masses of the nodes [kg], (W, nx, ny, nz).
            loss: Where to write the losses, float64, (W,).
            grid_mass_bar: Where to write the derivatives [1/kg], (W, nx, ny, nz).
        """
        loss.zero_()
        if self.kind == "log":
            kernel, inputs = log_mass_at_nodes, [grid_mass, self._target, self._scale, loss, grid_mass_bar]
        else:
            kernel, inputs = mass_at_nodes, [grid_mass, self._target, loss, grid_mass_bar]
        wp.launch(kernel, grid_mass.shape, inputs=inputs, device=self.device)

    def spread(self, x: wp.array, mass: wp.array, grid_mass_bar: wp.array, x_bar: wp.array, mass_bar: wp.array) -> None:
        """Turn derivatives by nodes into those by particles.

        Args:
            x: Positions [m], (W, N).
            mass: Masses [kg], (W, N).
            grid_mass_bar: Derivatives by the masses of the nodes, (W, nx, ny, nz).
            x_bar: Where to write the derivatives by positions [1/m], (W, N).
            mass_bar: Where to write those by masses [1/kg], (W, N).
        """
        inputs = [x, mass, *self._place, grid_mass_bar, x_bar, mass_bar]
        wp.launch(mass_to_grid_adjoint, x.shape, inputs=inputs, device=self.device)

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
        found = np.asarray(points, dtype=np.float64)
        self.grid.require(found, "points")
        x = wp.array(found[None], dtype=self._vec, device=self.device)
        mass = wp.array(np.asarray(masses, dtype=np.float64)[None], dtype=self._dtype, device=self.device)
        if mass.shape != x.shape:
            raise ConfigError(f"masses: expected shape ({len(found)},), got {np.shape(masses)}")
        grid_mass = self._on_grid(x, mass)
        loss, bar = wp.zeros(1, dtype=wp.float64, device=self.device), wp.zeros_like(grid_mass)
        x_bar, mass_bar = wp.zeros_like(x), wp.zeros_like(mass)
        self.evaluate(grid_mass, loss, bar)
        self.spread(x, mass, bar, x_bar, mass_bar)
        return float(loss.numpy()[0]), x_bar.numpy()[0], mass_bar.numpy()[0]

    def _on_grid(self, x: wp.array, mass: wp.array) -> wp.array:
        grid_mass = wp.zeros((x.shape[0], *self.grid.shape), dtype=self._dtype, device=self.device)
        wp.launch(mass_to_grid, x.shape, inputs=[x, mass, *self._place, grid_mass], device=self.device)
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
