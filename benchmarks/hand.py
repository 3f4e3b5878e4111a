"""What a step costs while a hand of 16 joints holds a soft ball, beside the built-in arm that holds the same ball.

Run: ``python -m benchmarks.hand [--hand wonik_allegro] [--device cuda:0]``. Both scenes have the same body, solver and
step, and are timed in turns: the processor's time on CPU, the wall's on CUDA.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import warp as wp

from examples.hand_squeeze import FOAM, RADIUS, STAGES, Hand
from softmode import robots
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from softmode.envs import LiftSoftConfig, LiftSoftEnv, scripted_policy
from softmode.objects import ObjectConfig
from softmode.scenes import TableSceneConfig, capture_graph
from softmode.viz import Film


def held_by_arm(device: str, samples: int) -> LiftSoftEnv:
    """Return LiftSoft with the ball in the air."""
    ball = ObjectConfig(preset="ball", size=2.0 * RADIUS, surface_count=samples)
    scene = replace(TableSceneConfig(), object=ball, material=FOAM, solver=SolverReducedOptions(), constraint_max=96)
    env = LiftSoftEnv(config=LiftSoftConfig(scene=scene, youngs_modulus_range=None), device=device)
    observation, info = env.reset(seed=0)
    policy = scripted_policy(env)
    while not info["is_success"]:
        observation, _, failed, late, info = env.step(policy(observation))
        if failed or late:
            raise SystemExit("the arm did not lift the ball")
    return env


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hand", default="wonik_allegro")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--frames", type=int, default=40, help="frames of 8 steps in each of five turns")
    parser.add_argument("--samples", type=int, default=1200, help="surface samples of the ball")
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    wp.set_device(given.device)
    hand = Hand(robots.load(given.hand), 96, given.samples)
    for stage in ("turn", "hold again"):
        STAGES.pop(stage)
    with Film(Path("out/benchmark_hand.mp4")) as film:
        hand.run(film)
    env = held_by_arm(given.device, given.samples)
    steps = {"hand": hand.scene.steps_per_frame, "arm": env.config.scene.substeps}
    arm = capture_graph(env.scene.control_step, env.scene.device)
    frames = {"hand": hand.scene.step, "arm": arm.launch}
    clock = time.process_time if given.device == "cpu" else time.perf_counter
    spent: dict[str, list[float]] = {name: [] for name in frames}
    for _ in range(5):
        for name, frame in frames.items():
            wp.synchronize()
            start = clock()
            for _ in range(given.frames):
                frame()
            wp.synchronize()
            spent[name].append(1e3 * (clock() - start) / (given.frames * steps[name]))
    for name, scene in (("hand", hand.scene), ("arm", env.scene)):
        solver = scene.solver
        count = int(solver.view.constraints.count.numpy().sum())
        dofs = scene.model.joint_dof_count
        print(f"{name:5s} {dofs} joints, {count} contacts: {np.min(spent[name]):.3f} ms per step (least of five turns)")
    print(f"ratio {np.min(spent['hand']) / np.min(spent['arm']):.2f}")


if __name__ == "__main__":
    main()
