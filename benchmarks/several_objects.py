"""Processor time of a control step of LiftSoft with room for eight objects of which one to eight are there.

Beside it the scene of that object alone. The arm goes down on the first object and closes, in turn with the others.

Run: ``python -m benchmarks.several_objects [--steps 60] [--turns 3]``
"""

import argparse
import time
from dataclasses import replace

import numpy as np
import warp as wp

from softmode.envs import LiftSoftConfig, LiftSoftEnv
from softmode.envs.presets import RL_BUILD
from softmode.objects import ObjectConfig, ObjectSet

SLOTS = 8
TOY = ObjectConfig(shape="box", extents=(0.05, 0.05, 0.05), surface_count=200, build=RL_BUILD)
PLACE = {"position": (0.45, 0.0), "yaw": 0.0, "youngs_modulus": 1.0e5}


def time_of(env: LiftSoftEnv, options: dict[str, object], steps: int) -> float:
    """Return the processor time of a control step [ms]."""
    env.reset(seed=0, options=options)
    begin = time.process_time()
    for step in range(steps):
        env.step(np.array([0.0, 0.0, -1.0, 0.0, 1.0 if step < steps // 3 else -1.0], np.float32))
    return 1.0e3 * (time.process_time() - begin) / steps


def main() -> None:
    """Print a line per number of objects."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--turns", type=int, default=3)
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    config = LiftSoftConfig()
    alone = LiftSoftEnv(config=replace(config, scene=replace(config.scene, object=TOY)), device="cpu")
    objects = ObjectSet((TOY,), resample=True, per_world=(1, SLOTS))
    several = LiftSoftEnv(config=replace(config, objects=objects), device="cpu")
    cases = {"the scene of one object": (alone, PLACE)}
    for count in (1, 2, 4, SLOTS):
        cases[f"{SLOTS} slots, {count} there"] = (several, {**PLACE, "object": [0] * count + [-1] * (SLOTS - count)})
    found: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(given.turns):
        for name, (env, options) in cases.items():
            found[name].append(time_of(env, options, given.steps))
    for name, times in found.items():
        print(f"{name:26s}{np.median(times):8.2f} ms per control step")


if __name__ == "__main__":
    main()
