"""Compiling the kernels of a step side by side, before it runs: one after another they take minutes on a GPU."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from types import ModuleType
from typing import Any

import newton
import numpy as np
import warp as wp

from softmode.quiet import quieten_warp

quieten_warp()

Wanted = dict[tuple[wp.Module, int | None], None]
"""Modules with the threads of a block that they are compiled for, in order."""

WORKERS = 16
"""Most modules that are compiled at a time: each takes up to 1 GB."""
BLOCK = 256
"""Threads of a block where a launch does not say."""
_ADJOINT_FREE = "newton._src.solvers.mujoco.kernels", "newton._src.sim.articulation", "mujoco_warp._src.set_const"
_BUILDING = (
    *_ADJOINT_FREE,
    "mujoco_warp._src.smooth",
    "newton._src.geometry.bvh",
    "softmode.deformables.model.parameter_kernels",
    "softmode.deformables.solver.step_kernels",
    "softmode.deformables.contact.friction_memory_kernels",
)
_BUILDING_CPU = ("softmode.deformables.solver.point_cpu_kernels",)


def compile_for_building(device: wp.DeviceLike, *others: ModuleType) -> None:
    """Compile the kernels that a model with joints and its solvers launch while they are built, and other modules'.

    Some of Newton's and MuJoCo-Warp's are compiled without adjoints, half of their time, unless they are loaded
    already. Where a program of its own records them on a tape, `wp.set_module_options` brings the adjoints back;
    without them the tape's backward pass leaves these kernels out, with a warning of Warp's that names them.

    Args:
        device: Warp device.
        others: Modules of Python whose kernels are compiled with them.
    """
    newton.solvers.SolverMuJoCo.import_mujoco()  # its modules are known only then
    for name in _ADJOINT_FREE:
        if name in sys.modules and not wp.get_module(name).execs:
            wp.set_module_options({"enable_backward": False}, module=sys.modules[name])
    own = wp.get_device(device)
    names = [*_BUILDING, *(_BUILDING_CPU if own.is_cpu else ()), *(other.__name__ for other in others)]
    _load({(wp.get_module(name), None): None for name in names if name in sys.modules}, own)


def compile_launches(launches: Callable[[], None], device: wp.DeviceLike) -> None:
    """Compile the kernels that launches need. They do not run, but what they copy and fill is copied and filled.

    Args:
        launches: Launches, without anything that reads from the device.
        device: Warp device.
    """
    with _collecting(wp.get_device(device)) as wanted:
        launches()
    _load(wanted, wp.get_device(device))


@contextmanager
def compiling_aside(device: wp.DeviceLike) -> Iterator[None]:
    """Let the threads that compile do so for launches that cannot be collected, since what they find is read between.

    The thread that launches would compile Warp's headers once more for its first module, 1.6 s on a CPU.

    Args:
        device: Warp device.
    """
    own, seen = wp.get_device(device), set()
    before: dict[str, Any] = {name: getattr(wp, name) for name in ("launch", "launch_tiled")}

    def compiled(launch: Callable[..., Any]) -> Callable[..., Any]:
        def compile_and_launch(kernel: Any, *rest: Any, **given: Any) -> Any:
            dim = given["dim"] if "dim" in given else rest[0]
            key = kernel.module, (given.get("block_dim") or BLOCK) if own.is_cuda else None
            wanted = key not in seen and not kernel.is_generic and np.min(dim) > 0
            if wanted and wp.get_device(given.get("device")) == own:
                seen.add(key)
                _load({key: None}, own)
            return launch(kernel, *rest, **given)

        return compile_and_launch

    for name, launch in before.items():
        setattr(wp, name, compiled(launch))
    try:
        yield
    finally:
        for name, launch in before.items():
            setattr(wp, name, launch)


@contextmanager
def _collecting(device: wp.Device) -> Iterator[Wanted]:
    """Collect what launches on a device need instead of launching; branches and loops are gone through once.

    A question for the block size that suits a kernel would compile it then and there. It is noted, and any answer
    will do: nothing is launched.
    """
    own: Wanted = {}
    others: Wanted = {}
    names = ("launch", "launch_tiled", "capture_if", "capture_while", "get_suggested_block_size")
    before: dict[str, Any] = {name: getattr(wp, name) for name in names}

    def note(kernel: Any, inputs: Sequence[Any], outputs: Sequence[Any], block_dim: int | None) -> None:
        if kernel.is_generic:
            kernel.add_overload(kernel.infer_argument_types([*inputs, *outputs]))
        found = own if kernel.func.__module__.startswith("softmode.") else others
        found[kernel.module, block_dim if device.is_cuda else None] = None

    def launch(
        kernel: Any, dim: Any, inputs: Sequence[Any] = (), outputs: Sequence[Any] = (), *rest: Any, **given: Any
    ) -> Any:
        if rest or given.get("record_cmd") or given.get("adjoint") or wp.get_device(given.get("device")) != device:
            return before["launch"](kernel, dim, inputs, outputs, *rest, **given)
        if np.min(dim) > 0:
            note(kernel, inputs, outputs, given.get("block_dim") or BLOCK)
        return None

    def launch_tiled(*arguments: Any, **given: Any) -> None:
        given = {**dict(zip(("kernel", "dim", "inputs", "outputs"), arguments, strict=False)), **given}
        note(given["kernel"], given.get("inputs", ()), given.get("outputs", ()), given["block_dim"])

    def capture_if(condition: Any, on_true: Any = None, on_false: Any = None, stream: Any = None, **given: Any) -> None:
        for branch in (on_true, on_false):
            if callable(branch):
                branch(**given)

    def capture_while(condition: Any, while_body: Any, stream: Any = None, **given: Any) -> None:
        if callable(while_body):
            while_body(**given)

    def suggested(kernel: Any, device: wp.DeviceLike = None) -> tuple[int, int]:
        note(kernel, (), (), kernel.module.options["block_dim"])
        return BLOCK, 1

    for name, instead in zip(names, (launch, launch_tiled, capture_if, capture_while, suggested), strict=True):
        setattr(wp, name, instead)
    wanted: Wanted = {}
    try:
        yield wanted
    finally:
        for name in names:
            setattr(wp, name, before[name])
    wanted |= own | others  # softmode's own first: the longest is among them


def _load(wanted: Wanted, device: wp.Device) -> None:
    """Load modules, several at a time; Warp compiles those that its cache does not hold."""

    def load(module: wp.Module, block_dim: int | None) -> None:
        wp.force_load(device, [module], block_dim=block_dim)

    pool = _pool(os.getpid())
    for done in [pool.submit(load, *one) for one in wanted]:
        done.result()


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Return the threads that compile in a process: always the same ones, since each compiles Warp's headers first."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return ThreadPoolExecutor(max_workers=min(cores, WORKERS), thread_name_prefix="compile")
