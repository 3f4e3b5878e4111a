"""Kernels of launches are compiled before they run, and nothing runs then."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import warp as wp

from softmode.deformables.model import compile_ahead
from softmode.deformables.model.compile_ahead import begin_compiling, compile_launches, compiling_aside
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


def launching(kernel: Any, numbers: wp.array) -> Callable[[], None]:
    """Return a launch of a kernel."""

    def launches() -> None:
        wp.launch(kernel, numbers.shape, [numbers], device="cpu")

    return launches


class Held:
    """Threads of their own that compile, with a module whose load waits until it is let go."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, workers: int, held: Any) -> None:
        self.loaded: list[Any] = []
        self.started, self.let_go = threading.Event(), threading.Event()
        threads, load = compile_ahead._Compilers(workers), compile_ahead._load

        def noted(device: str, module: Any, block_dim: int | None) -> None:
            if module is held.module:
                self.started.set()
                assert self.let_go.wait(60)
            load(device, module, block_dim)
            self.loaded.append(module)

        monkeypatch.setattr(compile_ahead, "_compilers", lambda process: threads)
        monkeypatch.setattr(compile_ahead, "_load", noted)


def test_launches_wait_for_their_own_module(monkeypatch: pytest.MonkeyPatch) -> None:
    """A launch acts while another module is still being compiled; at the end of the context that one is loaded too."""
    numbers, slow, quick = wp.zeros(8, dtype=int, device="cpu"), adder(400), adder(401)
    held = Held(monkeypatch, 2, slow)
    with compiling_aside("cpu"):
        begin_compiling(launching(slow, numbers), "cpu")
        assert held.started.wait(60)
        launching(quick, numbers)()
        assert held.loaded == [quick.module]
        held.let_go.set()
    assert held.loaded == [quick.module, slow.module] and slow.module.execs
    np.testing.assert_array_equal(numbers.numpy(), 401)


def test_what_takes_long_comes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """One thread loads what a launch waits for, then what takes long, then the others as they were launched."""
    numbers = wp.zeros(8, dtype=int, device="cpu")
    first, usual, last, long, awaited = (adder(500 + k) for k in range(5))
    monkeypatch.setattr(compile_ahead, "_LONGEST", (long.module.name,))
    held = Held(monkeypatch, 1, first)

    def launches() -> None:
        for kernel in (first, usual, last, long, awaited):
            launching(kernel, numbers)()

    with compiling_aside("cpu"):
        begin_compiling(launching(first, numbers), "cpu")
        assert held.started.wait(60)
        begin_compiling(launches, "cpu")
        threading.Timer(0.2, held.let_go.set).start()
        launching(awaited, numbers)()
    assert held.loaded == [kernel.module for kernel in (first, awaited, long, usual, last)]


def test_nothing_more_is_begun_after_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is being compiled is finished, what waits is dropped, and Warp launches as before."""
    numbers, first, second = wp.zeros(8, dtype=int, device="cpu"), adder(600), adder(601)
    held, before = Held(monkeypatch, 1, first), wp.launch
    with pytest.raises(RuntimeError, match="no"), compiling_aside("cpu"):
        for kernel in (first, second):
            begin_compiling(launching(kernel, numbers), "cpu")
        assert held.started.wait(60)
        threading.Timer(0.2, held.let_go.set).start()
        raise RuntimeError("no")
    assert held.loaded == [first.module] and not second.module.execs
    assert wp.launch is before


def test_module_that_gets_a_kernel_while_it_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Warp forgets the module's hashes then, and fails to look one up: the module is loaded once more."""
    numbers, kernel = wp.zeros(8, dtype=int, device="cpu"), adder(700)
    compiled: list[Any] = []
    compile_module: Any = wp.Module._compile

    def disturbed(module: Any, *rest: Any, **given: Any) -> Any:
        result = compile_module(module, *rest, **given)
        if not compiled:
            module.mark_modified()
        compiled.append(module)
        return result

    monkeypatch.setattr(wp.Module, "_compile", disturbed)
    compile_launches(launching(kernel, numbers), "cpu")
    assert compiled == [kernel.module] * 2 and kernel.module.execs


def test_warp_is_itself_again() -> None:
    """After an error among the launches Warp launches as before."""
    before = wp.launch, wp.launch_tiled, wp.capture_if, wp.capture_while, wp.get_suggested_block_size

    def fail() -> None:
        raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        compile_launches(fail, "cpu")
    after = wp.launch, wp.launch_tiled, wp.capture_if, wp.capture_while, wp.get_suggested_block_size
    assert after == before
