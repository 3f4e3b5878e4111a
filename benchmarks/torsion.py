"""Torsion under fingers: rigid balls of 20 mm that press a cube of 60 mm turn about their axis, against Lubkin's ball.

Run: ``python -m benchmarks.torsion``. The torque of a ball on a half space at a twist, pressed with F over a radius a:
rigid discs of radii s in (c, a) that turn by beta'(s) ds each make the traction mu p outside of c, and none slips in
it (Jaeger's superposition; Lubkin 1951, doi:10.1115/1.4010270). With Abel's inversion

    theta(c) = mu p_0 / (2 G) (K(k) - E(k)),  k^2 = 1 - c^2 / a^2,     T = 16/3 G int_c^a s^3 beta'(s) ds,

3 pi / 16 mu F a once all of it slips. Prints torque over that at twists in radians.
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

RADIUS, EDGE, MODULUS, NU, MU, DT = 0.02, 0.06, 1.0e5, 0.3, 0.5, 0.01
TWISTS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
RATE = 0.5
"""Of the twist [rad/s]."""


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    wp.config.log_level = wp.LOG_WARNING
    quadrature = quadrature_from_box((EDGE,) * 3, point_count=4000, surface_count=800)
    body = build_body(quadrature, BuildOptions(), name="cube")
    print("torque over Lubkin's at twists of", *TWISTS)
    for force in (0.5, 4.0):
        print(f"{force} N:", *(f"{ratio:.2f}" for ratio in twisted(body, force)), flush=True)


def lubkin(force: float, twist: float) -> float:
    """Return the torque [N m] of a rigid ball that presses a half space with a force [N] at a twist [rad]."""
    shear = 0.5 * MODULUS / (1.0 + NU)
    a = (0.75 * force * RADIUS * (1.0 - NU**2) / MODULUS) ** (1.0 / 3.0)
    s = a * np.sin(np.linspace(0.5 * np.pi, 1.0e-4, 4000))
    angle = 0.75 * MU * force / (np.pi * a**2 * shear) * (ellipk(1.0 - (s / a) ** 2) - ellipe(1.0 - (s / a) ** 2))
    parts = 16.0 / 3.0 * shear * (0.5 * (s[1:] + s[:-1])) ** 3 * np.diff(angle)
    return float(np.interp(twist, angle, np.concatenate([[0.0], np.cumsum(parts)])))


def twisted(body: ReducedBody, force: float) -> list[float]:
    """Press two balls into opposite faces, turn them against each other and return torque over Lubkin's."""
    config = newton.ModelBuilder.ShapeConfig(mu=MU)

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=MODULUS, poissons_ratio=NU, density=300.0, friction=MU, mass_damping=50.0)
        add_reduced_body(world, body, material=material)
        for _ in range(2):
            world.add_shape_sphere(world.add_body(is_kinematic=True), radius=RADIUS, cfg=config)

    scene = Scene(populate, [body], dt=DT)

    def steps(count: int, depth: float, angle: float, rate: float) -> None:
        for k in range(count):
            poses, twists = np.zeros((2, 7), dtype=np.float32), np.zeros((2, 6), dtype=np.float32)
            for side, sign in enumerate((-1.0, 1.0)):
                turn = 0.5 * sign * (angle + k * DT * rate)
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
    for _ in range(5):
        scene.restart()
        steps(25, depth, 0.0, 0.0)
        depth *= (force / reading()[0]) ** (2.0 / 3.0)
    found, angle = [], 0.0
    for target in TWISTS:
        steps(round((target - angle) / (RATE * DT)), depth, angle, RATE)
        steps(6, depth, target, 0.0)
        pressed, torque = reading()
        found.append(torque / lubkin(pressed, target))
        angle = target
    return found


if __name__ == "__main__":
    main()
