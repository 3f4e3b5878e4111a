"""The contact law against its targets, row by row: faces, Hertz, rolling, rest, stacks, slopes, gradients, energy.

Run: ``python -m benchmarks.contact_targets [--only ROW ...] [--jobs N] [--out FILE] [--table]``. Bodies are those that
users get (48 functions, 800 samples) or the tasks', at default options where not said. Every case prints what it
measured, its goal and status bits; `--out` keeps them as lines of JSON, `--table` prints one line a row in the end.
References: the uniaxial law, Hertz made finite by `hertz_elements`, rigid bodies that roll, central differences.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import multiprocessing
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import newton
import numpy as np
import trimesh
import warp as wp
from scipy.optimize import root_scalar

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.model.status import status_reasons
from softmode.deformables.quadrature.quadrature import quadrature_from_box, quadrature_from_sphere
from softmode.deformables.quadrature.quadrature_implicit import quadrature_from_implicit
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.cache import cached_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.envs.tasks.place_in_bin.task import BALL, DISC, TOY, bin_scene
from softmode.envs.tasks.press_soft.task import press_scene
from softmode.envs.tasks.push_soft.task import push_scene
from softmode.envs.tasks.rope_route.task import rope_scene
from softmode.envs.tasks.shape_soft.config import shape_scene
from softmode.objects.loader import load
from softmode.objects.shapes.primitives import primitive_quadrature
from softmode.objects.task_objects import BEAM, BEAM_MATERIAL
from softmode.scenes.table_scene import TableSceneConfig
from tests import reference
from tests.bodies import default_ball, default_cube
from tests.deformables.test_cells import uniaxial
from tests.deformables.test_contact_gradients import Landing
from tests.deformables.test_dents import FINITE, Press, hertz
from tests.deformables.test_friction import incline
from tests.scenes import GRAVITY, Scene, rotation

RADIUS, DT = 0.05, 1.0 / 240.0
BOXES = {
    "cube": (0.1, 0.1, 0.1),
    "beam on its side": (0.16, 0.04, 0.04),
    "pad": (0.1, 0.1, 0.02),
    "sheet of 4 mm": (0.1, 0.1, 0.004),
}
TIPS = {0.01: 0.006182, 0.02: 0.012216, 0.03: 0.018090, 0.05: 0.029284}
"""Force of finger tips on PressSoft's pad over E height^2 by depth over height: `edge_elements`; a block as wide as the
pad has up to 2 % more."""
TASKS = (
    *("PushSoft puck", "PressSoft pad", "ShapeSoft post", "RopeRoute rope", "PlaceInBin die", "PlaceInBin ball"),
    *("PlaceInBin disc", "LiftSoft beam"),
)
Figure = tuple[float, int]
"""What was measured over its reference, and status bits."""


class Case(NamedTuple):
    """One measurement."""

    row: str
    name: str
    low: float
    high: float
    run: Callable[..., Figure]
    arguments: tuple = ()


# -- bodies -----------------------------------------------------------------------------------------------------------


def built(name: str, ratio: float = 0.3) -> ReducedBody:
    """Return a body of the options that users get, from the cache."""

    def build() -> ReducedBody:
        if name in BOXES:
            quadrature = quadrature_from_box(BOXES[name])
        elif name == "ball of 1500":
            quadrature = quadrature_from_sphere(RADIUS, surface_count=1500)
        elif name == "cylinder":
            quadrature = primitive_quadrature("cylinder", (2.0 * RADIUS, 2.0 * RADIUS, 0.1), 800)
        else:  # a torus about Z, its outer radius that of the others

            def distance(x: np.ndarray) -> np.ndarray:
                return np.hypot(np.hypot(x[:, 0], x[:, 1]) - 0.035, x[:, 2]) - 0.015

            quadrature = quadrature_from_implicit(distance, np.array([[-0.051, -0.051, -0.016], [0.051, 0.051, 0.016]]))
        return build_body(quadrature, BuildOptions(poissons_ratio=ratio), name=name, progress=False)

    return cached_body(("contact targets", Path(__file__), {"name": name, "ratio": ratio}), build)


@functools.cache
def of_task(name: str) -> tuple[ReducedBody, Material]:
    """Return a body of a task as it is built there and its material; ShapeSoft's post without its clamp."""
    if name == "LiftSoft beam":
        return load(BEAM).body, BEAM_MATERIAL
    scenes: dict[str, TableSceneConfig] = {
        "PushSoft puck": push_scene(),
        "PressSoft pad": press_scene(),
        "ShapeSoft post": shape_scene(),
        "RopeRoute rope": rope_scene(),
    }
    toys = {"PlaceInBin die": TOY, "PlaceInBin ball": BALL, "PlaceInBin disc": DISC}
    scene = scenes.get(name) or bin_scene()
    return load(replace(toys.get(name, scene.object), clamped_height=0.0)).body, scene.material


# -- what is pressed --------------------------------------------------------------------------------------------------


def squeezed(body: ReducedBody, size: float, strain: float, material: Material, turn: np.ndarray) -> Figure:
    """Return the force [N] between two plates without friction that squeeze a body of a size [m] along Z."""
    still = replace(material, friction=0.0, mass_damping=100.0)

    def populate(world: newton.ModelBuilder) -> None:
        middle = -turn @ (body.surface.points.max(axis=0) + body.surface.points.min(axis=0)) / 2.0
        add_reduced_body(world, body, material=still, position=tuple(middle), rotation=turn)
        for side in (-1.0, 1.0):
            pose = wp.transform(wp.vec3(0.0, 0.0, side * (0.5 * (1.0 - strain) * size + 0.02)), wp.quat_identity())
            world.add_shape_box(-1, xform=pose, hx=0.4, hy=0.4, hz=0.02)

    scene = Scene(populate, [body], dt=0.01)
    scene.step(60)
    constraints = scene.reduced.view.constraints
    count = int(constraints.count.numpy()[0])
    force = np.maximum(constraints.force.numpy()[0, :count, 2], 0.0).sum()
    return float(force), int(scene.reduced.status.numpy()[0])


def face(name: str, ratio: float, strain: float) -> Figure:
    """Squeeze a block of default options."""
    material = Material(youngs_modulus=1.0e5, poissons_ratio=ratio, density=300.0)
    force, status = squeezed(built(name, ratio), BOXES[name][2], strain, material, np.eye(3))
    return force / (uniaxial(strain, 1.0e5, ratio) * BOXES[name][0] * BOXES[name][1]), status


def task_face(name: str, strain: float) -> Figure:
    """Squeeze a task's body between plates: blocks by their faces, rods across, a ball."""
    body, material = of_task(name)
    modulus, ratio, edges = material.youngs_modulus, material.poissons_ratio, np.ptp(body.bounds, axis=0)
    across = name in ("ShapeSoft post", "RopeRoute rope")
    turn = rotation((0, 1, 0), 0.5 * np.pi) if name == "ShapeSoft post" else np.eye(3)
    size = edges[0] if name == "ShapeSoft post" else edges[2]
    force, status = squeezed(body, size, strain, material, turn)
    if across:
        expected = rod(0.5 * size, strain, material) * (edges.max() - (size if name == "RopeRoute rope" else 0.0))
    elif name == "PlaceInBin ball":
        expected = hertz(0.5 * strain * size, modulus, ratio) * (0.5 * size / RADIUS) ** 0.5
        expected *= np.interp(strain, *FINITE) / np.interp(0.5 * strain * size / RADIUS, *FINITE)
    else:
        expected = uniaxial(strain, modulus, ratio) * body.volume / size
    return force / expected, status


def tips(depth: float) -> Figure:
    """Press the closed tips of fingers into PressSoft's pad without friction, on the mean over three places."""
    body, material = of_task("PressSoft pad")
    still, height = replace(material, poissons_ratio=0.3, friction=0.0, mass_damping=100.0), 0.04

    def populate(world: newton.ModelBuilder) -> None:
        add_reduced_body(world, body, material=still, position=tuple(-body.bounds.mean(axis=0)))
        below = wp.transform(wp.vec3(0.0, 0.0, -0.5 * height - 0.02), wp.quat_identity())
        world.add_shape_box(-1, xform=below, hx=0.1, hy=0.1, hz=0.02)
        hand = world.add_body(is_kinematic=True)
        for side in (-1.0, 1.0):
            finger = wp.transform(wp.vec3(0.0, 0.003 * side, 0.0), wp.quat_identity())
            world.add_shape_box(hand, xform=finger, hx=0.012, hy=0.003, hz=0.022)

    scene, found = Scene(populate, [body], dt=0.01), []
    for place in ((0.0, 0.0), (0.002, 0.001), (-0.003, 0.002)):
        scene.restart()
        pose = np.array([[*place, 0.022 + (0.5 - depth) * height, 0.0, 0.0, 0.0, 1.0]], dtype=np.float32)
        for state in (scene.state, scene.next_state):
            state.body_q.assign(pose)
        scene.step(60)
        constraints = scene.reduced.view.constraints
        force = constraints.force.numpy()[0, : int(constraints.count.numpy()[0]), 2]
        found.append(-np.minimum(force, 0.0).sum())
    expected = TIPS[depth] * material.youngs_modulus * height**2
    return float(np.mean(found)) / expected, int(scene.reduced.status.numpy()[0])


def rod(radius: float, strain: float, material: Material) -> float:
    """Return the force per length [N/m] of two plates on a long round rod: Johnson 1985, 5.6, free along its axis."""
    E, nu = material.youngs_modulus, material.poissons_ratio

    def approach(force: float) -> float:
        half = np.sqrt(4.0 * force * radius * (1.0 - nu**2) / (np.pi * E))
        across = 4.0 * force * (1.0 - nu**2) / (np.pi * E) * (np.log(4.0 * radius / half) - 0.5)
        return across + 4.0 * nu**2 * force / (np.pi * E)

    found = root_scalar(lambda force: approach(force) - 2.0 * radius * strain, bracket=(1.0e-9, E * radius))
    return float(found.root)


def ball(modulus: float, ratio: float, share: float) -> Figure:
    """Squeeze a ball between plates."""
    press = Press(default_ball(ratio), RADIUS, youngs_modulus=modulus, poissons_ratio=ratio)
    force = press.force(share * RADIUS)
    return force / hertz(share * RADIUS, modulus, ratio), int(press.scene.reduced.status.numpy()[0])


def two_balls(modulus: float, share: float) -> Figure:
    """Squeeze two balls in a row: by symmetry a plane is between them."""
    press = Press(default_ball(), RADIUS, count=2, youngs_modulus=modulus, damping=1.0e4)
    return press.force(share * RADIUS) / hertz(share * RADIUS, modulus), int(press.scene.reduced.status.numpy()[0])


def grip(name: str) -> Figure:
    """Hold a body between two opening plates: their normal force before it falls, over m g / (2 mu)."""
    body, material = of_task(name)
    mu, width = 0.5, float(np.ptp(body.bounds[:, 1]))
    config = newton.ModelBuilder.ShapeConfig(mu=mu)

    def populate(world: newton.ModelBuilder) -> None:
        middle = tuple(-body.bounds.mean(axis=0))
        add_reduced_body(world, body, material=replace(material, friction=mu), position=middle)
        for _ in range(2):
            world.add_shape_box(world.add_body(is_kinematic=True), hx=0.01, hy=0.02, hz=0.01, cfg=config)

    scene = Scene(populate, [body], gravity=(0.0, 0.0, -GRAVITY), dt=DT)
    held, start = 0.0, 0.0
    needed = scene.mass() * GRAVITY / (2.0 * mu)
    for k in range(2400):
        rate = 0.0 if k < 240 else 0.1 * width / 2160.0  # opens from a squeeze of a tenth to none
        closed = 0.9 * width + max(k - 240, 0) * rate
        poses = np.array([[0.0, s * (0.5 * closed + 0.02), 0.0, 0.0, 0.0, 0.0, 1.0] for s in (-1, 1)], dtype=np.float32)
        for state in (scene.state, scene.next_state):
            state.body_q.assign(poses)
        scene.step()
        start = scene.centre()[2] if k == 240 else start
        if k > 240 and scene.centre()[2] < start - 0.01:
            break
        if scene.qd()[:, 2] @ body.mean_basis > -0.005:
            constraints = scene.reduced.view.constraints
            count = int(constraints.count.numpy()[0])
            held = 0.5 * np.abs(constraints.force.numpy()[0, :count, 1]).sum() / needed
    return float(held), int(scene.reduced.status.numpy()[0])


# -- what rolls, rests, stands and lands ------------------------------------------------------------------------------


def ground(world: newton.ModelBuilder, kind: str) -> None:
    """Add what a body rolls on, level and at z = 0."""
    config = newton.ModelBuilder.ShapeConfig(mu=0.8)
    pose = wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity())
    if kind == "box":
        world.add_shape_box(-1, xform=pose, hx=4.0, hy=4.0, hz=0.1, cfg=config)
    else:
        mesh = trimesh.creation.box((8.0, 8.0, 0.2)).subdivide().subdivide().subdivide()
        world.add_shape_mesh(-1, xform=pose, mesh=newton.Mesh(mesh.vertices, mesh.faces.ravel()), cfg=config)


def roll(
    body: str, modulus: float, degrees: float, azimuth: float = 0.0, kind: str = "plane", viscosity: float = 0.0
) -> Figure:
    """Roll a body down a slope, or along the level: speed gained, or kept, over that of a rigid one."""
    angle, turn = np.radians(degrees), rotation((0, 0, 1), np.radians(azimuth))
    upright = rotation((1, 0, 0), 0.5 * np.pi) if body in ("cylinder", "torus") else np.eye(3)
    solid = default_ball() if body == "ball" else built(body)
    share = {"cylinder": 0.5, "torus": (0.035**2 + 0.75 * 0.015**2) / RADIUS**2}.get(body, 0.4)
    level = degrees == 0.0
    material = Material(youngs_modulus=modulus, poissons_ratio=0.3, density=300.0, viscosity=viscosity)
    along = turn @ [1.0, 0.0, 0.0]
    moving: dict[str, Any] = {"velocity": 0.2 * along, "angular_velocity": np.cross([0, 0, 1], along) * 0.2 / RADIUS}

    def populate(world: newton.ModelBuilder) -> None:
        place = {"position": (0.0, 0.0, RADIUS), "rotation": upright}
        add_reduced_body(world, solid, material=material, **place, **(moving if level else {}))
        if kind != "plane":
            ground(world, kind)
        for side in (-1.0, 1.0) if body == "torus" else ():  # which keep a wheel from falling over, without friction
            pose = wp.transform(wp.vec3(0.0, side * 0.0253, 0.1), wp.quat_identity())
            world.add_shape_box(-1, xform=pose, hx=4.0, hy=0.01, hz=0.09, cfg=newton.ModelBuilder.ShapeConfig(mu=0.0))

    down = GRAVITY * (np.sin(angle) * along - np.cos(angle) * np.array([0.0, 0.0, 1.0]))
    scene = Scene(populate, [solid], gravity=down.tolist(), ground=0.8 if kind == "plane" else None, dt=DT)
    seconds = 2.0 if level else {5.0: 1.0, 1.0: 1.0, 0.5: 2.0, 0.25: 3.0}[degrees]
    scene.step(round(0.25 / DT))
    before = scene.momentum()[0] @ along / scene.mass()
    scene.step(round(seconds / DT))
    after, status = scene.momentum()[0] @ along / scene.mass(), int(scene.reduced.status.numpy()[0])
    gained = float(after / before if level else (after - before) / (GRAVITY * np.sin(angle) / (1.0 + share) * seconds))
    return gained, status


def rest(body: str, modulus: float) -> Figure:
    """Return the kinetic energy over m g R of what lies on the ground for two seconds."""
    solid = default_ball() if body == "ball" else default_cube()

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=modulus, density=300.0)
        add_reduced_body(world, solid, material=material, position=(0.0, 0.0, 1.004 * RADIUS))

    scene = Scene(populate, [solid], gravity=(0.0, 0.0, -GRAVITY), ground=0.8, dt=DT)
    scene.step(round(2.0 / DT))
    energy = scene.kinetic_energy() / (scene.mass() * GRAVITY * RADIUS)
    return energy, int(scene.reduced.status.numpy()[0])


def stack(moduli: tuple[float, ...], seconds: float = 10.0) -> Figure:
    """Stand cubes on each other, each 4 and 3 mm aside: height after 10 s over what each sags under what is on it."""
    edge, density, body = 0.1, 300.0, default_cube()

    def populate(world: newton.ModelBuilder) -> None:
        for k, modulus in enumerate(moduli):
            material = Material(youngs_modulus=modulus, density=density)
            place = (0.004 * k, -0.003 * k, 0.5 * edge + k * edge)
            add_reduced_body(world, body, material=material, position=place)

    scene = Scene(populate, [body], gravity=(0.0, 0.0, -GRAVITY), ground=0.8, dt=DT)
    replay, count, lowest = scene.capture(), len(moduli), np.inf
    for k in range(round(0.5 * seconds / DT)):
        replay()
        if k * DT > 0.5:
            lowest = min(lowest, scene.centre(count - 1)[2])
    sag = sum(density * GRAVITY * edge**2 / E * (count - k - 0.5) for k, E in enumerate(moduli))
    top = count * edge - sag - 0.5 * edge * (1.0 - density * GRAVITY * edge / (4.0 * moduli[-1]))
    height = scene.centre(count - 1)[2]
    return (height if abs(height - top) > abs(lowest - top) else lowest) / top, int(scene.reduced.status.numpy()[0])


def creep(share: float) -> Figure:
    """Return how far a cube on a slope at a share of its friction cone moves in 60 s, from the second on [m]."""
    scene, along = incline(share)
    replay = scene.capture()
    places = []
    for _ in range(round(30.5 / scene.dt)):
        replay()
        places.append(along @ scene.centre())
    return float(np.ptp(places[round(0.5 / scene.dt) :])), int(scene.reduced.status.numpy()[0])


def gradient(kind: str, name: str) -> Figure:
    """Return dL/dx of the adjoint over differences, of those two steps that agree best, and how well they do."""
    body = default_ball() if kind in ("ball", "rolling") else default_cube()
    case = Landing(1.0e5, friction=0.8, body=body)
    soft, I = case.scene.model.softmode, body.linear_coordinates
    turn, height, v, omega = np.eye(3), 0.0502, (0.3, 0.1, -1.0), (2.0, 1.0, 0.5)
    if kind == "rolling":
        height, v, omega = 0.0499, (0.2, 0.0, 0.0), (0.0, 4.0, 0.0)
    elif kind == "box":
        omega = (0.0, 0.0, 0.0)
    elif kind == "edge":
        turn, height, omega = rotation((0, 1, 0), 0.23 * np.pi), 0.0716, (0.0, 1.0, 0.0)
    soft.q.assign(I[:, :3] @ (turn.T - np.eye(3)) + I[:, 3:] * np.array([0.0, 0.0, height]))
    soft.qd.assign(I[:, :3] @ turn.T @ np.cross(omega, np.eye(3)) + I[:, 3:] * np.array(v))
    case.least = 0
    found = case.gradient(case.gradients(), name)
    scale = 0.1 if name == "qd" else 1.0
    differences = [case.difference(name, scale * 10.0**-k) for k in (3.0, 3.5, 4.0, 4.5, 5.0)]
    pairs = list(itertools.pairwise(differences))
    best = min(pairs, key=lambda pair: abs(pair[0] - pair[1]) / abs(pair[1]))
    return found / best[1], int(case.scene.reduced.status.numpy()[0])


def bounce(kind: str, modulus: float, dt: float) -> Figure:
    """Return how far energy rises over its start, relative, while a body bounces without viscosity and rubs."""
    body = default_ball() if kind == "ball" else default_cube()
    material = Material(youngs_modulus=modulus, density=300.0, friction=0.5, viscosity=0.0)
    turn = rotation((1, 2, 0), 0.7) if kind == "tilted cube" else np.eye(3)

    def populate(world: newton.ModelBuilder) -> None:
        place: dict[str, Any] = {"position": (0.0, 0.0, 0.1), "rotation": turn, "velocity": (0.5, 0.0, -2.0)}
        add_reduced_body(world, body, material=material, **place, angular_velocity=(1.0, 2.0, 0.0))

    scene = Scene(populate, [body], gravity=(0.0, 0.0, -GRAVITY), ground=0.5, dt=dt)
    twin = reference.FreeBody(body=body, material=reference.with_float32(material), dt=dt)

    def energy() -> float:
        height = GRAVITY * scene.mass() * scene.centre()[2]
        return scene.kinetic_energy() + twin.elastic_energy(scene.q()) + height + scene.dents()[1]

    start, most = energy(), 0.0
    for _ in range(round(0.4 / dt)):
        scene.step()
        most = max(most, energy())
    return most / start - 1.0, int(scene.reduced.status.numpy()[0])


# -- the table --------------------------------------------------------------------------------------------------------


def cases() -> Iterator[Case]:
    """Yield every case, the long ones first."""
    unequal = (1.0e6, 2.0e5, 1.0e5, 1.0e5, 2.0e4)  # five of 20 kPa would buckle, as Greenhill's column from .354 m on
    for moduli in ((2.0e5,) * 5, (1.0e6,) * 5, unequal, (2.0e4,) * 3, (1.0e6,) * 3, unequal[2:]):
        name = f"{len(moduli)} of " + ("unequal E" if len(set(moduli)) > 1 else f"{moduli[0]:g} Pa")
        yield Case("stacks", name, 0.99, 1.01, stack, (moduli,))
    for share in (0.5, 0.9, 0.98):
        yield Case("creep", f"{share} of the cone", 0.0, 1.0e-6, creep, (share,))
    for kind in ("box", "ball", "edge", "rolling"):
        for name in ("youngs_modulus", "poissons_ratio", "density", "friction", "qd"):
            yield Case("gradients", f"{kind}, {name}", 0.995, 1.005, gradient, (kind, name))
    for name in TASKS:
        if name != "RopeRoute rope":  # which hangs down on both sides
            yield Case("grips of tasks", name, 0.95, 1.05, grip, (name,))
    slopes = {5.0: 0.02, 1.0: 0.03, 0.5: 0.05, 0.25: 0.1}
    for modulus, (degrees, error) in itertools.product((1.0e5, 1.0e6), slopes.items()):
        goal = (0.88, 1.1) if degrees == 0.25 else (1.0 - error, 1.0 + error)
        for kind, azimuth in (("plane", 0.0), ("plane", 22.5), ("plane", 45.0), ("box", 0.0), ("mesh", 0.0)):
            name = f"{degrees} degrees, E {modulus:g}, {kind}, azimuth {azimuth}"
            yield Case(f"ball down {degrees} degrees", name, *goal, roll, ("ball", modulus, degrees, azimuth, kind))
        for body in ("cylinder", "torus", "ball of 1500"):
            name = f"{body}, {degrees} degrees, E {modulus:g}"
            yield Case(f"{body} down {degrees} degrees", name, *goal, roll, (body, modulus, degrees))
    kept = {0.0: (0.99, 1.0), 0.002: (0.55, 0.59)}  # exp(-5/7 g viscosity seconds / R) where all of it is viscous
    for modulus, (viscosity, goal) in itertools.product((1.0e5, 1.0e6), kept.items()):
        name = f"viscosity {viscosity}, E {modulus:g}"
        yield Case(f"level, viscosity {viscosity}", name, *goal, roll, ("ball", modulus, 0.0, 0.0, "plane", viscosity))
    for body, modulus in itertools.product(("cube", "ball"), (1.0e4, 1.0e5, 1.0e6)):
        yield Case(f"at rest, {body}", f"{body}, E {modulus:g}", 0.0, 1.0e-9, rest, (body, modulus))
    for kind, modulus, dt in itertools.product(("ball", "cube", "tilted cube"), (1.0e5, 1.0e6), (DT, 0.001)):
        yield Case(
            "energy over bounces", f"{kind}, E {modulus:g}, {dt:.4f} s", -1.0, 1.0e-6, bounce, (kind, modulus, dt)
        )
    for name, ratio, strain in itertools.product(BOXES, (0.3, 0.45, 0.49), (0.01, 0.04, 0.1)):
        low = 0.93 if name.startswith("sheet") else 0.95
        yield Case(f"whole face, {name}", f"{name}, nu {ratio}, {strain:.0%}", low, 1.05, face, (name, ratio, strain))
    for name, strain in itertools.product(TASKS, (0.01, 0.04, 0.1)):
        yield Case(f"between plates, {name}", f"{name}, {strain:.0%}", 0.9, 1.1, task_face, (name, strain))
    for depth in TIPS:
        yield Case("finger tips, PressSoft pad", f"{depth:.0%} deep", 0.9, 1.1, tips, (depth,))
    for modulus, ratio, share in itertools.product((1.0e5, 1.0e6), (0.3, 0.45, 0.49), (0.01, 0.02, 0.04, 0.08)):
        name = f"{share:.0%} of R, E {modulus:g}, nu {ratio}"
        yield Case(f"Hertz, {share:.0%} of R", name, 0.93, 1.07, ball, (modulus, ratio, share))
    for modulus, share in itertools.product((1.0e5, 1.0e6), (0.01, 0.02, 0.04, 0.08)):
        yield Case("soft on soft", f"{share:.0%} of R, E {modulus:g}", 0.9, 1.1, two_balls, (modulus, share))


def measure(case: Case) -> dict[str, Any]:
    """Return what a case measures, or what went wrong."""
    wp.config.log_level = wp.LOG_WARNING
    start, found = time.process_time(), case._asdict() | {"run": case.run.__name__}
    try:
        value, status = case.run(*case.arguments)
        flags = status_reasons(status)
        inside = bool(case.low <= value <= case.high) and not flags
        found |= {"value": float(value), "flags": flags, "inside": inside}
    except Exception as error:  # the others go on
        found |= {"value": float("nan"), "flags": (repr(error),), "inside": False}
    return found | {"seconds": round(time.process_time() - start, 1)}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", default=[""], help="rows that begin with one of these")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--table", action="store_true")
    given = parser.parse_args()
    chosen = [case for case in cases() if case.row.startswith(tuple(given.only))]
    if not chosen:
        parser.error(f"no row begins with {' or '.join(given.only)}; rows: {', '.join({c.row: 0 for c in cases()})}")
    rows: dict[str, list[dict[str, Any]]] = {}
    with multiprocessing.get_context("spawn").Pool(given.jobs) as pool:
        for found in pool.imap_unordered(measure, chosen):
            rows.setdefault(found["row"], []).append(found)
            flags = " ".join(found["flags"])
            mark = "" if found["inside"] else "  OUTSIDE"
            text = f"{found['row']}: {found['name']}: {found['value']:.5g} ({found['low']:g} to {found['high']:g})"
            print(f"{text} {flags}{mark}, {found['seconds']} s", flush=True)
            if given.out:
                with given.out.open("a") as file:
                    file.write(json.dumps(found, default=str) + "\n")
    for row, found in rows.items() if given.table else ():
        values = [one["value"] for one in found]
        outside = sum(not one["inside"] for one in found)
        goal = f"{found[0]['low']:g} to {found[0]['high']:g}"
        print(f"| {row} | {goal} | {min(values):.3g} to {max(values):.3g} | {outside} of {len(found)} outside |")


if __name__ == "__main__":
    main()
