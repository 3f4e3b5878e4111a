"""How many blocks of physics steps a frame of a live session takes, and how that compares with the clock."""

from __future__ import annotations

from collections import deque

RATE_WINDOW = 1.0
"""Time over which the real-time factor is taken [s]."""


class Pace:
    """Simulated time over the clock's: whole blocks, the rest carried over, no more than the budget allows.

    Args:
        block_dt: Simulated time of a block [s].
        budget: Share of the time of a frame that physics may take.
    """

    def __init__(self, block_dt: float, budget: float) -> None:
        """Know nothing of how long a block takes."""
        self._block_dt, self._budget, self._debt = block_dt, budget, 0.0
        self._passed: deque[tuple[float, float]] = deque()
        self.block_seconds = 0.0
        """Mean time that a block takes [s]; 0 before the first."""

    def begin(self) -> None:
        """Owe nothing and forget what has passed."""
        self._debt = 0.0
        self._passed.clear()

    def pause(self) -> None:
        """Forget what has passed."""
        self._passed.clear()

    def blocks(self, frame_dt: float) -> int:
        """Return how many blocks a frame [s] takes."""
        self._debt += frame_dt
        count = int(self._debt / self._block_dt + 1e-6)
        if self.block_seconds > 0.0:
            count = min(count, max(int(self._budget * frame_dt / self.block_seconds), 1))
        return count

    def took(self, spent: float) -> None:
        """Note how long a block took [s]."""
        self.block_seconds = spent if self.block_seconds == 0.0 else 0.8 * self.block_seconds + 0.2 * spent

    def frame(self, begun: float, passed: float) -> None:
        """Note that simulated time [s] has passed in a frame that began at `begun` of `time.perf_counter` [s]."""
        self._debt = min(self._debt - passed, self._block_dt)  # what did not fit is lost
        self._passed.append((begun, passed))
        while self._passed[-1][0] - self._passed[0][0] > RATE_WINDOW and len(self._passed) > 2:
            self._passed.popleft()

    @property
    def factor(self) -> float:
        """Simulated time over the clock's in the last frames; 0 before there are two."""
        if len(self._passed) < 2:
            return 0.0
        return sum(dt for _, dt in list(self._passed)[1:]) / (self._passed[-1][0] - self._passed[0][0])
