"""Launches recorded as a graph, and replayed without what Warp's replay of a CPU graph costs per launch.

Warp looks the kernel of each launch up by name, copies its arguments and looks each address in them up again: 0.3 us of
a launch, a fifth of a control step of one world. Here a launch is the call of an address, with arguments that were laid
out when it was recorded. All arrays keep their addresses as long as the graph lives.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np
import warp as wp

from softmode.quiet import quieten_warp
from softmode.scenes.replay_kernels import Operation, replay

quieten_warp()

_ALIGNMENT = 64


class Recording:
    """Launches that :meth:`launch` repeats.

    Args:
        launches: Launches, without anything that reads from the device. They ran once before, so that their kernels
            are compiled and what they need is allocated.
        device: Warp device.

    Attributes:
        graph: The launches as Warp has them.
        operation_count: Launches, copies and fills that are replayed without Warp, those of branches included; 0 where
            Warp replays the graph: on CUDA, and where the graph holds what is not known here, such as sorts.
    """

    def __init__(self, launches: Callable[[], None], device: wp.DeviceLike) -> None:
        """Record the launches; they do not run."""
        own = wp.get_device(device)
        tape = _Tape(own)
        with tape.listening() if own.is_cpu else nullcontext(), wp.ScopedCapture(device=own) as capture:
            launches()
        assert capture.graph is not None
        self.graph: wp.Graph = capture.graph
        self.operation_count = 0
        self._replay: Any = None
        if own.is_cpu and tape.complete(self.graph):
            self.operation_count = sum(kind < Operation.UNLESS for kind, *_ in tape.rows)
            self._operations = wp.array(np.array(tape.rows, np.int64).reshape(-1, 4), dtype=wp.int64, device=own)
            self._held = tape.held
            self._replay = wp.launch(replay, 1, [self._operations], device=own, record_cmd=True)

    def launch(self) -> None:
        """Run the launches."""
        if self._replay is None:
            wp.capture_launch(self.graph)
        else:
            self._replay.launch()


class _Tape:
    """The operations of a capture on CPU, as rows of `replay_kernels.Operation`.

    Warp has no public way to read what a graph holds. This listens to the functions of Warp's library through which
    each operation of a capture goes, and then compares their number with that of the graph. Where they differ, or where
    a version of Warp has no such functions, :meth:`complete` says so, and Warp replays the graph. A public hook would
    be a graph's operations with their addresses, or a replay that resolves them once.
    """

    def __init__(self, device: wp.Device) -> None:
        self.rows: list[tuple[int, int, int, int]] = []
        self.held: list[Any] = []
        self._device = device
        self._whole = True
        self._top = 0

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Note what is recorded meanwhile."""
        core = getattr(getattr(wp, "_src", None), "context", None)
        core = getattr(getattr(core, "runtime", None), "core", None)
        notes = {
            "wp_cpu_launch_kernel": self._note_launch,
            "wp_memcpy_h2h": self._note_copy,
            "wp_memset_host": self._note_fill,
            "wp_memtile_host": self._note_repeat,
            "memset": self._note_fill,
            "memtile": self._note_repeat,
        }
        functions = {name: getattr(core, name, None) for name in notes if name.startswith("wp_")}
        methods = {name: getattr(self._device, name, None) for name in ("memset", "memtile")}
        if not all(callable(function) for function in (*functions.values(), *methods.values())):
            self._whole = False
            yield
            return
        branches = {name: getattr(wp, name) for name in ("capture_if", "capture_while")}
        places = [(core, functions), (self._device, methods), (wp, branches)]
        for place, known in places:
            for name, function in known.items():
                noting = self._branching(function) if place is wp else self._noting(function, notes[name])
                setattr(place, name, noting)
        try:
            yield
        finally:
            for place, known in places:
                for name, function in known.items():
                    setattr(place, name, function)

    def complete(self, graph: Any) -> bool:
        """Return whether all operations of the graph are known."""
        count = getattr(getattr(graph, "_apic_capture", None), "operation_count", None)
        return self._whole and count == self._top

    def _noting(self, function: Callable[..., Any], note: Callable[..., None]) -> Callable[..., Any]:
        def noted(*given: Any) -> Any:
            note(*given)
            return function(*given)

        return noted

    def _add(self, kind: Operation, first: int = 0, second: int = 0, third: int = 0, *, operation: bool = True) -> int:
        self.rows.append((int(kind), first, second, third))
        self._top += operation
        return len(self.rows) - 1

    def _keep(self, content: Any) -> int:
        """Copy a ctypes object to where it stays and return its address."""
        if content is None:
            return 0
        size = ctypes.sizeof(content)
        room = ctypes.create_string_buffer(size + _ALIGNMENT)
        address = -(-ctypes.addressof(room) // _ALIGNMENT) * _ALIGNMENT
        ctypes.memmove(address, ctypes.addressof(content), size)
        self.held.append(room)
        return address

    def _note_launch(self, function: Any, bounds: Any, arguments: Any, adjoint: Any, _info: Any) -> None:
        if adjoint is not None or not all(hasattr(given, "_obj") for given in (bounds, arguments) if given is not None):
            self._whole = False
            return
        given = [None if x is None else x._obj for x in (bounds, arguments)]
        self._add(Operation.LAUNCH, _number(function), *map(self._keep, given))

    def _note_copy(self, target: Any, source: Any, size: Any) -> None:
        if _number(size):
            self._add(Operation.COPY, _number(target), _number(source), _number(size))

    def _note_fill(self, target: Any, value: Any, size: Any) -> None:
        if _number(size):
            self._add(Operation.FILL, _number(target), _number(value), _number(size))

    def _note_repeat(self, target: Any, source: Any, size: Any, count: Any) -> None:
        many, times = _number(size), _number(count)
        if not many * times:
            return
        if times >= 2**32:
            self._whole = False
            return
        content = (ctypes.c_char * many).from_address(ctypes.cast(source, ctypes.c_void_p).value or 0)
        self._add(Operation.REPEAT, _number(target), self._keep(content), (many << 32) + times)

    def _branching(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return ``wp.capture_if`` or ``wp.capture_while`` with rows that go around what is not to run."""
        loops = function is wp.capture_while

        names = ("while_body",) if loops else ("on_true", "on_false")

        def branch(condition: Any, *bodies: Any, **given: Any) -> Any:
            chosen = dict(zip(names, bodies, strict=False)) | {name: given[name] for name in names if name in given}
            if len(bodies) > len(names) or "stream" in given or any(isinstance(x, wp.Graph) for x in chosen.values()):
                self._whole = False
                return function(condition, *bodies, **given)
            rest = {name: value for name, value in given.items() if name not in names}
            chosen = {name: body for name, body in chosen.items() if body is not None}
            if not chosen:
                return function(condition, **rest)
            top = self._top
            test = self._add(Operation.UNLESS, int(condition.ptr), operation=False)

            def noted(name: str, body: Callable[..., Any]) -> Callable[..., Any]:
                def run(**handed: Any) -> None:
                    leave = 0
                    if name == "on_false":  # behind the other branch, if there is one
                        leave = self._add(Operation.GO_ON, operation=False)
                        self.rows[test] = (int(Operation.UNLESS), self.rows[test][1], leave + 1, 0)
                    self._run_branch(body, handed)
                    end = len(self.rows)
                    if loops:
                        end = self._add(Operation.GO_ON, test, operation=False) + 1
                    if name == "on_false":
                        self.rows[leave] = (int(Operation.GO_ON), end, 0, 0)
                    else:
                        self.rows[test] = (int(Operation.UNLESS), self.rows[test][1], end, 0)

                return run

            result = function(condition, **{name: noted(name, body) for name, body in chosen.items()}, **rest)
            self._top = top + 1
            return result

        return branch

    def _run_branch(self, body: Callable[..., Any], given: dict[str, Any]) -> None:
        """Record a branch and compare the number of its operations with Warp's."""
        capture = getattr(getattr(wp, "_src", None), "context", None)
        capture = getattr(getattr(capture, "runtime", None), "_apic_capture", None)
        before = getattr(capture, "operation_count", None)
        self._top = 0
        body(**given)
        after = getattr(capture, "operation_count", None)
        if before is None or after is None or after - before != self._top:
            self._whole = False


def _number(given: Any) -> int:
    """Return an integer that may come as one of ctypes."""
    return int(getattr(given, "value", given) or 0)
