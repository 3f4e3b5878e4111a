"""Grasp a rigid box with soft fingertips, lift it, let it fall; read all forces from contact sensors.

Two capsules of soft rubber are glued to the fingers of the arm. The fingers press with three forces, one after the
other: what each pad feels is what its drive gives, and the contact patch grows. Then the arm lifts the box: friction
on the pads carries its weight. Nothing is scripted but the drives: arm, box and pads are unknowns of one solve.

Run: ``python examples/soft_fingertips.py [--short]``
"""

import argparse
from typing import Any, NamedTuple

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from softmode.deformables import ContactSensor, SolverCoupledReduced, SurfacePressure
from softmode.robots import add_arm, add_soft_fingertips

DT, GRAVITY, MASS, HALF, PLACE, LIFT = 0.004, 9.81, 0.15, 0.03, (0.45, 0.0), 0.1
"""Step [s], gravity [m/s^2]; mass [kg] and half height [m] of the box, where it stands, how far it is lifted [m]."""


class Row(NamedTuple):
    """What a stage ends with; per finger where there are two."""

    stage: str
    drive: np.ndarray  # [N]
    squeeze: np.ndarray  # normal to the box [N]
    friction: float  # upward [N]
    area: np.ndarray  # [m^2]
    peak: float  # [Pa]
    height: float  # above where the box stood [m]


class Grasp:
    """The arm with soft fingertips over a box on the ground."""

    def __init__(self) -> None:
        """Build the scene and record two steps and the reading of the sensors."""
        world = newton.ModelBuilder()
        SolverMuJoCo.register_custom_attributes(world)
        self.arm = add_arm(world)
        world.joint_q[:9] = [float(q) for q in self.joints(0.0, 0.0375)]
        tips = add_soft_fingertips(world, self.arm)
        self.box = world.add_body(xform=wp.transform((*PLACE, HALF), wp.quat_identity()), label="box")
        world.default_shape_cfg.mu, world.default_shape_cfg.density = 0.8, MASS / (8.0 * 0.02**2 * HALF)
        world.add_shape_box(self.box, hx=0.02, hy=0.02, hz=HALF)
        world.add_ground_plane()
        model: Any = world.finalize()
        self.state, self.control = model.state(), model.control()
        newton.eval_fk(model, model.joint_q, model.joint_qd, self.state)
        solver = SolverCoupledReduced(model, [tips.body], rigid=SolverMuJoCo(model, njmax=128, nconmax=128))
        self.contact = ContactSensor(solver, "box")
        self.pressure = [SurfacePressure(solver, tip) for tip in tips.instances]
        scratch = model.state()
        solver.step(self.state, scratch, self.control, None, DT)  # compiles
        with wp.ScopedCapture() as capture:
            solver.step(self.state, scratch, self.control, None, DT)
            solver.step(scratch, self.state, self.control, None, DT)
            for sensor in (self.contact, *self.pressure):
                sensor.update()
        self.graph: Any = capture.graph

    def joints(self, lift: float, finger: float | np.ndarray) -> np.ndarray:
        """Return the joint coordinates that hold the tool over the box, 4 cm above the ground when not lifted."""
        return np.append(self.arm.description.joint_q_over((*PLACE, 0.04 + lift)), np.broadcast_to(finger, 2))

    def run(self, stage: str, duration: float, *, force: float = 0.0, lift: tuple[float, float] = (0.0, 0.0)) -> Row:
        """Close the fingers with a force [N] each, or open them, while the tool moves between two heights [m]."""
        stiffness, count = self.arm.description.gripper.drive_stiffness, round(0.5 * duration / DT)
        targets = self.control.joint_target_q.numpy()
        for k in range(count):
            s = (k + 1) / count
            height = lift[0] + (lift[1] - lift[0]) * s * s * (3.0 - 2.0 * s)
            fingers = self.state.joint_q.numpy()[7:9]
            targets[:9] = self.joints(height, fingers - force / stiffness if force else 0.045)
            self.control.joint_target_q.assign(targets)
            wp.capture_launch(self.graph)
        on_box = self.contact.force_matrix.numpy()[0, 0]
        drive = stiffness * (self.state.joint_q.numpy()[7:9] - targets[7:9])
        area = self.contact.area_matrix.numpy()[0, 0].copy()
        peak = max(float(sensor.pressure.numpy().max()) for sensor in self.pressure)
        height = float(self.state.body_q.numpy()[self.box, 2]) - HALF
        return Row(stage, drive, np.abs(on_box[:, 1]), float(on_box[:, 2].sum()), area, peak, height)


def test_final(rows: list[Row]) -> None:
    """The pads feel what the drives give, patches grow with it, friction carries the box, and it falls when let go."""
    *squeezed, lifted, released = rows
    for row in (*squeezed, lifted):
        np.testing.assert_allclose(row.squeeze, row.drive, rtol=0.01)
    areas = np.array([row.area for row in squeezed])
    assert (np.diff(areas, axis=0) > 0.0).all()
    assert abs(lifted.friction / (MASS * GRAVITY) - 1.0) <= 0.02
    assert abs(lifted.height - LIFT) <= 0.003
    assert not released.squeeze.any() and not released.area.any() and released.height < lifted.height - 0.01


def main() -> None:
    """Print one row per stage."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true", help="two squeezes instead of three")
    forces = (4.0, 16.0) if parser.parse_args().short else (4.0, 8.0, 16.0)
    wp.config.log_level = wp.LOG_WARNING
    grasp = Grasp()
    rows = [grasp.run(f"squeeze {force:.0f} N", 0.32, force=force) for force in forces]
    grasp.run("lift", 0.6, force=forces[-1], lift=(0.0, LIFT))
    rows.append(grasp.run("hold", 0.24, force=forces[-1], lift=(LIFT, LIFT)))
    rows.append(grasp.run("let go", 0.12, lift=(LIFT, LIFT)))
    for r in rows:
        print(f"{r.stage:12s} drives {r.drive.round(2)}, squeeze {r.squeeze.round(2)}, friction {r.friction:.2f} N,")
        print(f"    patches {(1e6 * r.area).round()} mm2, peak {1e-3 * r.peak:.0f} kPa, box at {1e3 * r.height:.1f} mm")
    test_final(rows)


if __name__ == "__main__":
    main()
