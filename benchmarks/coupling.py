"""Two-way coupling of soft cubes and rigid bodies, side by side in one run.

Run: ``python -m benchmarks.coupling [--quick] [--schemes joint ...]`` from the repository root. Prints one markdown
table: the joint solve, and Newton's SolverCoupledProxy with one and three lagged passes around its SolverVBD on
tetrahedra. One core, no GPU; times are processor times of this process.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from benchmarks.coupling_schemes import SCHEMES, Coupled, Cube, SchemeName, World
from softmode.deformables.materials.material import Material
from softmode.deformables.solver.solver_reduced import SolverReduced
from tests.scenes import GRAVITY, GRIPPER, RIGID_GAP, add_free_box, add_gripper

EDGE = 0.1
"""Edge of the cubes that collide [m]."""
HELD = 0.06
"""Edge of the cubes that are grasped [m]."""
MASS_RATIOS = (1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
STIFFNESSES = (5e4, 5e5, 5e6)
STEPS = (0.001, 0.004, 0.010)
GRASPS = 100
FEW = 20
"""Of these, for the slowest scheme."""
SLOT = 0.015
"""Distance between finger and cube before a random grasp closes [m]."""


def main() -> None:
    """Run everything and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer cases, two minutes")
    parser.add_argument("--schemes", nargs="+", choices=SCHEMES, default=SCHEMES)
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    quick = options.quick
    rows: dict[str, list[str]] = {}
    notes: list[str] = []

    def fill(label: str, measure: Callable[[SchemeName], str]) -> None:
        cells = []
        for scheme in options.schemes:
            clock = time.process_time()
            try:
                cells.append(measure(scheme))
            except Exception as error:  # what a foreign solver cannot run is a row of the table, with its reason
                cells.append(f"not run ({type(error).__name__}: {str(error).splitlines()[0][:80]})")
            print(f"# {label} | {scheme}: {cells[-1]} [{time.process_time() - clock:.1f} s]", flush=True)
        rows[label] = cells

    for ratio in (0.1, 10.0) if quick else MASS_RATIOS:
        fill(f"impact, rigid/soft mass {ratio:g}: dp, energy gain", lambda s, r=ratio: show_impact(*impact(s, r)))
    for E in (5e5,) if quick else STIFFNESSES:
        for dt in (0.004,) if quick else STEPS:
            fill(
                f"squeeze, E {E:.0e} Pa, dt {1e3 * dt:g} ms: mean / drive, deviation",
                lambda s, E=E, dt=dt: show_squeeze(*squeeze(s, E, dt)),
            )
    counts = {scheme: 8 if quick else FEW if scheme == "VBD x3" else GRASPS for scheme in SCHEMES}
    penetration: dict[str, str] = {}

    def grasp(scheme: SchemeName) -> str:
        grasps = random_grasps(counts[scheme])
        held, depth = lift(scheme, grasps)
        for k in np.flatnonzero(~held):
            notes.append(f"{scheme}, dropped, grasp {k}: {describe(grasps[k])}")
        deepest = int(depth.max(axis=0).argmax())
        notes.append(f"{scheme}, deepest, grasp {deepest}: {describe(grasps[deepest])}")
        penetration[scheme] = f"{1e3 * depth.max():.2f} mm, {1e3 * np.quantile(depth, 0.999):.2f} mm"
        return f"{held.sum()} of {len(held)}"

    fill("hold and lift, random grasps, dt 4 ms", grasp)
    fill("penetration in these: worst, 99.9 % of steps", lambda s: penetration[s])
    fill("cost per step, held cube, dt 4 ms", lambda s: f"{cost(s, 50 if quick else 200):.3f} ms")
    joint, free, soft = references(50 if quick else 200)
    print_table(options.schemes, rows)
    print(f"\nIn turns: joint solve {joint:.3f} ms, free MuJoCo step {free:.3f} ms, soft step {soft:.3f} ms.")
    print(f"The target for the joint solve, 2.2 free MuJoCo steps and one soft step: {2.2 * free + soft:.3f} ms.")
    print(*notes, sep="\n")


def print_table(schemes: Sequence[str], rows: dict[str, list[str]]) -> None:
    """Print rows as markdown."""
    print(f"\n| | {' | '.join(schemes)} |\n|{'---|' * (len(schemes) + 1)}")
    for label, cells in rows.items():
        print(f"| {label} | {' | '.join(cells)} |")


# -- impacts -----------------------------------------------------------------------------------------------------------


def impact(scheme: SchemeName, ratio: float, *, dt: float = 0.001, speed: float = 0.5) -> tuple[float, float]:
    """Let a rigid cube, ``ratio`` times as heavy, hit a free soft one off centre without gravity.

    Returns:
        The largest error of the total momentum and the largest gain of energy, both relative to the start.
    """
    material = Material(friction=0.5)

    def rigid(builder: newton.ModelBuilder) -> None:
        mass = ratio * material.density * EDGE**3
        position = (0.02, 0.01, EDGE + RIGID_GAP)
        add_free_box(builder, (0.5 * EDGE,) * 3, mass, position, velocity=(0.0, 0.0, -speed))

    soft = Cube(edge=EDGE, material=material, position=(0.0, 0.0, 0.0))
    run = Coupled(scheme, [World(soft=soft, add_rigid=rigid, touching=(0,))], dt=dt)
    p0, e0 = run.totals()
    error = gain = 0.0
    for _ in range(40):
        run.replay()
        p, e = run.totals()
        # what is not a number stays in the maximum
        error, gain = np.maximum(error, np.abs(p - p0).max() / np.abs(p0).max()), np.maximum(gain, e / e0 - 1.0)
    if np.abs(run.state.body_qd.numpy()[0, 2] + speed) < 1e-3 * speed / (1.0 + ratio):
        raise RuntimeError("the bodies never touched")
    return float(error), float(gain)


def show_impact(error: float, gain: float) -> str:
    """Return the two figures of an impact."""
    return f"{error:.1e}, {gain:+.1e}" if np.isfinite([error, gain]).all() else "diverged"


# -- squeeze -----------------------------------------------------------------------------------------------------------


def gripper_world(
    material: Material, *, slot: float = 0.0, offset: Sequence[float] = (0.0, 0.0), yaw: float = 0.0
) -> World:
    """Return a gripper around a soft cube on the ground."""
    position = (offset[0], offset[1], 0.5 * HELD + RIGID_GAP)
    soft = Cube(edge=HELD, material=material, position=position, yaw=yaw)

    def rigid(builder: newton.ModelBuilder) -> None:
        add_gripper(builder, 0.5 * HELD + slot, friction=material.friction)

    return World(soft=soft, add_rigid=rigid, touching=(1, 2))


def drive(run: Coupled, t: float, *, slot: float = 0.0, lift_from: float = np.inf) -> None:
    """Close the fingers in 0.3 s and raise the palm in 0.4 s, and take two steps."""
    squeeze = (GRIPPER["squeeze"] + slot) * min(t / 0.3, 1.0)
    lift = GRIPPER["lift"] * float(np.clip((t - lift_from) / 0.4, 0.0, 1.0))
    target = np.array([lift, squeeze, squeeze], np.float32)
    run.control.joint_target_q.assign(np.tile(target, len(run.worlds)))
    run.replay()


def squeeze(scheme: SchemeName, youngs_modulus: float, dt: float) -> tuple[float, float]:
    """Close a gripper on a cube and hold it.

    Returns:
        Mean contact force on a finger over what its drive k (target - q) holds against, and the standard deviation
        of the force over the mean, both from the last 0.2 s; the worse of the two fingers.
    """
    world = gripper_world(Material(youngs_modulus=youngs_modulus, friction=0.8))
    run = Coupled(scheme, [world], dt=dt, gravity=GRAVITY, ground=0.8)
    force, held = [], []
    count = round(0.7 / (2 * dt))
    for k in range(count):
        drive(run, 2 * k * dt)
        force.append(np.abs(run.contact_force()[0, :, 1]))
        held.append(GRIPPER["stiffness"] * (GRIPPER["squeeze"] - run.state.joint_q.numpy()[1:3]))
    last = round(0.2 / (2 * dt))
    force, held = np.array(force[-last:]), np.array(held[-last:])
    ratio = force.mean(axis=0) / held.mean(axis=0)
    deviation = force.std(axis=0) / np.abs(force.mean(axis=0))
    return float(ratio[np.argmax(np.abs(ratio - 1.0))]), float(deviation.max())


def show_squeeze(ratio: float, deviation: float) -> str:
    """Return the two figures of a squeeze."""
    return f"{ratio:.4f}, {deviation:.2%}" if np.isfinite([ratio, deviation]).all() else "diverged"


# -- random grasps -----------------------------------------------------------------------------------------------------


def random_grasps(count: int, seed: int = 0) -> list[World]:
    """Draw cubes of 30 to 500 g, E 5e4 to 5e6 Pa, friction 0.4 to 1, turned by up to 10 degrees, up to 5 mm away."""
    rng = np.random.default_rng(seed)
    worlds = []
    for _ in range(count):
        mass = np.exp(rng.uniform(np.log(0.03), np.log(0.5)))
        material = Material(
            density=float(mass / HELD**3),
            youngs_modulus=float(np.exp(rng.uniform(np.log(5e4), np.log(5e6)))),
            friction=float(rng.uniform(0.4, 1.0)),
        )
        offset, yaw = rng.uniform(-0.005, 0.005, size=2), float(np.radians(rng.uniform(-10.0, 10.0)))
        worlds.append(gripper_world(material, slot=SLOT, offset=[float(x) for x in offset], yaw=yaw))
    return worlds


def describe(world: World) -> str:
    """Return the parameters of a grasp."""
    soft, material = world.soft, world.soft.material
    return (
        f"mass {1e3 * material.density * HELD**3:.0f} g, E {material.youngs_modulus:.2g} Pa, friction "
        f"{material.friction:.2f}, x {1e3 * soft.position[0]:.1f} mm, y {1e3 * soft.position[1]:.1f} mm, "
        f"yaw {np.degrees(soft.yaw):.1f} deg"
    )


def lift(scheme: SchemeName, worlds: Sequence[World], *, dt: float = 0.004) -> tuple[np.ndarray, np.ndarray]:
    """Close on every cube, lift it by 0.1 m and hold it until 1.1 s.

    Returns:
        Whether each cube is up at the end, and the penetration of every sampled step and world [m].
    """
    run = Coupled(scheme, worlds, dt=dt, gravity=GRAVITY, ground=0.8)
    start, depth = run.points()[:, :, 2].mean(axis=1), []
    for k in range(round(1.1 / (2 * dt))):
        drive(run, 2 * k * dt, slot=SLOT, lift_from=0.4)
        depth.append(run.penetration())
    rise = run.points()[:, :, 2].mean(axis=1) - start
    return rise > 0.8 * GRIPPER["lift"], np.nan_to_num(np.array(depth), nan=np.inf)


# -- cost --------------------------------------------------------------------------------------------------------------


def held_cube(scheme: SchemeName) -> Coupled:
    """Return a gripper that has held a cube for a while."""
    run = Coupled(
        scheme, [gripper_world(Material(youngs_modulus=5e5, friction=0.8))], dt=0.004, gravity=GRAVITY, ground=0.8
    )
    for k in range(70):
        drive(run, 8e-3 * k)
    return run


def cost(scheme: SchemeName, repeats: int) -> float:
    """Return the median processor time of a step that holds a cube [ms]."""
    run, times = held_cube(scheme), []
    for _ in range(repeats):
        clock = time.process_time()
        run.replay()  # two steps
        times.append(0.5e3 * (time.process_time() - clock))
    return float(np.median(times))


def references(repeats: int) -> tuple[float, float, float]:
    """Return the times of the joint solve and of what it is measured against, taken in turns on a held cube [ms].

    Returns:
        A step of the joint solve, a MuJoCo step without soft bodies, a soft step between fingers that are held.
    """
    run = held_cube("joint")
    model, dt = run.model, run.dt
    held: Any = model.state()
    out: Any = model.state()
    still: Any = model.state()
    for state in (held, still):
        state.assign(run.state)
    still.body_qd.zero_()
    soft = SolverReduced(model, [run.body])
    for _ in range(20):  # contact between held fingers is stiffer than between light ones: let it settle
        soft.step(still, still, run.control, None, dt)
    solvers = ((run.solver, held), (SolverMuJoCo(model, njmax=64, nconmax=32), held), (soft, still))
    graphs: list[Any] = []
    for solver, state in solvers:
        with wp.ScopedCapture(device="cpu") as capture:
            solver.step(state, out, run.control, None, dt)
        graphs.append(capture.graph)
    times = np.zeros((repeats, len(graphs)))
    for k in range(repeats):
        for g, graph in enumerate(graphs):
            clock = time.process_time()
            wp.capture_launch(graph)
            times[k, g] = 1e3 * (time.process_time() - clock)
    iterations = [int(solver.iteration.numpy()[0]) for solver in (run.solver.reduced, soft)]
    print(f"# Newton iterations of the timed steps: joint {iterations[0]}, soft {iterations[1]}")
    joint, free, alone = np.median(times, axis=0)
    return float(joint), float(free), float(alone)


if __name__ == "__main__":
    main()
