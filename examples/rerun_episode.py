"""Record an episode for the rerun viewer: robot, deforming splats, forces, pictures, energies and rewards over time.

A recording is data, not a film: here it is read back, and the work that the robot did shows in it. Look at it with
``rerun out/rerun_episode.rrd``.

Needs the extra viz. Run: ``python examples/rerun_episode.py [--out out/rerun_episode.rrd] [--short]``
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import warp as wp
from rerun.chunk import RrdReader

import softmode  # noqa: F401  (registers the environments)
from softmode.envs import scripted_policy
from softmode.viz import RerunLogger, RerunOptions

GRAVITY = 9.81


def record(env: Any, path: Path, *, images: bool, seed: int = 0) -> list[float]:
    """Record a scripted episode until a second after success; return the height of the toy in every frame [m]."""
    observation, info = env.reset(seed=seed)
    policy, scene = scripted_policy(env), env.unwrapped.scene
    heights, done, held = [float(scene.object_position.numpy()[0, 0, 2])], False, 0
    with RerunLogger(path, env, options=RerunOptions(images=images)) as logger:
        logger.record()
        while not done:
            action = policy(observation)
            observation, _, terminated, truncated, info = env.step(action)
            logger.record(scalars={"gripper_command": float(action[-1])})  # any number of one's own
            heights.append(float(scene.object_position.numpy()[0, 0, 2]))
            held += info["is_success"]
            done = terminated or truncated or held >= 30
    return heights


def read(path: Path) -> tuple[dict[str, np.ndarray], int]:
    """Return the numbers in a recording by entity, in the order of time, and how often splats were written."""
    rows: dict[str, dict[int, float]] = {}
    splats = 0
    for chunk in RrdReader(path).stream():
        batch, entity = chunk.to_record_batch(), chunk.entity_path.strip("/")
        if chunk.is_static or "step" not in batch.schema.names:
            continue
        splats += chunk.num_rows if "GaussianSplats3D:centers" in batch.schema.names else 0
        if "Scalars:scalars" in batch.schema.names:
            steps, values = (batch.column(name).to_pylist() for name in ("step", "Scalars:scalars"))
            rows.setdefault(entity, {}).update((s, v[0]) for s, v in zip(steps, values, strict=True) if v)
    return {entity: np.array([row[s] for s in sorted(row)]) for entity, row in rows.items()}, splats


def test_final(heights: list[float], weight: float, numbers: dict[str, np.ndarray], splats: int) -> None:
    """Every frame is there, and the toy's potential energy in the file is its weight times its height."""
    (name,) = (entity for entity in numbers if entity.startswith("energy/") and entity.endswith("/gravitational"))
    gained = numbers[name] - numbers[name][0]
    np.testing.assert_allclose(gained, weight * (np.array(heights) - heights[0]), atol=1e-5)
    assert splats >= len(heights) and len(numbers["gripper_command"]) == len(heights) - 1
    assert gained[-1] > 0.05 * weight
    kinetic = numbers[name.replace("gravitational", "kinetic")]
    assert kinetic.min() >= 0.0 and kinetic[-1] < 0.1 * kinetic.max()
    print(f"lifted: {1e3 * gained[-1]:.2f} mJ, moving at most {1e3 * kinetic.max():.2f} mJ")


def main(arguments: list[str] | None = None) -> None:
    """Record, read back, check."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/rerun_episode.rrd"))
    parser.add_argument("--short", action="store_true", help="no pictures")
    given = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    env = gym.make("softmode/LiftSoft-v0", render_mode=None if given.short else "rgb_array")
    heights = record(env, given.out, images=not given.short)
    print(f"wrote {given.out}: {len(heights)} frames, {1e-6 * given.out.stat().st_size:.1f} MB")
    task: Any = env.unwrapped
    weight = GRAVITY * task.config.scene.material.density * task.scene.soft.body.volume
    test_final(heights, weight, *read(given.out))


if __name__ == "__main__":
    main()
