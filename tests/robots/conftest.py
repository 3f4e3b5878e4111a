"""A replicated model of the default arm, shared by the tests of this folder."""

import newton
import numpy as np
import pytest
import warp as wp

from softmode.robots import ArmDescription, add_arm

DT = 1.0 / 240.0
SUBSTEPS = 8


class Rig:
    """The arm alone in a few worlds, with its solver."""

    def __init__(self, description=None, world_count=2, xform=None, friction=0.0):
        world = newton.ModelBuilder()
        self.arm = add_arm(world, description, xform=xform)
        world.joint_friction[:] = [friction] * world.joint_dof_count
        builder = newton.ModelBuilder()
        builder.replicate(world, world_count)
        self.model = builder.finalize(device="cpu")
        self.solver = newton.solvers.SolverMuJoCo(self.model, disable_contacts=True)
        self.world_count = world_count
        self.restart()

    def restart(self):
        """Put the arm back into its home pose, at rest."""
        self.state, self.next_state = self.model.state(), self.model.state()
        self.control = self.model.control()
        newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, self.state)

    def set_joint_q(self, joint_q, joint_qd=None):
        """Set the coordinates of every world."""
        self.state.joint_q.assign(np.tile(np.asarray(joint_q, dtype=np.float32), self.world_count))
        if joint_qd is not None:
            self.state.joint_qd.assign(np.tile(np.asarray(joint_qd, dtype=np.float32), self.world_count))
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)

    def step(self, count=1, dt=DT):
        """Step the rigid bodies; the wrenches in body_f stay."""
        for _ in range(count):
            self.next_state.body_f.assign(self.state.body_f)
            self.solver.step(self.state, self.next_state, self.control, None, dt)
            self.state, self.next_state = self.next_state, self.state

    def frame(self, controller, action, dt=DT):
        """One control step of SUBSTEPS steps; SUBSTEPS is even, so that a capture ends where it began."""
        controller.command(action, self.state)
        for i in range(SUBSTEPS):
            controller.write_targets(self.control, (i + 1) / SUBSTEPS)
            self.solver.step(self.state, self.next_state, self.control, None, dt)
            self.state, self.next_state = self.next_state, self.state
        controller.measure(self.state)


@pytest.fixture(scope="session")
def shared_rig():
    """Two worlds of the default arm."""
    return Rig(ArmDescription())


@pytest.fixture
def rig(shared_rig):
    """The shared rig in its home pose."""
    shared_rig.restart()
    return shared_rig


def as_action(row, world_count=2):
    """Repeat one action over the worlds."""
    return wp.array(np.tile(np.asarray(row, dtype=np.float32), (world_count, 1)), dtype=wp.float32, device="cpu")
