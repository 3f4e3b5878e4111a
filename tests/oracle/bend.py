"""A bar bent to a right angle by springs at both ends: the energy of a body beside that of finite elements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from softmode.deformables.body.reduced_body import ReducedBody
from tests.oracle.fem import Energy, Mesh, Minimiser, Solid
from tests.oracle.solids import Bricks

Array = NDArray[np.float64]

BAR = Bricks(mask=np.ones((24, 2, 2), dtype=bool), pitch=(0.0125, 0.015, 0.015))
"""0.3 x 0.03 x 0.03 m."""
STEPS = 4
KAPPA = 30.0 / 0.03**2
"""Springs per volume and E [1/m^2]."""


def ends(mesh: Mesh) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the elements of the two ends, a brick long."""
    middle = 0.5 * (mesh.lower + mesh.upper)[:, 0]
    return middle < BAR.pitch[0], middle > 0.3 - BAR.pitch[0]


def target(x: Array, angle: float, right: bool) -> Array:
    """Return where the springs of an end pull rest points (N, 3): along an arc as long as the bar."""
    side = 1.0 if right else -1.0
    away, turn = 0.15 - 0.5 * BAR.pitch[0], 0.5 * side * angle
    radius = 2.0 * away / angle
    rest = np.array([0.15 + side * away, 0.015, 0.015])
    place = np.array([0.15 + radius * np.sin(turn), 0.015, 0.015 + radius * (1.0 - np.cos(turn))])
    rotation = np.array([[np.cos(turn), 0.0, -np.sin(turn)], [0.0, 1.0, 0.0], [np.sin(turn), 0.0, np.cos(turn)]])
    return place + (x - rest) @ rotation.T


def bent_solid(poissons_ratio: float) -> float:
    """Return the energy of the bent finite elements per E [m^3], elastic and of the springs."""
    mesh = BAR.mesh()
    solid = Solid(mesh, energy="stable_neo_hookean_log", youngs_modulus=1.0, poissons_ratio=poissons_ratio)
    springs = [solid.gram(KAPPA * end[:, None]) for end in ends(mesh)]
    minimise = Minimiser(solid, springs[0] + springs[1], np.zeros(len(mesh.nodes), dtype=bool))
    x = mesh.nodes
    for angle in np.pi / 2 * np.arange(1, STEPS + 1) / STEPS:
        goals = [target(mesh.nodes, angle, right) for right in (False, True)]
        x = minimise(x, springs[0] @ goals[0] + springs[1] @ goals[1], 1e-6)[0]
    pull = sum(0.5 * float(((x - g) * (s @ (x - g))).sum()) for s, g in zip(springs, goals, strict=True))
    return solid.potential(x) + pull


def bent_body(body: ReducedBody, poissons_ratio: float) -> float:
    """Return the energy of the bent body per E [m^3], over its own cubature."""
    mesh, n = BAR.mesh(), body.function_count
    G, w = body.cubature.grad_basis.astype(np.float64), body.cubature.weights
    law = Energy.make("stable_neo_hookean_log", np.ones(len(w)), poissons_ratio)
    places = [mesh.points[end].reshape(-1, 3) for end in ends(mesh)]
    roots = [np.sqrt(KAPPA * mesh.weights[end].reshape(-1, 1)) for end in ends(mesh)]
    value = np.concatenate([r * body.evaluate(x - body.offset)[0] for r, x in zip(roots, places, strict=True)])

    def total(q: Array, goal: Array) -> float:
        F = np.eye(3) + np.einsum("kc,pkd->pcd", q, G, optimize=True)
        return float(w @ law.value(F) + 0.5 * ((value @ q - goal) ** 2).sum())

    q = np.zeros((n, 3))
    for angle in np.pi / 2 * np.arange(1, STEPS + 1) / STEPS:
        moved = [target(x, angle, right) - x for x, right in zip(places, (False, True), strict=True)]
        goal = np.concatenate([r * u for r, u in zip(roots, moved, strict=True)])
        for _ in range(60):
            F = np.eye(3) + np.einsum("kc,pkd->pcd", q, G, optimize=True)
            slope = np.einsum("p,pcd,pkd->kc", w, law.stress(F), G, optimize=True) + value.T @ (value @ q - goal)
            hessian = law.hessian(F).reshape(-1, 3, 3, 3, 3) * w[:, None, None, None, None]
            K = np.einsum("pkd,pcdef,plf->kcle", G, hessian, G, optimize=True).reshape(3 * n, 3 * n)
            K += np.kron(value.T @ value, np.eye(3))
            eigen, vector = linalg.eigh(K)
            step = -(vector @ ((vector.T @ slope.ravel()) / np.maximum(np.abs(eigen), 1e-9 * eigen[-1]))).reshape(n, 3)
            length, before = 1.0, total(q, goal)
            while length > 1e-4 and not total(q + length * step, goal) < before:
                length *= 0.5
            q = q + length * step
            if -(step * slope).sum() < 1e-10 * before:
                break
    return total(q, goal)
