"""Time the control step of LiftSoft's scene against the number of worlds.

Run: ``python benchmarks/worlds.py --device cuda:0 --worlds 1 64 1024``. Every world plays the same downward motion with
the gripper closing on the object, so that contact is active in all of them; with ``--random`` every world plays random
actions of its own instead. ``--preset rl`` takes the scene of ``softmode.envs.presets``.

Prints milliseconds per control step, world steps per second, the union of the solver's status bits and, on CUDA, the
memory taken; with ``--pixels 64`` also the time of a picture of that edge in every world, meshes, shadows and splats,
and what it takes without the splats. ``--grip`` prints instead, for bodies and solvers between a fine scene and the
preset, what the fingers feel and how wide the object between them is, scripted lifts, and processor time of one world.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from softmode.deformables.build.options import BuildOptions
from softmode.envs.presets import RL_BUILD, rl_scene
from softmode.envs.tasks.lift_soft.scripted import ScriptedLift
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig, LiftSoftEnv
from softmode.scenes.table_scene import TableScene, TableSceneConfig
from softmode.splats.camera import SplatCamera
from softmode.splats.pinhole import PinholeCamera


def main() -> None:
    """Print one line per world count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--pixels", type=int, default=0, help="edge of the pictures [px]; 0 for none")
    parser.add_argument("--random", action="store_true", help="random actions instead of a grasp")
    parser.add_argument("--warm-up", type=int, default=26, help="control steps before the clock starts")
    parser.add_argument("--preset", choices=["fine", "rl"], default="fine")
    parser.add_argument("--grip", nargs="*", help="print what bodies and solvers change in a grip: all, or rows named")
    options = parser.parse_args()
    if options.grip is not None:
        report_grips(options.grip)
        return
    config = rl_scene() if options.preset == "rl" else TableSceneConfig()
    wp.config.log_level = wp.LOG_WARNING
    for count in options.worlds:
        camera = PinholeCamera.look_at(
            "front",
            position=(0.86, 0.34, 0.25),
            target=(0.44, 0.0, 0.11),
            width=max(options.pixels, 1),
            height=max(options.pixels, 1),
            fov_y=0.6,
        )
        cameras = [camera] if options.pixels else []
        scene = TableScene(config, world_count=count, cameras=cameras, device=options.device)
        rng = np.random.default_rng(0)
        noise = rng.uniform(-1.0, 1.0, (64, count, 5)).astype(np.float32)

        def action(step: int, scene: TableScene = scene, noise: np.ndarray = noise) -> np.ndarray:
            return noise[step % len(noise)] if options.random else grasp_action(scene, step)

        for step in range(options.warm_up):
            scene.step(action(step))
        wp.synchronize_device(scene.device)
        clock = time.perf_counter()
        flags = 0
        for step in range(options.warm_up, options.warm_up + options.steps):
            scene.step(action(step))
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
        if options.pixels:
            report_pictures(scene, camera, options.steps)
        del scene


def report_pictures(scene: TableScene, camera: PinholeCamera, repeats: int) -> None:
    """Print the median time of a picture per world, whole and meshes alone."""
    bare = SplatCamera(scene.model, None, [camera])
    bare.render(scene.state)
    with wp.ScopedCapture(device=scene.device) as capture:
        bare.render(scene.state)
    graph: Any = capture.graph
    frames = {
        "whole": lambda: scene.render((camera.width, camera.height)),
        "meshes alone": lambda: wp.capture_launch(graph),
    }
    for name, frame in frames.items():
        frame()
        times = []
        for _ in range(repeats):
            wp.synchronize_device(scene.device)
            clock = time.perf_counter()
            frame()
            wp.synchronize_device(scene.device)
            times.append(1e3 * (time.perf_counter() - clock))
        spent = float(np.median(times))
        print(
            f"  {camera.width} px, {name}: {spent:.2f} ms, {1e3 * scene.world_count / spent:.0f} pictures/s", flush=True
        )


def report_grips(chosen: Sequence[str]) -> None:
    """Print force, width and extent of the object in one grip, scripted lifts, and time, by body and solver.

    Args:
        chosen: Names of rows; none for all.
    """
    fine = TableSceneConfig()

    def body(config: TableSceneConfig, **options: Any) -> TableSceneConfig:
        return replace(config, object=replace(config.object, build=BuildOptions(**options)))

    scenes = {
        "120 functions": body(fine, function_count=120),
        "default": fine,
        "default, 4 steps of 1/120 s": replace(fine, substeps=4),
        "32 functions": body(fine, function_count=32),
        "24 functions": body(fine, function_count=RL_BUILD.function_count),
        "preset": rl_scene(),
        "preset, 48 functions": body(rl_scene(), cubature_count=RL_BUILD.cubature_count),
        "preset, FreeForm's": body(rl_scene(), mode_count=5, cubature_count=RL_BUILD.cubature_count),
    }
    wp.config.log_level = wp.LOG_WARNING
    print(f"{'':<30}{'force [N]':>16}{'width [mm]':>12}{'extent [mm]':>20}{'ms':>7}  scripted lifts")
    for name, config in ((name, scenes[name]) for name in chosen or scenes):
        scene = TableScene(config, device="cpu")
        times = []
        for step in range(70):
            clock = time.process_time()
            scene.step(grasp_action(scene, step))
            times.append(1e3 * (time.process_time() - clock))
        force = np.linalg.norm(scene.finger_force.numpy()[0], axis=1)
        extent = 1e3 * np.ptp(scene.state.particle_q.numpy(), axis=0)
        lifts = []
        for seed in range(3):
            env = LiftSoftEnv(config=LiftSoftConfig(scene=replace(config, constraint_max=96)))
            observation, info = env.reset(seed=seed, options={"youngs_modulus": 1.0e5})
            policy, count = ScriptedLift(env), 0
            while not info["is_success"] and count < 200:
                observation, *_, info = env.step(policy(observation))
                count += 1
            lifts.append(str(count) if info["is_success"] else "lost")
        print(
            f"{name:<30}{force[0]:>8.2f}{force[1]:>8.2f}{1e3 * scene.controller.opening.numpy()[0]:>12.2f}"
            f"{extent[0]:>8.1f}{extent[1]:>6.1f}{extent[2]:>6.1f}{np.median(times[40:]):>7.2f}  {', '.join(lifts)}",
            flush=True,
        )


def grasp_action(scene: TableScene, step: int) -> np.ndarray:
    """Go down to the object, then close."""
    action = np.zeros((scene.world_count, 5), np.float32)
    height = scene.controller.target_position.numpy()[0, 2]
    action[:, 2] = np.clip((scene.soft.height - height) / 0.015, -1.0, 1.0)
    action[:, 4] = 1.0 if step < 18 else max(1.0 - 0.06 * (step - 17), -0.45)
    return action


if __name__ == "__main__":
    main()
