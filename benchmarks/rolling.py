"""A ball down a slope: what it gains in speed over 5/7 g sin(angle), by angle, samples and stiffness.

Run: ``python -m benchmarks.rolling [--samples N ...]``. A ball of 50 mm radius and 300 kg/m^3 without viscosity rolls
for a second at 1/240 s after a quarter of a second to settle. Negative numbers: it rocks back.
"""

from __future__ import annotations

import argparse

import newton
import numpy as np
import warp as wp

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.quadrature.quadrature import quadrature_from_sphere
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from tests.scenes import GRAVITY, Scene

RADIUS, DT = 0.05, 1.0 / 240.0
ANGLES = (5.0, 1.0, 0.25)
"""Of the slope [degrees]."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, nargs="+", default=[400, 1600, 2400])
    wp.config.log_level = wp.LOG_WARNING
    print("speed gained over 5/7 g sin at", *ANGLES, "degrees")
    for count in parser.parse_args().samples:
        body = ball(count)
        areas = body.surface.areas
        for modulus in (1.0e5, 1.0e6):
            row = [f"{roll(body, modulus, angle):.2f}" for angle in ANGLES]
            spread = areas.std() / areas.mean()
            print(f"{count} samples (areas vary by {spread:.2f}), E {modulus:g}:", *row, flush=True)


def ball(surface_count: int) -> ReducedBody:
    """Return the ball."""
    quadrature = quadrature_from_sphere(RADIUS, point_count=1500, surface_count=surface_count)
    return build_body(quadrature, BuildOptions(mode_count=6, kernel_count=200, cubature_count=200), name="ball")


def roll(body: ReducedBody, youngs_modulus: float, degrees: float, duration: float = 1.0) -> float:
    """Return the speed that a ball gains in ``duration`` [s], over what a rigid one would."""
    angle = np.deg2rad(degrees)
    material = Material(youngs_modulus=youngs_modulus, density=300.0, friction=0.8, viscosity=0.0)

    def populate(world: newton.ModelBuilder) -> None:
        add_reduced_body(world, body, material=material, position=(0.0, 0.0, RADIUS))

    down = GRAVITY * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    options = SolverReducedOptions(contact_max=1024)
    scene = Scene(populate, [body], gravity=down.tolist(), ground=0.8, dt=DT, options=options)
    scene.step(round(0.25 / DT))
    before = scene.momentum()[0][0]
    scene.step(round(duration / DT))
    gained = (scene.momentum()[0][0] - before) / scene.mass()
    return float(gained / (5.0 / 7.0 * GRAVITY * np.sin(angle) * duration))


if __name__ == "__main__":
    main()
