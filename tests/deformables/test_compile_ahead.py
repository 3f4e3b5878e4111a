"""Kernels of launches are compiled before they run, and nothing runs then."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import warp as wp

from softmode.deformables.model.compile_ahead import compile_launches, compiling_aside
from softmode.quiet import listening


def adder(amount: int) -> Any:
    """Return a kernel in a module of its own that adds a number."""

    @wp.kernel(module="unique", enable_backward=False)
    def add(numbers: wp.array[int]):
        i = wp.tid()
        wp.atomic_add(numbers, i, wp.static(amount))

    return add


def launches_of(numbers: wp.array, flag: wp.array, first: int) -> Callable[[], None]:
    """Return launches of four kernels: one by itself, one for tiles, one in a branch, one in a loop that never runs."""
    one, tiled, chosen, looped = (adder(first + k) for k in range(4))

    def launches() -> None:
        wp.launch(one, numbers.shape, [numbers], device="cpu")
        wp.launch_tiled(tiled, dim=numbers.shape, inputs=[numbers], device="cpu", block_dim=32)
        wp.capture_if(flag, lambda: wp.launch(chosen, numbers.shape, [numbers], device="cpu"))
        wp.capture_while(flag, lambda: wp.launch(looped, numbers.shape, [numbers], device="cpu"))

    return launches


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], None]], list[str]]:
    """Return what counts the modules that Warp loads in a call."""
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_INFO)

    def loaded(call: Callable[[], None]) -> list[str]:
        lines: list[str] = []
        with listening(lines.append):
            call()
        return [line for line in lines if "load on device" in line]

    return loaded


def test_compiled_before_they_run(told: Callable[[Callable[[], None]], list[str]]) -> None:
    """Four kernels are loaded ahead, also in branches that are not taken; the launches then load none, and act."""
    numbers, flag = wp.zeros(8, dtype=int, device="cpu"), wp.zeros(1, dtype=int, device="cpu")
    launches = launches_of(numbers, flag, 100)
    assert len(told(lambda: compile_launches(launches, "cpu"))) == 4
    np.testing.assert_array_equal(numbers.numpy(), 0)
    assert told(launches) == []
    np.testing.assert_array_equal(numbers.numpy(), 100 + 101)


def test_without_it_launches_compile(told: Callable[[Callable[[], None]], list[str]]) -> None:
    """The lines that the other test counts are those of kernels that were not compiled before."""
    numbers, flag = wp.zeros(8, dtype=int, device="cpu"), wp.zeros(1, dtype=int, device="cpu")
    assert len(told(launches_of(numbers, flag, 200))) == 2


def test_other_threads_compile_what_is_launched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Modules are loaded by threads that compile, before launches that then act; without it, by the thread of ours."""
    loaded: list[str] = []
    load: Any = wp.Module.load

    def noted(module: Any, *rest: Any, **given: Any) -> Any:
        if not module.execs:
            loaded.append(threading.current_thread().name)
        return load(module, *rest, **given)

    monkeypatch.setattr(wp.Module, "load", noted)
    numbers = wp.zeros(8, dtype=int, device="cpu")
    with compiling_aside("cpu"):
        wp.launch(adder(300), numbers.shape, [numbers], device="cpu")
        wp.launch(adder(301), 0, [numbers], device="cpu")
        wp.launch_tiled(adder(302), dim=numbers.shape, inputs=[numbers], device="cpu", block_dim=32)
    np.testing.assert_array_equal(numbers.numpy(), 300 + 302)
    assert len(loaded) == 2 and all(name.startswith("compile") for name in loaded)
    wp.launch(adder(303), numbers.shape, [numbers], device="cpu")
    assert loaded[2:] == [threading.current_thread().name]


def test_warp_is_itself_again() -> None:
    """After an error among the launches Warp launches as before."""
    before = wp.launch, wp.launch_tiled, wp.capture_if, wp.capture_while, wp.get_suggested_block_size

    def fail() -> None:
        raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        compile_launches(fail, "cpu")
    after = wp.launch, wp.launch_tiled, wp.capture_if, wp.capture_while, wp.get_suggested_block_size
    assert after == before
