"""Edges and corners of a box that press a cube, against finite elements in three dimensions."""

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from tests.bodies import default_cube
from tests.scenes import Scene

EDGE, MODULUS, PLATE = 0.1, 1.0e5, 0.02
LARGE = 0.3
"""Half extent of the box that presses [m]."""
WEDGE = {0.01: 0.00200, 0.02: 0.00459, 0.03: 0.00745, 0.05: 0.01382}
"""Force over E edge^2 by depth over edge: `benchmarks/edge_elements.py`; coarser elements give 1.5 % more."""
CORNER = {0.02: 0.000203, 0.03: 0.000470, 0.05: 0.00133}
"""The same; meshes differ by 4 %."""


def forces(kind: str, depths: list[float], shift: tuple[float, float]) -> np.ndarray:
    """Return the force [E edge^2] of a box on a cube between its edge or corner and a plate, at depths [edges].

    Args:
        kind: "wedge" or "corner".
        depths: One after the other.
        shift: Where it presses, from the middle of the face [m].
    """
    turn = Rotation.from_euler("y", 45.0, degrees=True)
    if kind == "corner":
        turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], [[1.0, 1.0, 1.0]])[0]
    corners = LARGE * np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    up = -turn.apply(corners)[:, 2].min()

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=MODULUS, density=300.0, friction=0.0, mass_damping=200.0)
        add_reduced_body(world, default_cube(), material=material)
        world.add_shape_box(world.add_body(is_kinematic=True), hx=EDGE, hy=EDGE, hz=PLATE)
        frame = wp.transform(wp.vec3(), wp.quat(*map(float, turn.as_quat())))
        world.add_shape_box(world.add_body(is_kinematic=True), xform=frame, hx=LARGE, hy=LARGE, hz=LARGE)

    scene = Scene(populate, [default_cube()], options=SolverReducedOptions(contact_max=2048), dt=0.01)
    found = []
    for depth in depths:
        scene.restart()
        poses = np.zeros((2, 7), dtype=np.float32)
        poses[:, 6], poses[0, 2] = 1.0, -0.5 * EDGE - PLATE
        poses[1, :3] = *shift, (0.5 - depth) * EDGE + up
        for state in (scene.state, scene.next_state):
            state.body_q.assign(poses)
        scene.step(40)
        assert not scene.reduced.status.numpy().any()
        constraints = scene.reduced.view.constraints
        count = int(constraints.count.numpy()[0])
        below = constraints.shape.numpy()[0, :count] == 0
        found.append(constraints.force.numpy()[0, :count][below, 2].sum())
    return np.array(found) / (MODULUS * EDGE**2)


@pytest.mark.parametrize(
    "shift", [(0.002, 0.001), *(pytest.param(at, marks=pytest.mark.rest) for at in ((0.0, 0.0), (0.0045, -0.003)))]
)
def test_wedge(shift: tuple[float, float]) -> None:
    """An edge of 90 degrees across a cube, 1 to 5 % deep, wherever it lies between the samples: within 15 and 10 %."""
    ratio = forces("wedge", list(WEDGE), shift) / np.array(list(WEDGE.values()))
    assert ratio[0] == pytest.approx(1.0, abs=0.15) and ratio[1:] == pytest.approx(1.0, abs=0.1)


def test_corner() -> None:
    """A corner, 2 to 5 % deep, whose patch lies in one to six cells: on the mean over four places within 20 %.

    Two per cent deep, places differ by 40 %.
    """
    places = [(0.0, 0.0), (0.002, 0.001), (-0.003, 0.002), (0.0045, -0.003)]
    mean = np.mean([forces("corner", list(CORNER), shift) for shift in places], axis=0)
    assert mean / np.array(list(CORNER.values())) == pytest.approx(1.0, abs=0.2)
