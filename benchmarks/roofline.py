"""How far each phase of a step in a grasp is from the arithmetic, the traffic and the launches that it needs.

Run: ``python -m benchmarks.roofline [--device cuda:0 --worlds 4096] [--preset beam]``. The table of
``benchmarks/JOURNAL.md`` is its output.

The object is held as in ``benchmarks/grasp_phases.py``. Each phase of Newton's iteration is launched by itself, in one
eager control step, and timed; its flops and bytes per world follow from the sizes of the body, listed in `work`. The
floor of a phase is the larger of its flops at the rate of a large product (float64 at half of it), its bytes at that of
a large copy, and the time of a launch that does nothing. It counts the worlds that need the launch, on average: those
that are done wait for the slowest. The last lines are the launches that take their place: rounds and the one launch.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import warp as wp

from benchmarks.camera import copy_rate
from benchmarks.clock import Clock
from benchmarks.grasp_phases import time_kernels
from benchmarks.scaling import ENVIRONMENT, add_object_options, task_configuration
from benchmarks.step import product_rate
from softmode.envs.throughput import _Source


@dataclass(frozen=True)
class Work:
    """What one launch of a phase has to do for one world."""

    flops: float
    """Multiplications and additions."""
    read_written: float
    """Bytes that are read or written once."""
    double: bool = False
    """Whether it works in float64."""


@wp.kernel(enable_backward=False, module="unique")
def nothing(out: wp.array[int]):
    """Write a number."""
    out[0] = 1  # pyright: ignore[reportIndexIssue]  # compiled by Warp


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, default=1)
    add_object_options(parser)
    parser.add_argument("--warmup", type=int, default=70, help="control steps before the fingers hold the object")
    parser.add_argument("--repeats", type=int, default=5, help="control steps that are timed")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(options.device)
    config = task_configuration(options)
    output = "torch" if device.is_cuda else "numpy"
    env: Any = gym.make_vec(
        ENVIRONMENT, num_envs=options.worlds, device=options.device, config=config, obs_type="state", output=output
    )
    source = _Source(env, "grasp", 0)
    env.reset(seed=0)
    for step in range(options.warmup):
        env.step(source(step))
    scene = env.task.scene
    reduced = scene.solver.reduced
    tables = reduced.tables
    product, copy = product_rate(options.device), copy_rate(options.device)
    flag = wp.zeros(1, dtype=int, device=device)
    least = Clock(device, 20).replay(lambda: [wp.launch(nothing, 1, [flag], device=device) for _ in range(100)]) / 100
    print(
        f"{device.name or device}, {options.worlds} worlds of {options.preset or 'plush'}: "
        f"product {product / 1e9:,.0f} Gflop/s, copy {copy / 1e9:,.0f} GB/s, a launch in a graph {1e3 * least:.2f} us\n"
    )
    whole = time_kernels(scene, device, options.repeats)
    reduced.tables = replace(tables, one_launch=False, shared=False, rounds=0)
    apart = time_kernels(scene, device, options.repeats)
    iterations = float(tables.newton.iteration.numpy().mean()) * apart["begin_newton"][1]
    titles = ("phase", "launches", "needed by", "Mflop", "kB", "floor of flops", "of bytes", "measured, a launch")
    print(f"| {' | '.join(titles)} | over the floor |\n{'|---' * (len(titles) + 1)}|")
    total = {"floor": 0.0, "measured": 0.0}
    for name, todo in work(tables).items():
        spent, launches = apart.get(name, (0.0, 0.0))
        if not launches:
            print(f"| {name} | 0 | | | | | | not launched here | |")
            continue
        needed = 1.0
        if options.worlds > 1:  # one world needs all of its launches; an iteration takes a trial step or a little more
            needed = min(iterations * (2.0 if name.startswith("evaluate") else 1.0) / launches, 1.0)
        rate = product / (2.0 if todo.double else 1.0)
        flops, traffic = (1e6 * needed * options.worlds * x for x in (todo.flops / rate, todo.read_written / copy))
        floor, measured = max(flops, traffic), 1e3 * spent / launches
        total["floor"] += launches * floor
        total["measured"] += launches * measured
        print(
            f"| {name} | {launches:.0f} | {needed:.0%} | {todo.flops / 1e6:.3f} | {todo.read_written / 1e3:.0f} | "
            f"{flops:.1f} us | {traffic:.1f} us | {measured:.1f} us | {measured / max(floor, 1e3 * least):.1f} x |"
        )
    one = sum(spent for name, (spent, _) in whole.items() if is_newton(name))
    count = sum(launches for name, (_, launches) in whole.items() if not is_newton(name))
    floor, measured = (1e-3 * total[name] for name in ("floor", "measured"))
    print(
        f"\nAll phases of a control step: floor {floor:.3f} ms, measured apart {measured:.3f} ms, "
        f"as rounds and one launch {one:.3f} ms ({one / floor:.1f} x the floor). "
        f"All else is {count:.0f} launches, which cost {least * count:.2f} ms at least as a graph."
    )
    env.close()


def is_newton(name: str) -> bool:
    """Return whether a kernel is one of Newton's iteration: the one launch or one of a round."""
    rounds = ("check_worlds", "direct_worlds", "evaluate_trials", "differentiate_points", "assemble_stiffness")
    return any(part in name for part in ("minimise_worlds", *rounds))


def work(tables: Any) -> dict[str, Work]:
    """Return what the launches of each phase do for a world at least, by kernel.

    With n functions, P points, E contacts of which A act, N = 3 n unknowns, padded to blocks of eight as they are
    computed, and c columns of the rigid dofs. Numbers per point and contact that are guessed, such as 1,200 flops of a
    material, are those of the code's size. On CPU *eights* evaluate points eight at a time, the Hessian by itself.
    """
    constraints, rigid = tables.constraints, tables.rigid.count_max
    n, points = float(tables.layout.stride), float(tables.instances.point_count.numpy().mean())
    near, acting = (float(array.numpy().mean()) for array in (constraints.count, constraints.acting_count))
    unknowns = 3.0 * n
    triangle, columns = unknowns * (unknowns + 1.0) / 2.0, rigid + 1.0
    basis = 12.0 * n * points  # gradients of the functions, float32
    stiffness = Work(27 * n * n * points, basis + 216 * points + 4 * triangle)
    return {
        "evaluate_points": Work(18 * n * points + 1200 * points, basis + 300 * points, double=True),
        "evaluate_eights": Work(18 * n * points + 600 * points, basis + 160 * points, double=True),
        "differentiate_eights": Work(18 * n * points + 600 * points, basis + 290 * points, double=True),
        "evaluate_constraints": Work(6 * n * near + 200 * near, 4 * n * near + 400 * near, double=True),
        "sum_forces": Work(18 * n * points + 6 * n * acting, basis + 72 * points + 4 * n * acting, double=True),
        **dict.fromkeys(("assemble_stiffness", "assemble_tiles"), stiffness),  # one of them runs
        "assemble_matrix": Work(triangle, 8 * triangle),
        "add_contacts": Work(2 * acting * triangle, 8 * triangle + (4 * n + 40) * acting),
        "assemble_columns": Work(6 * n * acting * rigid, 4 * unknowns * columns + (4 * n + 12 * rigid) * acting),
        "factor": Work(unknowns**3 / 3 + unknowns**2 * columns, 8 * (triangle + unknowns * columns)),
        "condense": Work(unknowns * rigid * (rigid + 1), 4 * unknowns * columns + 8 * rigid * rigid),
        "solve": Work(unknowns**2 + 2 * unknowns * columns, 4 * (triangle + unknowns * columns)),
    }


if __name__ == "__main__":
    main()
