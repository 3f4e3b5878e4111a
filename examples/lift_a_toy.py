"""A robot grasps a soft toy and lifts it to a goal, in the Gymnasium environment, and films it.

The script that plays looks at the simulation; a policy of one's own would look at the observation (docs/training.md).
What is checked is physics that no reward tells: who carries the toy, and that friction may hold it.

Run: ``python examples/lift_a_toy.py [--splat toy.ply] [--seed 0] [--video out/lift_a_toy.mp4] [--short]``
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import warp as wp

import softmode  # noqa: F401  (registers the environments)
from softmode.envs import LiftSoftConfig, scripted_policy
from softmode.viz import Film

GRAVITY = 9.81


class Row(NamedTuple):
    """What a control step ended with."""

    height: float  # of the toy over where it stood [m]
    carried: float  # upward force of the fingers on the toy [N]
    reward: float
    success: bool
    fine: bool  # whether every solve converged


def lift(env: Any, film: Film, seed: int) -> list[Row]:
    """Play until a second after success, or the end of the episode; return a row per step."""
    observation, info = env.reset(seed=seed)
    policy, scene = scripted_policy(env), env.unwrapped.scene
    rows, done, held = [], False, 0
    while not done:
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        film.add(env.render(), env.metadata["render_fps"])
        carried = 0.0 - float(scene.finger_force.numpy()[0, :, 2].sum())  # what acts on the fingers points down
        rows.append(Row(info["object_height"], carried, reward, info["is_success"], not info["solver_status"]))
        held += info["is_success"]
        done = terminated or truncated or held >= 30
    return rows


def test_final(rows: list[Row], weight: float) -> None:
    """The toy reached its goal and is carried by the fingers alone: with its weight, within a twentieth."""
    held = np.mean([row.carried for row in rows[-10:]])
    print(f"the toy weighs {weight:.3f} N, the fingers carry {held:.3f} N, {100 * rows[-1].height:.1f} cm up")
    assert rows[-1].success
    assert rows[-1].height > 0.05 and rows[0].carried == 0.0
    assert abs(held / weight - 1.0) < 0.05
    assert np.mean([row.fine for row in rows]) > 0.95


def main(arguments: list[str] | None = None) -> None:
    """Film one episode."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--splat", help="splat file of a toy at most 9 cm wide, y down; the plush bear if not given")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--video", type=Path, default=Path("out/lift_a_toy.mp4"))
    parser.add_argument("--short", action="store_true", help="small pictures")
    given = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    config = LiftSoftConfig(render_size=96 if given.short else 320, mesh_samples=4)
    env = gym.make("softmode/LiftSoft-v0", render_mode="rgb_array", splat=given.splat, config=config)
    with Film(given.video) as film:
        rows = lift(env, film, given.seed)
        film.publish()
    for k, row in list(enumerate(rows))[::10]:
        print(
            f"step {k:3d}: {100 * row.height:6.2f} cm up, fingers carry {row.carried:6.3f} N, reward {row.reward:.2f}"
        )
    print(f"wrote {film.path} and {film.sheet_path}")
    task: Any = env.unwrapped
    density = task.config.scene.material.density
    test_final(rows, GRAVITY * density * task.scene.soft.body.volume)


if __name__ == "__main__":
    main()
