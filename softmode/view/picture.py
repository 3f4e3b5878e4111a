"""The splats of a live scene as they are now, and where a ray meets them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import newton
import numpy as np
from numpy.typing import NDArray

from softmode.deformables.model.namespaces import soft
from softmode.envs.film import RING
from softmode.envs.markers import ring_marker
from softmode.objects.soft_object import SoftObject
from softmode.scenes.binding import BoundSplats
from softmode.splats.splats import Splats, rotations_from_quats
from softmode.view.live_types import Hit, SplatPicture

Array = NDArray[np.float64]
SIX = [0, 1, 2, 1, 3, 4, 2, 4, 5]
"""Where the entries of a symmetric matrix are among xx, xy, xz, yy, yz, zz."""
OPAQUE = 0.5
"""A ray stops where so much of the light behind is gone."""
REACH = 3.0
"""How many standard deviations a splat reaches for a ray."""
SLACK = 0.01
"""A ray that meets nothing takes the splat nearest to it, within this fraction of the object's size."""


def goal_marker(task: Any) -> Splats | None:
    """Return the splats about `marker_place` that show a task's goal in a view: a level ring where films have one."""
    return ring_marker(RING * task.scene.soft.radius) if task.goal_ring else task.scene.marker_of(0)


class LivePicture:
    """Splats of soft objects, deformed by the state of a model, and of a marker, if there is one.

    Args:
        objects: The soft objects, instance by instance.
        model: Their model.
        marker: Rigid splats behind them.
    """

    def __init__(self, objects: Sequence[SoftObject], model: newton.Model, marker: Splats | None) -> None:
        """Upload the rest state."""
        self.objects, self.bound = objects, BoundSplats(model, objects, others=[] if marker is None else [marker])
        shown = [thing.visible_splats for thing in objects] + ([] if marker is None else [marker])
        self.colors = np.concatenate([splats.colors() for splats in shown])
        self.opacities = np.concatenate([splats.opacities for splats in shown]).astype(np.float32)
        self._starts = soft(model).function_start
        self._marker = None if marker is None else marker.covariances()

    def update(self, state: newton.State, marker_points: Array, marker_pose: Array) -> None:
        """Deform the splats by a state and put the marker in its place.

        Args:
            state: A state of the model.
            marker_points: Centres of the marker before it is placed [m], shape (M, 3).
            marker_pose: Its position [m] and quaternion xyzw, shape (7,).
        """
        self.bound.update(state)
        if self._marker is not None:
            arrays, at = self.bound.arrays, self.bound.columns[-1]
            turn = rotations_from_quats(marker_pose[3:])
            C = turn @ self._marker @ turn.T
            six = C.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
            arrays.means[0, at].assign((marker_points @ turn.T + marker_pose[:3]).astype(np.float32))
            arrays.covariances[0, at].assign(six.astype(np.float32))

    def read(self) -> SplatPicture:
        """Return the splats on the host."""
        means, six = self.bound.arrays.means.numpy()[0], self.bound.arrays.covariances.numpy()[0]
        covariances = six[:, SIX].reshape(-1, 3, 3)
        return SplatPicture(means=means.copy(), covariances=covariances, colors=self.colors, opacities=self.opacities)

    def pick(self, origin: Array, direction: Array, state: newton.State) -> Hit | None:
        """Return where a ray with a unit direction meets the objects; see `LiveSession.pick`."""
        columns = self.bound.columns[: len(self.objects)]
        count = columns[-1].stop
        picture = self.read()
        means, covariances = picture.means[:count].astype(np.float64), picture.covariances[:count].astype(np.float64)
        away = means - origin
        along = away @ direction
        aside = np.linalg.norm(away - along[:, None] * direction, axis=1)
        spread = np.sqrt(np.maximum(np.trace(covariances, axis1=1, axis2=2), 0.0))  # at least the largest deviation
        near = np.flatnonzero((along > 0.0) & (aside < REACH * spread))
        chosen, distance = -1, 0.0
        if len(near):
            # the ray's least Mahalanobis distance to each splat, and where it has it
            C = covariances[near]
            C = C + (1e-6 * np.trace(C, axis1=1, axis2=2) + 1e-18)[:, None, None] * np.eye(3)
            a = np.linalg.solve(C, np.broadcast_to(direction, (len(near), 3))[..., None])[..., 0]
            b = np.linalg.solve(C, away[near][..., None])[..., 0]
            t = (b @ direction) / (a @ direction)
            gap = np.einsum("ni,ni->n", away[near], b) - t**2 * (a @ direction)
            alpha = self.opacities[near] * np.exp(-0.5 * np.clip(gap, 0.0, None))
            alpha = np.where((gap < REACH**2) & (t > 0.0), np.minimum(alpha, 0.99), 0.0)
            order = np.argsort(t)
            gone = 1.0 - np.cumprod(1.0 - alpha[order])
            stop = int(np.argmax(gone >= OPAQUE))
            if gone[stop] >= OPAQUE:
                chosen, distance = int(near[order[stop]]), float(t[order[stop]])
        if chosen < 0:
            size = max(float(np.linalg.norm(np.ptp(thing.body.bounds, axis=0))) for thing in self.objects)
            reachable = np.where(along > 0.0, aside, np.inf)
            chosen = int(reachable.argmin())
            if not reachable[chosen] < SLACK * size:
                return None
            distance = float(along[chosen])
        index = next(o for o, of in enumerate(columns) if chosen < of.stop)
        point = origin + distance * direction
        rest = self._rest_point(index, chosen - columns[index].start, point, state)
        return Hit(point=point, rest_point=rest, distance=distance, object_index=index, splat=chosen)

    def _rest_point(self, index: int, splat: int, point: Array, state: newton.State) -> Array:
        """Return the rest point [m] that a splat carries to a point, to first order about the splat's centre."""
        thing = self.objects[index]
        start = int(self._starts.numpy()[index])
        q = soft(state).q.numpy()[start : start + thing.body.function_count].astype(np.float64)
        X = thing.visible_splats.means[splat].astype(np.float64)
        x = X + thing.basis[splat] @ q
        F = np.eye(3) + q.T @ thing.grad_basis[splat]
        U, stretch, V = np.linalg.svd(F)
        back = (V.T / np.maximum(stretch, 0.1)) @ U.T  # where it is squeezed flat, not far
        return X + back @ (point - x)
