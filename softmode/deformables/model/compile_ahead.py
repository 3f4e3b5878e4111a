"""Compiling the kernels of a step side by side, before it runs: one after another they take minutes on a GPU.

A module is compiled by one of a process's compiling threads as soon as its launch is known: at best while a scene is
still being built. A launch waits for its own module alone. Warp's code generation holds a lock, as does the front end
of CUDA's compiler: a tenth of the time each module takes. The rest runs side by side in threads.
"""

from __future__ import annotations

import itertools
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from types import ModuleType
from typing import Any

import newton
import numpy as np
import warp as wp

from softmode.quiet import quieten_warp
from softmode.stages import KERNELS, stage

quieten_warp()

Key = tuple[wp.Module, int | None]
_Load = tuple[str, wp.Module, int | None]
Wanted = dict[Key, None]
"""Modules with the threads of a block that they are compiled for, in order."""

WORKERS = 16
"""Most modules that are compiled at a time: each takes up to 1 GB."""
BLOCK = 256
"""Threads of a block where a launch does not say."""
AWAITED, LONG, USUAL = range(3)
"""Which modules are compiled first: those that a launch waits for, then those that take longest."""
_LONGEST = (
    "minimise_worlds",
    "ccd_kernel_builder",
    "newton._src.sim.articulation",
    "softmode.robots.control_kernels",
    "direct_worlds",
)
"""Parts of the names of modules that take longest to compile for a GPU, the longest first."""
_ADJOINT_FREE = "newton._src.solvers.mujoco.kernels", "newton._src.sim.articulation", "mujoco_warp._src.set_const"
_BUILDING = (
    *_ADJOINT_FREE,
    "mujoco_warp._src.smooth",
    "newton._src.geometry.bvh",
    "softmode.deformables.model.parameter_kernels",
    "softmode.deformables.solver.step_kernels",
    "softmode.deformables.contact.friction_memory_kernels",
)
_BUILDING_CUDA = (("newton._src.sim.articulation", 8),)
"""What is launched with other blocks: Newton's forward kinematics of more than four joints."""
_BUILDING_CPU = "softmode.deformables.potential.point_cpu_kernels", "softmode.scenes.replay_kernels"


def compile_for_building(device: wp.DeviceLike, *others: ModuleType) -> None:
    """Begin to compile the kernels that a model with joints and its solvers launch while they are built, and others'.

    Some of Newton's and MuJoCo-Warp's are compiled without adjoints, half of their time, unless they are loaded
    already. Where a program of its own records them on a tape, `wp.set_module_options` brings the adjoints back;
    without them the tape's backward pass leaves these kernels out, with a warning of Warp's that names them.
    To be called within `compiling_aside`.

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
    launched = [(name, BLOCK) for name in names] + [*_BUILDING_CUDA]
    keys = [(name, block if own.is_cuda else None) for name, block in launched if name in sys.modules]
    _compilers(os.getpid()).begin([(wp.get_module(name), block) for name, block in dict.fromkeys(keys)], own)


def begin_compiling(launches: Callable[[], None], device: wp.DeviceLike) -> None:
    """Begin to compile the kernels that launches need, see `compile_launches`; to be called within `compiling_aside`.

    Args:
        launches: Launches, without anything that reads from the device.
        device: Warp device.
    """
    with _collecting(wp.get_device(device)) as wanted:
        launches()
    _compilers(os.getpid()).begin(wanted, wp.get_device(device))


def compile_launches(launches: Callable[[], None], device: wp.DeviceLike) -> None:
    """Compile the kernels that launches need. They do not run, but what they copy and fill is copied and filled.

    What is being compiled since before is waited for too.

    Args:
        launches: Launches, without anything that reads from the device.
        device: Warp device.
    """
    with _collecting(wp.get_device(device)) as wanted:
        launches()
    compilers = _compilers(os.getpid())
    compilers.begin(wanted, wp.get_device(device))
    compilers.wait_for_all()
    compilers.begin(wanted, wp.get_device(device))  # modules that got another kernel while they were compiled
    compilers.wait_for_all()


@contextmanager
def compiling_aside(device: wp.DeviceLike) -> Iterator[None]:
    """Let launches wait for the threads that compile: for their own module, the other ones are compiled meanwhile.

    So launches that cannot be collected, since what they find is read between, do not hold up the rest. The thread that
    launches would also compile Warp's headers once more for its first module, 1.6 s on a CPU. At the end everything is
    compiled that was begun; after an error, nothing more is begun. One such context within another adds nothing.

    Args:
        device: Warp device.
    """
    compilers = _compilers(os.getpid())
    if compilers.aside:
        yield
        return
    own, seen = wp.get_device(device), set()
    before: dict[str, Any] = {name: getattr(wp, name) for name in ("launch", "launch_tiled")}

    def compiled(launch: Callable[..., Any]) -> Callable[..., Any]:
        def compile_and_launch(kernel: Any, *rest: Any, **given: Any) -> Any:
            dim = given["dim"] if "dim" in given else rest[0]
            key = kernel.module, (given.get("block_dim") or BLOCK) if own.is_cuda else None
            wanted = key not in seen and not kernel.is_generic and np.min(dim) > 0
            if wanted and wp.get_device(given.get("device")) == own:
                seen.add(key)
                with stage(KERNELS):
                    for done in compilers.begin([key], own, awaited=True):
                        done.result()
            return launch(kernel, *rest, **given)

        return compile_and_launch

    compilers.aside = True
    for name, launch in before.items():
        setattr(wp, name, compiled(launch))
    try:
        yield
        compilers.wait_for_all()
    finally:
        compilers.aside = False
        compilers.drop()
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
    wanted |= own | others


class _Compilers:
    """The threads that compile in a process: always the same ones, since each compiles Warp's headers first.

    Args:
        workers: How many.
    """

    def __init__(self, workers: int) -> None:
        """Nothing is compiled yet."""
        self.aside = False
        """Whether launches wait for these threads."""
        self._pool = ThreadPoolExecutor(max_workers=workers, thread_name_prefix="compile")
        self._waiting: queue.PriorityQueue[tuple[int, int, int, _Load, Future[None]]] = queue.PriorityQueue()
        self._numbers = itertools.count()  # what is equally wanted comes in order
        self._under_way: dict[_Load, Future[None]] = {}
        self._taking = threading.Lock()

    def begin(self, wanted: Iterable[Key], device: wp.Device, *, awaited: bool = False) -> list[Future[None]]:
        """Have modules loaded, which compiles those that Warp's cache does not hold; return what tells of the end.

        A module that is waiting already, or being compiled, is not begun again; one that someone waits for moves up.
        """
        return [self._begin((device.alias, *key), awaited=awaited) for key in wanted]

    def _begin(self, load: _Load, *, awaited: bool) -> Future[None]:
        done = self._under_way.get(load)
        if done is None or done.done():
            done = self._under_way[load] = Future[None]()
        elif not awaited:
            return done
        length = next((k for k, name in enumerate(_LONGEST) if name in load[1].name), None)
        rank = AWAITED if awaited else USUAL if length is None else LONG
        self._waiting.put((rank, length or 0, next(self._numbers), load, done))
        self._pool.submit(self._take_one)
        return done

    def wait_for_all(self) -> None:
        """Wait until everything is compiled that was begun; raise what failed."""
        with stage(KERNELS):
            for done in self._under_way.values():
                done.result()
        self._under_way.clear()

    def drop(self) -> None:
        """Forget what waits to be compiled, and wait for what is being compiled."""
        with self._taking:
            for done in self._under_way.values():
                done.cancel()
        wait([done for done in self._under_way.values() if done.running()])
        self._under_way.clear()

    def _take_one(self) -> None:
        """Load the module that is most wanted, unless it was dropped; one that moved up was there twice."""
        *_, load, done = self._waiting.get()
        with self._taking:
            if done.running() or done.done():
                return
            done.set_running_or_notify_cancel()
        try:
            _load(*load)
        except BaseException as error:
            done.set_exception(error)
        else:
            done.set_result(None)


def _load(device: str, module: wp.Module, block_dim: int | None) -> None:
    """Load a module. Where it gets a kernel meanwhile, Warp forgets what it was about to look up: once more then."""
    try:
        wp.force_load(device, [module], block_dim=block_dim)
    except KeyError:
        wp.force_load(device, [module], block_dim=block_dim)


@cache
def _compilers(process: int) -> _Compilers:
    """Return the threads that compile in a process; a forked one has none of its parent's."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return _Compilers(min(cores, WORKERS))
