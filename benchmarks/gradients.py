"""Time the adjoint beside the forward steps, and show what an inexact forward solve costs the gradient.

Run: ``python benchmarks/gradients.py [--device cpu]``. A clamped bar of 1 x 0.2 x 0.2 m (E = 2e5 Pa, nu = 0.4, 1000
kg/m^3) falls for 60 steps of 1/60 s; the loss is the sum of its last coordinates. Medians of one run.
"""

from __future__ import annotations

import argparse
from typing import Any

import newton
import numpy as np
import warp as wp

from benchmarks.clock import Clock
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.gradients.adjoint import AdjointOptions, AdjointReduced
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_pins, add_reduced_body, register_custom_attributes
from softmode.deformables.quadrature.quadrature import quadrature_from_box
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.solver.solver_reduced import SolverReduced, SolverReducedOptions

STEPS, DT = 60, 1.0 / 60.0


class Bar:
    """Worlds of one cantilever each, with a recorder."""

    def __init__(self, body: ReducedBody, world_count: int, tolerance: float, device: str) -> None:
        """Build model, solver and recorder."""
        world, builder = newton.ModelBuilder(), newton.ModelBuilder()
        material = Material(youngs_modulus=2.0e5, poissons_ratio=0.4, density=1000.0)
        index = add_reduced_body(world, body, material=material)
        add_pins(
            world, index, body.cubature.points[body.cubature.points[:, 0] < body.bounds[0, 0] + 0.1], stiffness=2.0e3
        )
        register_custom_attributes(builder)
        builder.replicate(world, world_count)
        self.model: Any = builder.finalize(device=device)
        self.solver = SolverReduced(
            self.model, [body], options=SolverReducedOptions(tolerance=tolerance, iteration_max=100)
        )
        self.adjoint = AdjointReduced(
            self.solver, STEPS, options=AdjointOptions(residual_warning=np.inf, residual_max=np.inf)
        )
        self.loss = np.zeros((STEPS + 1, self.adjoint.total, 3))
        self.loss[-1] = 1.0

    def forward(self) -> None:
        """Simulate and record."""
        state, after, control = self.model.state(), self.model.state(), self.model.control()
        self.adjoint.start(state)
        for _ in range(STEPS):
            self.adjoint.step(state, after, control, DT)
            state, after = after, state
        wp.synchronize_device(self.model.device)

    def backward(self) -> dict[str, np.ndarray]:
        """Return the gradients."""
        return self.adjoint.backward(loss_q=self.loss).numpy()


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--worlds", type=int, nargs="*", default=[1, 16])
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    bodies = {
        modes: build_body(
            quadrature_from_box((1.0, 0.2, 0.2), point_count=4000, surface_count=400),
            BuildOptions(mode_count=modes, kernel_count=400, cubature_count=256),
            progress=False,
        )
        for modes in (8, 16)
    }
    for modes, body in bodies.items():
        for world_count in options.worlds:
            bar = Bar(body, world_count, 1.0e-7, options.device)
            clock = Clock(options.device, 5)
            forward, backward = (clock.median(run) / STEPS for run in (bar.forward, bar.backward))
            print(
                f"{modes} modes, {body.function_count} functions, {world_count} worlds: forward {forward:.2f} ms/step, "
                f"backward {backward:.2f} ms/step, ratio {backward / forward:.2f}"
            )
    exact: dict[str, np.ndarray] = {}
    for tolerance in (1.0e-13, 1.0e-5, 1.0e-6, 1.0e-7, 1.0e-8):
        bar = Bar(bodies[8], 1, tolerance, options.device)
        bar.forward()
        found = bar.backward()
        exact = exact or found
        names = ("youngs_modulus", "poissons_ratio", "density", "qd")
        errors = {k: float(np.abs(found[k] - exact[k]).max() / np.abs(exact[k]).max()) for k in names}
        print(
            f"tolerance {tolerance:.0e}: residual {found['grad_residual'].max():.1e}, relative error "
            + ", ".join(f"{k} {v:.1e}" for k, v in errors.items())
        )


if __name__ == "__main__":
    main()
