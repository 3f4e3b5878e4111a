"""Solids of cubes and bricks, for which finite elements and a closed mesh describe the same domain exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from tests.oracle.fem import Mesh, free_eigenvalues
from tests.shapes import voxels

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class Bricks:
    """A solid made of equal bricks."""

    mask: Mask
    """Which bricks of a grid are there, shape (nx, ny, nz)."""
    pitch: tuple[float, float, float]
    """Edges of a brick [m]."""
    refine: int = 1
    """Finite elements per brick and axis."""

    def surface(self) -> tuple[Array, NDArray[np.int64]]:
        """Return the closed surface: vertices [m] (V, 3), triangles (T, 3)."""
        return voxels(self.mask, self.pitch)

    def eigenvalues(self, poissons_ratio: float, count: int = 6) -> Array:
        """Return the first free eigenvalues by finite elements, per E / rho [1/m^2]."""
        return free_eigenvalues(self.mesh(), poissons_ratio, count)

    def mesh(self) -> Mesh:
        """Return the finite elements."""
        fine = self.mask
        for axis in range(3):
            fine = fine.repeat(self.refine, axis=axis)
        lines = tuple(np.arange(n + 1) * (p / self.refine) for n, p in zip(fine.shape, self.pitch, strict=True))
        return Mesh(lines, fine)  # type: ignore[arg-type]


def _full(*counts: int) -> Mask:
    return np.ones(counts, dtype=bool)


def _l() -> Mask:
    mask = np.zeros((8, 2, 8), dtype=bool)
    mask[:2], mask[:, :, :2] = True, True
    return mask


def _frame() -> Mask:
    mask = _full(10, 10, 2)
    mask[2:-2, 2:-2] = False
    return mask


def _cross() -> Mask:
    mask = np.zeros((10, 10, 2), dtype=bool)
    mask[4:6], mask[:, 4:6] = True, True
    return mask


def _y() -> Mask:
    mask = np.zeros((10, 2, 12), dtype=bool)
    mask[4:6, :, :6] = True
    for k in range(6):
        mask[max(0, 4 - k) : 6 - k + (k == 5), :, 6 + k] = True
        mask[4 + k - (k == 5) : 6 + k, :, 6 + k] = True
    return mask


def _hand() -> Mask:
    mask = np.zeros((9, 2, 10), dtype=bool)
    mask[:, :, :4] = True
    for finger in range(0, 9, 2):
        mask[finger, :, 4 : 9 + (finger == 4)] = True
    return mask


def _steps() -> Mask:
    mask = np.zeros((8, 3, 8), dtype=bool)
    for k in range(8):
        mask[k, :, : k + 1] = k < 3
        mask[k, :, max(0, k - 2) : k + 1] = True
    return mask


SOLIDS: dict[str, Callable[[], Bricks]] = {
    "bar 3:1": lambda: Bricks(mask=_full(9, 3, 3), pitch=(0.01, 0.01, 0.01)),
    "bar 10:1": lambda: Bricks(mask=_full(24, 3, 3), pitch=(0.0125, 0.01, 0.01)),
    "bar 20:1": lambda: Bricks(mask=_full(40, 2, 2), pitch=(0.015, 0.015, 0.015)),
    "plate 20:1": lambda: Bricks(mask=_full(14, 9, 2), pitch=(0.3 / 14, 0.02, 0.0075)),
    "slab 0.24 x 0.06 x 0.02": lambda: Bricks(mask=_full(16, 6, 2), pitch=(0.015, 0.01, 0.01)),
    "L": lambda: Bricks(mask=_l(), pitch=(0.015, 0.015, 0.015), refine=2),
    "frame": lambda: Bricks(mask=_frame(), pitch=(0.01, 0.01, 0.01)),
    "cross": lambda: Bricks(mask=_cross(), pitch=(0.01, 0.01, 0.01)),
    "Y": lambda: Bricks(mask=_y(), pitch=(0.01, 0.01, 0.01)),
    "hand": lambda: Bricks(mask=_hand(), pitch=(0.01, 0.01, 0.01)),
    "steps": lambda: Bricks(mask=_steps(), pitch=(0.01, 0.01, 0.01)),
}
"""Solids by name."""


def eigenvalues(body: ReducedBody, poissons_ratio: float, count: int = 6) -> Array:
    """Return the first free eigenvalues of a body per E / rho [1/m^2], from its points and gradients alone."""
    mu, lam = 1.0 / (2.0 * (1.0 + poissons_ratio)), poissons_ratio / ((1 + poissons_ratio) * (1 - 2 * poissons_ratio))
    G, n = body.grad_basis.astype(np.float64), body.function_count
    product = np.einsum("p,pai,pbj->iajb", body.weights * body.stiffness_scale, G, G, optimize=True)
    K = lam * product + mu * product.transpose(2, 1, 0, 3)
    for i in range(3):
        K[i, :, i] += mu * np.einsum("kakb->ab", product)
    value = np.linalg.eigvalsh(K.reshape(3 * n, 3 * n))
    return np.asarray(value[6 : 6 + count] / body.volume, dtype=np.float64)


def frequency_errors(body: ReducedBody, reference: Array, poissons_ratio: float) -> tuple[float, float]:
    """Return the smallest and the largest relative error of the frequencies."""
    error = np.sqrt(eigenvalues(body, poissons_ratio, len(reference)) / reference) - 1.0
    return float(error.min()), float(error.max())
