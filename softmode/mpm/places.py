"""Where particles belong in a target: a place for each in the first part of a morph, and a way back for strays.

The logarithm of masses is descended just as well by pressing what is in the way into a few nodes, where particles have
one velocity and never part again. A place of its own says to every particle which way out is. Places are those of an
entropic transport of the masses on the grid (Sinkhorn; the Gaussian kernel separates along the axes, Solomon et al.
2015, DOI 10.1145/2766963). What lies over a cell away from the target costs the square of the distance beyond.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import KDTree

from softmode.mpm.grid import Grid
from softmode.mpm.loss_kernels import place_at_particles, stray_at_nodes
from softmode.mpm.particles import ParticleBody
from softmode.mpm.simulation import MpmSimulation

Array = NDArray[np.float64]

STAGES = ((16.0, 10), (4.0, 10), (1.0, 20))
"""Entropy [cells^2] and iterations of the transport, one after another."""
FARTHEST = 26.0
"""Cells over the root of the entropy beyond which the kernel would vanish in float64."""
TINY = 1.0e-300
WEIGHT = 5.0
"""Weight of places, where they count in full, and of strays."""


def transported(points: Array, mass: Array, target: Array, grid: Grid) -> Array:
    """Return where points go when a mass on a grid is carried to a target's.

    Args:
        points: Positions [m], shape (N, 3).
        mass: Masses of the nodes to which the points belong [kg], shape (nx, ny, nz).
        target: Those of the target; the sum may be another.
        grid: The grid of both.

    Returns:
        Places [m], shape (N, 3).
    """
    filled = np.argwhere((mass > 0.0) | (target > 0.0))
    low, high = filled.min(axis=0), filled.max(axis=0) + 1
    box = tuple(slice(begin, end) for begin, end in zip(low, high, strict=True))
    a, b = (m[box].astype(np.float64) / m.sum(dtype=np.float64) for m in (mass, target))
    least = (float((high - low).max()) / FARTHEST) ** 2
    kernel: list[Array] = []
    v, last = (b > 0.0).astype(np.float64), 1.0
    for stage, count in STAGES:
        entropy = max(stage, least)
        kernel = [np.exp(-(np.subtract.outer(k, k) ** 2) / entropy) for k in map(np.arange, a.shape)]
        log_v = np.log(np.maximum(v, TINY)) * last / entropy
        v, last = np.where(b > 0.0, np.exp(np.clip(log_v, -600.0, 600.0)), 0.0), entropy
        for _ in range(count):
            u = a / np.maximum(_smeared(kernel, v), TINY)
            v = b / np.maximum(_smeared(kernel, u), TINY)
    at = np.stack(np.meshgrid(*map(np.arange, a.shape), indexing="ij"), axis=-1).astype(np.float64)
    reach = np.maximum(_smeared(kernel, v), TINY)
    moved = np.stack([_smeared(kernel, v * at[..., axis]) / reach for axis in range(3)], axis=-1) - at
    return points + grid.spacing * _between(moved, (points - grid.origin) / grid.spacing - (low + grid.first))


def _smeared(kernel: list[Array], values: Array) -> Array:
    """Apply a kernel along each axis."""
    return np.asarray(np.einsum("ai,bj,ck,ijk->abc", *kernel, values, optimize=True))


def _between(field: Array, at: Array) -> Array:
    """Return a field (nx, ny, nz, 3) at points (N, 3), counted in nodes, trilinear."""
    cell = np.clip(np.floor(at).astype(int), 0, np.array(field.shape[:3]) - 2)
    f, found = at - cell, np.zeros_like(at)
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, f, 1.0 - f), axis=1)
        found += weight[:, None] * field[tuple((cell + corner).T)]
    return found


class PlaceLoss:
    """What draws particles to a target from afar, added to a :class:`MassLoss`; it has no unit.

    w sum_p V_p / dx^3 |x_p - y_p|^2 / (2 dx^2) with places y, and w' sum_i m_i / m_0 (d_i / dx - 1)^2 / 2 over nodes
    whose distance d_i to the nearest particle of the target exceeds a cell. m_0 is the mass of a full node. Both are
    alike for every spacing of particles.
    """

    def __init__(self, simulation: MpmSimulation) -> None:
        """Begin with weights 0."""
        s = self._simulation = simulation
        dx = s.options.grid.spacing
        self._places, self._bar = wp.zeros_like(s.first.x), wp.zeros_like(s.first.x)
        self._volume = wp.array(s.volume.numpy() / dx**5, dtype=s.volume.dtype, device=s.device)
        self._weights = wp.zeros(2, dtype=wp.float64, device=s.device)
        self._stray = wp.zeros((0, 0, 0), dtype=s.volume.dtype, device=s.device)

    def place(self, grid: Grid, target: ParticleBody) -> None:
        """Take a part of the grid's nodes, and a target; graphs that were captured hold while the shape does."""
        nodes = grid.origin + grid.spacing * (np.argwhere(np.ones(grid.shape, dtype=bool)) + grid.first)
        distance = KDTree(target.positions).query(nodes)[0] / grid.spacing
        full = target.material.density * grid.spacing**3
        stray = (0.5 / full) * np.maximum(distance - 1.0, 0.0).reshape(grid.shape) ** 2
        if stray.shape != self._stray.shape:
            self._stray = wp.zeros(stray.shape, dtype=self._stray.dtype, device=self._simulation.device)
        self._stray.assign(stray)

    def aim(self, places: Array) -> None:
        """Take places [m], (W, N, 3)."""
        self._places.assign(places)

    def weigh(self, places: float, strays: float) -> None:
        """Set the parts, 0..1, with which places and strays count; graphs that were captured read them."""
        self._weights.assign([WEIGHT * places, WEIGHT * strays])

    def add(self, loss: wp.array) -> None:
        """Add the loss after the last step, once the masses are on the grid; keep its derivatives."""
        s = self._simulation
        nodes = [s.grid_mass, self._stray, self._weights, loss, s.grid_mass_bar, s.active]
        wp.launch(stray_at_nodes, s.grid_mass.shape, inputs=nodes, device=s.device)
        inputs = [s.last.x, self._volume, self._places, self._weights, loss, self._bar, s.active]
        wp.launch(place_at_particles, s.last.x.shape, inputs=inputs, device=s.device)

    def spread(self, x_bar: wp.array) -> None:
        """Take the derivatives by positions, those by the masses of nodes apart, as :meth:`add` kept them."""
        wp.copy(x_bar, self._bar)
