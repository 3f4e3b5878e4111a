"""Environment steps per second against worlds, functions, points, surface samples and bodies, as tables.

Run: ``python -m benchmarks.scaling [--device cuda:0] [--axes worlds functions points samples bodies]``. The tables of
``docs/scaling.md`` are its output.

LiftSoft with states, 4 steps of 1/120 s per control step, observations, rewards and resets included: with random
actions, and with the fingers kept on the object ("grasp"). One axis changes, the others stay at the default object:
24 functions, 96 points, 400 samples. Bodies are cubes at rest on the ground, one on the other, without a robot
(``benchmarks/pile.py``). Times are processor time on CPU and wall time on CUDA. Memory is that of the arrays on the
device which an environment has after its steps, over the worlds.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import warp as wp

from benchmarks.pile import pile
from softmode.envs.catalogue import config_class
from softmode.envs.reward_kernels import TOUCH_FORCE
from softmode.envs.throughput import Actions, _Source

ENVIRONMENT = "softmode/LiftSoft-v0"
AXES = {
    "worlds": ([1, 4, 16], [1, 64, 1024, 4096]),
    "functions": ([12, 24, 48, 96, 160], [24, 48, 120]),
    "points": ([48, 96, 192, 384], [48, 96, 384]),
    "samples": ([100, 400, 1600], [100, 400, 1600]),
    "bodies": ([1, 2, 4, 8], [1, 2, 4]),
}
"""Values of each axis on CPU and on CUDA, where each number of functions up to 56 compiles a kernel of its own."""


def main() -> None:
    """Print a table per axis."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--axes", nargs="+", choices=AXES, default=list(AXES))
    parser.add_argument("--worlds", type=int, default=None, help="worlds of the other axes; default 1, on CUDA 1024")
    parser.add_argument("--values", type=int, nargs="+", default=None, help="values of the axis, if it is one")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--warmup", type=int, default=60, help="control steps before the clock starts")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(options.device)
    print(f"{device.name or device}\n")
    for axis in options.axes:
        values = options.values if options.values and len(options.axes) == 1 else AXES[axis][device.is_cuda]
        worlds = options.worlds or (1024 if device.is_cuda else 1)
        report(axis, values, worlds, device, options)


def report(axis: str, values: Sequence[int], worlds: int, device: wp.Device, options: argparse.Namespace) -> None:
    """Print the table of an axis."""
    if axis == "bodies":
        print(f"| bodies in each of {worlds} worlds | ms per step | Newton iterations |\n|---|---|---|")
        for count in values:
            milliseconds, iterations = pile(count, worlds, 8, options.device)
            print(f"| {count} | {milliseconds:.2f} | {iterations:.1f} |", flush=True)
        print()
        return
    named = "worlds" if axis == "worlds" else f"{axis}, {worlds} worlds"
    titles = ("random actions [steps/s]", "grasp [steps/s]", "touching", "iterations", "contacts", "memory per world")
    print(f"| {named} | {' | '.join(titles)} |\n|{'---|' * (len(titles) + 1)}")
    for value in values:
        count = value if axis == "worlds" else worlds
        print(f"| {value:,} | {row(count, configuration(axis, value), device, options)} |", flush=True)
    print()


def configuration(axis: str, value: int) -> Any:
    """Return the configuration of LiftSoft with one value of an axis."""
    config = config_class(ENVIRONMENT)()
    thing = config.scene.object
    build = thing.build
    if axis == "functions":
        # as many points for each function as the default object has, so that its forces are as good
        build = replace(build, function_count=value, cubature_count=max(96, 4 * value))
    if axis == "points":
        build = replace(build, cubature_count=value)
    thing = replace(thing, build=build, **({"surface_count": value} if axis == "samples" else {}))
    return replace(config, scene=replace(config.scene, object=thing, control_hz=30.0, substeps=4))


def row(worlds: int, config: Any, device: wp.Device, options: argparse.Namespace) -> str:
    """Measure an environment; return the cells of its row."""
    before = held(device)
    output = "torch" if device.is_cuda else "numpy"
    env: Any = gym.make_vec(
        ENVIRONMENT, num_envs=worlds, device=options.device, config=config, obs_type="state", output=output
    )
    random, _ = rate(env, "random", device, options)
    grasp, touching = rate(env, "grasp", device, options)
    memory = (held(device) - before) / worlds
    tables = env.task.scene.solver.reduced.tables
    found, contacts = (array.numpy().mean() for array in (tables.newton.iteration, tables.constraints.count))
    env.close()
    cells = f"{random:,.0f} | {grasp:,.0f} | {100 * touching:.0f} % | {found:.1f} | {contacts:.0f}"
    return f"{cells} | {memory / 1e3:,.0f} kB"


def rate(env: Any, actions: Actions, device: wp.Device, options: argparse.Namespace) -> tuple[float, float]:
    """Return the environment steps per second of all worlds, and the share of them in which a finger touches."""
    now = time.perf_counter if device.is_cuda else time.process_time
    source, column = _Source(env, actions, 0), env.task_columns("finger_force")
    env.reset(seed=0)
    for step in range(options.warmup):
        env.step(source(step))
    touching = 0.0
    wp.synchronize_device(device)
    clock = now()
    for step in range(options.warmup, options.warmup + options.steps):
        env.step(source(step))
        touching = touching + (env.state_observation[:, column] > TOUCH_FORCE).any(1).sum()
    wp.synchronize_device(device)
    steps = env.num_envs * options.steps
    return steps / (now() - clock), float(touching) / steps


def held(device: wp.Device) -> float:
    """Return the memory that the process holds on a device [bytes]."""
    if device.is_cuda:
        return float(wp.get_mempool_used_mem_current(device))
    gc.collect()
    arrays = [found for found in gc.get_objects() if type(found) is wp.array and found.device == device]
    return float(sum({array.ptr: array.capacity for array in arrays if array.ptr and array.deleter}.values()))


if __name__ == "__main__":
    main()
