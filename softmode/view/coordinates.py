"""Reduced coordinates of the objects of a scene on the host, and carrying them over to another basis."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.model.namespaces import soft
from softmode.scenes.scene import Scene

Array = NDArray[np.float64]


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


def carry_over(scene: Scene, old: ReducedBody, q: Array, qd: Array) -> None:
    """Give the only object of a scene the positions and velocities that it had with another basis, by least squares.

    Args:
        scene: The scene, with the new body.
        old: The body before.
        q: Its coordinates [m], shape (n, 3).
        qd: Their velocities [m/s], shape (n, 3).
    """
    body, state = scene.objects[0].body, soft(scene.state)
    X = np.concatenate([old.surface_points, old.points])
    before, shift = old.evaluate(X)[0], old.offset - body.offset
    rows = body.evaluate(X + shift)[0]
    found = np.linalg.lstsq(rows, np.hstack([before @ q - shift, before @ qd]), rcond=1e-10)[0]
    state.q.assign(found[:, :3])
    state.qd.assign(found[:, 3:])
    state.dt_before.zero_()
    scene.solver.update_particles(scene.state)
