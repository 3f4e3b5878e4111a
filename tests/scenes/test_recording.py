"""Recordings that are replayed without Warp, against Warp's own replay of the same graph."""

from __future__ import annotations

import ctypes
import gc

import numpy as np
import warp as wp

from softmode.scenes import Recording
from tests.scenes.recording_kernels import add, count_down, mark


class Work:
    """Arrays, and launches, copies, fills, branches and loops on them."""

    def __init__(self) -> None:
        self.values = wp.zeros(5, dtype=float, device="cpu")
        self.copied = wp.zeros(5, dtype=float, device="cpu")
        self.vectors = wp.zeros(3, dtype=wp.vec3, device="cpu")
        self.visits = wp.zeros(4, dtype=int, device="cpu")
        self.flag = wp.zeros(1, dtype=int, device="cpu")
        self.left = wp.zeros(1, dtype=int, device="cpu")

    def launches(self) -> None:
        """Eleven operations, those of all branches counted."""
        self.left.fill_(3)
        wp.launch(add, 5, [self.values, 1.0], device="cpu")
        wp.copy(self.copied, self.values)
        wp.launch(add, 5, [self.copied, 2.0], device="cpu")
        self.vectors.fill_(wp.vec3(1.0, 2.0, 3.0))
        wp.capture_if(self.flag, lambda: self.mark(0), lambda: self.mark(1))
        wp.capture_if(self.flag, on_false=self.mark, k=2)
        wp.capture_while(self.left, self.loop)
        self.values[1:3].zero_()

    def mark(self, k: int) -> None:
        """Count a visit."""
        wp.launch(mark, 1, [self.visits, k], device="cpu")

    def loop(self) -> None:
        """Count down, with a branch inside."""
        wp.launch(count_down, 1, [self.left], device="cpu")
        wp.capture_if(self.flag, on_true=lambda: self.mark(3))

    def results(self) -> list[np.ndarray]:
        """Return what all arrays hold."""
        return [array.numpy().copy() for array in (self.values, self.copied, self.vectors, self.visits, self.left)]


def test_replay_is_warps() -> None:
    """Three replays, with the branches taken and not, and the operations that are counted."""
    works = [Work(), Work()]
    recordings = []
    for work in works:
        work.launches()
        recordings.append(Recording(work.launches, "cpu"))
    own, warps = recordings
    assert own.operation_count == 11
    for flag in (0, 1, 0):
        for work in works:
            work.flag.fill_(flag)
        own.launch()
        wp.capture_launch(warps.graph)
        for found, expected in zip(works[0].results(), works[1].results(), strict=True):
            np.testing.assert_array_equal(found, expected)
    assert works[0].results()[3].tolist() == [1, 3, 3, 3]


def test_recording_does_not_run() -> None:
    """Recording leaves the arrays as they are, and Warp's functions as they were."""
    before = [getattr(wp, name) for name in ("capture_if", "capture_while")], wp.get_device("cpu").memset
    work = Work()
    recording = Recording(work.launches, "cpu")
    assert recording.operation_count == 11
    assert all((array == 0.0).all() for array in work.results())
    assert before == ([getattr(wp, name) for name in ("capture_if", "capture_while")], wp.get_device("cpu").memset)


def test_unknown_operations_are_left_to_warp() -> None:
    """A prefix sum is no launch: Warp replays the graph that holds one."""
    values = wp.array([1, 2, 3], dtype=int, device="cpu")
    sums = wp.zeros_like(values)
    recording = Recording(lambda: wp.utils.array_scan(values, sums), "cpu")
    assert recording.operation_count == 0 and not sums.numpy().any()
    recording.launch()
    assert sums.numpy().tolist() == [1, 3, 6]


def test_a_recording_leaves_nothing_behind() -> None:
    """Once it is gone, no object of ctypes is left; 749 were, of every environment."""

    def alive() -> int:
        gc.collect()
        return sum(isinstance(found, ctypes.c_void_p) for found in gc.get_objects())

    work = Work()
    work.launches()
    before = alive()
    Recording(work.launches, "cpu")
    assert alive() == before
