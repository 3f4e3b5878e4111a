"""Builds for pins: the body that a build told of the pinned regions gives, made in the background."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from scipy.spatial import KDTree

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.build.hold import hold
from softmode.deformables.solver.attachments import UNTOLD_SHARE, untold_share
from softmode.deformables.tools.grips import Grip, GripOptions


class PinBuilds:
    """One build at a time, of the body of a session with the regions that pins hold."""

    def __init__(self) -> None:
        """Build nothing."""
        self._pool: ThreadPoolExecutor | None = None
        self._future: Future[ReducedBody] | None = None

    @property
    def running(self) -> bool:
        """Whether a build has been begun and not been taken."""
        return self._future is not None

    def begin(self, body: ReducedBody, regions: Iterable[Region]) -> None:
        """Build a body with regions in a thread of its own."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="pin-build")
        self._future = self._pool.submit(hold, body, *regions, progress=False)

    def take(self) -> ReducedBody | None:
        """Return the body that is built, once, or None.

        Raises:
            SoftmodeError: If it could not be built.
        """
        if self._future is None or not self._future.done():
            return None
        future, self._future = self._future, None
        return future.result()

    def close(self) -> None:
        """Wait for what is being built, and forget it."""
        self._future = None
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


def held_untold(body: ReducedBody, grips: Iterable[Grip]) -> float:
    """Return the fraction of a body's surface that grips hold without its build knowing, 0 if it is small."""
    points = [grip.rest_points for grip in grips if not grip.pulls]
    found = untold_share(body, np.concatenate(points), reach=max(map(_apart, points))) if points else 0.0
    return found if found > UNTOLD_SHARE else 0.0


def pin_regions(body: ReducedBody, grips: Iterable[Grip], strength: GripOptions) -> list[Region]:
    """Return regions for what grips hold, as springs as stiff as the grips are."""
    regions = []
    for grip in grips:
        if grip.pulls:
            continue
        X, radius = grip.rest_points, _apart(grip.rest_points)
        inside = KDTree(X).query(body.points)[0] <= radius
        volume = max(float(body.weights[inside].sum()), float(body.weights.min()))
        stiffness = strength.hold_stiffness * float(np.linalg.norm(np.ptp(body.bounds, axis=0))) / volume
        name = f"pin {len(regions) + 1}"
        regions.append(Region(name=name, points=X + body.offset, radius=radius, stiffness=stiffness))
    return regions


def _apart(points: np.ndarray) -> float:
    """Return a radius about points (N, 3) [m] within which their neighbours lie."""
    return float(KDTree(points).query(points, k=2)[0][:, 1].max())
