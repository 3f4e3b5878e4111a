"""A rigid box falls on a soft cushion: softmode's solver in an example of Newton's own shape.

``Example`` has the methods that Newton's examples have, and Newton opens the viewer and runs it. The cushion shows as
the points of its surface, which are particles of the model. In a window, drag the box with the right mouse button.

Run: ``python examples/newton_example.py [--viewer gl|rerun|usd|viser|null] [--num-frames 120] [--test]``
"""

import argparse
from typing import Any

import newton
import newton.examples
import numpy as np
import warp as wp

from softmode.deformables import (
    BuildOptions,
    Material,
    SolverCoupledReduced,
    add_reduced_body,
    build_body,
    quadrature_from_box,
    status_reasons,
)

SIZE, HALF, GRAVITY = (0.3, 0.3, 0.1), 0.08, 9.81
"""Edges of the cushion [m], half an edge of the box [m], gravity [m/s^2]."""
FOAM = Material(youngs_modulus=2.0e4, poissons_ratio=0.3, density=100.0, friction=0.6, viscosity=1.0e-2)


class Example:
    """The scene, its solver and its viewer."""

    def __init__(self, viewer: Any, args: argparse.Namespace) -> None:
        """Build the cushion, stand it on the ground with the box above it, and record a frame.

        Args:
            viewer: A viewer of Newton.
            args: Its options, as ``newton.examples.init`` returns them.
        """
        self.viewer = viewer
        self.fps, self.sim_substeps, self.sim_time = 60, 4, 0.0  # an even number: the two states swap back
        self.frame_dt = 1.0 / self.fps
        self.sim_dt = self.frame_dt / self.sim_substeps

        cushion = build_body(quadrature_from_box(SIZE), BuildOptions(mode_count=12))
        builder = newton.ModelBuilder()  # Z up, gravity 9.81 m/s^2
        start = wp.transform((0.0, 0.0, SIZE[2] + 1.5 * HALF), wp.quat_identity())
        self.box = builder.add_body(xform=start, label="box")
        builder.add_shape_box(self.box, hx=HALF, hy=HALF, hz=HALF)  # 4.1 kg, of Newton's default density
        add_reduced_body(builder, cushion, material=FOAM, position=(0.0, 0.0, 0.5 * SIZE[2] + 1.0e-3))
        builder.add_ground_plane()
        self.model = builder.finalize()

        self.solver = SolverCoupledReduced(self.model, [cushion])
        self.state_0, self.state_1, self.control = self.model.state(), self.model.state(), self.model.control()
        newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, self.state_0)
        self.viewer.set_model(self.model)
        self.viewer.show_particles = True
        self.capture()

    def capture(self) -> None:
        """Record the steps of a frame, to be played again and again; the first step compiles the kernels."""
        self.solver.step(self.state_0, self.state_1, self.control, None, self.sim_dt)
        with wp.ScopedCapture() as capture:
            self.simulate()
        self.graph = capture.graph

    def simulate(self) -> None:
        """Step through a frame."""
        for _ in range(self.sim_substeps):
            self.state_0.clear_forces()
            self.viewer.apply_forces(self.state_0)
            self.solver.step(self.state_0, self.state_1, self.control, None, self.sim_dt)
            self.state_0, self.state_1 = self.state_1, self.state_0

    def step(self) -> None:
        """Advance by a frame."""
        wp.capture_launch(self.graph)
        self.sim_time += self.frame_dt

    def render(self) -> None:
        """Show where everything is."""
        self.viewer.begin_frame(self.sim_time)
        self.viewer.log_state(self.state_0)
        self.viewer.end_frame()

    def test_final(self) -> None:
        """The box rests level on the cushion, which carries its weight and is pressed in."""
        position, velocity = self.state_0.body_q.numpy()[self.box], self.state_0.body_qd.numpy()[self.box]
        weight = GRAVITY * float(self.model.body_mass.numpy()[self.box])
        carried = self.solver.body_wrench.numpy()[self.box][:3]
        sunk = SIZE[2] + HALF - position[2]
        print(f"after {self.sim_time:.1f} s the cushion carries {carried[2]:.1f} N of {weight:.1f} N,", end=" ")
        print(f"{1e3 * sunk:.1f} mm deep")
        assert np.abs(velocity).max() < 1.0e-3  # [m/s], [rad/s]
        assert 2.0 * np.linalg.norm(position[3:5]) < 1.0e-2  # [rad]
        np.testing.assert_allclose(carried / weight, (0.0, 0.0, 1.0), atol=1.0e-3)
        assert 0.0 < sunk < weight * SIZE[2] / (FOAM.youngs_modulus * (2.0 * HALF) ** 2)  # a column under the box alone
        assert not status_reasons(int(self.solver.status.numpy()[0]))


if __name__ == "__main__":
    viewer, args = newton.examples.init(newton.examples.create_parser())
    newton.examples.run(Example(viewer, args), args)
