"""What a frame of a live session costs: physics, deformed splats on the host, a pick; medians, one core.

    OMP_NUM_THREADS=1 python -m benchmarks.live_session

Process CPU time, which other programs on the machine do not lengthen; frames of 1/30 s.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from softmode.cli.common import quiet_warp
from softmode.splats import make_plush
from softmode.splats.formats import write_splats
from softmode.view.live_types import LiveOptions
from softmode.view.session import LiveSession

FRAME = 1.0 / 30.0


def median(call: Callable[[], object], count: int = 60) -> float:
    """Return the median process CPU time of a call [ms]."""
    times = []
    for _ in range(count):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1e3 * statistics.median(times)


def measure(live: LiveSession) -> dict[str, float]:
    """Return the costs of a session that rests, is pulled, shown and picked [ms]."""
    rows = {}
    for _ in range(10):
        live.advance(FRAME)
    rows["advance"] = median(lambda: live.advance(FRAME))

    def shown() -> None:
        live._stale = True
        live.splats()

    rows["splats"] = median(shown)
    centre = live.centre()
    ray = (centre + np.array([0.0, 0.0, 1.0]), (0.0, 0.0, -1.0))
    rows["pick"] = median(lambda: live.pick(*ray))
    hit = live.pick(*ray)
    if hit is not None:
        live.begin_drag(hit)
        angle = iter(np.linspace(0.0, 4.0 * np.pi, 10_000))

        def pulled() -> None:
            a = 20.0 * next(angle)
            live.drag_to(hit.point + 0.2 * live.size * np.array([np.cos(a), np.sin(a), 0.5]))
            live.advance(FRAME)

        rows["advance, pulled"] = median(pulled)
        live.end_drag()
    return rows


def main(count: int = 20_000) -> None:
    """Print a table."""
    options = LiveOptions(budget=1.0e6)
    with quiet_warp(), tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "plush.ply"
        write_splats(file, make_plush(count))
        sessions = {
            f"plush of {count} splats, hanging": lambda: LiveSession.from_object(file, options=options),
            f"plush of {count} splats, on the table": lambda: LiveSession.from_object(
                file, scene="drop", options=options
            ),
            "LiftSoft, scripted": lambda: LiveSession.from_env(options=options),
        }
        for name, make in sessions.items():
            live = make()
            columns = ", ".join(f"{key} {value:.2f} ms" for key, value in measure(live).items())
            print(f"{name} ({len(live.splats().means)} splats): {columns}", flush=True)
            live.close()


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
