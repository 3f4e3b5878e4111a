"""Whether two versions or two tolerances of the solver grasp alike: successes, widths and forces of scripted lifts.

Run: ``python benchmarks/grasps.py [--variants tighter force_tolerance] [--tree DIR] [--seeds 64] [--processes 2]``.
Each variant of the solver's options, and softmode in each other tree, plays the same seeds as the reference does:
LiftSoft with Young's modulus, place and yaw drawn from the seed, the scripted policy, 150 control steps. The last step
is compared, where the object is held at its goal: the opening of the gripper, and the force on each finger relative to
the mean of both. Printed are how many seeds succeed in each, and median and largest difference.

A policy that feels forces may change its mind one control step later where they differ in the last digit. ``--replay``
gives every variant the reference's actions instead, so that what differs is the solver's. Then the last column compares
all control steps: the largest difference of a force over the largest force of the episode, median and most.

``--reference`` names the variant to compare with, by default ``tighter``, ten times tighter in both tolerances. Then
``default`` is the error of the default tolerances, and the variants that tighten one say which one makes it.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

STEPS = 150
"""Control steps of an episode."""
TIGHTER = 10.0
VARIANTS = (
    "default",
    "tighter",
    "converged",
    "force_tolerance",
    "tolerance",
    "iteration_max",
    "friction_lag",
    "carry_stiffness",
)


@dataclass(frozen=True)
class Grasps:
    """What the episodes of all seeds ended with."""

    modulus: np.ndarray
    """Young's modulus of each seed [Pa], shape (seeds,)."""
    success: np.ndarray
    """Whether the object was held at the goal, shape (seeds,)."""
    width: np.ndarray
    """Opening of the gripper after each control step [m], shape (seeds, STEPS)."""
    force: np.ndarray
    """Force on each finger then [N], shape (seeds, STEPS, 2)."""
    iterations: np.ndarray
    """Mean Newton iterations of the last substep of each control step, shape (seeds,)."""
    actions: np.ndarray
    """What was done, shape (seeds, STEPS, entries)."""


def solver_of(variant: str, given: Any) -> Any:
    """Return the options of a variant: ``given`` with one or both tolerances ten times tighter, or as its name says."""
    room = {"iteration_max": 20 * given.iteration_max}
    both = {"tolerance": given.tolerance / TIGHTER, "force_tolerance": given.force_tolerance / TIGHTER}
    changes: dict[str, dict[str, Any]] = {
        "default": {},
        "tighter": {**both, **room},
        "converged": {"tolerance": 1.0e-9, "force_tolerance": 1.0e-8, **room},
        "force_tolerance": {"force_tolerance": both["force_tolerance"], **room},
        "tolerance": {"tolerance": both["tolerance"], **room},
        "iteration_max": room,
        "friction_lag": {"friction_lag": 4 * given.friction_lag, **room},
        "carry_stiffness": {"carry_stiffness": not given.carry_stiffness},
    }
    return replace(given, **changes[variant])


def play(task: tuple[str, str, list[int], np.ndarray | None]) -> Grasps:
    """Play the episodes of some seeds with one environment, by the scripted policy or by given actions."""
    from softmode.envs.catalogue import config_class
    from softmode.envs.tasks.lift_soft.scripted import ScriptedLift
    from softmode.envs.tasks.lift_soft.task import LiftSoftEnv

    variant, preset, seeds, actions = task
    wp.config.log_level = wp.LOG_WARNING
    known = config_class("softmode/LiftSoft-v0")
    config = known() if preset == "plush" else known.preset(preset)
    solver = solver_of(variant, config.scene.solver)
    env = LiftSoftEnv(config=replace(config, scene=replace(config.scene, solver=solver)), progress=False)
    policy = ScriptedLift(env)
    found: dict[str, list[Any]] = {name: [] for name in Grasps.__dataclass_fields__}
    for row, seed in enumerate(seeds):
        observation, info = env.reset(seed=seed)
        policy.reset()
        iterations, done, width, force = [], [], [], []
        for step in range(STEPS):
            done.append(policy(observation) if actions is None else actions[row, step])
            observation, *_, info = env.step(done[-1])
            iterations.append(int(env.scene.solver.reduced.iteration.numpy()[0]))
            width.append(float(env.scene.controller.opening.numpy()[0]))
            force.append(np.linalg.norm(env.scene.finger_force.numpy()[0], axis=1))
        found["modulus"].append(float(env.scene.model.softmode.youngs_modulus.numpy()[0]))
        found["success"].append(bool(info["is_success"]))
        found["width"].append(width)
        found["force"].append(force)
        found["iterations"].append(float(np.mean(iterations)))
        found["actions"].append(done)
    env.close()
    return Grasps(**{name: np.array(values) for name, values in found.items()})


def play_all(variant: str, options: argparse.Namespace, actions: np.ndarray | None = None) -> Grasps:
    """Play all seeds, shared by several processes."""
    parts = np.array_split(np.arange(options.seeds), options.processes)
    tasks = [
        (variant, options.preset, [int(seed) for seed in part], None if actions is None else actions[part])
        for part in parts
    ]
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        found = pool.map(play, tasks, chunksize=1)
    return Grasps(**{name: np.concatenate([getattr(part, name) for part in found]) for name in vars(found[0])})


def play_in_tree(tree: Path, options: argparse.Namespace, actions: np.ndarray | None) -> Grasps:
    """Play all seeds by the softmode of another tree with its default options."""
    with tempfile.TemporaryDirectory() as folder:
        given, results = Path(folder) / "actions.npy", Path(folder) / "grasps.npz"
        command = [sys.executable, __file__, "--seeds", str(options.seeds), "--processes", str(options.processes)]
        command += ["--preset", options.preset, "--record", str(results)]
        if actions is not None:
            np.save(given, actions)
            command += ["--actions", str(given)]
        subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": str(tree)})
        return Grasps(**dict(np.load(results)))


def report(name: str, found: Grasps, expected: Grasps) -> None:
    """Print a row: successes, differences where both hold the object, and over the whole way."""
    last, wanted = found.force[:, -1], expected.force[:, -1]
    held = (last.min(axis=1) > 0.5) & (wanted.min(axis=1) > 0.5)
    width = 1e3 * np.abs(found.width - expected.width)[held, -1]
    force = 100 * (np.abs(last - wanted) / wanted.mean(axis=1, keepdims=True)).max(axis=1)[held]
    way = 100 * np.abs(found.force - expected.force).max(axis=(1, 2)) / expected.force.max(axis=(1, 2))
    alike = int((found.success == expected.success).sum())
    print(
        f"| {name} | {found.success.sum()} of {len(found.success)} | {alike} | {held.sum()} | "
        f"{np.median(width):.4f} / {width.max():.4f} mm | {np.median(force):.3f} / {force.max():.3f} % | "
        f"{(force > 0.5).sum()} | {found.iterations.mean():.2f} | {np.median(way):.2f} / {way.max():.2f} % |",
        flush=True,
    )


def main() -> None:
    """Print a row per variant and tree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--variants", nargs="*", choices=VARIANTS, default=["default"])
    parser.add_argument("--reference", choices=VARIANTS, default="tighter")
    parser.add_argument("--tree", type=Path, nargs="*", default=[], help="other trees of softmode")
    parser.add_argument("--preset", default="plush")
    parser.add_argument("--seeds", type=int, default=64)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--replay", action="store_true", help="all do what the reference does")
    parser.add_argument("--record", type=Path, help="write what the default gives to a file, compare nothing")
    parser.add_argument("--actions", type=Path, help="actions to replay while recording")
    options = parser.parse_args()
    if options.record:
        given = None if options.actions is None else np.load(options.actions)
        np.savez(options.record, **vars(play_all("default", options, given)))
        return
    expected = play_all(options.reference, options)
    actions = expected.actions if options.replay else None
    print(f"{options.seeds} grasps of {options.preset}, {'same actions' if options.replay else 'policy'}, E from")
    print(f"{expected.modulus.min():.1e} to {expected.modulus.max():.1e} Pa, against {options.reference}\n")
    titles = ("succeed", "as the reference", "held in both", "widths: median / most", "forces: median / most")
    print(f"| | {' | '.join(titles)} | above 0.5 % | iterations | forces on the way |\n|{'---|' * 9}")
    report(options.reference, expected, expected)
    for variant in options.variants:
        report(variant, play_all(variant, options, actions), expected)
    for tree in options.tree:
        report(str(tree), play_in_tree(tree.resolve(), options, actions), expected)


if __name__ == "__main__":
    main()
