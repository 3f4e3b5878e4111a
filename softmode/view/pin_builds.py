"""Builds in the background, such as of the body that a build told of the pinned regions gives."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from scipy.spatial import KDTree

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.regions import Region
from softmode.deformables.solver.attachments import UNTOLD_SHARE, untold_share
from softmode.deformables.tools.grips import Grip, GripOptions
from softmode.errors import ConfigError

Finish = Callable[[], None]
"""Takes up what was built, in the thread of the session."""


class Builds:
    """One build at a time, in a thread of its own, while the session goes on; it returns what is left to be done."""

    def __init__(self) -> None:
        """Build nothing."""
        self._pool: ThreadPoolExecutor | None = None
        self._future: Future[Finish] | None = None
        self.what = ""
        """What is being built, in words; empty if nothing is."""

    def begin(self, what: str, build: Callable[[], Finish]) -> None:
        """Begin a build.

        Raises:
            ConfigError: If one is under way.
        """
        if self._future is not None:
            raise ConfigError(f"a build is under way ({self.what})", hint="wait until it is done")
        if self._pool is None:
            self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="build")
        self.what, self._future = what, self._pool.submit(build)

    def take(self) -> Finish | None:
        """Return what takes up what is built, once, or None.

        Raises:
            SoftmodeError: If it could not be built.
        """
        if self._future is None or not self._future.done():
            return None
        future, self._future, self.what = self._future, None, ""
        return future.result()

    def forget(self) -> None:
        """Leave alone what is being built."""
        self._future, self.what = None, ""

    def close(self) -> None:
        """Wait for what is being built, and forget it."""
        self.forget()
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
        inside = KDTree(X).query(body.cubature.points)[0] <= radius
        volume = max(float(body.cubature.weights[inside].sum()), float(body.cubature.weights.min()))
        stiffness = strength.hold_stiffness * float(np.linalg.norm(np.ptp(body.bounds, axis=0))) / volume
        name = f"pin {len(regions) + 1}"
        regions.append(Region(name=name, points=X + body.offset, radius=radius, stiffness=stiffness))
    return regions


def _apart(points: np.ndarray) -> float:
    """Return a radius about points (N, 3) [m] within which their neighbours lie."""
    return float(KDTree(points).query(points, k=2)[0][:, 1].max())
