"""Draw the picture of docs/method.md: FreeForm's functions and those chosen by elastic energy, beside finite elements.

Run: ``python docs/method_picture.py [docs/images]`` in the root of the repository; needs matplotlib (``pip install
'softmode[viz]'``). A bar of 300 x 40 x 30 mm, free, nu = 0.49: its first bending by each, with the relative change of
volume; then the skinning weights that FreeForm's functions are made of, and the functions that are chosen.
"""

from __future__ import annotations

import argparse
import sys
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legval
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for the finite elements of the tests

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.reduction.reduced_stiffness import reduced_stiffness
from tests.oracle.fem import free_modes
from tests.oracle.solids import Bricks

Array = NDArray[np.float64]

RATIO, MODULUS, DENSITY = 0.49, 1.0e6, 1000.0
BAR = Bricks(mask=np.ones((24, 4, 3), dtype=bool), pitch=(0.0125, 0.01, 0.01))
SIZE = (0.3, 0.04, 0.03)
BEND, BULGE = 0.03, 10.0
"""Deflection that is drawn [m], and how much the mean section of the middle half is exaggerated beyond it."""


def modes_of(body: ReducedBody, nodes: Array) -> tuple[Array, Array]:
    """Return the first eigenvalues of a body per E / rho [1/m^2], (6,), and its modes at nodes, (N, 3, 6)."""
    gradient = body.cubature.grad_basis.astype(np.float64).transpose(1, 2, 0)
    value, mode = np.linalg.eigh(reduced_stiffness(gradient, body.cubature.weights, RATIO) / body.volume)
    return value[6:12], np.einsum("pk,dkm->pdm", body.evaluate(nodes)[0], mode[:, 6:12].reshape(3, -1, 6))


def draw_bending(axis: Any, section: Any, title: str, grid: Array, u: Array) -> Any:
    """Draw side and mean section of a bar whose nodes (X, Y, Z, 3) move by u, coloured by change of volume."""
    u = u * (BEND / u[u.shape[0] // 2, :, :, 2].mean() / 2.0)
    lines = [np.unique(grid[..., d].round(9)) for d in range(3)]
    change = sum(np.gradient(u[..., d], lines[d], axis=d) for d in range(3))
    strain = np.gradient(u[..., 0], lines[0], axis=0)
    relative = change / np.abs(strain).max()
    x, side = grid + u, grid.shape[1] // 2
    options = {"cmap": "RdBu", "vmin": -0.3, "vmax": 0.3, "shading": "gouraud"}
    shown = axis.pcolormesh(x[:, side, :, 0], x[:, side, :, 2], relative[:, side], **options)
    axis.set_title(title, fontsize=10)
    quarter = grid.shape[0] // 4
    rest, own = (field[quarter:-quarter, ..., 1:].mean(axis=0) for field in (grid, u))
    own = own - own.mean(axis=(0, 1))
    across = np.stack([-rest[..., 1], rest[..., 0]], axis=-1)  # the section is drawn without its own turn
    own = own - (own * across).sum() / (across * across).sum() * across
    y, z = np.moveaxis(rest + BULGE * own, -1, 0)
    section.pcolormesh(y, z, relative[quarter:-quarter].mean(axis=0), **options)
    for part in (axis, section):
        part.set_aspect("equal")
        part.set_axis_off()
    return shown


def draw_function(axis: Any, value: Any, title: str) -> None:
    """Colour the visible faces of the bar by a function of points (N, 3)."""
    half = 0.5 * np.array(SIZE)
    value_max = 0.0
    faces = []
    for fixed, sign in ((0, 1.0), (1, -1.0), (2, 1.0)):
        a, b = [d for d in range(3) if d != fixed]
        points = np.empty((40, 40, 3))
        points[..., fixed] = sign * half[fixed]
        points[..., a], points[..., b] = np.meshgrid(*(np.linspace(-half[d], half[d], 40) for d in (a, b)))
        found = value(points.reshape(-1, 3)).reshape(40, 40)
        value_max = max(value_max, float(np.abs(found).max()))
        faces.append((points, found))
    for points, found in faces:
        x, y, z = np.moveaxis(points, -1, 0)
        across, up = 0.45 * x + 0.7 * y, z + 0.35 * y - 0.04 * x  # the bar is drawn shorter than it is
        axis.pcolormesh(across, up, found, cmap="PuOr", vmin=-value_max, vmax=value_max, shading="gouraud")
    axis.set_title(title, fontsize=9)
    axis.set_aspect("equal")
    axis.set_axis_off()


def name_of(values: Array, points: Array) -> str:
    """Return the product of polynomials along x, and monomials across, that a function resembles most."""
    x, y, z = (points / (0.5 * np.array(SIZE))).T
    squares = (y * SIZE[1]) ** 2 - (z * SIZE[2]) ** 2
    across = {"": np.ones_like(x), "y": y, "z": z, "yz": y * z, "(y^2-z^2)": squares}
    found = {}
    for (text, f), order in product(across.items(), range(6)):
        g = legval(x, np.eye(6)[order]) * f
        g = g - g.mean()
        along = {0: "", 1: "x"}.get(order, f"P_{order}(x)")
        label = f"{along} {text}".strip()
        if np.linalg.norm(g) > 0.0:
            found[label] = float(abs(g @ values) / (np.linalg.norm(g) * np.linalg.norm(values)))
    best = max(found, key=lambda label: found[label])
    return f"${best}$" if found[best] > 0.8 else f"${best}$ and others"


def main() -> None:
    """Draw everything."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("docs/images"))
    folder = parser.parse_args().folder
    import matplotlib.pyplot as plt

    mesh = BAR.mesh()
    nodes = mesh.nodes - 0.5 * np.array(SIZE)
    order = np.lexsort(nodes.round(9).T[::-1])
    counts = [len(np.unique(nodes[:, d].round(9))) for d in range(3)]
    grid = nodes[order].reshape(*counts, 3)
    quadrature = quadrature_from_box(SIZE, point_count=4000)
    old = build_body(quadrature, BuildOptions(mode_count=8, cubature_count=None), name="freeform", progress=False)
    new = build_body(quadrature, BuildOptions(poissons_ratio=RATIO, cubature_count=None), name="chosen", progress=False)
    cases = {}
    for label, body in ((f"FreeForm's {old.function_count}", old), (f"{new.function_count} chosen", new)):
        cases[label] = modes_of(body, grid.reshape(-1, 3) - body.offset)
    value, mode = free_modes(mesh, RATIO)
    cases[f"FEM, {len(nodes):,} nodes"] = value, mode[order]

    picture = plt.figure(figsize=(11.0, 6.0), layout="constrained")
    rows = picture.add_gridspec(4, 1, height_ratios=(2.0, 0.75, 0.75, 0.75))
    top = rows[0].subgridspec(2, 3, height_ratios=(1.0, 1.0))
    shown = None
    for k, (label, (values, modes)) in enumerate(cases.items()):
        share = np.square(modes).sum(axis=0)
        flat = int((share[2] > 0.5 * share.sum(axis=0)).argmax())  # The first that bends the thinner way.
        hertz, u = np.sqrt(values[flat] * MODULUS / DENSITY) / (2.0 * np.pi), modes[:, :, flat]
        axes = picture.add_subplot(top[0, k]), picture.add_subplot(top[1, k])
        shown = draw_bending(*axes, f"{label}: first bending {hertz:.2f} Hz", grid, u.reshape(*counts, 3))
        print(label, np.round(np.sqrt(values * MODULUS / DENSITY) / (2.0 * np.pi), 2))
    assert shown is not None
    bar = picture.colorbar(shown, ax=picture.axes, shrink=0.7, pad=0.01)
    bar.set_label("change of volume / largest bending strain", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    weights = rows[1].subgridspec(1, 5)
    for k in range(5):
        axis = picture.add_subplot(weights[k])
        draw_function(axis, lambda x, k=k: old.skinning_weights(x)[0][:, 1 + k], f"weight $W_{{{k + 1}}}$")
    for row in range(2):
        cells = rows[2 + row].subgridspec(1, 5)
        for column in range(5):
            k = 4 + 5 * row + column
            values = new.evaluate(new.cubature.points)[0][:, k]
            title = f"$b_{{{k}}}$: {name_of(values, new.cubature.points)}"
            draw_function(picture.add_subplot(cells[column]), lambda x, k=k: new.evaluate(x)[0][:, k], title)
    target = folder / "method_functions.png"
    picture.savefig(target, dpi=110, facecolor="white")
    print(target)


if __name__ == "__main__":
    main()
