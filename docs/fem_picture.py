"""Draw finite elements beside softmode's bodies under the same loads: PIE-NeRF's figure 8.

Run: ``python docs/fem_picture.py [docs/images]`` in the root of the repository; needs matplotlib (``pip install
'softmode[viz]'``). Solids of bricks stand on an end that is held, and are bent far by a uniform acceleration: quadratic
hexahedra of the tests' oracle above, bodies of 48 functions below, the same stable Neo-Hookean energy, nu = 0.4.
Colours are displacements; the error is that of all nodes, root mean square, over the largest displacement.
"""

from __future__ import annotations

import argparse
import sys
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for the finite elements of the tests

from softmode.deformables import Material, Region, SolverReducedOptions, add_reduced_body, build_body
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.quadrature.quadrature import quadrature_from_mesh
from tests.oracle.fem import Solid, static
from tests.oracle.solids import SOLIDS, Bricks
from tests.scenes import Scene

Array = NDArray[np.float64]
MATERIAL = Material(youngs_modulus=1.0e5, poissons_ratio=0.4, density=1000.0, viscosity=0.0)
CASES = {
    "bar 10:1": (0, 1, (0.0, 4.0, -8.0)),
    "plate 20:1": (0, 1, (0.0, 6.0, -4.0)),
    "L": (2, 1, (30.0, 60.0, 0.0)),
}
"""Axis along whose lower side so many layers of bricks are held, and the acceleration [m/s^2]."""
LOAD_STEPS, STEPS, DT = 4, 400, 0.04
VIEW = {"elev": 18.0, "azim": -62.0}


def outer_faces(solid: Bricks) -> Array:
    """Return the corners of the outer faces of the bricks [m], (F, 4, 3)."""
    padded, faces = np.pad(solid.mask, 1), []
    for axis, side in product(range(3), (0, 1)):
        index = np.argwhere(solid.mask & ~np.roll(padded, 1 - 2 * side, axis)[1:-1, 1:-1, 1:-1])
        a, b = (d for d in range(3) if d != axis)
        corner = np.zeros((4, 3))
        corner[:, axis] = side
        corner[:, a], corner[:, b] = (0, 1, 1, 0), (0, 0, 1, 1)
        faces.append((index[:, None] + corner) * solid.pitch)
    return np.concatenate(faces)


def by_elements(solid: Bricks, axis: int, height: float, acceleration: Array) -> tuple[Solid, Array]:
    """Return the finite elements, and where their nodes are at rest under the load [m], (N, 3)."""
    elements = Solid(solid.mesh(), energy="stable_neo_hookean_log", youngs_modulus=MATERIAL.youngs_modulus,
                     poissons_ratio=MATERIAL.poissons_ratio, density=MATERIAL.density)  # fmt: skip
    nodes = elements.mesh.nodes
    held = nodes[:, axis] < height + 1e-9
    force = elements.body_force(acceleration)
    return elements, static(elements, held=held, target=nodes, force=force, load_steps=LOAD_STEPS)


def by_body(solid: Bricks, axis: int, height: float, acceleration: Array) -> tuple[ReducedBody, Array]:
    """Return the body with its end as an exact region, and its coordinates [m] at rest under the load."""
    box = np.array([[-np.inf] * 3, [np.inf] * 3])
    box[1, axis] = height
    body = build_body(quadrature_from_mesh(*solid.surface()), regions=[Region(name="end", box=box)], progress=False)
    scene = Scene(
        lambda builder: add_reduced_body(builder, body, material=MATERIAL),
        [body],
        gravity=tuple(acceleration),
        options=SolverReducedOptions(tolerance=1e-7, contact_max=1),
        dt=DT,
    )
    start = before = scene.q()
    for _ in range(STEPS):
        scene.step()
        now = scene.q()
        if np.abs(now - before).max() < 1e-5 * np.abs(now - start).max():
            return body, now - start
        before = now
    raise RuntimeError("the body does not come to rest")


def draw(axes: Any, corners: Array, size: Array, largest: float, title: str) -> None:
    """Draw faces (F, 4, 3) coloured by the displacements of their corners (F, 4) [m]."""
    from matplotlib import colormaps
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    shade = 0.72 + 0.28 * np.abs(normal @ [0.2, -0.5, 0.84]) / np.linalg.norm(normal, axis=1)
    color = colormaps["viridis"](size.mean(axis=1) / largest)
    color[:, :3] *= shade[:, None]
    axes.add_collection3d(Poly3DCollection(corners, facecolors=color, edgecolors=(0, 0, 0, 0.25), linewidths=0.3))
    axes.set_title(title, fontsize=10, y=1.0)
    axes.set_axis_off()


def main() -> None:
    """Draw the pictures and print the errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("docs/images"))
    folder = parser.parse_args().folder
    import matplotlib.pyplot as plt

    picture = plt.figure(figsize=(11.0, 7.0), layout="constrained")
    for k, (name, (axis, layers, load)) in enumerate(CASES.items()):
        solid, acceleration = SOLIDS[name](), np.asarray(load)
        height = layers * solid.pitch[axis]
        elements, x = by_elements(solid, axis, height, acceleration)
        body, q = by_body(solid, axis, height, acceleration)
        nodes = elements.mesh.nodes
        own = body.evaluate(nodes - body.offset)[0] @ q
        largest = float(np.linalg.norm(x - nodes, axis=1).max())
        error = float(np.sqrt(np.square(own - (x - nodes)).sum(axis=1).mean()) / largest)
        counts = f"{len(nodes)} nodes, {body.function_count} functions"
        print(f"{name}: {counts}, moved by {1e3 * largest:.1f} mm, error {error:.4f}", flush=True)
        corners = outer_faces(solid)
        flat = corners.reshape(-1, 3)
        moves = elements.mesh.interpolation(flat) @ (x - nodes), body.evaluate(flat - body.offset)[0] @ q
        places = [corners + move.reshape(corners.shape) for move in moves]
        every = np.concatenate([places[0].reshape(-1, 3), places[1].reshape(-1, 3)])
        titles = (
            f"{name}: FEM, {3 * len(nodes):,} unknowns",
            f"softmode, {3 * body.function_count} unknowns: {error:.1%}",
        )
        for row in range(2):
            axes: Any = picture.add_subplot(2, 3, 1 + k + 3 * row, projection="3d")
            size = np.linalg.norm(moves[row], axis=1).reshape(corners.shape[:2])
            draw(axes, places[row], size, largest, titles[row])
            low, high = every.min(axis=0), every.max(axis=0)
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
            axes.set_box_aspect(high - low, zoom=1.0)
            axes.view_init(**VIEW)
    target = folder / "fem.png"
    picture.savefig(target, dpi=110, facecolor="white")
    print(target)


if __name__ == "__main__":
    main()
