"""`file_frame`: from the axes in which a file is drawn to the frame of the body that was made of it."""

from __future__ import annotations

import json

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.body.reduced_body import ReducedBody


def file_frame(body: ReducedBody) -> NDArray[np.float64]:
    """Return what takes places of an object's file into the body frame, a rotation times a factor and a move, (4, 4).

    Places of the file are as `softmode splat show` draws them: upright, at the object's size [m], standing on z = 0
    around the origin. `load` and `build_object` may lay the object on a stable side, scale what a fill made too large,
    and move its centre of mass to the origin; this says what they did. A body that was made from arrays has its asset
    coordinates as file.
    """
    turn = np.array(json.loads(str(body.provenance.get("turn", "[[1, 0, 0], [0, 1, 0], [0, 0, 1]]"))), dtype=np.float64)
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = turn, -body.offset
    return frame


def in_body(body: ReducedBody, points: ArrayLike) -> NDArray[np.float64]:
    """Return places of an object's file [m], shape (..., 3), in the body frame."""
    frame = file_frame(body)
    return np.asarray(points, dtype=np.float64) @ frame[:3, :3].T + frame[:3, 3]


def laid_down(body: ReducedBody) -> bool:
    """Return whether an object was turned onto a stable side when it was loaded."""
    turn = file_frame(body)[:3, :3]
    return not np.allclose(turn, np.cbrt(np.linalg.det(turn)) * np.eye(3), atol=1e-6)
