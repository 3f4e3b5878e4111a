"""Iterations of hard impacts, BDF2's order, and the momentum of a floating base that a soft cube hits.

Run: ``python -m benchmarks.impacts [--only drops|order|base]``. Rolling balls: `contact_targets`.
"""

from __future__ import annotations

import argparse
from typing import get_args

import newton
import numpy as np
import warp as wp

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_pins, add_reduced_body
from softmode.deformables.model.status import status_reasons
from softmode.deformables.solver.options import Integrator, SolverReducedOptions
from tests.bodies import bar, cube
from tests.scenes import GRAVITY, Scene, rotation

TUMBLING = (9.0, 5.0, 3.0)
"""Angular velocity of the drops [rad/s]."""


STEPS = (
    *((1e5, 1 / 60), (1e7, 1 / 60), (1e7, 1 / 240), (1e7, 1 / 1000)),
    *((1e8, 1 / 60), (1e9, 1 / 240), (1e9, 1 / 1000)),
)
"""Young's moduli [Pa] and steps [s] of the drops."""
SEEDS = 8
"""Drops of each, each turned another way."""


def drops() -> None:
    """Drop a tumbling cube of 0.1 m at 5 m/s on the ground; print Newton's iterations over a quarter of a second."""
    print("| E [Pa] | step [s] | most iterations | more than 20 | drops with a flag |\n|---|---|---|---|---|")
    for modulus, dt in STEPS:
        found, flagged = [], 0
        for seed in range(SEEDS):
            iterations, status = drop(modulus, dt, seed)
            found += iterations
            flagged += bool(status_reasons(status))
        share = np.mean(np.array(found) > 20)
        flags = f"{flagged} of {SEEDS}"
        print(f"| {modulus:.0e} | 1/{1 / dt:.0f} | {max(found)} | {share:.1%} of steps | {flags} |", flush=True)


def drop(modulus: float, dt: float, seed: int) -> tuple[list[int], int]:
    """Return Newton's iterations in every step of one drop, and the status bits that it raised."""
    turned = rotation(list(np.random.default_rng(seed).normal(size=3)), 1.0 + seed)

    def populate(world: newton.ModelBuilder) -> None:
        add_reduced_body(
            world,
            cube(),
            material=Material(youngs_modulus=modulus),
            position=(0.0, 0.0, 0.12),
            rotation=turned,
            velocity=(0.0, 0.0, -5.0),
            angular_velocity=TUMBLING,
        )

    scene = Scene(populate, [cube()], gravity=(0.0, 0.0, -GRAVITY), ground=0.5, dt=dt)
    iterations = []
    for _ in range(round(0.25 / dt)):
        scene.step()
        iterations.append(int(scene.reduced.iteration.numpy()[0]))
    return iterations, int(scene.reduced.status.numpy()[0])


def path(integrator: Integrator, pinned: bool, dt: float, duration: float) -> np.ndarray:
    """Return coordinates at 16 moments of a bar that bends at its clamp, or spins and pulses freely."""
    options = SolverReducedOptions(integrator=integrator, tolerance=1.0e-9)
    material = Material(youngs_modulus=2.0e5 if pinned else 2.0e4, viscosity=0.0)

    def populate(world: newton.ModelBuilder) -> None:
        body = bar()
        spin = (0.0, 0.0, 0.0) if pinned else (0.0, 3.0, 5.0)
        index = add_reduced_body(world, body, material=material, angular_velocity=spin)
        if pinned:
            add_pins(world, index, body.cubature.points[body.cubature.points[:, 0] < -0.16], stiffness=500.0)

    gravity = (0.0, 0.0, -GRAVITY if pinned else 0.0)
    scene = Scene(populate, [bar()], gravity=gravity, options=options, dt=dt)
    if not pinned:
        scene.set(q=scene.q() + bar().affine(np.diag([1.01, 0.99, 1.0])))
    moments = []
    for _ in range(16):
        scene.step(round(duration / 16 / dt))
        moments.append(scene.q().copy())
    return np.array(moments)


def order() -> None:
    """Print the order of both integrators in bending and in free motion, from halved steps."""
    duration, finest = 0.064, 0.0625e-3
    for pinned in (True, False):
        for integrator in get_args(Integrator):
            exact = path(integrator, pinned, finest, duration)
            errors = [np.linalg.norm(path(integrator, pinned, dt, duration) - exact) for dt in (4e-3, 2e-3, 1e-3, 5e-4)]
            orders = ", ".join(f"{a:.2f}" for a in np.log2(np.array(errors[:-1]) / errors[1:]))
            print(f"{'bending' if pinned else 'free'}, {integrator}: order {orders} from 4, 2, 1 ms", flush=True)


def momentum(scene: Scene, bodies: int, *, soft: bool) -> np.ndarray:
    """Return linear and angular momentum of all bodies, shape (6,)."""
    parts = [np.concatenate(scene.rigid_momentum(body)[:2]) for body in range(bodies)]
    return np.sum([*parts, *([np.concatenate(scene.momentum())] if soft else [])], axis=0)


def base(dt: float, *, armature: float, hinge: bool, soft: bool = True) -> tuple[float, float]:
    """Return how far linear and angular momentum drift, over those of the cube, as it hits a base that floats."""

    def populate(world: newton.ModelBuilder) -> None:
        joints = []
        for k in range(1 + hinge):
            link = world.add_link(
                xform=wp.transform(wp.vec3(0.3 * k, 0.0, 0.0), wp.quat_identity()),
                mass=1.0,
                inertia=wp.mat33(np.diag([4e-3, 8e-3, 8e-3])),
                lock_inertia=True,
            )
            world.add_shape_box(link, hx=0.1, hy=0.1, hz=0.05, cfg=newton.ModelBuilder.ShapeConfig(density=0.0))
            if k == 0:
                joints.append(world.add_joint_free(parent=-1, child=link))
            else:
                ends = [wp.transform(wp.vec3(s * 0.15, 0.0, 0.0), wp.quat_identity()) for s in (1.0, -1.0)]
                turn = {"axis": (0, 1, 0), "parent_xform": ends[0], "child_xform": ends[1], "armature": armature}
                joints.append(world.add_joint_revolute(parent=link - 1, child=link, **turn))
        world.add_articulation(joints)
        material = Material(youngs_modulus=1.0e5, density=1000.0)
        place = (0.3 if hinge else 0.05, 0.02, 0.105) if soft else (5.0, 0.0, 0.0)
        add_reduced_body(world, cube(), material=material, position=place, velocity=(0.0, 0.0, -1.0))

    options = SolverReducedOptions(tolerance=1e-8, force_tolerance=1e-8, iteration_max=100)
    scene = Scene(populate, [cube()], coupled=True, options=options, dt=dt)
    if not soft:  # it turns at its hinge by itself
        joint_qd = scene.state.joint_qd.numpy()
        joint_qd[:7] = [0.1, 0.2, 0.3, 0.5, 1.0, 0.2, 4.0][: len(joint_qd)]
        scene.state.joint_qd.assign(joint_qd)
        newton.eval_fk(scene.model, scene.state.joint_q, scene.state.joint_qd, scene.state)
    bodies = 1 + hinge
    before = momentum(scene, bodies, soft=soft)
    drift = []
    for _ in range(round(0.2 / dt)):
        scene.step()
        drift.append(momentum(scene, bodies, soft=soft) - before)
    off, scale = np.abs(drift).max(axis=0), np.abs(before)
    return off[:3].max() / scale[:3].max(), off[3:].max() / scale[3:].max()


def bases() -> None:
    """Print the drift of momentum with and without a hinge, by step and armature, and without the cube."""
    print("floating base: drift of linear, angular momentum over 0.2 s")
    for label, given in {
        "one body": {"armature": 0.0, "hinge": False},
        "with a hinge": {"armature": 0.0, "hinge": True},
        "with a hinge of armature 0.01": {"armature": 0.01, "hinge": True},
        "with a hinge, no cube near": {"armature": 0.0, "hinge": True, "soft": False},
    }.items():
        for dt in (4e-3, 2e-3, 1e-3):
            linear, angular = base(dt, **given)
            print(f"  {label}, dt {dt:g}: {linear:.1e}, {angular:.1e}", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=("drops", "order", "base"))
    chosen = parser.parse_args().only
    for name, work in {"drops": drops, "order": order, "base": bases}.items():
        if chosen in (None, name):
            work()


if __name__ == "__main__":
    main()
