"""In a grasp: graphs equal launches, worlds a world alone, all ways to solve agree, and room for contacts runs out."""

import dataclasses
from collections.abc import Sequence

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.model import status as bits
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.model.compile_ahead import compile_launches
from softmode.deformables.newton.one_launch_kernels import newton_kernel
from softmode.deformables.solver import step_tables
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from tests.bodies import cube
from tests.marks import rest_but
from tests.scenes import GRAVITY, GRIPPER, Scene, add_gripper

EDGE = 0.06
RAMP = 10
"""Steps in which the fingers are driven to where they press hardest."""
STEPS = 40
SIZES = [(1, 24), (2, 48), (4, 72), (6, 96), (8, 120), (11, 144), (13, 168), (15, 192), (16, 216)]
"""FreeForm's modes of a cube, and the unknowns of its system."""


def grasp(
    body: ReducedBody,
    moduli: Sequence[float] = (1.0e5,),
    *,
    options: SolverReducedOptions | None = None,
    device: str = "cpu",
) -> Scene:
    """Return worlds, one per Young's modulus, each with a cube on the ground between two fingers."""

    def populate(world: newton.ModelBuilder) -> None:
        add_gripper(world, 0.5 * EDGE)
        add_reduced_body(world, body, material=Material(friction=0.8), position=(0.0, 0.0, 0.5 * EDGE + 1.0e-4))

    scene = Scene(
        populate,
        [body],
        coupled=True,
        gravity=(0.0, 0.0, -GRAVITY),
        ground=0.8,
        world_count=len(moduli),
        options=options,
        device=device,
    )
    scene.set_parameter("youngs_modulus", moduli)
    return scene


def drive(scene: Scene, step: int) -> None:
    """Drive the fingers of every world together, and lift them when they press."""
    squeeze = GRIPPER["squeeze"] * min((step + 1) / RAMP, 1.0)
    target = np.array([1.0e-3 * max(step - RAMP, 0), squeeze, squeeze], np.float32)
    scene.control.joint_target_q.assign(np.tile(target, scene.model.world_count))


def close(scene: Scene, steps: int = STEPS) -> dict[str, np.ndarray]:
    """Close the fingers and lift; return where everything is and what presses."""
    for step in range(steps):
        drive(scene, step)
        scene.step()
    return results(scene)


def results(scene: Scene) -> dict[str, np.ndarray]:
    """Return coordinates of soft bodies and joints, and the force on the fingers [N], world by world."""
    worlds = scene.model.world_count
    arrays = {
        "q": scene.state.softmode.q,
        "qd": scene.state.softmode.qd,
        "joint_q": scene.state.joint_q,
        "joint_qd": scene.state.joint_qd,
        "force": scene.reduced.body_wrench,
    }
    found = {name: array.numpy().reshape(worlds, -1).copy() for name, array in arrays.items()}
    fingers = scene.reduced.body_wrench.numpy().reshape(worlds, -1, 6)[:, 1:, 1]
    assert (np.abs(fingers) > 1.0).all()
    return found


def test_captured_graph_equals_eager() -> None:
    """Replays of a graph of two steps, with targets that are written between them, give the bits of launches."""
    eager = grasp(cube(EDGE))
    for step in range(0, STEPS, 2):
        drive(eager, step)
        eager.step(2)
    captured = grasp(cube(EDGE))
    replay = captured.capture()
    for step in range(0, STEPS, 2):
        drive(captured, step)
        replay()
    expected = results(eager)
    for name, value in results(captured).items():
        np.testing.assert_array_equal(value, expected[name])


def test_worlds_equal_a_world_alone() -> None:
    """World i of five, each of another stiffness, has the bits of that world alone."""
    moduli = [1.0e4, 1.0e5, 3.0e5, 1.0e6, 1.0e7]
    together = close(grasp(cube(EDGE), moduli))
    for i, modulus in enumerate(moduli):
        for name, value in close(grasp(cube(EDGE), [modulus])).items():
            np.testing.assert_array_equal(together[name][i], value[0], err_msg=f"{name} of {modulus:.0e} Pa")


def solved(scene: Scene, *, one_launch: bool, shared: bool) -> dict[str, np.ndarray]:
    """Close the fingers with one launch per step or one per phase, the systems in shared memory or not."""
    tables = scene.reduced.tables
    system = tables.system
    size = (3 * tables.layout.stride, system.scalars.shape[2]) if shared else ()
    kernel = newton_kernel(system.unit.dtype, *size, team=tables.world_team)  # as the solver compiles it
    scene.reduced.tables = dataclasses.replace(tables, one_launch=one_launch, shared=shared, fused_kernel=kernel)
    if scene.model.device.is_cuda:
        compile_launches(lambda: scene.step(1), scene.model.device)
        scene.restart()
    found = close(scene)
    assert not scene.reduced.status.numpy().any()
    return found


def agree(found: dict[str, np.ndarray], expected: dict[str, np.ndarray], place: float) -> None:
    """Assert that places agree to a fraction of the size, and forces to a thousandth."""
    for name in ("q", "joint_q"):
        np.testing.assert_allclose(found[name], expected[name], atol=place * EDGE)
    np.testing.assert_allclose(found["force"], expected["force"], atol=1.0e-3 * np.abs(expected["force"]).max())


@pytest.mark.parametrize(
    ("mode_count", "size"),
    rest_but([SIZES[0], SIZES[-1]], SIZES),
)
def test_one_launch_equals_launches_per_phase(mode_count: int, size: int) -> None:
    """From 24 to 216 unknowns, with systems in global memory, they end with the same bits."""
    scenes = [grasp(cube(EDGE, mode_count)) for _ in range(2)]
    assert 3 * scenes[0].reduced.tables.layout.stride == size
    apart, at_once = (
        solved(scene, one_launch=flag, shared=False) for scene, flag in zip(scenes, (False, True), strict=True)
    )
    for name, value in apart.items():
        np.testing.assert_array_equal(at_once[name], value)


@pytest.mark.parametrize(
    ("mode_count", "size"), [SIZES[0], *(pytest.param(*given, marks=pytest.mark.slow) for given in SIZES[1:])]
)
def test_shared_memory_agrees_with_launches_per_phase(mode_count: int, size: int) -> None:
    """The code of the fast path, run by one thread, solves in single precision and another order: 1e-6 of the size.

    It is compiled anew for each size, in some fifteen seconds on a core.
    """
    apart, shared = (solved(grasp(cube(EDGE, mode_count)), one_launch=flag, shared=flag) for flag in (False, True))
    agree(shared, apart, 1.0e-6)


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a GPU")
@pytest.mark.parametrize(("mode_count", "size"), SIZES)
def test_no_capacity_cliff_on_cuda(mode_count: int, size: int) -> None:
    """One launch with shared memory, without it, and a launch per phase end as a CPU does, to 1e-4 of the size.

    Up to 168 unknowns are taken in one launch; what is larger falls back to launches per phase, and a note says so.
    """
    body = cube(EDGE, mode_count)
    expected = close(grasp(body))
    given = grasp(body, device="cuda:0").reduced
    assert given.tables.one_launch == given.tables.shared == (size <= 168)
    for one_launch, shared in [(False, False), (True, False), (True, True)] if size <= 168 else [(False, False)]:
        agree(solved(grasp(body, device="cuda:0"), one_launch=one_launch, shared=shared), expected, 1.0e-4)
    if size <= 168:
        assert given.notes == ()
    else:
        (note,) = given.notes
        assert note.startswith(f"systems of {size} unknowns take a launch per phase")


def test_more_contacts_than_capacity_set_their_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight contacts where more touch: the bit of that world alone, every step finite; with room there is none."""
    monkeypatch.setattr(step_tables, "sample_room", lambda *_: 0)  # which refuses so few
    few = grasp(cube(EDGE), [1.0e5, 1.0e5], options=SolverReducedOptions(contact_max=8))
    enough = grasp(cube(EDGE), [1.0e5])
    seen = 0
    for step in range(STEPS):
        for scene in (few, enough):
            drive(scene, step)
            scene.step()
        seen |= int(few.reduced.status.numpy()[0])
        assert not enough.reduced.status.numpy().any()
        assert few.reduced.view.constraints.count.numpy().max() <= 8
    assert enough.reduced.view.constraints.count.numpy().max() > 8
    assert seen & bits.WORLD_CONTACT_OVERFLOW
    assert not seen & bits.WORLD_NOT_FINITE
    assert "contact_overflow (raise contact_max)" in bits.status_reasons(seen, remedies=True)
    assert np.isfinite(few.state.softmode.q.numpy()).all() and np.isfinite(few.state.joint_q.numpy()).all()
