"""Where a control step goes while the fingers hold the object: rate, Newton iterations, contacts, time per kernel.

Run: ``python benchmarks/grasp_phases.py --device cuda:0`` or, on one core, ``python benchmarks/grasp_phases.py``. Two
versions of softmode compare with the same script: ``PYTHONPATH=<the other tree> python benchmarks/grasp_phases.py``.

Protocol of ``softmode bench --actions grasp``: LiftSoft with states, 4 steps of 1/120 s per control step;
``--actions random`` for comparison. The rate is of replayed graphs, by the wall clock on CUDA and by processor time on
CPU. Iterations are those of the last step of each control step. Kernels are then timed in control steps launched
eagerly, by CUDA events or processor time, so their sum is more than a replayed step takes.
"""

from __future__ import annotations

import argparse
import re
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import warp as wp

import softmode
from softmode.envs.catalogue import config_class
from softmode.envs.reward_kernels import TOUCH_FORCE
from softmode.envs.throughput import _Source

ENVIRONMENT = "softmode/LiftSoft-v0"
SUBSTEPS = 4


def main() -> None:
    """Print a block per preset and number of worlds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=None, help="default 64 1024 4096, on CPU 1")
    parser.add_argument("--presets", nargs="+", default=["plush", "beam"], help="plush is the default object")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--warmup", type=int, default=100)
    parser.add_argument("--actions", choices=("random", "grasp"), default="grasp")
    parser.add_argument("--poissons-ratio", type=float, nargs=2, default=None, help="range drawn from per world")
    parser.add_argument("--kernel-steps", type=int, default=8, help="control steps in which kernels are timed")
    parser.add_argument("--kernels", type=int, default=12, help="kernels to print, the slowest first; 0 for none")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(options.device)
    print(f"{device.name or device}: {softmode.__file__}")
    for preset in options.presets:
        for count in options.worlds or ([64, 1024, 4096] if device.is_cuda else [1]):
            report(preset, count, device, options)


def report(preset: str, count: int, device: wp.Device, options: argparse.Namespace) -> None:
    """Make an environment, hold the object, print what a step costs."""
    known = config_class(ENVIRONMENT)
    config = known() if preset == "plush" else known.preset(preset)
    ratios = None if options.poissons_ratio is None else tuple(options.poissons_ratio)
    scene = replace(config.scene, control_hz=30.0, substeps=SUBSTEPS)
    config = replace(config, scene=scene, poissons_ratio_range=ratios)
    given = {"config": config, "obs_type": "state", "output": "torch" if device.is_cuda else "numpy"}
    clock = time.perf_counter()
    env: Any = gym.make_vec(ENVIRONMENT, num_envs=count, device=options.device, **given)
    made = time.perf_counter() - clock
    tables = env.task.scene.solver.reduced.tables
    source = _Source(env, options.actions, 0)
    env.reset(seed=0)
    for step in range(options.warmup):
        env.step(source(step))
    now = time.perf_counter if device.is_cuda else time.process_time
    wp.synchronize_device(device)
    clock = now()
    for step in range(options.warmup, options.warmup + options.steps):
        env.step(source(step))
    wp.synchronize_device(device)
    seconds = now() - clock
    iterations, contacts, touching, column = [], [], [], env.task_columns("finger_force")
    for step in range(options.warmup + options.steps, options.warmup + options.steps + 32):
        env.step(source(step))
        iterations.append(tables.newton.iteration.numpy().copy())
        contacts.append(tables.constraints.count.numpy().copy())
        touching.append(float((env.state_observation[:, column] > TOUCH_FORCE).any(1).sum()) / count)
    found = np.concatenate(iterations)
    way = "one launch" if tables.one_launch else "a launch per phase"
    way += ", shared memory" if tables.shared else ""
    way += f", after {tables.rounds} rounds" if tables.rounds else ""
    print(
        f"{preset}, {count} worlds, {3 * tables.layout.stride} unknowns, {way}: "
        f"{count * options.steps / seconds:,.0f} env-steps/s, "
        f"{1e3 * seconds / options.steps:.2f} ms per control step; Newton iterations mean {found.mean():.2f}, "
        f"p90 {np.percentile(found, 90):.0f}, max {found.max()}; {np.mean(contacts):.0f} contacts; "
        f"a finger touches in {100 * np.mean(touching):.0f} %; made in {made:.1f} s",
        flush=True,
    )
    if options.kernels:
        times = time_kernels(env.task.scene, device, options.kernel_steps)
        total = sum(spent for spent, _ in times.values())
        print(f"  eager control step: {total:.2f} ms in {sum(n for _, n in times.values()):.0f} launches")
        for name in sorted(times, key=lambda name: -times[name][0])[: options.kernels]:
            spent, launches = times[name]
            print(f"  {spent:9.3f} ms {spent / total:6.1%} {launches:7.1f} x  {name}")
    env.close()


def time_kernels(scene: Any, device: wp.Device, steps: int) -> dict[str, tuple[float, float]]:
    """Return time [ms] and launches of every kernel in an eager control step, the mean of several."""
    spent: dict[str, float] = defaultdict(float)
    launches: dict[str, int] = defaultdict(int)
    scene.control_step()
    for _ in range(steps):
        if device.is_cuda:
            wp.timing_begin(cuda_filter=wp.TIMING_ALL, synchronize=True)
            scene.control_step()
            for result in wp.timing_end(synchronize=True):
                name = kernel_name(result)
                spent[name] += result.elapsed
                launches[name] += 1
        else:
            with timed_launches(spent, launches):
                scene.control_step()
    return {name: (spent[name] / steps, launches[name] / steps) for name in spent}


def kernel_name(result: Any) -> str:
    """Return the name of the kernel of a timing, without its hash."""
    return re.sub(r"(_[0-9a-f]{8})?(_cuda_kernel_forward)?$|^forward kernel ", "", result.name)


@contextmanager
def timed_launches(spent: dict[str, float], launches: dict[str, int]) -> Iterator[None]:
    """Let every launch add its processor time, less that of preparing its arguments."""
    launch = wp.launch

    def timed(kernel: Any, *args: Any, **kwargs: Any) -> Any:
        if kwargs.get("record_cmd"):
            return launch(kernel, *args, **kwargs)
        command: Any = launch(kernel, *args, **kwargs, record_cmd=True)
        if command is None:  # nothing to launch
            return None
        clock = time.process_time()
        command.launch()
        spent[kernel.key] += 1e3 * (time.process_time() - clock)
        launches[kernel.key] += 1
        return None

    wp.launch = timed
    try:
        yield
    finally:
        wp.launch = launch


if __name__ == "__main__":
    main()
