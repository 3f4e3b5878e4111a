"""The motion of the objects of a scene on the host, and giving it to other builds of them, or to their parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.model.namespaces import soft
from softmode.deformables.reduction.hold import carry_over
from softmode.deformables.tools.energies import SoftEnergies
from softmode.scenes.scene import Scene

Array = NDArray[np.float64]

_HALVINGS = 12


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Where the objects of a scene are, and how they move."""

    bodies: tuple[ReducedBody, ...]
    """Their bodies."""
    q: tuple[Array, ...]
    """Coordinates of each [m], shape (n, 3)."""
    qd: tuple[Array, ...]
    """Their velocities [m/s], shape (n, 3)."""
    elastic: Array
    """Elastic energy of each [J], shape (B,)."""


def coordinates(scene: Scene, name: Literal["q", "qd"], object_index: int = 0) -> Array:
    """Return the coordinates [m] or velocities [m/s] of an object of the first world, shape (n, 3).

    Args:
        scene: The scene.
        name: "q" for coordinates, "qd" for velocities.
        object_index: Which object.
    """
    start = int(soft(scene.model).function_start.numpy()[object_index])
    values = getattr(soft(scene.state), name).numpy()
    return values[start : start + scene.objects[object_index].body.function_count].astype(np.float64)


def motion_of(scene: Scene) -> Motion:
    """Return the motion of the objects of a scene of one world."""
    count = range(len(scene.objects))
    return Motion(
        bodies=tuple(thing.body for thing in scene.objects),
        q=tuple(coordinates(scene, "q", i) for i in count),
        qd=tuple(coordinates(scene, "qd", i) for i in count),
        elastic=_elastic(scene, SoftEnergies(scene.solver)),
    )


def set_motion(scene: Scene, before: Motion, came_from: Sequence[int] | None = None) -> None:
    """Give the objects of a scene of one world a motion that others had.

    It goes over by :func:`softmode.deformables.carry_over`, which keeps place and momentum and never adds kinetic
    energy. Elastic energy may grow where functions are another build's; then the deformation of what came from one
    object is made smaller, about the place and turn of each part, until it does not.

    Args:
        scene: The scene.
        before: The motion; of other builds of the objects, or of those that they are parts of.
        came_from: Of each object, which one of `before` it is or was a part of; None: the one of the same number.
    """
    owner = range(len(scene.objects)) if came_from is None else came_from
    bodies = [thing.body for thing in scene.objects]
    moved = [
        carry_over(before.bodies[i], body, before.q[i], before.qd[i]) for i, body in zip(owner, bodies, strict=True)
    ]
    scales = soft(scene.model).scale.numpy()
    rigid = [_rigid(body, q, float(s)) for body, (q, _), s in zip(bodies, moved, scales, strict=True)]
    state, energies = soft(scene.state), SoftEnergies(scene.solver)
    state.qd.assign(np.concatenate([qd for _, qd in moved]))
    share = np.ones(len(bodies))

    def elastic() -> Array:
        rows = [r + s * (q - r) for s, r, (q, _) in zip(share, rigid, moved, strict=True)]
        state.q.assign(np.concatenate(rows))
        return _elastic(scene, energies)

    index = np.array(owner)
    found = np.bincount(index, elastic(), minlength=len(before.bodies))
    large = found[index] > before.elastic[index]
    if large.any():
        low, high = np.where(large, 0.0, 1.0), np.ones(len(bodies))
        for _ in range(_HALVINGS):
            share = 0.5 * (low + high)
            found = np.bincount(index, elastic(), minlength=len(before.bodies))
            fits = (found <= before.elastic)[index]
            low, high = np.where(fits, share, low), np.where(fits, high, share)
        share = low
        elastic()
    state.dt_before.zero_()
    state.dent.zero_()  # the next step finds what is touched
    scene.solver.update_particles(scene.state)


def _rigid(body: ReducedBody, q: Array, scale: float) -> Array:
    """Return the coordinates of a body, at its scale, placed and turned as coordinates q (n, 3) have it."""
    c = body.linear_coordinates
    content = np.linalg.solve(c.T @ c, c.T @ q)
    left, _, right = np.linalg.svd(np.eye(3) + content[:3].T)
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return body.affine(scale * turn, body.mean_basis @ q)


def _elastic(scene: Scene, energies: SoftEnergies) -> Array:
    """Return the elastic energy of every object [J], shape (B,)."""
    energies.update(scene.state)
    return energies.elastic.numpy().astype(np.float64)
