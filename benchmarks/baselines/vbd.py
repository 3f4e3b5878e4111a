"""Newton's `SolverVBD`: vertex block descent on linear tetrahedra, with the same energy density as the reference.

The clamped half metre is left out and the first layer of vertices has no mass: an exact clamp. Implicit Euler of the
scene's step, which block descent minimises by a number of sweeps over the vertices; more sweeps, closer to the minimum.
"""

from __future__ import annotations

from itertools import permutations
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverVBD
from scipy import sparse

from benchmarks.baselines.common import FREE, SCENE, Row, lines_of, measure, sample


def run(cells: tuple[int, int, int], sweeps: int, steps: int) -> Row:
    """Bend the beam with six tetrahedra per cell and a number of sweeps per step."""
    vertices, tetrahedra = kuhn_mesh(lines_of(cells))
    nu, E = SCENE.poissons_ratio, SCENE.youngs_modulus
    identity: Any = wp.quat_identity()
    builder = newton.ModelBuilder()
    builder.add_soft_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=identity,
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*v) for v in vertices],
        indices=tetrahedra.ravel().tolist(),
        density=SCENE.density,
        k_mu=E / (2.0 * (1.0 + nu)),
        k_lambda=E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)),
        k_damp=0.0,
        particle_radius=1e-3,
    )
    held = np.flatnonzero(vertices[:, 0] < FREE[0, 0] + 1e-6)
    for vertex in held:
        builder.particle_mass[vertex] = 0.0
    builder.color()
    model: Any = builder.finalize(device="cpu")
    model.set_gravity(SCENE.gravity)
    solver = SolverVBD(model, iterations=sweeps, particle_enable_self_contact=False)
    states = [model.state(), model.state()]
    control = model.control()
    solver.step(states[0], states[1], control, None, SCENE.dt)  # compiles; the state is renewed below
    states[:] = [model.state(), model.state()]
    graphs = []
    for a, b in ((0, 1), (1, 0)):
        with wp.ScopedCapture(device="cpu") as capture:
            solver.step(states[a], states[b], control, None, SCENE.dt)
        graphs.append(capture.graph)
    states[0].assign(model.state())
    states[1].assign(model.state())
    points, _ = sample()
    matrix = kuhn_interpolation(lines_of(cells), points)
    count = 0

    def step() -> None:
        nonlocal count
        wp.capture_launch(graphs[count % 2])
        count += 1

    return measure(
        "Newton VBD, tetrahedra",
        f"{cells[0]} x {cells[1]} x {cells[2]}, {sweeps} sweeps",
        3 * (len(vertices) - len(held)),
        steps,
        step,
        lambda: matrix @ (states[count % 2].particle_q.numpy().astype(np.float64) - vertices),
    )


def kuhn_mesh(lines: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Cut every cell of a box grid into six tetrahedra along its diagonal; vertices (N, 3), tetrahedra (T, 4)."""
    vertices = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    counts = [len(line) for line in lines]
    cell = np.stack(np.meshgrid(*[np.arange(c - 1) for c in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    tetrahedra = []
    for path in permutations(range(3)):
        corner, corners = cell.copy(), [cell]
        for axis in path:
            corner = corner + np.eye(3, dtype=int)[axis]
            corners.append(corner)
        flat = np.stack([np.ravel_multi_index(tuple(c.T), counts) for c in corners], axis=1)
        odd = np.linalg.det(np.eye(3)[list(path)]) < 0.0
        tetrahedra.append(flat[:, [0, 2, 1, 3]] if odd else flat)
    return vertices, np.concatenate(tetrahedra)


def kuhn_interpolation(lines: list[np.ndarray], points: np.ndarray) -> sparse.csr_matrix:
    """Return the linear interpolation (P, N) on the tetrahedra of `kuhn_mesh`; points outside take no vertex."""
    counts = [len(line) for line in lines]
    inside = np.all([(points[:, d] >= lines[d][0]) & (points[:, d] <= lines[d][-1]) for d in range(3)], axis=0)
    cell = np.stack(
        [np.clip(np.searchsorted(lines[d], points[:, d], side="right") - 1, 0, counts[d] - 2) for d in range(3)], axis=1
    )
    low = np.stack([lines[d][cell[:, d]] for d in range(3)], axis=1)
    high = np.stack([lines[d][cell[:, d] + 1] for d in range(3)], axis=1)
    t = (points - low) / (high - low)
    order = np.argsort(-t, axis=1)
    sorted_t = np.take_along_axis(t, order, axis=1)
    weight = -np.diff(sorted_t, axis=1, prepend=1.0, append=0.0) * inside[:, None]
    corner, corners = cell.copy(), [cell]
    for k in range(3):
        corner = corner + np.eye(3, dtype=int)[order[:, k]]
        corners.append(corner)
    column = np.stack([np.ravel_multi_index(tuple(c.T), counts) for c in corners], axis=1)
    row = np.repeat(np.arange(len(points)), 4)
    return sparse.csr_matrix((weight.ravel(), (row, column.ravel())), shape=(len(points), int(np.prod(counts))))
