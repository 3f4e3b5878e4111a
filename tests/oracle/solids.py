"""Solids of bricks, for which finite elements and a closed mesh describe the same domain exactly, and round tubes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from tests.oracle.fem import Mesh, free_eigenvalues, spring_work
from tests.shapes import voxels

Array = NDArray[np.float64]
GRAVITY = (0.48, 0.6, 0.64)
"""Direction of gravity, along no axis [per E, 1/m]."""
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class Bricks:
    """A solid made of equal bricks."""

    mask: Mask
    """Which bricks of a grid are there, shape (nx, ny, nz)."""
    pitch: tuple[float, float, float]
    """Edges of a brick [m]."""
    refine: int = 1
    """Finite elements per brick and axis. At inner corners one is up to 9 % too stiff in a frequency."""
    end: tuple[int, int] = (0, 1)
    """The end that springs hold: an axis, and how many layers of bricks from its lower side."""

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

    @property
    def end_width(self) -> float:
        """Width of the end that springs hold [m]."""
        return self.end[1] * self.pitch[self.end[0]]

    def spring_works(self, body: ReducedBody, poissons_ratio: float, hardness: float = 30.0) -> tuple[float, float]:
        """Return the work of gravity on a body, and on finite elements, that springs hold at the end, per E [m^5].

        Args:
            body: The body; its functions are summed over the finite elements' own points of the end.
            poissons_ratio: nu.
            hardness: Springs per volume, in units of E over the square of the end's width.
        """
        return self.spring_work(body, poissons_ratio, hardness), self.spring_reference(poissons_ratio, hardness)

    def spring_work(self, body: ReducedBody, poissons_ratio: float, hardness: float) -> float:
        """Return that on a body."""
        mesh, held = self._held()
        value = body.evaluate(mesh.points[held].reshape(-1, 3) - body.offset)[0]
        springs = value.T @ (hardness / self.end_width**2 * mesh.weights[held].reshape(-1, 1) * value)
        whole = stiffness(body, poissons_ratio) + np.kron(np.eye(3), springs)
        force = np.outer(GRAVITY, body.volume * body.mean_basis).ravel()
        return float(force @ np.linalg.solve(whole, force))

    def spring_reference(self, poissons_ratio: float, hardness: float) -> float:
        """Return that on finite elements."""
        mesh, held = self._held()
        return spring_work(mesh, poissons_ratio, held, hardness / self.end_width**2, GRAVITY)

    def _held(self) -> tuple[Mesh, Mask]:
        """Return the finite elements, and which of them the springs hold."""
        mesh = self.mesh()
        return mesh, 0.5 * (mesh.lower + mesh.upper)[:, self.end[0]] < self.end_width


@dataclass(frozen=True, kw_only=True)
class Tube:
    """A round tube, or a ring."""

    radii: tuple[float, float]
    """Inner and outer [m]."""
    height: float
    """Along the axis [m]."""
    cells: tuple[int, int, int]
    """Finite elements across the wall, around and along the axis."""

    def surface(self) -> tuple[Array, NDArray[np.int64]]:
        """Return the closed surface of 192 flat sides: vertices [m] (V, 3), triangles (T, 3)."""
        mesh = trimesh.creation.annulus(*self.radii, self.height, sections=192)
        return np.asarray(mesh.vertices), np.asarray(mesh.faces)

    def eigenvalues(self, poissons_ratio: float, count: int = 6) -> Array:
        """Return the first free eigenvalues by finite elements, per E / rho [1/m^2]."""
        return free_eigenvalues(self.mesh(), poissons_ratio, count)

    def mesh(self) -> Mesh:
        """Return the finite elements, whose edges around are parabolas."""
        spans = (self.radii, (0.0, 2.0 * np.pi), (-0.5 * self.height, 0.5 * self.height))
        lines = tuple(np.linspace(*span, n + 1) for span, n in zip(spans, self.cells, strict=True))
        mesh = Mesh(lines, np.ones(self.cells, dtype=bool), _from_polar)
        # The last nodes around are the first.
        first, same = np.unique(mesh.nodes.round(9), axis=0, return_index=True, return_inverse=True)[1:]
        mesh.elements, mesh.nodes = same.ravel()[mesh.elements], mesh.nodes[first]
        return mesh


def _from_polar(polar: Array) -> Array:
    radius, angle, height = polar.T
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1) + 0.0


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


def _walk(shape: tuple[int, int, int], moves: str, start: tuple[int, int, int] = (0, 0, 0)) -> Mask:
    """Return what a block of 2 x 2 x 2 bricks sweeps: "x6" goes six bricks on, "X6" back."""
    mask, at = np.zeros(shape, dtype=bool), np.array(start)
    for move in ["x0", *moves.split()]:
        axis, way = "xyz".index(move[0].lower()), 1 if move[0].islower() else -1
        for _ in range(max(1, int(move[1:]))):
            at[axis] += way * (int(move[1:]) > 0)
            mask[tuple(slice(a, a + 2) for a in at)] = True
    return mask


def _ring() -> Mask:
    x, y = np.meshgrid(np.arange(12) - 5.5, np.arange(12) - 5.5, indexing="ij")
    radius = np.hypot(x, y)
    return np.repeat(((radius > 3.6) & (radius < 6.2))[:, :, None], 2, axis=2)


def _t() -> Mask:
    mask = np.zeros((10, 2, 9), dtype=bool)
    mask[:, :, 7:] = mask[4:6] = True
    return mask


def _dumbbell() -> Mask:
    mask = np.zeros((14, 4, 4), dtype=bool)
    mask[:4] = mask[10:] = mask[:, 1:3, 1:3] = True
    return mask


def _tube() -> Mask:
    mask = _full(5, 5, 12)
    mask[1:-1, 1:-1] = False
    return mask


def _cup() -> Mask:
    mask = _full(6, 6, 6)
    mask[1:-1, 1:-1, 1:] = False
    return mask


def _fork() -> Mask:
    mask = _full(7, 2, 10)
    mask[2:5, :, 3:] = False
    return mask


HELIX = "x6 z2 y6 z2 X6 z2 Y6 z2 x6 z2 y6"
SPIRAL = "x10 y10 X10 Y6 x6 y2"
SOLIDS: dict[str, Callable[[], Bricks]] = {
    "bar 3:1": lambda: Bricks(mask=_full(9, 3, 3), pitch=(0.01, 0.01, 0.01)),
    "bar 10:1": lambda: Bricks(mask=_full(24, 3, 3), pitch=(0.0125, 0.01, 0.01)),
    "bar 20:1": lambda: Bricks(mask=_full(40, 2, 2), pitch=(0.015, 0.015, 0.015)),
    "plate 20:1": lambda: Bricks(mask=_full(14, 9, 2), pitch=(0.3 / 14, 0.02, 0.0075)),
    "slab 0.24 x 0.06 x 0.02": lambda: Bricks(mask=_full(16, 6, 2), pitch=(0.015, 0.01, 0.01)),
    "L": lambda: Bricks(mask=_l(), pitch=(0.015, 0.015, 0.015), refine=2),
    "frame": lambda: Bricks(mask=_frame(), pitch=(0.01, 0.01, 0.01), refine=2),
    "cross": lambda: Bricks(mask=_cross(), pitch=(0.01, 0.01, 0.01), refine=2),
    "Y": lambda: Bricks(mask=_y(), pitch=(0.01, 0.01, 0.01), refine=2),
    "hand": lambda: Bricks(mask=_hand(), pitch=(0.01, 0.01, 0.01), refine=2),
    "steps": lambda: Bricks(mask=_steps(), pitch=(0.01, 0.01, 0.01), refine=2),
    "ring": lambda: Bricks(mask=_ring(), pitch=(0.01, 0.01, 0.01), refine=2),
    "T": lambda: Bricks(mask=_t(), pitch=(0.01, 0.01, 0.01), refine=2, end=(2, 1)),
    "dumbbell": lambda: Bricks(mask=_dumbbell(), pitch=(0.01, 0.01, 0.01), refine=2),
    "tube": lambda: Bricks(mask=_tube(), pitch=(0.01, 0.01, 0.01), refine=2),
    "cup": lambda: Bricks(mask=_cup(), pitch=(0.01, 0.01, 0.01), refine=2),
    "fork": lambda: Bricks(mask=_fork(), pitch=(0.01, 0.01, 0.01), refine=2),
    "plate 40:1": lambda: Bricks(mask=_full(20, 12, 2), pitch=(0.05, 0.05, 0.0125)),
    "rod 50:1": lambda: Bricks(mask=_full(50, 2, 2), pitch=(0.02, 0.01, 0.01), end=(0, 2)),
    "helix": lambda: Bricks(mask=_walk((8, 8, 12), HELIX), pitch=(0.01, 0.01, 0.01), refine=2, end=(2, 1)),
    "spiral": lambda: Bricks(mask=_walk((12, 12, 2), SPIRAL), pitch=(0.01, 0.01, 0.01), refine=2, end=(1, 2)),
}
"""Solids of bricks by name."""
TUBES: dict[str, Callable[[], Tube]] = {
    "round ring": lambda: Tube(radii=(0.036, 0.062), height=0.02, cells=(2, 32, 2)),
    "round tube": lambda: Tube(radii=(0.015, 0.025), height=0.12, cells=(2, 32, 16)),
}
"""Round ones."""


def eigenvalues(body: ReducedBody, poissons_ratio: float, count: int = 6) -> Array:
    """Return the first free eigenvalues of a body per E / rho [1/m^2], from its points and gradients alone."""
    value = np.linalg.eigvalsh(stiffness(body, poissons_ratio))
    return np.asarray(value[6 : 6 + count] / body.volume, dtype=np.float64)


def stiffness(body: ReducedBody, poissons_ratio: float) -> Array:
    """Return the stiffness of a body at rest per E [m], (3 n, 3 n), from its points and gradients alone."""
    E, nu = body.cubature.moduli(1.0, poissons_ratio)
    G, n = body.cubature.grad_basis.astype(np.float64), body.function_count

    def products(modulus: Array) -> Array:
        return np.einsum("p,pai,pbj->iajb", body.cubature.weights * modulus, G, G, optimize=True)

    shear = products(E / (2.0 * (1.0 + nu)))
    K = products(E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))) + shear.transpose(2, 1, 0, 3)
    for i in range(3):
        K[i, :, i] += np.einsum("kakb->ab", shear)
    return np.asarray(K.reshape(3 * n, 3 * n))


def frequency_errors(body: ReducedBody, reference: Array, poissons_ratio: float) -> tuple[float, float]:
    """Return the smallest and the largest relative error of the frequencies."""
    error = np.sqrt(eigenvalues(body, poissons_ratio, len(reference)) / reference) - 1.0
    return float(error.min()), float(error.max())
