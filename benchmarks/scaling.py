"""Environment steps per second against worlds, functions, points, surface samples, bodies and devices, as tables.

Run: ``python -m benchmarks.scaling [--device cuda:0] [--axes worlds functions points samples bodies]``, and
``--axes devices --values 1 2 --worlds 4096`` for several GPUs of one host. The tables of
``benchmarks/JOURNAL.md`` ("Scaling") are its output.

LiftSoft with states, 4 steps of 1/120 s per control step, observations, rewards and resets included: with random
actions, and with the fingers kept on the object ("grasp"). Young's modulus is drawn per world at each reset, and with
``--poissons-ratio 0.2 0.49`` Poisson's ratio too. One axis changes, the others stay at the object of the preset, by
default the plush of 24 functions, 96 points, 400 samples. Bodies are cubes at rest on the ground, one on the other,
without a robot (``benchmarks/pile.py``). Times are processor time on CPU and wall time on CUDA. Memory is that of the
arrays on the device which an environment has after its steps, over the worlds.

Several devices have a process each, and share the worlds. They make their environments, wait for each other, and step
without another word. The total is all steps over the time from the first start to the last end, by the wall clock.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import warp as wp

from benchmarks.clock import held
from benchmarks.pile import pile
from benchmarks.record import add_record_option, record
from softmode.envs.catalogue import config_class
from softmode.envs.reward_kernels import TOUCH_FORCE
from softmode.envs.throughput import Actions, _Source

ENVIRONMENT = "softmode/LiftSoft-v0"
AXES = {
    "worlds": ([1, 4, 16], [1, 64, 1024, 4096, 16384]),
    "functions": ([10, 24, 48, 96, 160], [10, 24, 48, 96, 160]),
    "points": ([48, 96, 192, 384], [48, 96, 384]),
    "samples": ([100, 400, 1600], [100, 400, 1600]),
    "bodies": ([1, 2, 4, 8], [1, 2, 4, 8]),
    "devices": ([1, 2], [1, 2]),
}
"""Values of each axis on CPU and on CUDA, where each number of functions up to 56 compiles a kernel of its own."""
PATIENCE = 200.0
"""Time that processes of several devices wait for each other [s]."""


def main() -> None:
    """Print a table per axis."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--axes", nargs="+", choices=AXES, default=[axis for axis in AXES if axis != "devices"])
    parser.add_argument("--worlds", type=int, default=None, help="worlds of the other axes; default 1, on CUDA 1024")
    parser.add_argument("--values", type=int, nargs="+", default=None, help="values of the axis, if it is one")
    add_object_options(parser)
    add_record_option(parser)
    parser.add_argument("--actions", nargs="+", choices=("random", "grasp"), default=["random", "grasp"])
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--warmup", type=int, default=60, help="control steps before the clock starts")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(options.device)
    print(f"{device.name or device}, {options.preset or 'plush'}\n")
    for axis in options.axes:
        values = options.values if options.values and len(options.axes) == 1 else AXES[axis][device.is_cuda]
        worlds = options.worlds or (1024 if device.is_cuda else 1)
        if axis == "bodies":
            report_bodies(values, worlds, options)
        elif axis == "devices":
            report_devices(values, worlds, options)
        else:
            report(axis, values, worlds, device, options)


def report(axis: str, values: Sequence[int], worlds: int, device: wp.Device, options: argparse.Namespace) -> None:
    """Print the table of an axis; rates of actions that are left out are empty cells."""
    named = "worlds" if axis == "worlds" else f"{axis}, {worlds} worlds"
    titles = ("random actions [steps/s]", "grasp [steps/s]", "touching", "iterations", "contacts", "memory per world")
    print(f"| {named} | {' | '.join(titles)} |\n|{'---|' * (len(titles) + 1)}")
    for value in values:
        count = value if axis == "worlds" else worlds
        print(f"| {value:,} | {row(count, configuration(axis, value, options), device, options)} |", flush=True)
    print()


def report_bodies(values: Sequence[int], worlds: int, options: argparse.Namespace) -> None:
    """Print the table of bodies in a world."""
    print(f"| bodies in each of {worlds} worlds | ms per step | Newton iterations | memory per world |\n|{'---|' * 4}")
    for count in values:
        milliseconds, iterations, memory = pile(count, worlds, 8, options.device, max(options.steps // 2, 1))
        print(f"| {count} | {milliseconds:.2f} | {iterations:.1f} | {memory / 1e3:,.0f} kB |", flush=True)
    print()


def report_devices(values: Sequence[int], worlds: int, options: argparse.Namespace) -> None:
    """Print the table of devices that share worlds."""
    print(f"| devices, {worlds} worlds in all | actions | steps/s | over the first row |\n|{'---|' * 4}")
    first: dict[Actions, float] = {}
    for count in values:
        for actions, total in share(count, worlds, options).items():
            ratio = total / first.setdefault(actions, total)
            print(f"| {count} | {actions} | {total:,.0f} | {ratio:.2f} |", flush=True)
    print()


def share(count: int, worlds: int, options: argparse.Namespace) -> dict[Actions, float]:
    """Return the environment steps per second of worlds shared by processes with a device each, by actions."""
    context = multiprocessing.get_context("spawn")
    barrier, results = context.Barrier(count), context.SimpleQueue()
    family = "cuda" if options.device.startswith("cuda") else "cpu"
    processes = []
    for k in range(count):
        part = worlds // count + (k < worlds % count)
        given = argparse.Namespace(**{**vars(options), "device": f"cuda:{k}" if family == "cuda" else "cpu"})
        processes.append(context.Process(target=play_part, args=(part, given, barrier, results)))
        processes[-1].start()
    for process in processes:
        process.join()
    if failed := [process.exitcode for process in processes if process.exitcode]:
        raise RuntimeError(f"{len(failed)} of {count} processes failed, their exit codes are {failed}")
    spans = [results.get() for _ in processes]
    steps = worlds * options.steps
    return {
        actions: steps / (max(span[actions][1] for span in spans) - min(span[actions][0] for span in spans))
        for actions in options.actions
    }


def play_part(worlds: int, options: argparse.Namespace, barrier: Any, results: Any) -> None:
    """Step the worlds of one device; put down when each kind of actions began and ended [s]."""
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(options.device)
    env = make(worlds, task_configuration(options), device)
    spans = {}
    for actions in options.actions:
        source = warmed_up(env, actions, options)
        wp.synchronize_device(device)
        barrier.wait(PATIENCE)
        start = time.time()
        for step in range(options.warmup, options.warmup + options.steps):
            env.step(source(step))
        wp.synchronize_device(device)
        spans[actions] = start, time.time()
    env.close()
    results.put(spans)


def add_object_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that `task_configuration` reads."""
    parser.add_argument("--preset", default=None, help="such as beam, Isaac Lab's object")
    parser.add_argument(
        "--poissons-ratio", type=float, nargs=2, default=None, help="range from which each world draws at each reset"
    )


def task_configuration(options: argparse.Namespace) -> Any:
    """Return the configuration of LiftSoft, with 4 steps of 1/120 s per control step."""
    known = config_class(ENVIRONMENT)
    config = known() if options.preset in (None, "plush") else known.preset(options.preset)
    ratios = None if options.poissons_ratio is None else tuple(options.poissons_ratio)
    scene = replace(config.scene, control_hz=30.0, substeps=4)
    return replace(config, scene=scene, poissons_ratio_range=ratios)


def configuration(axis: str, value: int, options: argparse.Namespace) -> Any:
    """Return the configuration of LiftSoft with one value of an axis."""
    config = task_configuration(options)
    toy = config.scene.object
    build = toy.build
    if axis == "functions":
        # as many points for each function as the default object has, so that its forces are as good
        build = replace(build, function_count=value, cubature_count=max(96, 4 * value))
    if axis == "points":
        build = replace(build, cubature_count=value)
    toy = replace(toy, build=build, **({"surface_count": value} if axis == "samples" else {}))
    return replace(config, scene=replace(config.scene, object=toy))


def make(worlds: int, config: Any, device: wp.Device) -> Any:
    """Return a vector environment with states."""
    output = "torch" if device.is_cuda else "numpy"
    return gym.make_vec(
        ENVIRONMENT, num_envs=worlds, device=str(device), config=config, obs_type="state", output=output
    )


def row(worlds: int, config: Any, device: wp.Device, options: argparse.Namespace) -> str:
    """Measure an environment; return the cells of its row."""
    before = held(device)
    env = make(worlds, config, device)
    rates, touching = dict.fromkeys(("random", "grasp"), ""), ""
    measured: dict[str, float | str] = {}
    for actions in options.actions:
        found, share_touching = rate(env, actions, device, options)
        rates[actions] = f"{found:,.0f}"
        measured[f"{options.preset or 'plush'}_{actions}_{worlds}"] = round(found)
        if actions == "grasp":
            touching = f"{100 * share_touching:.0f} %"
    if options.record and options.axes == ["worlds"]:
        record("scaling", measured, str(device))
    memory = (held(device) - before) / worlds
    tables = env.task.scene.solver.reduced.tables
    iterations, contacts = (array.numpy().mean() for array in (tables.newton.iteration, tables.constraints.count))
    env.close()
    cells = f"{rates['random']} | {rates['grasp']} | {touching} | {iterations:.1f} | {contacts:.0f}"
    return f"{cells} | {memory / 1e3:,.0f} kB"


def rate(env: Any, actions: Actions, device: wp.Device, options: argparse.Namespace) -> tuple[float, float]:
    """Return the environment steps per second of all worlds, and the share of them in which a finger touches."""
    now = time.perf_counter if device.is_cuda else time.process_time
    source, column = warmed_up(env, actions, options), env.task_columns("finger_force")
    touching = 0.0
    wp.synchronize_device(device)
    clock = now()
    for step in range(options.warmup, options.warmup + options.steps):
        env.step(source(step))
        touching = touching + (env.state_observation[:, column] > TOUCH_FORCE).any(1).sum()
    wp.synchronize_device(device)
    steps = env.num_envs * options.steps
    return steps / (now() - clock), float(touching) / steps


def warmed_up(env: Any, actions: Actions, options: argparse.Namespace) -> _Source:
    """Reset an environment, take its first steps and return where its actions come from."""
    source = _Source(env, actions, 0)
    env.reset(seed=0)
    for step in range(options.warmup):
        env.step(source(step))
    return source


if __name__ == "__main__":
    main()
