"""Edges and corners of a box that press a cube, against finite elements in three dimensions."""

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from softmode.deformables.contact.ridge_kernels import RIDGE
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from tests import reference
from tests.bodies import cube, default_cube
from tests.deformables.probe_kernels import evaluate_ridges
from tests.scenes import Scene

EDGE, MODULUS, PLATE = 0.1, 1.0e5, 0.02
LARGE = 0.3
"""Half extent of the box that presses [m]."""
WEDGE = {0.01: 0.00200, 0.02: 0.00459, 0.03: 0.00745, 0.05: 0.01382}
"""Force over E edge^2 by depth over edge: `benchmarks/edge_elements.py`; coarser elements give 1.5 % more."""
CORNER = {0.02: 0.000203, 0.03: 0.000470, 0.05: 0.00133}
"""The same; meshes differ by 4 %."""
PLACES = ((0.0, 0.0), (0.002, 0.001), (-0.003, 0.002), (0.0045, -0.003))
"""Where it presses, from the middle of the face [m]."""


class Edged:
    """A cube between a plate and an edge or a corner of a box, without friction.

    Args:
        kind: "wedge" or "corner".
    """

    def __init__(self, kind: str) -> None:
        """Build the scene."""
        turn = Rotation.from_euler("y", 45.0, degrees=True)
        if kind == "corner":
            turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], [[1.0, 1.0, 1.0]])[0]
        corners = LARGE * np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
        self.up = -turn.apply(corners)[:, 2].min()

        def populate(world: newton.ModelBuilder) -> None:
            material = Material(youngs_modulus=MODULUS, density=300.0, friction=0.0, mass_damping=200.0)
            add_reduced_body(world, default_cube(), material=material)
            world.add_shape_box(world.add_body(is_kinematic=True), hx=EDGE, hy=EDGE, hz=PLATE)
            frame = wp.transform(wp.vec3(), wp.quat(*map(float, turn.as_quat())))
            world.add_shape_box(world.add_body(is_kinematic=True), xform=frame, hx=LARGE, hy=LARGE, hz=LARGE)

        self.scene = Scene(populate, [default_cube()], dt=0.01)

    def force(self, depth: float, place: tuple[float, float], steps: int = 40) -> float:
        """Go on from what is pressed so far; return the force [E edge^2] at a depth [edges] at a place [m]."""
        poses = np.zeros((2, 7), dtype=np.float32)
        poses[:, 6], poses[0, 2] = 1.0, -0.5 * EDGE - PLATE
        poses[1, :3] = *place, (0.5 - depth) * EDGE + self.up
        for state in (self.scene.state, self.scene.next_state):
            state.body_q.assign(poses)
        self.scene.step(steps)
        assert not self.scene.reduced.status.numpy().any()
        constraints = self.scene.reduced.view.constraints
        count = int(constraints.count.numpy()[0])
        below = constraints.shape.numpy()[0, :count] == 0
        return float(constraints.force.numpy()[0, :count][below, 2].sum()) / (MODULUS * EDGE**2)

    def ratios(self, expected: dict[float, float], place: tuple[float, float]) -> np.ndarray:
        """Return forces over those expected by depth, each from a cube at rest."""
        found = []
        for depth in expected:
            self.scene.restart()
            found.append(self.force(depth, place))
        return np.array(found) / np.array(list(expected.values()))


def test_a_face_hardly_wider_than_a_cell() -> None:
    """Two fingers of 25 mm on a cube with cells of 20 mm press alike, about their middles, wherever samples lie.

    Forces within 5 % of their mean, centres of pressure within 2 mm. With whole cells, pressed where their samples
    are, one to four of them count.
    """
    half = 0.0125

    def populate(world: newton.ModelBuilder) -> None:
        material = Material(youngs_modulus=MODULUS, density=300.0, friction=0.0, mass_damping=50.0)
        add_reduced_body(world, cube(), material=material)
        for _ in range(2):
            world.add_shape_box(world.add_body(is_kinematic=True), hx=half, hy=half, hz=PLATE)

    scene, found = Scene(populate, [cube()], dt=0.01), []
    for place in ((0.0, 0.0), (0.004, 0.007), (-0.009, 0.003), (0.01, 0.01)):
        scene.restart()
        poses = np.zeros((2, 7), dtype=np.float32)
        poses[:, :2], poses[:, 2], poses[:, 6] = place, (0.5 * EDGE + PLATE - 0.001) * np.array([-1.0, 1.0]), 1.0
        for state in (scene.state, scene.next_state):
            state.body_q.assign(poses)
        scene.step(40)
        constraints = scene.reduced.view.constraints
        count = int(constraints.count.numpy()[0])
        force, arm = constraints.force.numpy()[0, :count, 2], constraints.arm.numpy()[0, :count, :2]
        up = force > 0.0
        found.append(force[up].sum())
        centre = force[up] @ arm[up] / force[up].sum()
        assert np.abs(centre).max() < 0.002, (place, centre)
    np.testing.assert_allclose(found, np.mean(found), rtol=0.05)


def test_wedge() -> None:
    """An edge of 90 degrees across a cube, 1 to 5 % deep, wherever it lies between the samples."""
    edged = Edged("wedge")
    ratios = np.array([edged.ratios(WEDGE, place) for place in PLACES])
    assert ratios.mean(axis=0) == pytest.approx(1.0, abs=0.1)
    assert ratios == pytest.approx(1.0, abs=0.2)


@pytest.mark.rest
def test_corner() -> None:
    """A corner, 2 to 5 % deep, on the mean over four places: 0.1, also where its patch lies in one cell."""
    edged = Edged("corner")
    mean = np.mean([edged.ratios(CORNER, place) for place in PLACES], axis=0)
    assert mean == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("kind", ["corner", pytest.param("wedge", marks=pytest.mark.rest)])
def test_along_a_path(kind: str) -> None:
    """3 % deep at places 1 mm apart: mean within 0.1, places within 0.2; neighbours differ by 0.1, of an edge by 0.12.

    Samples pass outside of a second face of a corner there.
    """
    edged, expected = Edged(kind), {0.03: (CORNER if kind == "corner" else WEDGE)[0.03]}
    places = np.outer(np.arange(-6.0e-3, 6.5e-3, 1.0e-3), np.array([1.0, 0.4]) / np.hypot(1.0, 0.4))
    ratios = np.array([edged.ratios(expected, (x, y))[0] for x, y in places])
    assert ratios.mean() == pytest.approx(1.0, abs=0.1)
    assert ratios == pytest.approx(1.0, abs=0.2)
    leaps = np.abs(np.diff(ratios)) / np.minimum(ratios[1:], ratios[:-1])
    assert leaps.max() < (0.1 if kind == "corner" else 0.12)


def cells(count: int, least: float, dent: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Return what cells beside edges are, sides from ``least`` to 10 mm and dents in m, and what is evaluated of it."""
    rng = np.random.default_rng(0)
    half, side = rng.uniform(0.005, 0.03, (count, 3)), rng.uniform(least, 0.01, count).astype(np.float32)
    x = np.where(rng.random((count, 3)) < 0.5, -1.0, 1.0) * (half + rng.uniform(-1, 1, (count, 3)) * side[:, None])
    inward, front = rng.normal(size=(count, 3)), rng.uniform(0.2, 1.0, count)
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    inputs = [wp.array(value, dtype=wp.vec3d, device="cpu") for value in (half, x, inward)]
    inputs += [wp.array(value, dtype=float, device="cpu") for value in (side, np.full(count, dent))]
    out = wp.zeros(count, dtype=wp.vec3d, device="cpu")
    front_of = wp.array(front, dtype=wp.float64, device="cpu")
    wp.launch(evaluate_ridges, dim=count, inputs=[*inputs, front_of], outputs=[out], device="cpu")
    return [half, x, inward, side.astype(float) ** 2, out.numpy()[:, 2], front], out.numpy()


def test_ridges() -> None:
    """Length and depth of edges in 200 cells are those of the twin, edge by edge: on all, and some have edges."""
    given, found = cells(200, 0.003, 0.0)
    expected = [reference.ridge_in_cell(*one) for one in zip(*given, strict=True)]
    assert 20 < np.count_nonzero(found[:, 0]) < 180
    np.testing.assert_allclose(found[:, 2], 0.85 * np.sqrt(given[3]), rtol=1.0e-6)
    np.testing.assert_allclose(found[:, :2], expected, rtol=2.0e-3, atol=1.0e-5)  # of 2,001 points along an edge


def test_an_edge_is_no_stiffer_than_a_face() -> None:
    """However small the cells, RIDGE length v / area is less than 1 by what (depth / v)^0.2 grows to at 5 dents v.

    A face is as stiff as 1 at least; cells of a millimetre of a cube of 10 cm would have 2.2.
    """
    dent = 0.00825
    given, found = cells(4000, 1.0e-4, dent)
    assert (float(RIDGE) * dent * found[:, 0] / given[3]).max() < 5.0**-0.2
    assert (float(RIDGE) * dent * found[:, 0] / given[3] * found[:, 2] / (0.85 * np.sqrt(given[3]))).max() > 2.0


def test_torsion() -> None:
    """Two box fingers, pressed in by an eighth of their half width a, stick as rigid squares: 8.3 G a^3 to 0.2.

    What lies under their rims is pressed back, not aside: before they turn, their torque is 2 % of mu F a at most.
    """
    a, mu, depth, twist = EDGE / 6.0, 0.5, 0.02 * EDGE, 0.01

    def populate(world: newton.ModelBuilder) -> None:
        add_reduced_body(
            world, default_cube(), material=Material(youngs_modulus=MODULUS, friction=mu, mass_damping=50.0)
        )
        for _ in range(2):
            config = newton.ModelBuilder.ShapeConfig(mu=mu)
            world.add_shape_box(world.add_body(is_kinematic=True), hx=a, hy=a, hz=PLATE, cfg=config)

    scene = Scene(populate, [default_cube()], dt=0.01)
    torque, pressed = [], 0.0
    for k in range(30):
        angle, rate = (0.0, 0.0) if k < 20 else (twist * min((k - 19) / 5.0, 1.0), 20.0 * twist * (k < 25))
        poses, twists = np.zeros((2, 7), dtype=np.float32), np.zeros((2, 6), dtype=np.float32)
        for side, sign in enumerate((-1.0, 1.0)):
            half = 0.5 * sign * (angle - 0.01 * rate)
            z = sign * (0.5 * EDGE + PLATE - depth)
            poses[side] = -0.004, 0.005, z, 0.0, 0.0, np.sin(half), np.cos(half)  # samples lie under its rim
            twists[side, 5] = sign * rate
        for state in (scene.state, scene.next_state):
            state.body_q.assign(poses)
            state.body_qd.assign(twists)
        scene.step()
        constraints = scene.reduced.view.constraints
        count = int(constraints.count.numpy()[0])
        shape, force, arm = (getattr(constraints, name).numpy()[0, :count] for name in ("shape", "force", "arm"))
        torque.append(float(np.cross(arm, force)[shape == 1, 2].sum()))
        pressed = float(-force[shape == 1, 2].sum())
    assert abs(torque[19]) < 0.02 * mu * pressed * a
    stiffness = 8.3 * MODULUS / 2.6 * a**3
    assert (torque[-1] - torque[19]) / twist == pytest.approx(stiffness, rel=0.2)


def test_an_edge_presses_without_a_jump() -> None:
    """As an edge goes in, no step of the force is twice the mean one, while samples and faces come to touch."""
    edged, deepest, count = Edged("wedge"), 0.04, 40
    down = [edged.force(deepest * k / count, (0.002, 0.001), 8) for k in range(count + 1)]
    assert 0.0 < np.diff(down).min() and np.diff(down).max() < 2.0 * down[-1] / count
