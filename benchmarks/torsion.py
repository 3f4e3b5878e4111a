"""Torsion under fingers: two rigid fingers press opposite faces of a cube of 60 mm and turn against each other.

Run: ``python -m benchmarks.torsion``. Fingers are balls of 20 mm, against Lubkin's ball, and boxes 20 mm wide, against
finite elements with friction (`torsion_elements`), at three places of the lattice of samples each. The torque of a ball
on a half space at a twist, pressed with F over a radius a: rigid discs of radii s in (c, a) that turn by beta'(s) ds
each make the traction mu p outside of c, and none slips in it (Jaeger's superposition; Lubkin 1951,
doi:10.1115/1.4010270). With Abel's inversion

    theta(c) = mu p_0 / (2 G) (K(k) - E(k)),  k^2 = 1 - c^2 / a^2,     T = 16/3 G int_c^a s^3 beta'(s) ds,

3 pi / 16 mu F a once all of it slips. Prints torque over that at twists in radians; before it slips, of a box, less the
torque before it turns.
"""

from __future__ import annotations

import argparse

import newton
import numpy as np
import warp as wp
from scipy.special import ellipe, ellipk

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from tests.scenes import Scene

RADIUS, HALF, EDGE, MODULUS, NU, MU, DT = 0.02, 0.01, 0.06, 1.0e5, 0.3, 0.5, 0.01
TWISTS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
RATE = 0.25
"""Of the twist [rad/s]."""
PLACES = ((0.0, 0.0), (0.0013, 0.0021), (-0.0017, 0.0011))
"""From the middle of the faces [m]."""
BOX = {
    0.5: (0.968, 0.708, 0.364, 0.146, 0.067, 0.035, 0.017),
    4.0: (0.996, 0.989, 0.977, 0.904, 0.568, 0.287, 0.151),
}
"""Torque of a box by force [N] and twist over 8.3 G a^3 times the twist, that of a square which sticks to a half space:
`torsion_elements`."""


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    wp.config.log_level = wp.LOG_WARNING
    quadrature = quadrature_from_box((EDGE,) * 3, point_count=4000, surface_count=800)
    body = build_body(quadrature, BuildOptions(), name="cube")
    print("force, depth, torque over the reference at twists of", *TWISTS)
    for kind in ("ball", "box"):
        for force in (0.5, 4.0):
            for place in PLACES:
                depth, ratios = twisted(body, force, kind, place)
                print(f"{kind} {force} N, {1e3 * depth:.2f} mm:", *(f"{ratio:.2f}" for ratio in ratios), flush=True)


def lubkin(force: float, twist: float, *, modulus: float = MODULUS, radius: float = RADIUS) -> float:
    """Return the torque [N m] of a rigid ball that presses a half space with a force [N] at a twist [rad]."""
    shear = 0.5 * modulus / (1.0 + NU)
    a = (0.75 * force * radius * (1.0 - NU**2) / modulus) ** (1.0 / 3.0)
    s = a * np.sin(np.linspace(0.5 * np.pi, 1.0e-4, 4000))
    angle = 0.75 * MU * force / (np.pi * a**2 * shear) * (ellipk(1.0 - (s / a) ** 2) - ellipe(1.0 - (s / a) ** 2))
    parts = 16.0 / 3.0 * shear * (0.5 * (s[1:] + s[:-1])) ** 3 * np.diff(angle)
    return float(np.interp(twist, angle, np.concatenate([[0.0], np.cumsum(parts)])))


def twisted(
    body: ReducedBody, force: float, kind: str = "ball", place: tuple[float, float] = (0.0, 0.0)
) -> tuple[float, list[float]]:
    """Press two fingers into opposite faces, turn them and return their depth [m] and torque over the reference."""
    config = newton.ModelBuilder.ShapeConfig(mu=MU)

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=MODULUS, poissons_ratio=NU, density=300.0, friction=MU, mass_damping=50.0)
        add_reduced_body(world, body, material=material)
        for _ in range(2):
            finger = world.add_body(is_kinematic=True)
            if kind == "ball":
                world.add_shape_sphere(finger, radius=RADIUS, cfg=config)
            else:
                world.add_shape_box(finger, hx=HALF, hy=HALF, hz=RADIUS, cfg=config)

    scene = Scene(populate, [body], dt=DT)

    def steps(count: int, depth: float, angle: float, rate: float) -> None:
        for k in range(count):
            poses, twists = np.zeros((2, 7), dtype=np.float32), np.zeros((2, 6), dtype=np.float32)
            for side, sign in enumerate((-1.0, 1.0)):
                turn = 0.5 * sign * (angle + k * DT * rate)
                poses[side, :2] = place
                poses[side, 2:] = sign * (0.5 * EDGE + RADIUS - depth), 0.0, 0.0, np.sin(turn), np.cos(turn)
                twists[side, 5] = sign * rate
            for state in (scene.state, scene.next_state):
                state.body_q.assign(poses)
                state.body_qd.assign(twists)
            scene.step()

    def reading() -> tuple[float, float]:
        constraints = scene.reduced.view.constraints
        count = int(constraints.count.numpy()[0])
        shape, f = constraints.shape.numpy()[0, :count], constraints.force.numpy()[0, :count]
        torque = np.cross(constraints.arm.numpy()[0, :count].astype(float), f)[shape == 1, 2].sum()
        return float(f[shape == 0, 2].sum()), float(torque)

    depth = (0.75 * force * (1.0 - NU**2) / MODULUS / RADIUS**0.5) ** (2.0 / 3.0)
    if kind == "box":
        depth = force * (1.0 - NU**2) / (2.3 * HALF * MODULUS)
    for _ in range(5):
        scene.restart()
        steps(25, depth, 0.0, 0.0)
        depth *= (force / reading()[0]) ** (2.0 / 3.0 if kind == "ball" else 1.0)
    found, angle, start = [], 0.0, reading()[1] if kind == "box" else 0.0
    for k, target in enumerate(TWISTS):
        steps(round((target - angle) / (RATE * DT)), depth, angle, RATE)
        steps(6, depth, target, 0.0)
        pressed, torque = reading()
        plain = lubkin(pressed, target)
        if kind == "box":
            plain = BOX[force][k] * 8.3 * 0.5 * MODULUS / (1.0 + NU) * HALF**3 * target
        found.append((torque - (start if target < 0.05 else 0.0)) / plain)
        angle = target
    return depth, found


if __name__ == "__main__":
    main()
