"""References for contact by finite elements: a sphere between rigid plates.

Run: ``python -m benchmarks.hertz_elements``. Own elements (axisymmetric quadrilaterals), the energy of softmode's
default material written from its closed form, frictionless contact by a penalty a thousand times as stiff. Prints force
over Hertz's on two meshes. Edges and corners: `edge_elements`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
PERMUTATION = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    PERMUTATION[_i, _j, _k], PERMUTATION[_i, _k, _j] = 1.0, -1.0


def main() -> None:
    """Print the tables."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    depths = (0.01, 0.02, 0.04, 0.08, 0.11)
    print("sphere between plates, force over Hertz's at d / R of", *depths)
    for ratio in (0.3, 0.45):
        for counts in ((60, 40), (110, 70)):
            forces = press(*sphere(*counts), depths, ratio)
            row = [f / (4.0 / 3.0 / (1.0 - ratio**2) * d**1.5) for f, d in zip(forces, depths, strict=True)]
            print(f"nu {ratio}, {counts[0] * counts[1]} elements:", *(f"{value:.3f}" for value in row), flush=True)


def graded(count: int, share: float) -> Array:
    """Return points from 0 to 1, finer towards 0."""
    x = np.linspace(0.0, 1.0, count + 1)
    return share * x**2 + (1.0 - share) * x


def sphere(around: int, out: int) -> tuple[Array, Array, Array, Ints, Mask, Array]:
    """Return matrices and weights of F, dofs, what is held, the surface and its areas, of half a sphere about Z."""
    angle, radius = np.meshgrid(0.5 * np.pi * graded(around, 0.85), 1.0 - graded(out, 0.85)[::-1], indexing="ij")
    x = np.stack([radius * np.sin(angle), radius * np.cos(angle)], -1).reshape(-1, 2)
    index = np.arange(len(x)).reshape(angle.shape)
    index[:, 0] = 0
    corners = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]], -1).reshape(-1, 4)
    gradient, weight, values = integrate(x, corners)
    r = np.einsum("qn,en->qe", values, x[corners][:, :, 0]).ravel()
    matrix = np.zeros((len(weight), 9, 8))
    matrix[:, 0, 0::2], matrix[:, 2, 0::2] = gradient[:, :, 0], gradient[:, :, 1]
    matrix[:, 6, 1::2], matrix[:, 8, 1::2] = gradient[:, :, 0], gradient[:, :, 1]
    matrix[:, 4, 0::2] = np.repeat(values, len(corners), axis=0) / r[:, None]
    top = index[:, -1]
    part = np.linalg.norm(np.diff(x[top], axis=0), axis=1) * np.pi * (x[top[1:], 0] + x[top[:-1], 0])
    area = np.convolve(part, [0.5, 0.5])
    held = np.stack([x[:, 0] < 1.0e-9, x[:, 1] < 1.0e-9], -1)
    held[index[1:, 0]] = True
    unused = np.setdiff1d(np.arange(len(x)), corners)
    held[unused] = True
    return matrix, 2.0 * np.pi * r * weight, x, corners, held, np.stack([top, area])


def integrate(x: Array, corners: Ints) -> tuple[Array, Array, Array]:
    """Return gradients of the linear shape functions, weights, and values by Gauss point, points before elements."""
    dim = x.shape[1]
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * dim, indexing="ij")).reshape(dim, -1).T
    gradients, weights, values = [], [], []
    for place in signs / np.sqrt(3.0):
        terms = 1.0 + signs * place
        values.append(terms.prod(axis=1) / 2.0**dim)
        local = np.stack([signs[:, k] * np.delete(terms, k, 1).prod(axis=1) for k in range(dim)], -1) / 2.0**dim
        jacobian = np.einsum("eni,nj->eij", x[corners], local)
        gradients.append(np.einsum("nj,eji->eni", local, np.linalg.inv(jacobian)))
        weights.append(np.abs(np.linalg.det(jacobian)))
    return np.concatenate(gradients), np.concatenate(weights), np.array(values)


def stress(F: Array, ratio: float) -> tuple[Array, Array]:
    """Return P = m (1 - 1 / (I + 1)) F + l (J - a) cof F and dP/dF, shapes (n, 9) and (n, 9, 9), E 1."""
    mu, lam = 0.5 / (1.0 + ratio), ratio / ((1.0 + ratio) * (1.0 - 2.0 * ratio))
    m, k = 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu
    n = len(F)
    cofactor = np.stack([np.cross(F[:, (r + 1) % 3], F[:, (r + 2) % 3]) for r in range(3)], axis=1)
    more = 1.0 / ((F**2).sum(axis=(1, 2)) + 1.0)[:, None, None]
    pressure = (k * ((F[:, 0] * cofactor[:, 0]).sum(axis=1) - 1.0) - 0.75 * m)[:, None, None]
    by_F = np.einsum("ikm,jln,emn->eijkl", PERMUTATION, PERMUTATION, F).reshape(n, 9, 9)
    f, c = F.reshape(n, 9, 1), cofactor.reshape(n, 9, 1)
    tangent = m * (1.0 - more) * np.eye(9) + 2.0 * m * more**2 * f * f.swapaxes(1, 2) + k * c * c.swapaxes(1, 2)
    return (m * (1.0 - more) * F + pressure * cofactor).reshape(n, 9), tangent + pressure * by_F


def elastic(
    matrix: Array, weight: Array, own: Ints, size: int, ratio: float
) -> Callable[[Array], tuple[Array, sparse.csr_matrix]]:
    """Return what gives the elastic forces and their derivative at displacements (size,).

    Args:
        matrix: F of the points by the displacements of their elements, shape (P, 9, K), points before elements.
        weight: Volumes of the points.
        own: Displacements of the elements, shape (M, K).
        size: Number of displacements.
        ratio: Poisson's ratio.
    """
    count, each = own.shape
    dofs = np.tile(own, (len(weight) // count, 1))
    rows, columns = np.repeat(own, each, axis=1).ravel(), np.tile(own, (1, each)).ravel()

    def at(u: Array) -> tuple[Array, sparse.csr_matrix]:
        F = (np.einsum("eij,ej->ei", matrix, u[dofs]) + np.eye(3).ravel()).reshape(-1, 3, 3)
        P, tangent = stress(F, ratio)
        blocks = matrix.swapaxes(1, 2) @ (tangent * weight[:, None, None]) @ matrix
        H = sparse.csr_matrix((blocks.reshape(-1, count, each, each).sum(axis=0).ravel(), (rows, columns)), (size,) * 2)
        forces = np.einsum("eij,ei,e->ej", matrix, P, weight)
        return np.asarray(np.bincount(dofs.ravel(), forces.ravel(), size), dtype=float), H

    return at


def press(
    matrix: Array,
    weight: Array,
    x: Array,
    corners: Ints,
    held: Mask,
    surface: Array,
    depths: tuple[float, ...],
    ratio: float,
) -> list[float]:
    """Press a plate onto the top and return its forces [E R^2] at some depths."""
    top, stiffness = surface[0].astype(int), 1.0e3 * surface[1]
    inside = elastic(matrix, weight, (2 * corners[:, :, None] + np.arange(2)).reshape(len(corners), -1), x.size, ratio)
    u, free, forces = np.zeros(x.size), np.flatnonzero(~held.ravel()), []
    at = 2 * top + 1
    for depth in depths:
        force = 0.0
        for _ in range(60):
            gradient, H = inside(u)
            gap = x[top, 1] + u[at] - (1.0 - depth)
            touching = stiffness * (gap > 0.0)
            gradient += np.bincount(at, touching * gap, x.size)
            H += sparse.csr_matrix((touching, (at, at)), H.shape)
            move = np.zeros(x.size)
            move[free] = -linalg.spsolve(H[free][:, free].tocsc(), gradient[free])
            force = float((touching * gap).sum())
            most = np.abs(move).max()
            u += min(1.0, 0.02 / most) * move
            if most < 1.0e-8:
                break
        forces.append(force)
    return forces


if __name__ == "__main__":
    main()
