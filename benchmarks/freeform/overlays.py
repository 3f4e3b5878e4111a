"""Figures 5 and 6: beams and objects over what finite elements give, with magnified parts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy import FINE_RANK, KAPPA, affine
from benchmarks.accuracy_runner import Row, Simulation, body_of
from benchmarks.freeform.beam import default, freeform
from benchmarks.freeform.explicit import beam_particles
from benchmarks.freeform.figures import _panels, _save
from benchmarks.freeform.grips import STEPS
from benchmarks.freeform.meshes import read_folder, simulate
from benchmarks.freeform.objects import EQUAL, reduced_motion
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from tests.oracle import frames
from tests.oracle.scenes import SCENES

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

GREY, GREEN, BLUE, ORANGE = "0.7", "#2e9e4f", "#2f6fd0", "#d9822b"
SHOWN = (("armadillo", "farthest"), ("cow-low-resolution", "boundary"), ("cheburashka", "fix"))
"""Objects of figure 6 and what is done to them; others of the folder where it lacks one."""
ELEMENTS = 9
"""Along the longest edge, of the elements that are drawn."""
ZOOM = 0.22
"""Edge of the magnified square over the width of a picture."""


def paint(panel: Any, points: Array, faces: Faces, colour: str, view: Array, alpha: float = 1.0) -> None:
    """Draw triangles from far to near, shaded, as seen along the third row of a view (3, 3)."""
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgb

    corner = (points @ view.T)[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    front = np.flatnonzero(normal[:, 2] > 0.0)
    front = front[np.argsort(corner[front, :, 2].mean(axis=1), kind="stable")]
    light = 0.45 + 0.55 * np.clip(normal[front] @ np.array([0.3, 0.5, 0.81]), 0.0, 1.0)
    colours = np.column_stack([light[:, None] * np.array(to_rgb(colour)), np.full(len(front), alpha)])
    panel.add_collection(
        PolyCollection(list(corner[front, :, :2]), facecolors=colours, edgecolors="none", antialiased=False)
    )


def magnify(panel: Any, layers: list[tuple[Array, Faces, str, float]], view: Array, place: int) -> None:
    """Frame a panel on layers, and magnify the place of a vertex of the first."""
    flat = np.concatenate([points @ view.T for points, *_ in layers])
    lower, upper = flat[:, :2].min(axis=0), flat[:, :2].max(axis=0)
    edge = ZOOM * (upper - lower).max()
    at = (layers[0][0] @ view.T)[place, :2]
    room = 0.03 * (upper - lower).max()
    panel.set(xlim=(lower[0] - room, upper[0] + 2.6 * edge), ylim=(lower[1] - room, upper[1] + room))
    panel.set(aspect="equal", xticks=[], yticks=[])
    for side in panel.spines.values():
        side.set_visible(False)
    inset = panel.inset_axes(
        [upper[0] + 0.5 * edge, upper[1] - 2.1 * edge, 2.0 * edge, 2.0 * edge], transform=panel.transData
    )
    for target in (panel, inset):
        for points, faces, colour, alpha in layers:
            paint(target, points, faces, colour, view, alpha)
    inset.set(
        xlim=at[0] + edge * np.array([-0.5, 0.5]), ylim=at[1] + edge * np.array([-0.5, 0.5]), xticks=[], yticks=[]
    )
    panel.indicate_inset_zoom(inset, edgecolor="0.2")


def beam_surface(count: int = 12) -> tuple[Array, Faces]:
    """Return the surface of the oracle's beam as squares cut in two, (V, 3) and (T, 3)."""
    lower, upper = SCENES["bend"].shape.bounds
    cells = np.maximum(np.round(count * (upper - lower) / (upper - lower).min() / 2).astype(int), 1)
    points, faces = [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, 1):
            grid = np.stack(np.meshgrid(np.arange(cells[u] + 1), np.arange(cells[v] + 1), indexing="ij"), axis=-1)
            at = np.zeros((grid[..., 0].size, 3))
            at[:, [u, v]] = lower[[u, v]] + grid.reshape(-1, 2) / cells[[u, v]] * (upper - lower)[[u, v]]
            at[:, axis] = (lower, upper)[side][axis]
            i, j = np.meshgrid(np.arange(cells[u]), np.arange(cells[v]), indexing="ij")
            a = (i * (cells[v] + 1) + j).ravel() + sum(map(len, points))
            b, c, d = a + cells[v] + 1, a + cells[v] + 2, a + 1
            triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
            faces.append(triangles if side else triangles[:, ::-1])
            points.append(at)
    return np.concatenate(points), np.concatenate(faces)


def figure5(path: Path, *, quick: bool = False) -> dict[str, float]:
    """Draw the bent and the twisted beam of three methods over finite elements; return the largest distances [m]."""
    rest, faces = beam_surface()
    figure, panels = _panels(2, 3, (12.0, 4.4))
    view = np.array([[1.0, 0.0, 0.0], [0.0, 0.25, 0.97], [0.0, -0.97, 0.25]])
    record = {}
    for row, (name, at) in enumerate((("bend", 90), ("twist_360", 100))):
        scene, at = SCENES[name], 2 if quick else at
        expected = rest + frames.load(name).displacement(rest, slice(at, at + 1))[0]
        found: dict[str, tuple[Array, str]] = {}
        for label, options, colour in (
            ("FreeForm's functions, m = 16", freeform(16), GREEN),
            ("default functions, 68", default(68), BLUE),
        ):
            body = body_of(SCENES["bend"], options, 5000, "none", None)[0]
            spring_row = Row(label="", scene=name, options=BuildOptions(), stiffness=KAPPA)
            q = Simulation(scene, body, spring_row).run(at)[0]
            found[label] = rest + body.evaluate(rest - body.offset)[0] @ (q[-1] - q[0]), colour
        particles = beam_particles(scene, 0.25)
        moved = particles.rest
        for _ in range(at):
            moved = particles.step()
        near = ((rest[:, None] - particles.rest) ** 2).sum(axis=2).argsort(axis=1)[:, :8]
        found["softmode's MPM, cells of 0.25 m"] = rest + carried(rest, particles.rest, moved, near), ORANGE
        place = None
        for column, (label, (points, colour)) in enumerate(found.items()):
            off = np.linalg.norm(points - expected, axis=1)
            record[f"{name}, {label}"] = float(off.max())
            panel = panels[3 * row + column]
            layers = [(points, faces, colour, 1.0), (expected, faces, GREY, 0.5)]
            place = int(off.argmax()) if place is None else place
            magnify(panel, layers, view, place)
            panel.set_title(f"{label}: up to {off.max():.2f} m off", fontsize=9)
    _save(figure, path)
    return record


def carried(points: Array, rest: Array, moved: Array, near: NDArray[np.intp]) -> Array:
    """Return displacements at points, linear in the place, fitted to those of the nearest particles."""
    found = np.empty_like(points)
    for k, rows in enumerate(near):
        design = np.column_stack([np.ones(len(rows)), rest[rows] - points[k]])
        found[k] = np.linalg.lstsq(design, moved[rows], rcond=None)[0][0]
    return found


def figure6(folder: Path, path: Path, *, quick: bool = False) -> dict[str, float]:
    """Draw objects of a folder over finite elements; return the largest distances [m]."""
    things = {thing.name: thing for thing in read_folder(folder)}
    shown = [(things.pop(name), condition) for name, condition in SHOWN if name in things]
    left = [condition for name, condition in SHOWN if name not in {thing.name for thing, _ in shown}]
    shown += list(zip(things.values(), left, strict=False))
    figure, panels = _panels(2, len(shown), (4.6 * len(shown), 7.4))
    bases: dict[str, tuple[Any, str]] = {
        "FreeForm's functions, m = 16": (affine(16, rank_tolerance=FINE_RANK), GREEN),
        "default functions, 68": (EQUAL["default, 68"], BLUE),
    }
    names = {"farthest": "four far points pulled", "boundary": "both ends pulled", "fix": "held below"}
    record = {}
    for column, (thing, condition) in enumerate(shown):
        steps, grip = 2 if quick else STEPS, thing.grip(condition)
        rest, faces = thing.vertices, thing.faces
        expected = rest + simulate(thing, grip, rest, 4 if quick else ELEMENTS, steps)[-1]
        view = np.array([[0.94, 0.0, -0.34], [0.06, 0.98, 0.17], [0.34, -0.18, 0.92]])
        place = None
        for row, (label, (options, colour)) in enumerate(bases.items()):
            body = build_body(thing.quadrature, options, name=thing.name, progress=False)
            points = rest + reduced_motion(thing, grip, body, rest, steps)[0][-1]
            off = np.linalg.norm(points - expected, axis=1)
            record[f"{thing.name}, {condition}, {label}"] = float(off.max())
            panel = panels[len(shown) * row + column]
            place = int(off.argmax()) if place is None else place
            magnify(panel, [(points, faces, colour, 1.0), (expected, faces, GREY, 0.5)], view, place)
            panel.set_title(
                f"{label}\n{names[condition]}: up to {100.0 * off.max():.1f} % of its length off", fontsize=9
            )
    _save(figure, path)
    return record
