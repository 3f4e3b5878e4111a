"""Count scripted lifts of files and shapes that nobody prepared, without options; what failed is told with its reason.

Run: ``python benchmarks/lifts.py [FILE ...] [--captures | --presets] [--only cup torus]``: splat files, or the shapes
or captures of the tests, or the presets. Every object is brought to 80 mm, and Young's modulus is drawn from 2e4 to 2e6
Pa; the presets have their own size and material.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import trimesh
import warp as wp

from softmode.cli.object_options import ObjectOptions
from softmode.envs.scripted import scripted_policy
from softmode.envs.tasks.lift_soft.log import LiftLog
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig, LiftSoftEnv, lift_scene
from softmode.errors import GraspError, SoftmodeError
from softmode.objects.config import ObjectConfig
from softmode.objects.shapes.presets import PRESETS
from softmode.splats.colored_mesh import ColoredMesh
from tests.captures import CAPTURES
from tests.shapes import SHAPES

STEPS = 150
"""Control steps of an episode."""


Named = Iterator[tuple[str, LiftSoftConfig]]


def lifting(thing: ObjectConfig) -> LiftSoftConfig:
    """Return the task with an object."""
    return LiftSoftConfig(scene=replace(lift_scene(), object=thing))


def files(paths: list[Path]) -> Named:
    """Yield what splat files hold."""
    for path in paths:
        yield path.name, lifting(replace(lift_scene().object, splat=path))


def presets(names: list[str]) -> Named:
    """Yield the presets, each of its own size and material."""
    for name in PRESETS:
        if not names or name in names:
            yield name, ObjectOptions(object=Path(name)).configured(LiftSoftConfig())


def captures(names: list[str]) -> Named:
    """Yield the captures of the tests."""
    for name, capture in CAPTURES.items():
        if not names or name in names:
            yield name, lifting(replace(lift_scene().object, splat=capture.scene(), **capture.options))


def shapes(names: list[str]) -> Named:
    """Yield the shapes of the tests that are meshes in one piece."""
    for name, shape in SHAPES.items():
        if shape.source == "mesh" and shape.connected and (not names or name in names):
            mesh = trimesh.Trimesh(*shape.geometry(), process=False)
            yield name, lifting(replace(lift_scene().object, mesh=ColoredMesh.from_trimesh(mesh, name=name)))


def lift(env: LiftSoftEnv, seed: int) -> str:
    """Play an episode; return "" for a success, else why it failed."""
    observation, info = env.reset(seed=seed)
    policy, log, ended = scripted_policy(env), LiftLog(env.config), False
    try:
        for _ in range(STEPS):
            observation, _, ended, _, info = env.step(policy(observation))
            log.record(info)
            if ended:
                break
    except GraspError as error:
        return str(error)
    return "" if info["is_success"] else log.reason(info)


def main() -> None:
    """Print a line per object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", type=Path)
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument("--captures", action="store_true", help="the captures of the tests")
    kinds.add_argument("--presets", action="store_true", help="the presets")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--only", nargs="*", default=[])
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    named = captures if options.captures else presets if options.presets else shapes
    things = files(options.files) if options.files else named(options.only)
    for name, config in things:
        try:
            env = LiftSoftEnv(config=config, progress=False)
        except SoftmodeError as error:
            print(f"{name:20} cannot be built: {error}", flush=True)
            continue
        results = [lift(env, seed) for seed in range(options.seeds)]
        reasons = Counter(reason.partition(" at ")[0] for reason in results if reason)
        told = "; ".join(f"{count} x {reason}" for reason, count in reasons.most_common())
        print(f"{name:20} {results.count(''):3d} of {options.seeds}  {told}", flush=True)


if __name__ == "__main__":
    main()
