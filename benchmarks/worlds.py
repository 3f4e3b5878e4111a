"""Time the control step of LiftSoft's scene against the number of worlds.

Run: ``python benchmarks/worlds.py --device cuda:0 --worlds 1 64 1024``. Every world plays the same downward motion with
the gripper closing on the object, so that contact is active in all of them. Prints milliseconds per control step, world
steps per second, the union of the solver's status bits and, on CUDA, the memory taken.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import warp as wp

from softmode.envs.table_scene import TableScene, TableSceneConfig


def main() -> None:
    """Print one line per world count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--steps", type=int, default=30)
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    for count in options.worlds:
        scene = TableScene(TableSceneConfig(), world_count=count, device=options.device)
        for step in range(26):
            scene.step(grasp_action(scene, step))
        wp.synchronize_device(scene.device)
        clock = time.perf_counter()
        flags = 0
        for step in range(26, 26 + options.steps):
            scene.step(grasp_action(scene, step))
            flags |= int(np.bitwise_or.reduce(scene.status))
        wp.synchronize_device(scene.device)
        milliseconds = 1e3 * (time.perf_counter() - clock) / options.steps
        touching = int((np.linalg.norm(scene.finger_force.numpy(), axis=2).min(axis=1) > 0.02).sum())
        memory = f", {wp.get_mempool_used_mem_current(scene.device) / 1e6:.0f} MB" if scene.device.is_cuda else ""
        print(
            f"{count} worlds: {milliseconds:.2f} ms per control step, {1e3 * count / milliseconds:.0f} world steps/s, "
            f"{touching} grasped, {scene.solver.reduced.iteration.numpy().mean():.2f} iterations, "
            f"status {flags}{memory}",
            flush=True,
        )
        del scene


def grasp_action(scene: TableScene, step: int) -> np.ndarray:
    """Go down to the object, then close."""
    action = np.zeros((scene.world_count, 5), np.float32)
    height = scene.controller.target_position.numpy()[0, 2]
    action[:, 2] = np.clip((scene.soft.height - height) / 0.015, -1.0, 1.0)
    action[:, 4] = 1.0 if step < 18 else max(1.0 - 0.06 * (step - 17), -0.45)
    return action


if __name__ == "__main__":
    main()
