"""Time the build of a body and every stage of a substep of LiftSoft, in the middle of a grasp.

Run: ``python benchmarks/grasp.py [--repeats N] [--device cpu]`` (``make bench``). Medians over graph replays; a CPU
device runs Warp's kernels on one core. Ratios refer to the whole substep measured in the same run.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from softmode.deformables.build.build_body import build_body
from softmode.deformables.build.options import BuildOptions
from softmode.deformables.build.quadrature import quadrature_from_splats
from softmode.deformables.solver.evaluate import assemble, evaluate, gather_gradient, solve
from softmode.deformables.solver.minimise import check_convergence
from softmode.envs.tasks.lift_soft.scripted import ScriptedLift
from softmode.envs.tasks.lift_soft.task import LiftSoftEnv
from softmode.splats import make_plush

GRASP_STEPS = 55
"""Control steps of the scripted policy after which the object is held off the table."""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    print_build()
    env = LiftSoftEnv(obs_type="pixels", render_mode="rgb_array", device=options.device)
    observation, _ = env.reset(seed=0, options={"youngs_modulus": 2.0e5})
    policy = ScriptedLift(env)
    iterations = []
    for _ in range(GRASP_STEPS):
        observation, *_ = env.step(policy(observation))
        iterations.append(int(env.scene.solver.reduced.iteration.numpy()[0]))
    print_substep(env, options.repeats, statistics.mean(iterations[-15:]))
    print_cameras(env, options.repeats)


def print_build() -> None:
    """Time the build of the default object."""
    splats = make_plush()
    clock = time.perf_counter()
    quadrature = quadrature_from_splats(splats.means, splats.scales, splats.quats, splats.opacities)
    filled = time.perf_counter() - clock
    body = build_body(quadrature, BuildOptions(), name="plush", progress=False)
    print(f"build: quadrature {filled:.2f} s, body {body.build_seconds:.2f} s")
    print(f"  {len(quadrature.points)} quadrature points, {body.function_count} functions, {body.point_count} cubature")
    for name, value in body.provenance.items():
        if name.startswith(("seconds", "cubature")):
            print(f"  {name}: {value}")


def print_substep(env: LiftSoftEnv, repeats: int, iterations: float) -> None:
    """Time the stages of one substep, each captured on its own, from the same state."""
    scene = env.scene
    solver, dt, device = scene.solver, scene.dt, scene.device
    soft, state, scratch = solver.reduced, scene.state, scene._scratch
    blank = soft.tables.newton.active
    blank.fill_(1)
    whole = measure(lambda: solver.step(state, scratch, scene.control, None, dt), repeats, device)
    print(
        f"substep: {whole:.3f} ms, {iterations:.2f} Newton iterations, "
        f"{int(soft.view.constraints.count.numpy()[0])} contacts"
    )

    def renewed(stage: Callable[[], None]) -> None:
        soft.tables.newton.refresh.fill_(1)
        stage()
        soft.tables.newton.refresh.zero_()

    stages: dict[str, Callable[[], None]] = {
        "MuJoCo step (two per substep)": lambda: solver.rigid.step(state, scratch, scene.control, None, dt),
        "Jacobian, mass matrix": lambda: solver._linearise(state, dt),
        "begin": lambda: soft.begin(state, scene.control, dt),
        "detect contacts": lambda: soft.detect(state, scene.control, dt, prescribed=False),
        "evaluate with Hessian (once or twice)": lambda: renewed(lambda: evaluate(soft.tables, dt, derivatives=True)),
        "evaluate with gradient (per iteration)": lambda: evaluate(soft.tables, dt, derivatives=True),
        "evaluate energy (per trial)": lambda: evaluate(soft.tables, dt, derivatives=False),
        "sum potential (per evaluation)": lambda: check_convergence(soft.tables, dt),
        "gather gradient (per iteration)": lambda: gather_gradient(soft.tables, dt),
        "assemble with stiffness (once or twice)": lambda: renewed(lambda: assemble(soft.tables, dt)),
        "assemble (per iteration)": lambda: assemble(soft.tables, dt),
        "factor and solve (per iteration)": lambda: solve(soft.tables),
        "finish": lambda: soft.finish(scratch, dt),
    }
    for name, stage in stages.items():
        blank.fill_(1)
        soft.tables.newton.refresh.zero_()
        milliseconds = measure(stage, repeats, device)
        print(f"  {name:<44}{milliseconds:8.3f} ms  {milliseconds / whole:6.1%}")
    frame = measure(scene.control_step, max(repeats // 10, 5), device)
    print(
        f"control step: {frame:.2f} ms for {scene.config.substeps} substeps, "
        f"{1e3 / scene.config.control_hz / frame:.2f} x real time"
    )


def print_cameras(env: LiftSoftEnv, repeats: int) -> None:
    """Time a frame of every camera."""
    for size in env.scene.cameras:
        env.scene.render(size)
        clock = []
        for _ in range(max(repeats // 10, 5)):
            start = time.process_time()
            env.scene.render(size)
            wp.synchronize_device(env.scene.device)
            clock.append(1e3 * (time.process_time() - start))
        views = env.scene.cameras[size].view_count
        print(f"camera {size[0]} px, {views} view(s): {np.median(clock):.2f} ms per frame")


def measure(stage: Callable[[], None], repeats: int, device: Any) -> float:
    """Return the median time [ms] of a captured stage."""
    stage()
    with wp.ScopedCapture(device=device) as capture:
        stage()
    graph: Any = capture.graph
    clock = time.perf_counter if device.is_cuda else time.process_time  # of this process: one core
    times = []
    for _ in range(repeats):
        start = clock()
        wp.capture_launch(graph)
        wp.synchronize_device(device)
        times.append(1e3 * (clock() - start))
    return float(np.median(times))


if __name__ == "__main__":
    main()
