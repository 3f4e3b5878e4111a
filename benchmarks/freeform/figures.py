"""Figures 4 and 7: the first Laplacian eigenmode on three kinds of kernels, and the numerical fracture of MPM."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from benchmarks.accuracy_runner import Row, Simulation, body_of
from benchmarks.baselines.mpm import Particles
from softmode.deformables.body.rkpm import BasisRKPM, make_basis
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.reduction.options import BuildOptions
from tests.oracle.scenes import BEAM, LEFT, RIGHT, Clamp, Motion, Scene

Array = NDArray[np.float64]

SLAB = (2.0, 1.0, 0.5)
"""Edges of figure 4's box [m]; its first eigenmode is cos(pi x / L)."""
KINDS = ("RBF", "partition of unity", "RKPM")
STRETCH = Scene(
    name="stretch",
    shape=BEAM,
    youngs_modulus=5.0e5,
    clamps=(Clamp(region=LEFT), Clamp(region=RIGHT, motion=Motion(velocity=(5.0, 0.0, 0.0)))),
    dt=0.05,
    steps=40,
)
"""The beam of figure 7: its right end is drawn out by 10 m, so that the 4 m between the clamps become 14 m."""


def kernels(kind: str, basis: BasisRKPM, points: Array) -> tuple[Array, Array]:
    """Return Gaussians (N, K) and gradients (3, N, K) as they are, divided by their sum, or corrected."""
    if kind == "RKPM":
        found = basis.evaluate(points)
        return found.value.toarray(), np.stack([part.toarray() for part in found.gradient])
    offset = points[:, None] - basis.centres
    value = np.exp(-(offset**2).sum(axis=2) / basis.radii**2)
    slope = -2.0 * (value / basis.radii**2) * offset.transpose(2, 0, 1)
    if kind == "RBF":
        return value, slope
    total, total_slope = value.sum(axis=1, keepdims=True), slope.sum(axis=2, keepdims=True)
    return value / total, (slope - value / total * total_slope) / total


def first_mode(kind: str, basis: BasisRKPM, points: Array, weights: Array) -> tuple[Array, float]:
    """Return coefficients of the first eigenmode beyond the (nearly) constant one, and its eigenvalue [1/m^2]."""
    value, slope = kernels(kind, basis, points)
    mass = value.T @ (weights[:, None] * value)
    energy = sum(part.T @ (weights[:, None] * part) for part in slope)
    ridge = 1e-12 * np.trace(mass) / len(mass) * np.eye(len(mass))
    found, modes = linalg.eigh(energy, mass + ridge, subset_by_index=[0, 1])
    return modes[:, 1], float(found[1])


def figure4(path: Path, *, quick: bool = False) -> dict[str, Any]:
    """Draw the mode and its slope on the three kinds, centres alike; return their distances to the closed form."""
    quadrature = quadrature_from_box(SLAB, point_count=1000 if quick else 12_000)
    basis = make_basis(quadrature.points, 100 if quick else 400, kernel="gaussian", spacing=0.0)
    share = quadrature.weights / quadrature.volume
    wave = np.pi / SLAB[0]
    axes = [np.linspace(-0.5 * size, 0.5 * size, count) for size, count in zip(SLAB[:2], (121, 61), strict=True)]
    plane = np.stack(np.meshgrid(*axes, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    figure, panels = _panels(2, 3, (9.5, 3.8))
    record = {}
    for column, kind in enumerate(KINDS):
        mode, eigenvalue = first_mode(kind, basis, quadrature.points, share)
        value, slope = kernels(kind, basis, quadrature.points)
        field, expected = value @ mode, np.sin(wave * quadrature.points[:, 0])
        factor = (share * field) @ expected / ((share * field) @ field)
        off = factor * (slope @ mode)
        off[0] -= wave * np.cos(wave * quadrature.points[:, 0])
        record[kind] = {
            "distance": float(np.sqrt(share @ (factor * field - expected) ** 2 / 0.5)),
            "slope distance": float(np.sqrt(share @ (off**2).sum(axis=0) / (0.5 * wave**2))),
            "eigenvalue": eigenvalue / wave**2,
        }
        shown, shown_slope = kernels(kind, basis, plane)
        drawn = (shown @ mode, shown_slope[0] @ mode / wave)
        for row, (picture, key) in enumerate(zip(drawn, ("distance", "slope distance"), strict=True)):
            panel = panels[3 * row + column]
            levels = np.linspace(-1.3, 1.3, 27) if row == 0 else np.linspace(-0.5, 1.5, 21)
            panel.contourf(*axes, factor * picture.reshape(121, 61).T, levels, cmap="RdBu_r", extend="both")
            near = np.abs(basis.centres[:, 2]) < 0.1
            panel.plot(*basis.centres[near, :2].T, ".", color="0.2", markersize=1.5)
            what = kind if row == 0 else "its slope along x"
            panel.set(title=f"{what}: {100.0 * record[kind][key]:.1f} % off", xticks=[], yticks=[], aspect="equal")
    _save(figure, path)
    return record


def figure7(path: Path, *, quick: bool = False) -> dict[str, Any]:
    """Draw the stretched beam of MPM on two grids and of softmode; return the gaps between neighbours."""
    scene = dataclasses.replace(STRETCH, steps=2) if quick else STRETCH
    rest, moved = {}, {}
    for voxel, per_cell in ((0.5, 2), (1.0, 4)):  # the same particles; cells of 0.33 m end in NaN
        beam = Particles(scene, voxel, per_cell=per_cell)
        for _ in range(scene.steps):
            beam.step()
        label = f"MPM, cells of {voxel:.2g} m"
        rest[label], moved[label] = beam.rest, beam.rest + beam.displacement()
    body = body_of(scene, BuildOptions(mode_count=3, poissons_ratio=scene.poissons_ratio), 5000, "exact", None)[0]
    row = Row(label="", scene=scene.name, options=BuildOptions(), stiffness=None)
    q = Simulation(scene, body, row).run(scene.steps)[0]
    points = next(iter(rest.values()))
    rest["softmode"] = points
    moved["softmode"] = points + body.evaluate(points - body.offset)[0] @ (q[-1] - q[0])
    gaps = {label: longest_gap(rest[label], moved[label]) for label in rest}
    figure, panels = _panels(len(rest), 1, (9.5, 4.2))
    for panel, label in zip(panels, rest, strict=True):
        panel.scatter(*moved[label][:, [0, 2]].T, 9, rest[label][:, 0], cmap="viridis")
        panel.set(title=f"{label}: neighbours up to {gaps[label]:.1f} times their distance at rest", aspect="equal")
        panel.set(xlim=(-2.7, 12.7), ylim=(-0.7, 0.7), yticks=[])
    _save(figure, path)
    return gaps


def longest_gap(rest: Array, moved: Array) -> float:
    """Return the largest distance of neighbours along x, over that at rest; points on a grid."""
    order = np.lexsort((rest[:, 0], rest[:, 1], rest[:, 2]))
    before, after = rest[order], moved[order]
    step = np.diff(before[:, 0])
    inside = step > 0.0
    return float((np.linalg.norm(np.diff(after, axis=0), axis=1)[inside] / step[inside]).max())


def _panels(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, Any]:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(rows, columns, figsize=size, layout="constrained")
    return figure, panels.ravel()


def _save(figure: Any, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
