"""The same code on CUDA: agreement with the CPU, capture, and the whole task. Skipped without a CUDA device."""

from __future__ import annotations

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body, register_custom_attributes
from softmode.deformables.solver.attachments import attach
from softmode.deformables.solver.solver_reduced import SolverReduced
from softmode.deformables.tools.grips import Grips, add_grip_slots
from softmode.deformables.tools.sensing import ContactSensor, SurfacePressure
from tests.bodies import cube

pytestmark = pytest.mark.gpu

DT = 0.004


KINDS = ("cube", "pile", "hung", "loaded", "loaded pile")


def drop(device: str, kind: str, world_count: int = 1, *, captured: bool = True, steps: int = 100) -> np.ndarray:
    """Drop a spinning cube from 3 cm onto the ground; return the particles of every world.

    "pile": a second soft cube falls onto it; "hung": a second one hangs beside it by its top; "loaded": a rigid box
    falls onto what is there, which MuJoCo moves.
    """
    world = newton.ModelBuilder()
    material = Material(youngs_modulus=1.0e5)
    spin = (1.0, 0.5, 0.0)
    add_reduced_body(world, cube(), material=material, position=(0.0, 0.0, 0.08), angular_velocity=spin)
    if "pile" in kind:
        add_reduced_body(world, cube(), material=material, position=(0.02, 0.01, 0.19))
    elif kind == "hung":
        instance = add_reduced_body(world, cube(), material=material, position=(0.15, 0.0, 0.08))
        attach(world, instance, cube(), box=((-1.0, -1.0, 0.045), (1.0, 1.0, 1.0)))
    if "loaded" in kind:
        box = world.add_body(xform=wp.transform((0.0, 0.01, 0.3), wp.quat_identity()))
        world.add_shape_box(box, hx=0.04, hy=0.04, hz=0.01, cfg=newton.ModelBuilder.ShapeConfig(density=500.0))
    builder = newton.ModelBuilder()
    register_custom_attributes(builder)
    builder.replicate(world, world_count)
    builder.add_ground_plane()
    model = builder.finalize(device=device)
    solver = SolverCoupledReduced(model, [cube()]) if "loaded" in kind else SolverReduced(model, [cube()])
    first, second = model.state(), model.state()

    def two_steps() -> None:
        solver.step(first, second, None, None, DT)
        solver.step(second, first, None, None, DT)

    two_steps()
    if captured:
        with wp.ScopedCapture(device=device) as capture:
            two_steps()
        for _ in range(steps // 2 - 1):
            wp.capture_launch(capture.graph)
    else:
        for _ in range(steps // 2 - 1):
            two_steps()
    assert not solver.status.numpy().any()
    return first.particle_q.numpy().reshape(world_count, -1, 3)


@pytest.mark.parametrize("kind", KINDS)
def test_cuda_agrees_with_cpu(kind):
    """100 steps with an impact: the directions differ in rounding only, both stop at the same potential's minimum.

    Bodies that roll over each other, or lie under a box, spread what the stopping tolerance leaves, ten times as much.
    """
    atol = (1e-4 if kind in ("cube", "hung") else 1e-3) * 0.1
    np.testing.assert_allclose(drop("cuda:0", kind), drop("cpu", kind), atol=atol)


@pytest.mark.parametrize("kind", KINDS)
def test_cuda_graph_equals_eager(kind):
    """A replayed graph takes the same branches and adds in the same order as eager launches."""
    np.testing.assert_array_equal(drop("cuda:0", kind), drop("cuda:0", kind, captured=False))


@pytest.mark.parametrize("kind", KINDS)
def test_cuda_worlds_are_alike(kind):
    """256 replicas that start alike stay alike to the bit: no world sees another, no sum has a free order."""
    worlds = drop("cuda:0", kind, 256)
    np.testing.assert_array_equal(worlds, np.broadcast_to(worlds[:1], worlds.shape))


def grip(device: str) -> np.ndarray:
    """Hold a cube by its top, pull it by a corner, move the hold, let go of the pull; return the particles."""
    world = newton.ModelBuilder()
    instance = add_reduced_body(
        world, cube(), material=Material(youngs_modulus=1.0e5, viscosity=0.01), position=(0.0, 0.0, 1.0)
    )
    add_grip_slots(world, instance, 7)
    model = world.finalize(device=device)
    solver = SolverReduced(model, [cube()])
    grips = Grips(solver, instance, slot_count=7)
    first, second, control = model.state(), model.state(), model.control()

    def two_steps() -> None:
        for start, end in ((first, second), (second, first)):
            grips.apply(start, control, DT)
            solver.step(start, end, control, None, DT)

    two_steps()
    with wp.ScopedCapture(device=device) as capture:
        two_steps()
    solver.reset(first)
    order = np.argsort(-cube().surface.points[:, 2])
    hold = grips.take(cube().surface.points[order[:6]], first)
    pull = grips.take(cube().surface.points[order[-1:]], first, pulls=True)
    grips.aim(pull, grips.pose(pull)[0] + np.array([0.02, 0.0, 0.0]))
    grips.aim(hold, grips.pose(hold)[0] + np.array([0.0, 0.01, 0.0]), (0.0, 0.0, 0.6, 0.8))
    grips.begin_frame(40)
    for k in range(50):
        wp.capture_launch(capture.graph)
        if k == 30:
            grips.let_go(pull)
    assert not solver.status.numpy().any()
    return first.particle_q.numpy()


def test_cuda_grips():
    """Parts that are gripped, moved and let go between launches of a graph are where they are on the CPU."""
    moved = grip("cpu")
    assert np.abs(moved[:, 1].mean()) > 5e-3
    np.testing.assert_allclose(grip("cuda:0"), moved, atol=1e-4 * 0.1)


def weigh(device: str) -> tuple[np.ndarray, np.ndarray]:
    """Let cubes settle on the ground in three worlds; return what the ground and the surfaces feel, captured."""
    world = newton.ModelBuilder()
    material = Material(youngs_modulus=5.0e5, mass_damping=5.0)
    add_reduced_body(world, cube(), material=material, position=(0.0, 0.0, 0.0501))
    builder = newton.ModelBuilder()
    register_custom_attributes(builder)
    builder.replicate(world, 3)
    builder.add_ground_plane()
    model = builder.finalize(device=device)
    solver = SolverReduced(model, [cube()])
    ground, surface = ContactSensor(solver, [-1]), SurfacePressure(solver)
    first, second = model.state(), model.state()

    def two_steps() -> None:
        solver.step(first, second, None, None, DT)
        solver.step(second, first, None, None, DT)
        ground.update()
        surface.update()

    two_steps()
    with wp.ScopedCapture(device=device) as capture:
        two_steps()
    for _ in range(100):
        wp.capture_launch(capture.graph)
    return ground.total_force.numpy()[:, 0], surface.pressure.numpy()


def test_cuda_senses():
    """Sensors on CUDA: equal in all worlds to the bit, and as on the CPU to the tolerance of the step."""
    force, pressure = weigh("cuda:0")
    np.testing.assert_array_equal(pressure, np.broadcast_to(pressure[:1], pressure.shape))
    expected_force, expected_pressure = weigh("cpu")
    np.testing.assert_allclose(force, expected_force, atol=1e-3 * np.abs(expected_force).max())
    np.testing.assert_allclose(pressure, expected_pressure, atol=1e-2 * expected_pressure.max())


def test_cuda_lifts():
    """The scripted policy lifts the plush on CUDA with pixel observations."""
    from softmode.envs.tasks.lift_soft.scripted import ScriptedLift
    from softmode.envs.tasks.lift_soft.task import LiftSoftEnv

    env = LiftSoftEnv(obs_type="pixels_agent_pos", device="cuda:0")
    observation, info = env.reset(seed=1)
    policy = ScriptedLift(env)
    for _ in range(150):
        observation, _, terminated, _, info = env.step(policy(observation))
        assert not terminated
    assert info["is_success"]
    assert 20 < observation["pixels"].std() < 120


def lie_and_lift(device: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Let objects that a second reset has drawn lie in 16 worlds for 30 steps, then lift them.

    Returns:
        Height of each over the table after the first part, as a share of that at rest; why the episodes ended, and
        which objects were lifted, shape (world_count,) each.
    """
    from softmode.envs import LiftSoftVectorEnv
    from softmode.envs.tasks.lift_soft.scripted import ScriptedLift
    from softmode.objects import ObjectSet
    from tests.envs.object_kinds import KINDS, MATERIALS, lift

    config = lift(ObjectSet(KINDS, materials=MATERIALS, resample=True))
    options = {"device": device, "max_episode_steps": 180, "autoreset_mode": "Disabled"}
    env = LiftSoftVectorEnv(16, config=config, **options)
    env.reset(seed=1)
    _, infos = env.reset(seed=2)
    assert len(set(infos["object"].tolist())) == len(KINDS)
    scene, still = env.task.scene, np.zeros((16, 5), np.float32)
    for _ in range(30):
        *_, infos = env.step(still)
        assert not infos["end_reason"].any()
    lying = scene.object_position.numpy()[:, 0, 2] / scene.occupancy.heights[:, 0]
    policies = [ScriptedLift(env, world=world) for world in range(16)]
    for _ in range(150):
        *_, infos = env.step(np.stack([policy() for policy in policies]))
    return lying, infos["end_reason"], infos["is_success"]


def test_cuda_resets_draw_objects():
    """Objects that resets put into worlds lie on the table, are lifted, and episodes end as on the CPU."""
    lying, reasons, lifted = lie_and_lift("cuda:0")
    expected, expected_reasons, expected_lifted = lie_and_lift("cpu")
    np.testing.assert_allclose(lying, expected, atol=1e-2)
    assert (expected > 0.9).all()
    np.testing.assert_array_equal(reasons, expected_reasons)
    assert lifted.mean() > 0.8 and expected_lifted.mean() > 0.8
