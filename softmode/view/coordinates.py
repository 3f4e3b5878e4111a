"""Reduced coordinates of the objects of a scene on the host, and giving them those of another body."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.build.hold import carry_over
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


def set_motion(scene: Scene, old: ReducedBody, q: Array, qd: Array) -> None:
    """Give the only object of a scene the motion that it had with another body; see `carry_over`.

    Args:
        scene: The scene, with the new body.
        old: The body before.
        q: Its coordinates [m], shape (n, 3).
        qd: Their velocities [m/s], shape (n, 3).
    """
    state = soft(scene.state)
    place, rate = carry_over(old, scene.objects[0].body, q, qd)
    state.q.assign(place)
    state.qd.assign(rate)
    state.dt_before.zero_()
    scene.solver.update_particles(scene.state)
