"""Frequencies of free bodies of two moduli, 1 to 10, beside finite elements: which mean a cell that a jump cuts wants.

Run from the repository root: ``python -m benchmarks.moduli``.

A row: a solid, the position of its jump in no relation to the grid, and the smallest and largest relative error of its
first six frequencies, in percent, with the modulus at each quadrature point (what `build_body` takes), and with its
mean over the eighth of a cell that the point stands for.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from softmode.deformables import BuildOptions, Quadrature, build_body, quadrature_from_box
from tests.oracle.fem import Mesh, free_eigenvalues
from tests.oracle.solids import frequency_errors

Array = NDArray[np.float64]
MEANS: dict[str, Callable[[Array], Array]] = {
    "arithmetic": lambda E: E.mean(axis=1),
    "geometric": lambda E: np.exp(np.log(E).mean(axis=1)),
    "harmonic": lambda E: 1.0 / (1.0 / E).mean(axis=1),
}
CASES = {
    "bar, along": ((0.3, 0.03, 0.03), 0, 0.013),
    "plate, two layers": ((0.2, 0.1, 0.02), 2, -0.004),
    "bar, side by side": ((0.3, 0.03, 0.03), 1, 0.0031),
}
"""Edges [m], the axis along which the modulus jumps, and where [m]."""


def two_moduli(axis: int, jump: float) -> Callable[[Array], Array]:
    """Return a field that is 1 below a plane and 10 above it."""
    return lambda X: np.where(X[..., axis] > jump, 10.0, 1.0)


def two_moduli_mesh(size: tuple[float, float, float], axis: int, jump: float) -> tuple[Mesh, Array]:
    """Return elements whose faces lie on the jump, and their moduli."""
    lines = []
    for d, edge in enumerate(size):
        count = max(2, round(24 * edge / max(size)))
        line = np.linspace(-0.5 * edge, 0.5 * edge, count + 1)
        if d == axis:
            below = max(2, round(count * (jump / edge + 0.5)))
            parts = (
                np.linspace(-0.5 * edge, jump, below + 1),
                np.linspace(jump, 0.5 * edge, max(count - below, 2) + 1),
            )
            line = np.concatenate([parts[0], parts[1][1:]])
        lines.append(line)
    mesh = Mesh(tuple(lines), np.ones([len(line) - 1 for line in lines], dtype=bool))
    return mesh, two_moduli(axis, jump)(mesh.nodes[mesh.elements].mean(axis=1))


def samples(quadrature: Quadrature) -> Array:
    """Return 64 points in the eighth of a cell of every point of a box [m], shape (P, 64, 3)."""
    assert quadrature.cells is not None
    octants = quadrature.cells.octants
    edge = [np.diff(np.unique(octants[:, d].round(9))).min() for d in range(3)]
    steps = (np.arange(4) + 0.5) / 4.0 - 0.5
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    near = ((quadrature.points[:, None] - octants[None]) ** 2).sum(axis=2).argmin(axis=1)
    return octants[near][:, None] + grid * edge


def main() -> None:
    """Print the table."""
    print(f"{'solid':<20}{'points':>8}{'at the point':>18}" + "".join(f"{name:>18}" for name in MEANS))
    for name, (size, axis, jump) in CASES.items():
        mesh, moduli = two_moduli_mesh(size, axis, jump)
        reference = free_eigenvalues(mesh, 0.3, stiffness=moduli)
        field = two_moduli(axis, jump)
        for count in (1500, 4000):
            quadrature = quadrature_from_box(size, point_count=count)
            inside = field(samples(quadrature))
            cells = []
            for values in (field(quadrature.points), *(mean(inside) for mean in MEANS.values())):
                options = BuildOptions(poissons_ratio=0.3, cubature_count=None)
                body = build_body(quadrature, options, stiffness_scale=values, progress=False)
                low, high = frequency_errors(body, reference, 0.3)
                cells.append(f"{100 * low:+.1f}..{100 * high:+.1f} %")
            print(f"{name:<20}{count:>8}" + "".join(f"{cell:>18}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
