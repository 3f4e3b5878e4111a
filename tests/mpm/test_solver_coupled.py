"""Particles beside rigid and reduced bodies in one step: momentum, a lump that a gripper lifts, faults."""

from __future__ import annotations

from dataclasses import replace

import newton
import numpy as np
import pytest
from newton.solvers import SolverMuJoCo

from softmode.deformables import Material, add_reduced_body
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.errors import ConfigError, SolverDiverged
from softmode.mpm import Grid, GridShapes, MpmOptions, MpmSimulation, SolverCoupledParticles, particles_from_shape
from softmode.mpm.particles import ParticleBody
from tests.bodies import cube
from tests.scenes import GRAVITY, GRIPPER, RIGID_GAP, Scene, add_free_box, add_gripper

CELL = 0.01
DOUGH = Material(youngs_modulus=2.0e4, poissons_ratio=0.3, density=1000.0, model=MaterialModel.COROTATED)


def lump(size: tuple[float, float, float], middle: tuple[float, float, float], h: float = 0.005) -> ParticleBody:
    """Return a block of dough."""
    half = 0.5 * np.array(size)
    first = np.array(middle) - half + 0.5 * h
    bounds = [first, first + 2.0 * half - 0.9 * h]
    return particles_from_shape(lambda x: np.ones(len(x), dtype=bool), bounds, spacing=h, material=DOUGH)


def beside(scene: Scene, body: ParticleBody, options: MpmOptions) -> MpmSimulation:
    """Put particles beside what the scene's solver moves, in two steps for one of its."""
    shapes = GridShapes(scene.model, state=scene.state)
    found = MpmSimulation(body, options, step_count=2, shapes=shapes, device="cpu")
    scene.solver = SolverCoupledParticles(scene.solver, found)
    return found


def test_momentum_goes_through_the_joint_solve() -> None:
    """Without gravity a lump falls on a free box that lies on a free reduced cube: the sum of the momenta stays.

    To 1e-6 of what the lump had, moments to 1e-3. All three end up with a good part of it.
    """
    body, edge = cube(), 0.1

    def populate(world: newton.ModelBuilder) -> None:
        add_free_box(world, (0.06, 0.06, 0.03), 0.8, (0.005, 0.01, 0.5 * edge + RIGID_GAP + 0.03))
        add_reduced_body(world, body, material=Material(friction=0.5))

    scene = Scene(populate, [body], coupled=True, dt=0.001)
    options = MpmOptions(
        grid=Grid(shape=(24, 24, 24), spacing=CELL, origin=(-0.115, -0.115, 0.005)), dt=0.0005, precision="float64"
    )
    s = beside(scene, lump((0.06, 0.06, 0.04), (0.0, 0.0, 0.16)), options)
    s.start(v=np.tile([0.1, 0.0, -1.0], (1, s.count, 1)))
    m = s.mass.numpy()[0]

    def momenta() -> np.ndarray:
        x, v, C = s.first.x.numpy()[0], s.first.v.numpy()[0], s.first.C.numpy()[0]
        turn = np.stack([C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], axis=1)
        grains = np.concatenate([m @ v, m @ (np.cross(x, v) + CELL**2 / 3.0 * turn)])
        return np.array([grains, np.concatenate(scene.rigid_momentum()[:2]), np.concatenate(scene.momentum())])

    before = momenta()
    for _ in range(60):
        scene.step()
    s.check()
    after = momenta()
    change = (after - before).sum(axis=0)
    assert np.abs(change[:3]).max() < 1e-6 * np.abs(before[0, :3]).max()
    assert np.abs(change[3:]).max() < 1e-3 * np.abs(before[0, 3:]).max()
    assert (after[1:, 2] < 0.05 * before[0, 2]).all()


def test_a_gripper_lifts_a_lump_and_its_wrist_feels_the_weight() -> None:
    """The slide of the palm bears the lump's weight more than before, to 2 %; steps are replayed from a graph."""
    scene = Scene(
        lambda world: add_gripper(world, 0.03, friction=0.9),
        [],
        gravity=(0.0, 0.0, -GRAVITY),
        ground=0.5,
        coupled=True,
        dt=0.001,
    )
    grid = Grid(shape=(21, 31, 24), spacing=0.5 * CELL, origin=(-0.05, -0.075, -0.02505))
    options = MpmOptions(grid=grid, dt=0.0005, gravity=(0.0, 0.0, -GRAVITY), damping=4.0)
    body = replace(lump((0.03, 0.05, 0.03), (0.0, 0.0, 0.015), h=0.0025), yield_stress=3.0e3)
    s = beside(scene, body, options)
    play = scene.capture()

    def bear(fingers: float, height: float, steps: int) -> float:
        """Go on with targets [m]; return what the slide bears at the end [N]."""
        scene.control.joint_target_q.assign([height, fingers, fingers])
        for _ in range(steps // 2):
            play()
        return 5.0e4 * (height - float(scene.state.joint_q.numpy()[0]))

    free = bear(0.0, -0.015, 100)
    for step in range(10):
        bear(0.001 * (step + 1), -0.015, 10)
    bear(0.012, -0.015, 60)
    for step in range(10):
        bear(0.012, -0.015 + 0.003 * (step + 1), 16)
    bear(0.012, 0.015, 100)
    lifted = np.mean([bear(0.012, 0.015, 2) for _ in range(60)])  # it swings a little: two periods
    s.check()
    x = s.first.x.numpy()[0]
    assert free == pytest.approx((1.0 + 2.0 * GRIPPER["finger_mass"]) * GRAVITY, rel=1e-3)
    assert lifted - free == pytest.approx(body.mass * GRAVITY, rel=0.02)
    assert x[:, 2].min() > 0.02
    assert np.abs(x[:, 1]).max() < 0.025


def test_faults_of_a_step() -> None:
    """Another duration, another model, derivatives; particles that leave the grid are counted."""
    scene = Scene(lambda world: add_free_box(world, (0.05,) * 3, 1.0, (0.0, 0.0, 0.1)), [], coupled=True, dt=0.001)
    options = MpmOptions(grid=Grid(shape=(24, 24, 24), spacing=CELL, origin=(-0.115, -0.115, 0.105)), dt=0.0005)
    body = lump((0.04,) * 3, (0.0, 0.0, 0.2))
    with pytest.raises(ConfigError, match="shapes of the solver's model"):
        SolverCoupledParticles(SolverMuJoCo(scene.model), MpmSimulation(body, options, device="cpu"))
    s = beside(scene, body, options)
    with pytest.raises(ConfigError, match=r"2 steps of 0.0005 s.*step_count"):
        scene.solver.step(scene.state, scene.next_state, None, None, 0.004)
    with pytest.raises(ConfigError, match="no derivatives across"):
        s.backward()
    s.start(v=np.tile([200.0, 0.0, 0.0], (1, s.count, 1)))
    scene.step(3)
    with pytest.raises(SolverDiverged, match=rf"left the grid; {s.count} of {s.count} are outside.*room"):
        s.check()
