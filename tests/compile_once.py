"""A test run compiles as little as it can: a module once, though several processes want it at the same time."""

from __future__ import annotations

import fcntl
import time
from pathlib import Path
from typing import Any

WITHOUT_ADJOINTS = (
    *("newton._src.solvers.mujoco.kernels", "newton._src.sim.articulation", "mujoco_warp._src.set_const"),
    "newton._src.viewer.kernels",
)
"""Modules of Newton that nothing here differentiates through: the first two take 5 s to compile instead of 17."""

WAIT = 120.0
"""Longest time that one process waits for another's compilation before it does its own [s]."""


def compile_once() -> None:
    """Have Warp compile a module only while no other process does, which then finds it in the cache.

    Each module has a lock of its own, a file beside Warp's cache: the threads of all processes share a list of modules
    among them instead of compiling it as often as there are processes. Modules of Newton are compiled without adjoints,
    whenever they are imported, as environments do, or both kinds would be.
    """
    import warp as wp

    for name in WITHOUT_ADJOINTS:
        if not wp.get_module(name).execs:
            wp.set_module_options({"enable_backward": False}, module=name)

    compile_alone = wp.Module._compile

    def compile_or_wait(self: wp.Module, device: Any = None, output_dir: Any = None, *rest: Any, **given: Any) -> bool:
        if output_dir is None:
            return compile_alone(self, device, output_dir, *rest, **given)
        locks = Path(wp.config.kernel_cache_dir).parent / "locks"
        locks.mkdir(parents=True, exist_ok=True)
        end = time.monotonic() + WAIT
        with (locks / Path(output_dir).name).open("w") as file:
            while time.monotonic() < end:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    time.sleep(0.02)
            return compile_alone(self, device, output_dir, *rest, **given)  # closing the file opens the lock

    wp.Module._compile = compile_or_wait
