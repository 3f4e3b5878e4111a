"""Medians of the time that something takes on a device, and the memory that a process holds there."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from softmode.deformables.model.compile_ahead import compile_launches


class Clock:
    """Times work on one device.

    On CPU it reads the processor time of this process, which other processes do not disturb much.
    """

    def __init__(self, device: Any, repeats: int) -> None:
        """Remember where and how often."""
        self.device, self.repeats = wp.get_device(device), repeats

    def once(self, run: Callable[[], Any]) -> float:
        """Return the time of a call, device included [ms]."""
        now = time.perf_counter if self.device.is_cuda else time.process_time
        wp.synchronize_device(self.device)
        start = now()
        run()
        wp.synchronize_device(self.device)
        return 1e3 * (now() - start)

    def median(self, run: Callable[[], Any]) -> float:
        """Return the median time of a call, device included [ms]."""
        return float(np.median([self.once(run) for _ in range(self.repeats + 2)][2:]))

    def replay(self, run: Callable[[], Any]) -> float:
        """Return the median time of a captured call [ms]."""
        run()
        with wp.ScopedCapture(device=self.device) as capture:
            run()
        graph: Any = capture.graph
        return self.median(lambda: wp.capture_launch(graph))


def held(device: wp.Device) -> float:
    """Return the memory of the arrays that the process holds on a device [bytes]."""
    if device.is_cuda:
        return float(wp.get_mempool_used_mem_current(device))
    gc.collect()
    arrays = [found for found in gc.get_objects() if type(found) is wp.array and found.device == device]
    return float(sum({array.ptr: array.capacity for array in arrays if array.ptr and array.deleter}.values()))


def replayed(control_step: Callable[[], None], device: wp.Device) -> Callable[[int], None]:
    """Capture a control step; return what replays it a number of times and waits for the end."""
    compile_launches(control_step, device)
    control_step()
    with wp.ScopedCapture(device=device) as capture:
        control_step()
    graph: Any = capture.graph

    def play(count: int) -> None:
        for _ in range(count):
            wp.capture_launch(graph)
        wp.synchronize_device(device)

    play(0)
    return play


def in_spells(
    play: Callable[[int], None], steps: int, device: wp.Device, look: Callable[[], None]
) -> tuple[float, int]:
    """Play steps in ten spells, and look at the state outside of the clock; return the seconds and the steps."""
    now = time.perf_counter if device.is_cuda else time.process_time
    each, spent = max(steps // 10, 1), 0.0
    for _ in range(10):
        start = now()
        play(each)
        spent += now() - start
        look()
    return spent, 10 * each
