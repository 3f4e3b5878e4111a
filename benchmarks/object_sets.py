"""Environment steps per second of LiftSoft with 16 objects, beside one object of the largest size.

The objects are the fifteen presets and a box. The set is measured with an object per world, and with another one at
every reset.

Run: ``python -m benchmarks.object_sets [--num-envs 4096] [--device cuda:0] [--actions grasp]``; on a CPU add
``--device cpu --num-envs 4 --steps 10 --warmup 4``.
"""

import argparse
import functools
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import gymnasium as gym
import warp as wp

from softmode.envs import LiftSoftConfig
from softmode.envs.presets import RL_BUILD
from softmode.envs.throughput import measure_throughput
from softmode.objects import PRESETS, ObjectConfig, ObjectSet, load


def sixteen(**options: Any) -> ObjectSet:
    """Return all presets and a box."""
    box = ObjectConfig(shape="box", extents=(0.06, 0.06, 0.06), surface_count=200, build=RL_BUILD)
    return ObjectSet((*PRESETS, box), **options)


def body_size(objects: ObjectSet, k: int) -> tuple[float, ...]:
    """Build the body of object k of a set into the cache; return functions, samples, points and volume [m^3]."""
    body = load(objects.resolved(LiftSoftConfig().scene.object).config(k)).body
    return body.function_count, body.surface_count, len(body.cubature.weights), body.volume


def build_all(objects: ObjectSet) -> list[tuple[float, ...]]:
    """Build all bodies of a set in processes of their own; return their sizes."""
    with ProcessPoolExecutor(min(os.cpu_count() or 1, 16), mp_context=get_context("spawn")) as pool:
        return list(pool.map(functools.partial(body_size, objects), range(len(objects.names))))


def main() -> None:
    """Print a line per case and turn."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--warmup", type=int, default=60)
    parser.add_argument("--turns", type=int, default=2)
    parser.add_argument("--actions", choices=("random", "grasp"), default="random")
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    same = sixteen(order="in_turn")
    sizes = build_all(same)
    largest = max(range(len(sizes)), key=lambda k: sizes[k])
    print(f"largest: {same.names[largest]}")
    cases = {
        "one of the largest size": ObjectSet((same.objects[largest],)),
        "16 objects": same,
        "16 objects, resampled": sixteen(resample=True),
    }
    envs: dict[str, Any] = {}
    for name, objects in cases.items():
        config = LiftSoftConfig(objects=objects, youngs_modulus_range=None)
        options = {"config": config, "device": given.device, "output": "torch"}
        envs[name] = gym.make_vec("softmode/LiftSoft-v0", num_envs=given.num_envs, **options)
    for _ in range(given.turns):
        for name, env in envs.items():
            found = measure_throughput(env, steps=given.steps, warmup=given.warmup, actions=given.actions)
            rate, touching = f"{found.rate:12,.0f} env steps/s", f"{100 * found.touching:.0f} % touching"
            print(f"{name:24s}{rate}, {touching}, {found.failures} failures", flush=True)


if __name__ == "__main__":
    main()
