"""Find Young's modulus from where mass is: no markers, and not even the same particles.

A soft bar swings and bends for a quarter of a second. What is known of it afterwards are masses on a grid, as a scan
would give them, of a bar that was filled with other particles. The adjoint of the material point method gives the
derivative of the distance of the masses by E, and a secant of it finds E.

Run: ``python examples/morph_identify.py [--short]``
"""

import argparse

import numpy as np
import warp as wp

from softmode.deformables import Material
from softmode.mpm import Grid, MassLoss, MpmOptions, MpmSimulation, ParticleBody, particles_from_shape

TRUE_MODULUS = 4.0e4
"""What is to be found [Pa]."""
HALF = np.array([6.0, 1.5, 1.5])
"""Half edges of the bar [m]."""


def bar(modulus: float, spacing: float) -> ParticleBody:
    """Fill the bar."""
    material = Material(youngs_modulus=modulus, poissons_ratio=0.2, density=75.0)
    bounds = [-HALF + 0.5 * spacing, HALF - 0.5 * spacing]
    volume = float(np.prod(2.0 * HALF))
    return particles_from_shape(
        lambda x: (np.abs(x) < HALF).all(axis=1), bounds, spacing=spacing, material=material, volume=volume
    )


def moving(body: ParticleBody, options: MpmOptions, steps: int) -> MpmSimulation:
    """Return the bar with the velocity of a first bend."""
    found = MpmSimulation(body, options, step_count=steps, device="cpu")
    s = body.positions[:, 0] / HALF[0]
    v = np.zeros((1, body.count, 3))
    v[0, :, 2] = 16.0 * (s**2 - np.mean(s**2))
    C = np.zeros((1, body.count, 3, 3))
    C[0, :, 2, 0] = 32.0 * s / HALF[0]
    found.start(v=v, C=C)
    return found


def identify(observed: ParticleBody, options: MpmOptions, steps: int, start: float) -> list[float]:
    """Return the iterates [Pa]: secants of dL/d(ln E), begun with a small step downhill."""
    loss = MassLoss(options.grid, observed, mass_scale=10.0, dtype=wp.float64, device="cpu")
    value = wp.zeros(1, dtype=wp.float64, device="cpu")
    x, iterates, before = float(np.log(start)), [], None
    for _ in range(14):
        iterates.append(float(np.exp(x)))
        simulation = moving(bar(iterates[-1], 0.5), options, steps)
        simulation.forward()
        simulation.check()
        loss.after(simulation, value)
        _, bars = loss.gradient(simulation)
        # E scales mu and lambda alike: dL/d(ln E) = mu dL/dmu + lambda dL/dlambda.
        slope = sum(
            float((p.numpy() * b.numpy()).sum()) for p, b in ((simulation.mu, bars.mu), (simulation.lam, bars.lam))
        )
        step = -0.15 * float(np.sign(slope))
        if before and (slope - before[1]) * (x - before[0]) > 0.0:
            step = float(np.clip(-slope * (x - before[0]) / (slope - before[1]), -0.5, 0.5))
        if abs(step) < 1.0e-3:
            break
        before, x = (x, slope), x + step
    return iterates


def test_final(iterates: list[float]) -> None:
    """E is found to 5 %: the two bars are filled with other particles."""
    assert abs(iterates[-1] / TRUE_MODULUS - 1.0) < 0.05, iterates


def main() -> None:
    """Observe, then identify."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true", help="one start")
    short = parser.parse_args().short
    wp.config.log_level = wp.LOG_WARNING
    options = MpmOptions(grid=Grid(shape=(24, 14, 20), origin=(-11.5, -6.5, -9.5)), precision="float64")
    steps = 30
    true = moving(bar(TRUE_MODULUS, 0.4), options, steps)
    true.forward()
    observed = ParticleBody(positions=true.last.x.numpy()[0], masses=true.bodies[0].masses)
    for factor in (2.0,) if short else (2.0, 0.5):
        iterates = identify(observed, options, steps, factor * TRUE_MODULUS)
        print(f"E over the true E: {' '.join(f'{E / TRUE_MODULUS:.4f}' for E in iterates)}")
        test_final(iterates)


if __name__ == "__main__":
    main()
