"""Functions of a body averaged over splats: exactly, or, of many splats, interpolated on a grid and checked."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse

Array = NDArray[np.float64]

TOGETHER = 8192
"""Splats that are averaged at a time: the arrays of 100,000 would be gigabytes."""
MANY = 20_000
"""Splats from which on functions are interpolated."""
SPACING = 1.2
"""Spacing of the grid, in widths over which the functions hardly bend: three tenths of a kernel's radius."""
TOLERANCE = 0.25
"""Error of an interpolated value, over a spacing times the slope of the functions (root mean square), from which on
splats there are averaged exactly: near gaps and corners, which functions go around."""
GRID_LIMIT = 2**24
"""Most nodes of a grid."""


class Functions(Protocol):
    """Scalar functions of rest points; a `ReducedBody` is some."""

    @property
    def narrow(self) -> float:
        """Width sqrt(3) sigma [m] of the widest splats over which they hardly bend."""
        ...

    def values(self, points: Array, /) -> Array:
        """Return values (N, n) at points [m] (N, 3)."""
        ...

    def evaluate(self, points: Array, /) -> tuple[Array, Array]:
        """Return values (N, n) and gradients [1/m] (N, n, 3) at points [m] (N, 3)."""
        ...


def average_basis(
    functions: Functions,
    means: ArrayLike,
    covariances: ArrayLike,
    *,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[Array, Array]:
    """Return basis values and gradients averaged over each splat, for `SkinSplats`.

    A splat is as wide as the deformation varies where a basis is coarse or torn: the gradient at its centre then draws
    it out into a spike, or leaves it behind. The Gaussian that has the mean of x(X) and the best affine fit to it is
    the one with E[b_k] and E[grad b_k] = Sigma^-1 E[(X - mean) b_k] (Stein's lemma): statistical linearisation. Both
    expectations are taken by the cubature rule of degree three, mean +/- sqrt(3) sigma_i e_i (Arasaratnam and Haykin
    2009, DOI 10.1109/TAC.2009.2019800). x(X) is linear in q, so this is done once and costs nothing in a frame; affine
    motion stays exact. It takes six evaluations; a splat over which the functions hardly bend needs one, at its centre.

    Of many splats the functions are evaluated on a grid around them and interpolated by cubics, which affine motion
    survives as well. In every cell one splat is evaluated exactly, too; where it disagrees, all are.

    Args:
        functions: The body.
        means: Rest centres in the body frame [m], shape (N, 3).
        covariances: Rest covariances [m^2], shape (N, 3, 3).
        progress: Told which share of the splats is done, 0 to 1.

    Returns:
        Values, shape (N, n), and gradients [1/m], shape (N, n, 3).
    """
    x = np.asarray(means, dtype=np.float64)
    variance, axes = np.linalg.eigh(np.asarray(covariances, dtype=np.float64))
    arms = np.sqrt(3.0 * np.maximum(variance, 0.0))
    # Below this width the difference of two values would be rounding; a derivative is as good.
    least = 1e-5 * max(float(np.ptp(x, axis=0).max()), float(np.sqrt(variance.max())))
    small = arms[:, 2] <= functions.narrow
    arms = np.maximum(arms, least)
    grid = _Grid(functions, x, arms, axes, small) if len(x) >= MANY and functions.narrow > 0.0 else None
    sources = [(functions, np.ones(len(x), bool))] if grid is None else [(functions, grid.exact), (grid, ~grid.exact)]
    parts: list[Any] = []  # rows, values, gradients
    done = 0
    for (source, member), narrow in product(sources, (True, False)):
        for rows in filter(len, _portions(np.flatnonzero(member & (small == narrow)))):
            wide = () if narrow else (arms[rows], axes[rows])
            parts.append((rows, *(_differences(source, x[rows], *wide) if wide else source.evaluate(x[rows]))))
            done += len(rows)
            progress(done / len(x))
    back = np.argsort(np.concatenate([rows for rows, _, _ in parts]))
    return np.concatenate([value for _, value, _ in parts])[back], np.concatenate([g for _, _, g in parts])[back]


def _portions(rows: NDArray[Any]) -> list[NDArray[Any]]:
    """Return rows in parts that are small enough."""
    return np.array_split(rows, 1 + len(rows) // TOGETHER)


def _differences(functions: Functions | _Grid, x: Array, arms: Array, axes: Array) -> tuple[Array, Array]:
    """Return averages over wide splats, from values at both ends of their arms."""
    value, gradient = np.zeros(()), np.zeros(())
    for i in range(3):
        arm, axis = arms[:, i, None], axes[:, :, i]
        ahead, behind = (functions.values(x + way * arm * axis) for way in (1.0, -1.0))
        value = value + (ahead + behind) / 6.0
        gradient = gradient + ((ahead - behind) / (2.0 * arm))[:, :, None] * axis[:, None]
    return np.asarray(value), np.asarray(gradient)


class _Grid:
    """Functions interpolated by cubics (Catmull and Rom) between nodes around splats.

    Args:
        functions: The body.
        x: Centres [m], shape (N, 3).
        arms: Half-widths [m], shape (N, 3).
        axes: Axes of the splats, as columns, shape (N, 3, 3).
        small: Which splats are evaluated at their centres alone, shape (N,).
    """

    def __init__(self, functions: Functions, x: Array, arms: Array, axes: Array, small: NDArray[np.bool_]):
        """Evaluate the functions at the nodes, and find the splats for which that is not exact enough."""
        tips = np.concatenate([x + way * arms[:, i, None] * axes[:, :, i] for i in range(3) for way in (1.0, -1.0)])
        owner = np.tile(np.arange(len(x)), 6)
        wide = ~small[owner]
        points, owner = np.concatenate([x[small], tips[wide]]), np.concatenate([np.flatnonzero(small), owner[wide]])
        self.exact = np.zeros(len(x), dtype=bool)
        """Which splats are to be averaged exactly, shape (N,)."""
        low, high = np.quantile(x, [0.001, 0.999], axis=0)
        far = ((points < low - 0.1 * (high - low)) | (points > high + 0.1 * (high - low))).any(axis=1)
        self.exact[owner[far]] = True
        points, owner = points[~far], owner[~far]
        low, high = points.min(axis=0), points.max(axis=0)
        self.spacing = max(SPACING * functions.narrow, float(np.prod(high - low) / GRID_LIMIT) ** (1.0 / 3.0))
        self.origin = low - 1.5 * self.spacing
        shape = np.ceil((high - self.origin) / self.spacing).astype(int) + 3
        self.strides = np.array([shape[1] * shape[2], shape[2], 1])
        key = np.floor((points - self.origin) / self.spacing).astype(np.intp) @ self.strides
        occupied = np.zeros(shape, dtype=bool)
        occupied.flat[key] = True
        # A cell's cubics reach one node before it and two behind.
        nodes: Any = ndimage.binary_dilation(occupied, np.ones((4, 4, 4)), origin=-1)
        self.number = np.full(nodes.size, -1, dtype=np.int32)
        place = np.flatnonzero(nodes)
        self.number[place] = np.arange(len(place))
        at = self.origin + self.spacing * np.stack(np.unravel_index(place, nodes.shape), axis=1)
        self.table = np.concatenate([functions.values(part).astype(np.float32) for part in _portions(at)])
        _, first, back = np.unique(key, return_index=True, return_inverse=True)
        error = np.abs(self.values(points[first]) - functions.values(points[first]))
        slope = np.sqrt(np.square(self.evaluate(points[first[::8]])[1]).mean())
        bad = error.max(axis=1) > TOLERANCE * self.spacing * slope
        self.exact[owner[bad[back]]] = True

    def values(self, points: Array) -> Array:
        """Return values (N, n) at points [m] (N, 3)."""
        return self._found(points, None)

    def evaluate(self, points: Array) -> tuple[Array, Array]:
        """Return values (N, n) and gradients [1/m] (N, n, 3) at points [m] (N, 3)."""
        return self._found(points, None), np.stack([self._found(points, d) for d in range(3)], axis=2)

    def _found(self, points: Array, along: int | None) -> Array:
        """Return values, or derivatives along an axis, by a sparse product with the nodes."""
        place = (points - self.origin) / self.spacing
        cell = np.floor(place).astype(np.intp)
        t = (place - cell)[:, :, None]
        cubic = np.array([[0, -0.5, 1, -0.5], [1, 0, -2.5, 1.5], [0, 0.5, 2, -1.5], [0, 0, -0.5, 0.5]])
        weight = t ** np.arange(4) @ cubic.T  # (N, axis, node)
        if along is not None:
            weight[:, along] = (np.arange(4) * t[:, along] ** [0, 0, 1, 2]) @ cubic.T / self.spacing
        data = np.einsum("ni,nj,nk->nijk", weight[:, 0], weight[:, 1], weight[:, 2]).astype(np.float32)
        around = (np.indices((4, 4, 4)).reshape(3, 64).T - 1) @ self.strides
        index = (cell @ self.strides)[:, None] + around
        rows = np.arange(0, data.size + 1, 64)
        matrix = sparse.csr_matrix((data.ravel(), self.number[index.ravel()], rows), (len(points), len(self.table)))
        return (matrix @ self.table).astype(np.float64)
