"""A robot loaded by name closes on a soft cube and lifts it; the friction of its fingers carries the cube's weight.

The robot is one arm of an ALOHA station, which ships with mujoco-warp, so nothing is downloaded. Its file's position
servos became joint drives: each finger presses with k (q - target), and the table below compares that with the force
that the cube returns.

Run: ``python examples/robot_by_name.py [--short]``
"""

import argparse
from typing import Any

import newton
import numpy as np
import warp as wp

from softmode import robots
from softmode.deformables import (
    BuildOptions,
    Material,
    SolverCoupledReduced,
    add_reduced_body,
    build_body,
    quadrature_from_box,
)

EDGE, GRAVITY, DT = 0.04, 9.81, 0.004
RAISE = {"left\\elbow": -0.12, "left\\wrist_angle": 0.12}
"""Change of the joint targets that raises the hand and keeps it level [rad]."""


class Lift:
    """The arm, a stand, a cube on it, and the joint solve."""

    def __init__(self) -> None:
        """Build and record two steps."""
        self.robot = robots.load("aloha_arm")
        self.open, self.closed = self.robot.with_opening(1.0), self.robot.with_opening(0.5)
        self.raised = np.array([RAISE.get(name, 0.0) for name in self.robot.joint_names])
        body = build_body(
            quadrature_from_box((EDGE,) * 3, point_count=1000, surface_count=150),
            BuildOptions(mode_count=4, kernel_count=150, cubature_count=128),
        )
        material = Material(youngs_modulus=5.0e5, density=300.0, friction=0.8)
        self.weight = material.density * EDGE**3 * GRAVITY
        world = newton.ModelBuilder()  # gravity is 9.81 m/s^2 along -z
        self.arm = self.robot.add_to(world)
        world.joint_q[:] = self.open.tolist()
        # The finger tips meet 4 mm behind the tool point and 3.5 mm below it.
        tool: Any = wp.transform(*self.robot.tool_pose())
        place: Any = wp.transform_get_translation(tool * wp.transform((-0.008, 0.0, -0.0035), wp.quat_identity()))
        add_reduced_body(world, body, material=material, position=tuple(place))
        stand = wp.transform(place - wp.vec3(0.0, 0.0, 0.5 * EDGE + 0.01), wp.quat_identity())
        world.add_shape_box(-1, xform=stand, hx=0.015, hy=0.015, hz=0.01, label="stand")
        self.model: Any = world.finalize()
        self.solver = SolverCoupledReduced(self.model, [body])
        self.states: Any = (self.model.state(), self.model.state())
        self.control: Any = self.model.control()
        for state in self.states:
            newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, state)
        self.command(0.0)
        self._two_steps()
        with wp.ScopedCapture(device=self.model.device) as capture:
            self._two_steps()
        self.graph: Any = capture.graph

    def _two_steps(self) -> None:
        first, second = self.states
        self.solver.step(first, second, self.control, None, DT)
        self.solver.step(second, first, self.control, None, DT)

    def command(self, t: float) -> None:
        """Close until 0.5 s, raise from 0.7 s to 1.3 s."""
        close, lift = np.clip((t / 0.5, (t - 0.7) / 0.6), 0.0, 1.0)
        self.target = self.open + close * (self.closed - self.open) + lift * self.raised
        self.control.joint_target_q.assign(self.target.astype(np.float32))

    def run(self, duration: float) -> list[dict[str, float]]:
        """Simulate and return a row per 0.2 s."""
        rows, status = [], 0
        for k in range(round(duration / DT / 2)):
            self.command(2 * k * DT)
            wp.capture_launch(self.graph)
            status |= int(self.solver.reduced.status.numpy()[0])
            if (k + 1) % 25 == 0:
                wrench, state = self.solver.body_wrench.numpy(), self.states[0]
                press = 1000.0 * (state.joint_q.numpy()[-2:] - self.target[-2:])
                rows.append({"t": 2 * (k + 1) * DT, "hand": float(state.body_q.numpy()[self.arm.hand_body, 2])})
                rows[-1] |= {"drive": float(press.mean()), "carried": float(-wrench[:, 2].sum()), "status": status}
                rows[-1] |= {"force": float(np.abs(wrench[list(self.arm.finger_bodies), 1]).mean())}
        return rows


def test_final(rows: list[dict[str, float]], weight: float) -> None:
    """The fingers press as their drives do and carry the weight, both within 2 %; the hand rose; no flag was raised."""
    last = rows[-1]
    assert abs(last["carried"] / weight - 1.0) <= 0.02
    assert abs(last["force"] / last["drive"] - 1.0) <= 0.02
    assert last["hand"] > rows[0]["hand"] + 0.01
    assert last["status"] == 0


def main() -> None:
    """Print one row per 0.2 s."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true", help="1.6 s instead of 4 s")
    short = parser.parse_args().short
    wp.config.log_level = wp.LOG_WARNING
    lift = Lift()
    rows = lift.run(1.6 if short else 4.0)
    print(f"the cube weighs {lift.weight:.4f} N\n   t [s]  hand [m]  drive [N]  finger force [N]  carried [N]")
    for row in rows:
        print("{t:8.2f}{hand:10.4f}{drive:11.3f}{force:18.3f}{carried:13.4f}".format(**row))
    test_final(rows, lift.weight)


if __name__ == "__main__":
    main()
