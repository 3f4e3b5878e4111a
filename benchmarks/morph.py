"""Morphs: time per particle and step forward and backward, whole morphs, and a table of pairs, on a CPU core or a GPU.

Run from the repository root: ``python -m benchmarks.morph [--device cuda:0] [--frames 420] [--worlds 1 64] [--spacing
0.5] [--damping 4 0.5] [--pairs sphere bunny duck cow car]``. Bodies of the volume of a ball of radius 6.93 m on the
paper's grid, with its material and step (Xu, Song, Levin, Hyde 2025); times are processor time on a CPU, wall clock on
a GPU. ``--bodies FILE`` keeps the particles of the pairs, for machines without the assets. ``--meshes FOLDER`` morphs
twelve of the paper's pairs between its own meshes (paper_bob.obj, paper_bunny.obj, paper_isosphere.obj, paper_spot.obj;
github.com/Chayoso/Shape-morphing-binder, folder assets).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
import warp as wp
from scipy.spatial import KDTree

from benchmarks.record import add_record_option, record
from softmode.errors import AssetError
from softmode.mpm import (
    MORPH_MATERIAL,
    MassLoss,
    MorphOptions,
    MorphPlanner,
    MorphRun,
    MpmSimulation,
    ParticleBody,
    particles_from_mesh,
)
from softmode.objects.solids import filled, solid_of

PAIRS = ("sphere", "bunny", "duck", "cow", "car")
MESHES = {"sphere": ("isosphere", 11166), "bunny": ("bunny", 9262), "bob": ("bob", 10609), "spot": ("spot", 7651)}
"""Files of the paper's meshes, and how many particles it fills them with."""
PAPER = {
    ("sphere", "bunny"): (420, 75.0, 5302.69, 98.28),
    ("sphere", "bob"): (600, 60.0, 11600.0, 97.41),
    ("sphere", "spot"): (400, 60.0, 7685.97, 98.38),
    ("bob", "sphere"): (450, 70.0, 12018.7, 96.77),
    ("bob", "bunny"): (600, 75.0, 12055.2, 98.62),
    ("bob", "spot"): (500, 75.0, 12218.3, 98.31),
    ("bunny", "sphere"): (500, 100.0, 6104.12, 98.04),
    ("bunny", "bob"): (630, 120.0, 14184.2, 95.71),
    ("bunny", "spot"): (400, 110.0, 4469.88, 98.42),
    ("spot", "sphere"): (400, 75.0, 8606.47, 94.59),
    ("spot", "bunny"): (400, 75.0, 3694.31, 96.85),
    ("spot", "bob"): (600, 75.0, 12218.3, 95.29),
}
"""Frames and density [kg/m^3] of its table II, first loss and accuracy [%] of its table III."""
REST = 60
"""Frames without control after a morph, in which the shape should stay."""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--frames", type=int, default=420)
    parser.add_argument("--worlds", type=int, nargs="+", default=[1])
    parser.add_argument("--spacing", type=float, default=0.5, help="distance between particles [m]")
    parser.add_argument("--target", default="bunny", help="what the ball becomes")
    parser.add_argument("--damping", type=float, nargs="+", default=[4.0], help="zeta [1/s]")
    parser.add_argument("--places", type=float, default=MorphOptions().places, help="0 compares masses alone")
    parser.add_argument("--loss", choices=("log", "squared"), default="log", help="distance of masses on the grid")
    parser.add_argument("--accuracy", type=float, help="leave off when so much of the loss is gone, such as 0.95")
    parser.add_argument("--pairs", nargs="*", help=f"all ordered pairs of these; {' '.join(PAIRS)} if none is named")
    parser.add_argument("--sources", nargs="+", help="only pairs that begin with these")
    parser.add_argument("--bodies", type=Path, help="particles of the pairs (.npz): read if it is there, else written")
    parser.add_argument("--json", type=Path, help="where to write the table")
    parser.add_argument("--meshes", type=Path, help="folder of the paper's meshes")
    add_record_option(parser)
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    chosen = MorphOptions(
        frame_count=options.frames, places=options.places, loss=options.loss, target_accuracy=options.accuracy
    )
    if options.meshes is not None:
        morph_paper(options.meshes, options.spacing, chosen, options.device)
        return
    if options.pairs is not None:
        bodies = pair_bodies(options.pairs or PAIRS, options.spacing, options.bodies)
        rows = []
        for damping in options.damping:
            made = replace(chosen, mpm=replace(chosen.mpm, damping=damping))
            for target in bodies:
                sources = [name for name in options.sources or bodies if name != target]
                if sources:
                    rows += morph_pairs(bodies, sources, target, made, options.device)
                if options.json is not None:
                    options.json.write_text(json.dumps(rows, indent=1))
            if rows:
                found = [row["accuracy"] for row in rows if row["damping"] == damping]
                print(f"zeta {damping:g}: median {np.median(found):.2f} %, worst {min(found):.2f} %", flush=True)
        return
    ball, goal = centred(filled([solid_of("sphere"), solid_of(options.target)], spacing=options.spacing)[1])
    print(f"{options.device}: ball of {ball.count} particles to {options.target} of {goal.count}")
    forward, backward = time_step(ball, goal, chosen, options.device)
    measured: dict[str, float | str] = {"forward": forward, "backward": backward} if options.device == "cpu" else {}
    for worlds in options.worlds:
        for damping in options.damping:
            made = replace(chosen, mpm=replace(chosen.mpm, damping=damping))
            seconds = time_morph(ball, goal, made, options.device, worlds)
            if worlds == 1 and made == MorphOptions():
                measured["core" if options.device == "cpu" else "h100"] = seconds
    if options.record:
        record("morph", measured, options.device)


def paper_bodies(folder: Path, spacing: float) -> dict[str, ParticleBody]:
    """Return the paper's meshes filled as it fills them, by name."""
    files = {name: folder / f"paper_{file}.obj" for name, (file, _) in MESHES.items()}
    if missing := [file.name for file in files.values() if not file.is_file()]:
        raise AssetError(f"{folder}: no {', '.join(missing)}", hint="take them from Chayoso/Shape-morphing-binder")
    meshes = {name: trimesh.load_mesh(file) for name, file in files.items()}
    return {
        name: particles_from_mesh(m.vertices, m.faces, spacing=spacing, material=MORPH_MATERIAL, exact=False)
        for name, m in meshes.items()
    }


def paper_pair(bodies: dict[str, ParticleBody], pair: tuple[str, str]) -> list[ParticleBody]:
    """Return both bodies of a pair with the paper's density."""
    density = PAPER[pair][1]
    material = replace(MORPH_MATERIAL, density=density)
    factor = density / MORPH_MATERIAL.density
    return [replace(bodies[name], masses=factor * bodies[name].masses, material=material) for name in pair]


def morph_paper(folder: Path, spacing: float, options: MorphOptions, device: str) -> None:
    """Print what becomes of the paper's pairs, beside what it prints."""
    bodies = paper_bodies(folder, spacing)
    print("particles: " + ", ".join(f"{name} {b.count} (paper {MESHES[name][1]})" for name, b in bodies.items()))
    for pair, (frames, _, first, accuracy) in PAPER.items():
        source, goal = paper_pair(bodies, pair)
        start = time.process_time() if device == "cpu" else time.perf_counter()
        run = MorphPlanner(source, goal, replace(options, frame_count=frames), device=device).run()[0]
        seconds = (time.process_time() if device == "cpu" else time.perf_counter()) - start
        print(
            f"{' to '.join(pair)}: first loss {run.losses[0]:.2f} (paper {first}, ratio {run.losses[0] / first:.4f}), "
            f"{100.0 * run.accuracy:.2f} % (paper {accuracy}), {100.0 * ejected(run, goal):.2f} % over a cell away, "
            f"{seconds:.1f} s",
            flush=True,
        )


def centred(bodies: list[ParticleBody]) -> list[ParticleBody]:
    """Return bodies with their centres of mass at the origin, which is the middle of the grid but for half a cell."""
    return [body.moved(-body.centre) for body in bodies]


def pair_bodies(names: tuple[str, ...] | list[str], spacing: float, file: Path | None) -> dict[str, ParticleBody]:
    """Return bodies of one volume by name, from a file where there is one."""
    if file is not None and file.exists():
        with np.load(file) as stored:
            arrays = {name: (stored[name], stored[f"{name}.masses"]) for name in names}
        return {name: ParticleBody(positions=x, masses=m, material=MORPH_MATERIAL) for name, (x, m) in arrays.items()}
    found = dict(zip(names, centred(filled([solid_of(name) for name in names], spacing=spacing)[1]), strict=True))
    if file is not None:
        parts = {name: body.positions for name, body in found.items()}
        parts |= {f"{name}.masses": body.masses for name, body in found.items()}
        np.savez(file, allow_pickle=False, **parts)
    return found


def morph_pairs(
    bodies: dict[str, ParticleBody], sources: list[str], target: str, options: MorphOptions, device: str
) -> list[dict[str, float | str]]:
    """Morph several bodies into one at once; print and return a row for each."""
    goal = bodies[target]
    start = time.process_time() if device == "cpu" else time.perf_counter()
    planner = MorphPlanner([bodies[name] for name in sources], goal, options, device=device)
    runs = planner.run()
    seconds = (time.process_time() if device == "cpu" else time.perf_counter()) - start
    rested = rest(planner)
    rows: list[dict[str, float | str]] = []
    for name, run, after in zip(sources, runs, rested, strict=True):
        row = {
            "source": name,
            "target": target,
            "particles": bodies[name].count,
            "damping": options.mpm.damping,
            "segments": run.segment_count,
            "first_loss": float(run.losses[0]),
            "loss": float(run.losses[-1]),
            "least_loss": float(run.losses.min()),
            "rested_loss": float(after),
            "accuracy": 100.0 * run.accuracy,
            "ejected": 100.0 * ejected(run, goal),
            "kinetic_energy": float(run.kinetic_energy[-1]),
            "seconds_of_all": seconds,
            "megabytes_of_all": 1e-6 * bytes_of(planner),
            "notes": "; ".join(run.notes),
        }
        print(
            f"zeta {row['damping']:g} {name} -> {target}: {row['first_loss']:.1f} -> {row['loss']:.2f} "
            f"({row['accuracy']:.2f} %), least {row['least_loss']:.2f}, rested {after:.2f}, "
            f"ejected {row['ejected']:.2f} %, E {row['kinetic_energy']:.3g} J, "
            f"{run.segment_count} segments, {seconds:.1f} s and {row['megabytes_of_all']:.1f} MB for {len(sources)} "
            f"{row['notes']}",
            flush=True,
        )
        rows.append(row)
    return rows


def rest(planner: MorphPlanner) -> np.ndarray:
    """Step on without control; return the losses of the worlds."""
    s = planner.simulation
    s.control.zero_()
    loss = wp.zeros(s.world_count, dtype=wp.float64, device=s.device)
    for _ in range(REST // planner.options.segment_length):
        s.forward()
        planner.loss.after(s, loss)
        s.first.copy_from(s.last)
    return loss.numpy().copy()


def ejected(run: MorphRun, goal: ParticleBody) -> float:
    """Return the part of the particles that lie over a cell away from every particle of the target."""
    return float((KDTree(goal.positions).query(run.positions[-1])[0] > 1.0).mean())


def time_step(ball: ParticleBody, goal: ParticleBody, options: MorphOptions, device: str) -> tuple[float, float]:
    """Print and return the time of a particle's step, forward and backward with the grid computed again."""
    simulation = MpmSimulation(ball, options.mpm, step_count=options.segment_length, device=device)
    loss = MassLoss(options.mpm.grid, goal, device=device)
    value = wp.zeros(1, dtype=wp.float64, device=device)

    simulation.forward()
    loss.after(simulation, value)
    loss.gradient(simulation)
    count = ball.count * options.segment_length
    runs = (simulation.forward, lambda: loss.gradient(simulation))
    forward, backward = (1e6 * clock(run, device) / count for run in runs)
    print(f"a particle's step: forward {forward:.3f} us, backward {backward:.3f} us")
    return forward, backward


def time_morph(ball: ParticleBody, goal: ParticleBody, options: MorphOptions, device: str, worlds: int) -> float:
    """Print time and accuracy of a morph, after one segment that compiles; return the time [s]."""
    MorphPlanner([ball] * worlds, goal, replace(options, frame_count=20), device=device).run()
    planner = MorphPlanner([ball] * worlds, goal, options, device=device)
    start = time.process_time() if device == "cpu" else time.perf_counter()
    run = planner.run()[0]
    wp.synchronize_device(device)
    seconds = (time.process_time() if device == "cpu" else time.perf_counter()) - start
    print(
        f"{worlds} morphs, zeta {options.mpm.damping:g}, {len(run.losses) - 1} segments: {seconds:.2f} s, loss "
        f"{run.losses[0]:.0f} -> {run.losses[-1]:.1f} (least {run.losses.min():.1f}), accuracy "
        f"{100.0 * run.accuracy:.2f} %, {run.gradient_count} gradients, {run.trial_count} trials, "
        f"{100.0 * ejected(run, goal):.2f} % over a cell away, kinetic energy {run.kinetic_energy[-1]:.3g} J, "
        f"{1e-6 * bytes_of(planner):.1f} MB of arrays"
    )
    return seconds


def bytes_of(thing: object) -> int:
    """Return what the arrays of a planner take on its device [bytes]: states, grids, controls, moments, losses."""
    found: dict[int, int] = {}
    seen: set[int] = set()
    waiting = [thing]
    while waiting:
        at = waiting.pop()
        if id(at) in seen:
            continue
        seen.add(id(at))
        if isinstance(at, wp.array):
            if at.ptr is not None and at._ref is None:  # a view takes nothing of its own
                found[at.ptr] = at.capacity
        elif isinstance(at, list | tuple):
            waiting += at
        elif type(at).__module__.startswith("softmode.mpm"):
            waiting += vars(at).values()
    return sum(found.values())


def clock(run: Callable[[], object], device: str) -> float:
    """Return the median time of five runs [s]."""
    times = []
    for _ in range(5):
        wp.synchronize_device(device)
        start = time.process_time() if device == "cpu" else time.perf_counter()
        run()
        wp.synchronize_device(device)
        times.append((time.process_time() if device == "cpu" else time.perf_counter()) - start)
    return float(np.median(times))


if __name__ == "__main__":
    main()
