"""The table of morphs in one run of minutes: kernels, one morph, pairs, many at once, more particles, passes, gamma.

Run from the repository root: ``python -m benchmarks.morph_table --device cuda:0 [--bodies out/morph_bodies.npz]
[--json out/morph_table.json]``; on a CPU core with ``--spacing 1.0 --frames 60 --worlds 4 --finer --pairs sphere
torus``. Bodies, grid, material and step are those of ``benchmarks.morph``. A part that would begin after 0.8 of
``--limit`` is left out and named. Times are processor time on a CPU, wall clock on a GPU, without compiling.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import warp as wp

from benchmarks.morph import PAIRS, centred, morph_pairs, pair_bodies
from softmode.mpm import MassLoss, MorphOptions, MorphPlanner, MorphRun, MpmSimulation, ParticleBody
from softmode.objects.solids import filled, solid_of

BEGIN = time.perf_counter()
STEPS = 10


def main() -> None:
    """Measure part by part; print, and write after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--frames", type=int, default=420, help="steps of a morph")
    parser.add_argument("--spacing", type=float, default=0.5, help="distance between particles [m]")
    parser.add_argument("--worlds", type=int, default=64, help="morphs at once, of a fifth of the frames")
    parser.add_argument("--finer", type=float, nargs="*", default=[0.38, 0.25], help="further spacings, 60 frames")
    parser.add_argument("--pairs", nargs="+", default=list(PAIRS))
    parser.add_argument("--bodies", type=Path, help="particles of the pairs (.npz): read if it is there, else written")
    parser.add_argument("--limit", type=float, default=200.0, help="seconds in all, compiling included")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    bodies = pair_bodies(given.pairs, given.spacing, given.bodies)
    source, goal = list(bodies.values())[:2]
    chosen = MorphOptions(frame_count=given.frames)
    short = replace(chosen, frame_count=max(20, given.frames // 5))
    device, found = given.device, {}

    def one() -> dict[str, object]:
        return timed([source], goal, chosen, device)

    def pairs() -> list[dict[str, float | str]]:
        rows: list[dict[str, float | str]] = []
        for name in bodies:
            rows += morph_pairs(bodies, [other for other in bodies if other != name], name, chosen, device)
        quantities = {
            "accuracy [%]": [float(row["accuracy"]) for row in rows],
            "more than a cell away [%]": [float(row["ejected"]) for row in rows],
            "rise in 60 steps of rest [%]": [
                100.0 * (float(row["rested_loss"]) / float(row["loss"]) - 1.0) for row in rows
            ],
        }
        for name, values in quantities.items():
            print(f"{name}: median {np.median(values):.2f}, least {min(values):.2f}, most {max(values):.2f}")
        return rows

    def many() -> dict[str, object]:
        alone, together = (timed([source] * n, goal, short, device) for n in (1, given.worlds))
        ratio = given.worlds * float(str(alone["seconds"])) / float(str(together["seconds"]))
        print(f"{given.worlds} at once are {ratio:.2f} times as fast as one by one")
        return {"alone": alone, "together": together, "ratio": ratio}

    def finer() -> list[dict[str, object]]:
        rows = []
        for spacing in given.finer:
            pair = centred(filled([solid_of("sphere"), solid_of("torus")], spacing=spacing)[1])
            rows.append(timed(pair[:1], pair[1], replace(chosen, frame_count=60), device))
        return rows

    def variants() -> dict[str, object]:
        found: dict[str, object] = {}
        for passes, iterations in ((1, 12), (3, 4), (6, 2), (12, 1)):
            print(f"{passes} passes of {iterations}: ", end="")
            made = replace(chosen, pass_count=passes, iteration_count=iterations)
            found[f"{passes}x{iterations}"] = timed([source], goal, made, device)
        for smoothing in (0.0, 0.93, 0.965):
            print(f"gamma {smoothing}: ", end="")
            made = replace(chosen, mpm=replace(chosen.mpm, smoothing=smoothing))
            found[f"gamma {smoothing}"] = timed([source], goal, made, device)
        return found

    def compile_all() -> float:
        start = time.perf_counter()
        MorphPlanner(source, goal, replace(chosen, frame_count=20), device=device).run()
        return time.perf_counter() - start

    parts: dict[str, Callable[[], object]] = {
        "compile": compile_all,
        "kernels": lambda: kernels([source], goal, chosen, device),
        "one": one,
        "pairs": pairs,
        "kernels of many": lambda: kernels([source] * given.worlds, goal, chosen, device),
        "many": many,
        "finer": finer,
        "variants": variants,
    }
    for name, part in parts.items():
        spent = time.perf_counter() - BEGIN
        if spent > 0.8 * given.limit:
            print(f"left out after {spent:.0f} s: {name}")
            continue
        found[name] = part()
        print(f"-- {name}: {time.perf_counter() - BEGIN - spent:.1f} s of the limit", flush=True)
        if given.json is not None:
            given.json.write_text(json.dumps(found, indent=1))


def now(device: str) -> float:
    """Return processor time on a CPU, wall clock on a GPU [s]."""
    wp.synchronize_device(device)
    return time.perf_counter() if wp.get_device(device).is_cuda else time.process_time()


def timed(sources: list[ParticleBody], goal: ParticleBody, options: MorphOptions, device: str) -> dict[str, object]:
    """Morph several bodies into one at once; print and return what it took."""
    planner = MorphPlanner(sources, goal, options, device=device)
    start = now(device)
    run: MorphRun = planner.run()[0]
    seconds = now(device) - start
    row: dict[str, object] = {
        "worlds": len(sources),
        "particles": sources[0].count,
        "steps": run.segment_count * options.segment_length,
        "seconds": seconds,
        "accuracy": 100.0 * run.accuracy,
        "gradients": run.gradient_count,
        "trials": run.trial_count,
        "us_per_particle_step_and_gradient": 1e6
        * seconds
        / (len(sources) * sources[0].count * options.segment_length * max(run.gradient_count, 1)),
    }
    print(", ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)
    return row


def kernels(bodies: list[ParticleBody], goal: ParticleBody, options: MorphOptions, device: str) -> dict[str, float]:
    """Return the time of each kernel for a particle and step [us], in a forward and a backward run with controls."""
    s = MpmSimulation(bodies, options.mpm, step_count=STEPS, device=device)
    s.control.assign(0.01 * np.random.default_rng(0).standard_normal((*s.control.shape, 3, 3)))
    loss = MassLoss(options.mpm.grid, goal, device=device)
    value = wp.zeros(s.world_count, dtype=wp.float64, device=device)
    spent: defaultdict[str, float] = defaultdict(float)

    def run() -> None:
        s.forward()
        loss.after(s, value)
        loss.gradient(s)

    run()
    if wp.get_device(device).is_cuda:
        wp.timing_begin(cuda_filter=wp.TIMING_KERNEL | wp.TIMING_MEMSET | wp.TIMING_MEMCPY)
        run()
        for event in wp.timing_end():
            spent[event.name] += 1e-3 * event.elapsed
    else:
        launch = wp.launch

        def watched(kernel: wp.Kernel, *args: object, **names: object) -> object:
            start = time.process_time()
            result = launch(kernel, *args, **names)  # type: ignore[arg-type]
            spent[kernel.key] += time.process_time() - start
            return result

        with patch.object(wp, "launch", watched):
            run()
    scale = 1e6 / (STEPS * s.world_count * bodies[0].count)
    found = {name: scale * seconds for name, seconds in sorted(spent.items(), key=lambda item: -item[1])}
    for name, cost in found.items():
        print(f"{1e3 * cost:9.2f} ns for a particle and step: {name}")
    return found


if __name__ == "__main__":
    main()
