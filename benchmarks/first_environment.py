"""What the first environment of a fresh machine costs: processor time, modules compiled, and by which thread.

Run: ``python -m benchmarks.first_environment [--environment softmode/LiftSoft-v0] [--device cpu] [--worlds 1]
[--modules 20] [--timeline]``.
Kernels go to an empty folder that is removed afterwards; bodies come from the cache, so run it twice to leave out the
build. Two versions compare with the same script: ``PYTHONPATH=<the other tree> python
benchmarks/first_environment.py``. With ``--warm`` the same process is started a second time on the folder of the first:
what a later start takes. The timeline has the modules as they were loaded: from when to when, with how much processor
time of their thread. What a module spent beyond its processor time it waited for a lock or a core.
"""

from __future__ import annotations

import argparse
import functools
import os
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any


def main() -> None:
    """Print a block for the first start, and one for the second where it is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--environment", default="softmode/LiftSoft-v0")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, default=1)
    parser.add_argument("--timeline", action="store_true", help="print all modules in the order of their start")
    parser.add_argument("--modules", type=int, default=20, help="modules to print, the slowest first")
    parser.add_argument("--warm", action="store_true", help="start once more, with the kernels of the first start")
    parser.add_argument("--cache", default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.cache:
        start(options)
        return
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(1 + options.warm):
            subprocess.run([sys.executable, __file__, *sys.argv[1:], "--cache", folder], check=True)


def start(options: argparse.Namespace) -> None:
    """Make an environment and step it once, with kernels in the given folder; print what that took."""
    os.environ["WARP_CACHE_PATH"] = options.cache
    processor, clock = time.process_time(), time.perf_counter()
    import warp as wp

    spent: dict[str, tuple[float, str]] = {}
    spans: list[tuple[float, float, float, str, str]] = []
    warp_module: Any = wp.Module
    load = warp_module.load

    def timed(module: Any, *rest: Any, **given: Any) -> Any:
        before, begin, known = time.thread_time(), time.perf_counter() - clock, len(module.execs)
        found = load(module, *rest, **given)
        took, here = time.thread_time() - before, threading.current_thread().name
        seconds, thread = spent.get(module.name, (0.0, here))
        spent[module.name] = seconds + took, thread
        if len(module.execs) > known:
            spans.append((begin, time.perf_counter() - clock, took, here, module.name))
        return found

    warp_module.load = timed
    wp.config.log_level = wp.LOG_WARNING
    import gymnasium as gym

    import softmode

    imported = time.perf_counter() - clock
    worlds: Any = {"num_envs": options.worlds, "vectorization_mode": gym.VectorizeMode.VECTOR_ENTRY_POINT}
    make: Any = gym.make if options.worlds == 1 else functools.partial(gym.make_vec, **worlds)
    env = make(options.environment, device=options.device)
    made = time.perf_counter() - clock
    env.reset(seed=0)
    env.step(env.action_space.sample())
    wp.synchronize_device(options.device)
    in_main = sum(seconds for seconds, thread in spent.values() if thread == "MainThread")
    used, passed = time.process_time() - processor, time.perf_counter() - clock
    print(
        f"{softmode.__file__}, {options.environment} on {options.device}, worlds: {options.worlds}; {used:.1f} s of "
        f"processor time, {passed:.1f} s by the clock ({imported:.1f} s until imported, {made:.1f} s until made); "
        f"{len(spent)} modules took "
        f"{sum(seconds for seconds, _ in spent.values()):.1f} s to generate, compile and load, {in_main:.1f} s of it "
        f"in the thread that waits for them; {len(os.listdir(next(os.scandir(options.cache)).path))} compiled",
        flush=True,
    )
    for name in sorted(spent, key=lambda name: -spent[name][0])[: options.modules]:
        print(f"  {spent[name][0]:7.2f} s  {spent[name][1]:<12} {name}", flush=True)
    if options.timeline:
        print("  from    to  processor  thread")
        for begin, end, took, thread, name in sorted(spans):
            print(f"{begin:6.1f} {end:5.1f} {took:10.2f}  {thread:<12} {name}", flush=True)


if __name__ == "__main__":
    main()
