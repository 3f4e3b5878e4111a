"""References for edges and corners by finite elements, in three dimensions: what presses, and what is pressed.

Run: ``python -m benchmarks.edge_elements``. Force over E edge^2 at depths of 1, 2, 3 and 5 % of a cube's edge, nu 0.3,
without friction, on two meshes each (about ten minutes):

- wedge: a rigid edge of 90 degrees across the middle of the upper face of a cube that stands on a plate,
- corner: a corner of a rigid box there, its three faces alike;
- tips: the closed tips of the arm's fingers, 24 by 12 mm, on a block as high as PressSoft's pad and as wide, over its
  height of 40 mm, which stands on a plate;
- own edge, own corner: the cube itself between two plates that press opposite edges or corners, each so deep.

Elements and material are those of `hertz_elements`. Nodes are kept out of the rigid body by a penalty a thousand times
as stiff as the cube. Cubes that are alike under a group of rotations and mirrors are solved for what is alike.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from itertools import permutations
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse import linalg
from scipy.spatial import KDTree

from benchmarks.hertz_elements import Array, Ints, Mask, elastic, integrate

DEPTHS = (0.01, 0.02, 0.03, 0.05)
"""Over the edge."""
CAP = 0.004
"""Largest motion of a node in an iteration, over the edge."""
Top = tuple[Ints, Array, Callable[[float], tuple[Array, Array]]]
"""Nodes that may be touched, their areas, and at a depth the faces of what presses: outward normals and offsets."""


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    print("force over E edge^2 at depths over the edge of", *DEPTHS)
    cases = ((wedge, (18, 5, 16), (26, 6, 22)), (corner, (7, 7, 9), (9, 8, 11)))
    for case, *meshes in (
        *cases,
        (tips, (8, 6, 12), (11, 8, 14)),
        (own_edge, (12, 3), (20, 4)),
        (own_corner, (16,), (22,)),
    ):
        for counts in meshes:
            print(case.__name__, *counts, *(f"{force:.6f}" for force in case(*counts)), flush=True)


def line(count: int) -> Array:
    """Return points from 0 to 1, finer towards 0."""
    x = np.linspace(0.0, 1.0, count + 1)
    return 0.95 * x**3 + 0.05 * x


def both(count: int) -> Array:
    """Return points from -0.5 to 0.5, finer towards both ends."""
    half = 0.5 * line(count // 2)
    return np.concatenate([-0.5 + half, 0.5 - half[::-1][1:]])


def grid(lines: Sequence[Array]) -> tuple[Array, Ints, Ints]:
    """Return nodes, their index by place, and the corners of the elements."""
    x = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3)
    n = [len(points) - 1 for points in lines]
    index = np.arange(len(x)).reshape([k + 1 for k in n])
    parts = [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    return x, index, np.stack([index[a : n[0] + a, b : n[1] + b, c : n[2] + c].ravel() for a, b, c in parts], -1)


def face(index: Ints, lines: Sequence[Array], axis: int, end: int) -> tuple[Ints, Array]:
    """Return the nodes of a face of the grid and their areas."""
    a, b = (np.convolve(np.diff(lines[k]), [0.5, 0.5]) for k in range(3) if k != axis)
    return np.take(index, end, axis).ravel(), np.outer(a, b).ravel()


def joined(faces: Sequence[tuple[Ints, Array]]) -> tuple[Ints, Array]:
    """Return nodes and areas of several faces, each node once."""
    nodes, places = np.unique(np.concatenate([nodes for nodes, _ in faces]), return_inverse=True)
    return nodes, np.asarray(np.bincount(places, np.concatenate([area for _, area in faces])), dtype=float)


def wedge(across: int, along: int, deep: int) -> Array:
    """Return the forces of a wedge along Y: a quarter of the cube is solved."""
    lines = (0.5 * line(across), 0.5 * np.linspace(0.0, 1.0, along + 1), 1.0 - line(deep)[::-1])
    x, index, corners = grid(lines)
    normals = np.array([[1.0, 0.0, -1.0], [-1.0, 0.0, -1.0]]) / np.sqrt(2.0)
    top = (*face(index, lines, 2, -1), lambda depth: (normals, (depth - 1.0) / np.sqrt(2.0) * np.ones(2)))
    return -4.0 * press(x, corners, only(x, x < 1.0e-9), [top])[:, 2]


def corner(across: int, along: int, deep: int) -> Array:
    """Return the forces of a corner, one of its faces towards X: half of the cube is solved."""
    half = 0.5 * line(across)
    lines = (np.concatenate([-half[::-1], half[1:]]), 0.5 * line(along), 1.0 - line(deep)[::-1])
    x, index, corners = grid(lines)
    angle = np.arange(3) * 2.0 * np.pi / 3.0
    flat = np.sqrt(2.0 / 3.0)
    normals = np.stack([flat * np.cos(angle), flat * np.sin(angle), -np.ones(3) / np.sqrt(3.0)], -1)
    held = np.zeros(x.shape, dtype=bool)
    held[:, 1:] = x[:, 1:] < 1.0e-9
    held[index[across, 0, 0], 0] = True
    top = (*face(index, lines, 2, -1), lambda depth: (normals, normals[:, 2] * (1.0 - depth)))
    return -2.0 * press(x, corners, only(x, held), [top])[:, 2]


def tips(under: int, beside: int, deep: int) -> Array:
    """Return the forces of a flat punch on the nodes under it at rest: a quarter of the block is solved."""
    half, width = (0.3, 0.15), 0.5 * np.sqrt(np.pi) * 0.75

    def graded(rim: float) -> Array:
        return np.concatenate([rim - rim * line(under)[::-1], rim + (width - rim) * line(beside)[1:]])

    lines = (graded(half[0]), graded(half[1]), 1.0 - line(deep)[::-1])
    x, index, corners = grid(lines)
    nodes, area = face(index, lines, 2, -1)
    pressed = np.all(x[nodes, :2] < np.array(half) + 1.0e-9, axis=1)
    down = np.array([[0.0, 0.0, -1.0]])
    top = (nodes[pressed], area[pressed], lambda depth: (down, np.array([depth - 1.0])))
    return -4.0 * press(x, corners, only(x, x < 1.0e-9), [top])[:, 2]


def own_edge(across: int, along: int) -> Array:
    """Return the forces on opposite edges along Y: half of the cube is solved."""
    lines = (both(across), 0.5 * np.linspace(0.0, 1.0, along + 1), both(across))
    x, index, corners = grid(lines)
    swap, back = np.eye(3)[[2, 1, 0]], np.diag([-1.0, 1.0, -1.0])
    alike: Any = symmetric(x, [np.eye(3), swap, back, back @ swap])
    moves = np.ones(x.shape)
    moves[x[:, 1] < 1.0e-9, 1] = 0.0
    alike = (sparse.diags(moves.ravel()) @ alike).tocsc()
    alike = alike[:, np.flatnonzero(np.diff(alike.indptr) * np.asarray(abs(alike).sum(axis=0)).ravel())]
    up = np.array([1.0, 0.0, 1.0]) / np.sqrt(2.0)
    tops = between_plates(up, np.sqrt(0.5), lambda end: joined([face(index, lines, k, end) for k in (0, 2)]))
    return 2.0 * press(x, corners, alike, tops) @ up


def own_corner(across: int) -> Array:
    """Return the forces on opposite corners."""
    lines = (both(across),) * 3
    x, index, corners = grid(lines)
    turns = [np.eye(3)[list(order)] for order in permutations(range(3))]
    up = np.ones(3) / np.sqrt(3.0)
    tops = between_plates(up, np.sqrt(0.75), lambda end: joined([face(index, lines, k, end) for k in range(3)]))
    return press(x, corners, symmetric(x, turns + [-turn for turn in turns]), tops) @ up


def between_plates(up: Array, half: float, faces: Callable[[int], tuple[Ints, Array]]) -> list[Top]:
    """Return what two plates press that lie at both ends of a diagonal of length 2 ``half``."""
    below: Top = (*faces(0), lambda depth: (up[None], np.array([depth - half])))
    return [below, (*faces(-1), lambda depth: (-up[None], np.array([depth - half])))]


def only(x: Array, held: Mask) -> sparse.csr_matrix:
    """Return the motions of what is not held."""
    free = np.flatnonzero(~held.ravel())
    return sparse.csr_matrix((np.ones(len(free)), (free, np.arange(len(free)))), (x.size, len(free)))


def symmetric(x: Array, group: Sequence[Array]) -> sparse.csr_matrix:
    """Return the motions of nodes that are the same under a group of matrices; images may lie outside of the nodes."""
    tree, images = KDTree(x), []
    for g in group:
        distance, image = tree.query(x @ g.T)
        images.append(np.where(np.asarray(distance) < 1.0e-9, image, -1))
    rows, columns, values, count = [], [], [], 0
    for node in range(len(x)):
        orbit = sorted({int(image[node]) for image in images if image[node] >= 0})
        if node != orbit[0]:
            continue
        moves = np.zeros((len(orbit), 3, 3))
        for g, image in zip(group, images, strict=True):
            if image[node] >= 0:
                moves[orbit.index(int(image[node]))] += g
        U, s, _ = np.linalg.svd(moves.reshape(-1, 3), full_matrices=False)
        for vector in U.T[s > 1.0e-9]:
            rows.append((3 * np.array(orbit)[:, None] + np.arange(3)).ravel())
            columns.append(np.full(len(vector), count))
            values.append(vector)
            count += 1
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_matrix(entries, (x.size, count))


def solid(x: Array, corners: Ints) -> Callable[[Array], tuple[Array, sparse.csr_matrix]]:
    """Return what gives forces and their derivative at displacements, of nodes (N, 3) and elements (M, 8)."""
    gradient, weight, _values = integrate(x, corners)
    matrix = np.zeros((len(weight), 9, 24))
    for i in range(3):
        for j in range(3):
            matrix[:, 3 * i + j, i::3] = gradient[:, :, j]
    return elastic(matrix, weight, (3 * corners[:, :, None] + np.arange(3)).reshape(len(corners), -1), x.size, 0.3)


def press(x: Array, corners: Ints, moves: sparse.csr_matrix, tops: Sequence[Top]) -> Array:
    """Return the force on the first top at each depth, shape (depths, 3) [E edge^2].

    Args:
        x: Nodes, shape (N, 3).
        corners: Nodes of the elements, shape (M, 8).
        moves: Motions that are solved for, shape (3 N, unknowns).
        tops: What may be touched, and by what.
    """
    elasticity, u, forces = solid(x, corners), np.zeros(x.size), []
    for depth in DEPTHS:
        force = np.zeros(3)
        for _ in range(80):
            residual, H = elasticity(u)
            for k, (nodes, area, faces) in enumerate(tops):
                normals, offsets = faces(depth)
                above = (x + u.reshape(x.shape))[nodes] @ normals.T - offsets
                inside = above.max(axis=1) < 0.0
                n, stiffness = normals[above.argmax(axis=1)[inside]], 1.0e3 * area[inside]
                pushed = -(stiffness * above.max(axis=1)[inside])[:, None] * n
                at = 3 * nodes[inside][:, None] + np.arange(3)
                residual -= np.bincount(at.ravel(), pushed.ravel(), x.size)
                entries = (stiffness[:, None, None] * n[:, :, None] * n[:, None, :]).ravel()
                H += sparse.csr_matrix((entries, (np.repeat(at, 3, 1).ravel(), np.tile(at, (1, 3)).ravel())), H.shape)
                if k == 0:
                    force = pushed.sum(axis=0)
            options = {"SymmetricMode": True}
            lu = linalg.splu((moves.T @ H @ moves).tocsc(), "MMD_AT_PLUS_A", 0.0, options=options)
            step = -moves @ lu.solve(moves.T @ residual)
            most = np.abs(step).max()
            u += min(1.0, CAP / most) * step
            if most < 1.0e-7:
                break
        forces.append(force)
    return np.array(forces)


if __name__ == "__main__":
    main()
