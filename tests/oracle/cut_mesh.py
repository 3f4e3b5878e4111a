"""Elements that a closed triangle mesh cuts: the hexahedra of a grid, integrated over what of each lies inside.

No element follows the surface, so no object has stairs or corners that it does not have (finite cells: Parvizian,
Duester and Rank 2007, doi:10.1007/s00466-007-0173-y). Elements inside have 27 Gauss points. What is inside of a cut one
is summed up along rays, and as many of these points as reproduce its moments up to degree four are kept, with positive
weights. Functions that live outside but for a sliver are held by a weak membrane, `CutMesh.membrane`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.optimize import nnls

from tests.oracle.fem import Mesh, shape_functions

Array = NDArray[np.float64]

RAYS = 8
"""Rays across an element along each axis, and parts of an element along a ray."""
DEGREE = 4
"""Moments of a cut element are those of monomials up to this total degree."""
FULL = 1.0e-9
"""An element that lacks less than this fraction of its volume is whole."""
SLIVER = 1.0e-6
"""An element with less than this fraction of its volume is left out."""
MEMBRANE = 1.0e-5
"""Strength of the membrane over Young's modulus."""


def inner_points(vertices: ArrayLike, faces: ArrayLike, lines: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Return points inside a closed mesh and their volumes, eight along each edge of a cell of a grid.

    Args:
        vertices: Positions [m], (V, 3).
        faces: Triangles, counter-clockwise seen from outside, (T, 3).
        lines: Lines of the grid [m].

    Raises:
        ValueError: If rays along z say that the mesh is not closed.
    """
    corner = np.asarray(vertices, float)[np.asarray(faces)]
    fine = [np.interp(np.arange(RAYS * (len(x) - 1) + 1) / RAYS, np.arange(len(x)), x) for x in lines]
    # Not quite at the middle: a ray that meets an edge or a vertex would count it twice.
    x, y = (line[:-1] + (0.5 + 1e-4 * np.sqrt(2.0 + d)) * np.diff(line) for d, line in enumerate(fine[:2]))
    low = [np.searchsorted(line, corner[:, :, d].min(axis=1)) for d, line in enumerate((x, y))]
    count = [np.searchsorted(line, corner[:, :, d].max(axis=1)) - low[d] for d, line in enumerate((x, y))]
    pairs = count[0] * count[1]
    face = np.repeat(np.arange(len(corner)), pairs)
    n = np.arange(len(face)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    i, j = low[0][face] + n // count[1][face], low[1][face] + n % count[1][face]
    a, b, c = (corner[face, k] for k in range(3))
    ray = np.stack([x[i], y[j]], axis=1)

    def twice(p: Array, q: Array) -> Array:
        return (p[:, 0] - ray[:, 0]) * (q[:, 1] - ray[:, 1]) - (p[:, 1] - ray[:, 1]) * (q[:, 0] - ray[:, 0])

    part = np.stack([twice(b, c), twice(c, a), twice(a, b)], axis=1)
    met = np.flatnonzero((part > 0.0).all(axis=1) | (part < 0.0).all(axis=1))
    part = part[met]
    height = np.einsum("nk,nk->n", part, np.stack([a[met, 2], b[met, 2], c[met, 2]], axis=1)) / part.sum(axis=1)
    column, sign = i[met] * len(y) + j[met], -np.sign(part[:, 0])
    order = np.lexsort((height, column))
    column, height, depth = column[order], height[order], np.cumsum(sign[order])
    if not np.all(depth[np.flatnonzero(np.diff(column, append=-1))] == 0.0):
        raise ValueError("mesh: rays enter it more often than they leave it; close it and turn its faces outwards")
    inside = np.flatnonzero(depth[:-1] > 0.0)
    column, start, end = column[inside], height[inside], height[inside + 1]
    first = np.clip(np.searchsorted(fine[2], start, side="right") - 1, 0, len(fine[2]) - 2)
    parts = np.clip(np.searchsorted(fine[2], end), 1, len(fine[2]) - 1) - first
    chord = np.repeat(np.arange(len(start)), parts)
    k = first[chord] + np.arange(len(chord)) - np.repeat(np.cumsum(parts) - parts, parts)
    bottom, top = np.maximum(start[chord], fine[2][k]), np.minimum(end[chord], fine[2][k + 1])
    i, j = column[chord] // len(y), column[chord] % len(y)
    area = np.diff(fine[0])[i] * np.diff(fine[1])[j]
    points = np.stack([(fine[d][q] + fine[d][q + 1]) / 2 for d, q in ((0, i), (1, j))] + [(bottom + top) / 2], axis=1)
    return points, area * (top - bottom)


class CutMesh(Mesh):
    """The elements of a grid that a closed triangle mesh fills or cuts.

    Args:
        vertices: Positions [m], (V, 3).
        faces: Triangles, counter-clockwise seen from outside, (T, 3).
        count: Elements along the longest edge of its bounding box.
    """

    reach = 1.0
    """Tips of which rays see nothing have no element of their own."""

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, count: int) -> None:
        """Integrate the elements."""
        vertex = np.asarray(vertices, float)
        lower, upper = vertex.min(axis=0), vertex.max(axis=0)
        cells = np.maximum(np.round(count * (upper - lower) / (upper - lower).max()).astype(int), 1)
        lines = tuple(np.linspace(lower[d], upper[d], cells[d] + 1) for d in range(3))
        points, volumes = inner_points(vertex, faces, lines)  # type: ignore[arg-type]
        index = [np.searchsorted(lines[d][1:-1], points[:, d], side="right") for d in range(3)]
        cell = np.ravel_multi_index(tuple(index), tuple(cells))
        whole, share = float(np.prod((upper - lower) / cells)), np.bincount(cell, volumes, minlength=cells.prod())
        super().__init__(lines, (share > SLIVER * whole).reshape(cells))  # type: ignore[arg-type]
        self.fill = share[share > SLIVER * whole] / whole
        """Fraction of each element that lies inside, (E,)."""
        self.whole_weights, self.whole_gradients = self.weights, self.gradients
        centre, half = 0.5 * (self.lower + self.upper), 0.5 * (self.upper - self.lower)
        numbers = np.flatnonzero(share > SLIVER * whole)
        order = np.argsort(cell, kind="stable")
        start, stop = np.searchsorted(cell[order], numbers), np.searchsorted(cell[order], numbers, side="right")
        power = np.array([p for p in np.ndindex(*[DEGREE + 1] * 3) if sum(p) <= DEGREE])
        most = max(27, len(power))
        gauss = (self.points - centre[:, None]) / half[:, None]
        local, self.weights = np.zeros((len(numbers), most, 3)), np.zeros((len(numbers), most))
        for e in range(len(numbers)):
            if self.fill[e] > 1.0 - FULL:
                local[e, :27], self.weights[e, :27] = gauss[e], self.whole_weights[e]
                continue
            rows = order[start[e] : stop[e]]
            at = (points[rows] - centre[e]) / half[e]
            legendre = np.polynomial.legendre.legvander(at, DEGREE)  # (points, axis, degree)
            moments = np.prod([legendre[:, d, power[:, d]] for d in range(3)], axis=0).T
            found = nnls(moments, moments @ volumes[rows])[0]
            kept = np.flatnonzero(found > 0.0)
            local[e, : len(kept)], self.weights[e, : len(kept)] = at[kept], found[kept]
        value, slope = shape_functions(local.reshape(-1, 3))
        self.values = value.reshape(len(numbers), most, 27)
        self.gradients = np.ascontiguousarray(slope.reshape(len(numbers), most, 27, 3) / half[:, None, None])
        self.points = centre[:, None] + half[:, None] * local

    def membrane(self, youngs_modulus: float) -> sparse.csr_matrix:
        """Return the stiffness [N/m] against displacements of a weak membrane over all of each cut element, (N, N)."""
        weight = MEMBRANE * youngs_modulus * self.whole_weights * (self.fill < 1.0 - FULL)[:, None]
        block = np.einsum("eq,eqad,eqbd->eab", weight, self.whole_gradients, self.whole_gradients, optimize=True)
        row, column = np.repeat(self.elements, 27, axis=1), np.tile(self.elements, (1, 27))
        return sparse.csr_matrix((block.ravel(), (row.ravel(), column.ravel())), shape=(len(self.nodes),) * 2)
