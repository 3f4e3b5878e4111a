"""Dents: spheres between plates against Hertz, flat punches against half spaces, with the dent and without.

Run: ``python -m benchmarks.dents``. "without" is the contact stiffness of the same rule given by hand, which takes the
dent away. Prints force over Hertz's, made finite, and force over that of two half spaces under punches.
"""

from __future__ import annotations

import argparse

import numpy as np
import warp as wp

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from tests.bodies import default_ball
from tests.bodies import smooth_ball as ball
from tests.deformables.test_dents import RADIUS, RATIO, Press, hertz

DEPTHS = (0.01, 0.02, 0.04, 0.08, 0.11)
"""Over the radius."""
RIGID = 400.0
"""Contact stiffness over P-wave modulus per size of the rows without the dent, as in the rule."""
BOXES = {"cube": (0.1, 0.1, 0.1), "beam": (0.24, 0.05, 0.05), "pad": (0.1, 0.1, 0.02), "sheet": (0.1, 0.1, 0.004)}


def main() -> None:
    """Print the tables."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    wp.config.log_level = wp.LOG_WARNING
    print("sphere between plates, force over Hertz's (finite sphere), at d / R of", *DEPTHS)
    for modes, samples in ((8, 400), (8, 1500), (8, 2400), (16, 1500)):
        body = ball(modes, samples)
        for modulus in (1.0e5, 1.0e6):
            for name, stiffness in (("dents", None), ("without", rigid(body, modulus))):
                press = Press(body, RADIUS, youngs_modulus=modulus, stiffness=stiffness)
                row = [press.force(share * RADIUS) / hertz(share * RADIUS, modulus) for share in DEPTHS]
                print(f"{body.function_count} functions, {samples} samples, E {modulus:g}, {name}:", *shown(row))
    print("the same of the 48 functions and 800 samples that a body has by default, E 1e5")
    for ratio in (0.3, 0.45, 0.49):
        body = default_ball(ratio)
        press = Press(body, RADIUS, youngs_modulus=1.0e5, poissons_ratio=ratio)
        row = [press.force(share * RADIUS) / hertz(share * RADIUS, 1.0e5, ratio) for share in DEPTHS[:-1]]
        print(f"{body.function_count} functions, nu {ratio}:", *shown(row))
    print("two punches, force over that of half spaces, radii of 6, 12 and 18 mm, 1 mm deep (0.4 mm into the pad)")
    print("whole face: plates that squeeze by 4 %, force over E A strain")
    for name, edges in BOXES.items():
        quadrature = quadrature_from_box(edges, point_count=2000, surface_count=1500)
        options = BuildOptions(mode_count=8, kernel_count=250, cubature_count=300)
        body = build_body(quadrature, options, name=name)
        for kind, stiffness in (("dents", None), ("without", rigid(body, 1.0e6))):
            row = []
            for a in (0.006, 0.012, 0.018):
                press = Press(body, 0.5 * edges[2], punch=a, stiffness=stiffness)
                depth = 0.02 * edges[2] if edges[2] < 0.05 else 0.001
                row.append(press.force(depth) * compliance(a, edges[2]) / depth)
            press, depth = Press(body, 0.5 * edges[2], stiffness=stiffness), 0.02 * edges[2]
            whole = press.force(depth) * edges[2] / (1.0e6 * edges[0] * edges[1] * 2.0 * depth)
            print(f"{name}, {body.function_count} functions, {kind}:", *shown(row), "whole face", *shown([whole]))


def rigid(body: ReducedBody, youngs_modulus: float) -> float:
    """Return the stiffness per area [Pa/m] of the rule for contact, without its terms for inertia and light loads."""
    wave = youngs_modulus * (1.0 - RATIO) / ((1.0 + RATIO) * (1.0 - 2.0 * RATIO))
    return RIGID * wave / float(np.linalg.norm(np.ptp(body.bounds, axis=0)))


def compliance(a: float, height: float) -> float:
    """Return approach of one of two opposite rigid punches over force [m/N], E 1e6: half spaces, see the tests."""
    z = height / a
    surface = np.pi * (1.0 - RATIO)
    opposite = 2.0 * (1.0 - RATIO) * np.arctan(1.0 / z) + z / (1.0 + z * z)
    return float((1.0 + RATIO) / (2.0 * np.pi * a * 1.0e6) * (surface - opposite))


def shown(row: list[float]) -> list[str]:
    """Return numbers to two places."""
    return [f"{value:.2f}" for value in row]


if __name__ == "__main__":
    main()
