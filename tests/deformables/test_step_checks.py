"""What a step, a reset and an attachment refuse, each with a remedy."""

from types import SimpleNamespace

import newton
import numpy as np
import pytest
import warp as wp

from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.attachments import attach
from softmode.deformables.solver.solver_reduced import SolverReduced
from softmode.errors import ConfigError
from tests.bodies import brick, cube
from tests.scenes import Scene, add_free_box

DT = 1.0 / 240.0


def scene(*, coupled=True, world_count=1):
    """Return a cube at rest, with a free box beside it."""

    def populate(world):
        add_reduced_body(world, cube())
        add_free_box(world, (0.05, 0.05, 0.05), 0.5, (0.5, 0.0, 0.0))

    return Scene(populate, [cube()], coupled=coupled, world_count=world_count)


@pytest.mark.parametrize("coupled", [False, True])
def test_steps_that_are_refused(coupled):
    """A step that is no step, and states and controls of another model: our error, no crash."""
    one, two = scene(coupled=coupled), scene(coupled=coupled, world_count=2)
    model, solver = one.model, one.solver
    a, b, control = model.state(), model.state(), model.control()
    for dt in (0.0, -0.01, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match=r"dt must be a finite number"):
            solver.step(a, b, control, None, dt)
    foreign = two.model.state()
    with pytest.raises(ConfigError, match=r"state_in belongs to another model.*instead of.*model.state"):
        solver.step(foreign, b, control, None, DT)
    with pytest.raises(ConfigError, match=r"state_out belongs to another model"):
        solver.step(a, foreign, control, None, DT)
    with pytest.raises(ConfigError, match=r"state_in belongs to another model"):
        two.solver.step(a, foreign, None, None, DT)
    with pytest.raises(ConfigError, match=r"control belongs to another model"):
        solver.step(a, b, two.model.control(), None, DT)
    rigid = newton.ModelBuilder()
    rigid.add_body()
    with pytest.raises(ConfigError, match=r"state_in holds no reduced body"):
        solver.step(rigid.finalize().state(), b, control, None, DT)
    with pytest.raises(ConfigError, match=r"control holds no reduced body"):
        solver.step(a, b, SimpleNamespace(), None, DT)
    solver.step(a, b, None, None, DT)
    assert np.isfinite(b.particle_q.numpy()).all()


@pytest.mark.parametrize(
    "mask", [[True, False], wp.array([True], dtype=wp.bool), wp.array([1, 0], dtype=wp.int32)], ids=str
)
def test_masks_that_are_refused(mask):
    """A mask of another shape or type is refused by reset, release and hold."""
    kept = []

    def populate(world):
        instance = add_reduced_body(world, cube())
        kept.append(attach(world, instance, cube(), box=((-1.0,) * 3, (1.0,) * 3)))

    solver: SolverReduced = (it := Scene(populate, [cube()])).solver
    for call in (
        lambda: solver.reset(it.model.state(), mask),
        lambda: solver.release(kept[0], mask),
        lambda: solver.hold(kept[0], mask),
    ):
        with pytest.raises(ConfigError, match=r"world_mask must be a wp.array of wp.bool"):
            call()


def test_attachments_of_other_bodies_are_refused():
    """An index that no soft body has, a body that the index does not belong to, and points outside the body."""
    world, everything = newton.ModelBuilder(), ((-1.0,) * 3, (1.0,) * 3)
    with pytest.raises(ConfigError, match=r"it has 0.*add_reduced_body"):
        attach(world, 0, cube(), box=everything)
    instance = add_reduced_body(world, cube())
    with pytest.raises(ConfigError, match=r"got 5; it has 1"):
        attach(world, 5, cube(), box=everything)
    with pytest.raises(ConfigError, match=r"is not of body 'brick'"):
        attach(world, instance, brick(), box=everything)
    for far in (5.0, np.nan):
        with pytest.raises(ConfigError, match=r"1 of 2 points lie outside body 'cube 0.1'.*rest frame"):
            attach(world, instance, cube(), points=np.array([[0.0, 0.0, 0.0], [far, 0.0, 0.0]]))


def test_the_joint_solve_reports_and_releases():
    """Status, iterations, release and hold of the joint solve are those of the reduced solver inside."""
    kept = []

    def populate(world):
        link = add_free_box(world, (0.05, 0.05, 0.02), 0.5, (0.0, 0.0, 0.07))
        instance = add_reduced_body(world, cube())
        kept.append(attach(world, instance, cube(), link=link, box=((-1.0, -1.0, 0.045), (1.0, 1.0, 1.0))))

    it = Scene(populate, [cube()], coupled=True)
    solver = it.solver
    assert solver.status is solver.reduced.status and solver.iteration is solver.reduced.iteration
    stiffness = it.model.softmode.pin_stiffness
    held = stiffness.numpy().copy()
    assert (held > 0.0).all()
    solver.release(kept[0])
    assert (stiffness.numpy() <= 0.0).all()
    solver.hold(kept[0])
    np.testing.assert_array_equal(stiffness.numpy(), held)
