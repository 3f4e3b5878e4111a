"""Friction and penetration: creep below the cone, acceleration above it, a held cube, impacts, the depth of a grasp.

Run: ``python -m benchmarks.contact [--skip-lift]``. Every figure with friction that remembers and, in the same run,
without (``stick_ratio=0``), every impact with the automatic stiffness and with its part for inertia left out.
Processor times are of this process.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from softmode.envs.tasks.lift_soft.scripted import ScriptedLift
from softmode.envs.tasks.lift_soft.task import LiftSoftEnv
from tests import reference
from tests.bodies import cube
from tests.deformables.test_coupling import grasp, impact, totals
from tests.deformables.test_friction import MU, incline
from tests.scenes import GRAVITY, Scene

FRICTION = {"remembers": SolverReducedOptions(), "smoothed": SolverReducedOptions(stick_ratio=0.0)}

LIFT_STEPS = 120
"""Control steps of the scripted policy: reach, grasp, lift, hold."""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--skip-lift", action="store_true")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    for name, options in FRICTION.items():
        for share in (0.5, 0.9, 0.98, 1.05, 1.5):
            print_incline(name, share, options)
        print_hold(name, options)
    for youngs_modulus, density, dt in ((1e4, 100.0, 0.004), (1e5, 1e3, 0.004), (1e6, 8e3, 0.004), (1e6, 8e3, 0.001)):
        for name, inertia in (("automatic", True), ("without inertia", False)):
            print_drop(name, youngs_modulus, density, dt, inertia=inertia)
    for ratio in (1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3):
        for speed in (0.5, 5.0):
            print_impact(ratio, speed)
    if not arguments.skip_lift:
        for youngs_modulus in (2.0e4, 2.0e5, 2.0e6):
            print_lift(youngs_modulus)


def replayed(scene: Scene, count: int, replay: Callable[[int], Any], seen: Callable[[], Any]) -> tuple[Any, Any, float]:
    """Return what was seen after every replay of two steps, the Newton iterations, and ms per step."""
    rows, iterations, clock = [], [], time.process_time()
    for k in range(count):
        replay(k)
        rows.append(seen())
        iterations.append(int(scene.reduced.iteration.numpy()[0]))
    return np.array(rows), np.array(iterations), 1e3 * (time.process_time() - clock) / (2 * count)


def print_incline(name: str, share: float, options: SolverReducedOptions) -> None:
    """Print creep over nine seconds or the acceleration of a cube on a slope with tan(angle) = share mu."""
    scene, along = incline(share, options=options)
    run, held = scene.capture(), share < 1.0
    count = round((10.0 if held else 1.0) / scene.dt / 2)
    x, iterations, cost = replayed(scene, count, lambda _: run(), lambda: along @ scene.centre())
    t = 2.0 * scene.dt * np.arange(1, count + 1)
    if held:
        figure = f"moved {abs(x[-1]):.1e} m, of it {x[-1] - x[t > 1.0][0]:.1e} m from 1 s to 10 s"
    else:
        angle = np.arctan(share * MU)
        exact = GRAVITY * (np.sin(angle) - MU * np.cos(angle))
        figure = f"a / exact {2.0 * np.polyfit(t[t > 0.3], x[t > 0.3], 2)[0] / exact:.4f}"
    print(f"incline {share:4.2f} {name}: {figure}; {iterations.mean():.2f} iterations, {cost:.3f} ms", flush=True)


def print_hold(name: str, options: SolverReducedOptions) -> None:
    """Print how far a cube creeps out of a gripper in ten seconds."""
    dt = 0.004
    scene, close, _ = grasp(5.0e5, dt, options=options)
    start = round(1.4 / dt / 2)
    place, iterations, cost = replayed(
        scene,
        start + round(10.0 / dt / 2),
        lambda k: close(2 * k * dt),
        lambda: scene.centre() - [0.0, 0.0, scene.state.joint_q.numpy()[0]],
    )
    creep = np.ptp(place[start:], axis=0).max()
    print(f"gripper {name}: creep {creep:.1e} m in 10 s; {iterations.mean():.2f} iterations, {cost:.3f} ms", flush=True)


def print_drop(name: str, youngs_modulus: float, density: float, dt: float, *, inertia: bool) -> None:
    """Print how deep a cube sinks that hits the ground with 5 m/s."""
    body, material = cube(), Material(youngs_modulus=youngs_modulus, density=density)
    given = None if inertia else reference.contact_stiffness(body, material, np.inf)

    def populate(world: Any) -> None:
        place: Any = {"position": (0.0, 0.0, 0.051), "velocity": (0.0, 0.0, -5.0)}
        add_reduced_body(world, body, material=material, contact_stiffness_per_area=given, **place)

    scene = Scene(populate, [body], gravity=(0.0, 0.0, -GRAVITY), ground=0.5, dt=dt)
    depth, iterations = [], []
    for _ in range(round(0.1 / dt)):
        scene.step()
        depth.append(-1e3 * scene.state.particle_q.numpy()[:, 2].min())
        iterations.append(scene.reduced.iteration.numpy()[0])
    print(
        f"drop E {youngs_modulus:.0e} rho {density:.0f} dt {1e3 * dt:.0f} ms {name}: {max(depth):.2f} mm deep; "
        f"{np.mean(iterations):.2f} iterations, at most {max(iterations)}",
        flush=True,
    )


def print_impact(ratio: float, speed: float) -> None:
    """Print momentum error, energy gain and depth of a free rigid cube on a free soft one."""
    scene, twin = impact(ratio, speed=speed)
    momentum, _, energy = totals(scene, twin)
    rows = []
    for _ in range(100):
        scene.step()
        p, _, e = totals(scene, twin)
        error = np.abs(p - momentum).max() / np.abs(momentum).max()
        rows.append([error, e / energy - 1.0, -1e3 * min(scene.reduced.view.samples.gap.numpy()[0, :, 0].min(), 0.0)])
    error, gain, depth = np.max(rows, axis=0)
    print(f"impact {ratio:g} {speed} m/s: |dp| {error:.1e}, energy {gain:+.1e}, {depth:.2f} mm deep", flush=True)


def print_lift(youngs_modulus: float) -> None:
    """Print the depth of every substep of a scripted LiftSoft episode."""
    env = LiftSoftEnv(obs_type="state")
    observation, _ = env.reset(seed=1, options={"youngs_modulus": youngs_modulus})
    policy = ScriptedLift(env)
    scene: Any = env.scene
    soft, depth, iterations = scene.solver.reduced, [], []
    step = scene.solver.step

    def watched(*arguments: Any) -> None:
        step(*arguments)
        touched = soft.view.samples.shape.numpy()[0] >= 0
        depth.append(-1e3 * np.where(touched, soft.view.samples.gap.numpy()[0], 0.0).min())
        iterations.append(int(soft.iteration.numpy()[0]))

    task: Any = env.task
    scene.solver.step, task.step = watched, task._step  # not as a graph, whose substeps nobody sees
    info: dict[str, Any] = {}
    for _ in range(LIFT_STEPS):
        observation, _, terminated, truncated, info = env.step(policy(observation))
        if terminated or truncated:
            break
    size = 1e3 * float(soft.view.layout.size[0])
    print(
        f"LiftSoft E {youngs_modulus:.0e}: {len(depth)} steps, at most {max(depth):.2f} mm deep, mean "
        f"{np.mean(depth):.2f} mm, body {size:.0f} mm; {np.mean(iterations):.2f} iterations; {info.get('is_success')}",
        flush=True,
    )


if __name__ == "__main__":
    main()
