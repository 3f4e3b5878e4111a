"""Grasps of twenty shapes, captures and presets: antipodal, inside the opening, clear of all around; and refusals."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.errors import ConfigError, GraspError
from softmode.objects import ObjectConfig
from softmode.objects.pipeline import standing_quadrature
from softmode.objects.source import object_source
from softmode.robots import ArmDescription, Grasp, ParallelJaw, plan_grasps
from softmode.robots.grasp_planner import DEPTH, MARGIN
from tests.captures import CAPTURES
from tests.marks import rest_but
from tests.shapes import SHAPES, box, sample_surface

Array = NDArray[np.float64]

JAW = ParallelJaw.of(ArmDescription())
FRICTION = 0.8
SIZE = 0.08
"""Longest edge of every shape [m]."""
NAMES = [name for name in SHAPES if name not in ("plate 40:1", "bunny", "bear") and "," not in name] + [
    "star, splats",
    "L-shape, points",
]
OBJECTS = {f"{name}, capture": name for name in ("thin neck", "mug", "ground beneath")} | {
    f"{name}, preset": name for name in ("cable", "glove", "mug")
}
"""Captures as they are filled, and presets at their own size."""
DEAR = {"hand", "gyroid", "star, splats", "mug, capture", "thin neck, capture", "ground beneath, capture"}
"""Shapes that take more than two seconds each."""


@functools.cache
def surface(name: str, count: int = 400) -> tuple[Array, Array, Array]:
    """Return points, normals and areas of a shape of 80 mm, or of an object, that stands on the table."""
    if name in OBJECTS:
        given: dict[str, Any] = {"preset": OBJECTS[name]}
        if name.endswith("capture"):
            capture = CAPTURES[OBJECTS[name]]
            given = {"splat": capture.scene(), **capture.options}
        config = ObjectConfig(surface_count=count, **given)
        found = standing_quadrature(config, object_source(config))[0]
        at = found.surface_points - [*found.surface_points[:, :2].mean(axis=0), found.surface_points[:, 2].min()]
        return at, found.surface_normals, found.surface_areas
    shape = SHAPES[name]
    if shape.source in ("implicit", "splats", "points"):
        found = shape.quadrature(surface_count=count)
        points, normals, areas = found.surface_points, found.surface_normals, found.surface_areas
    else:
        points, normals = sample_surface(*shape.geometry(), count)
        areas = np.full(count, 1.0 / count)
    scale = SIZE / np.ptp(points, axis=0).max()
    points = scale * points
    points = points - [*points[:, :2].mean(axis=0), points[:, 2].min()]
    return points, normals, areas / areas.sum() * 0.02


def block(edges: Any, count: int = 400, turn: float = 0.0) -> tuple[Array, Array, Array]:
    """Return points, normals and areas of a block with `edges` [m] on the table, turned about the vertical."""
    vertices, faces = box(edges)
    points, normals = sample_surface(vertices + np.array([0.0, 0.0, 0.5 * edges[2]]), faces, count)
    turned = Rotation.from_euler("z", turn)
    area = 2.0 * (edges[0] * edges[1] + edges[1] * edges[2] + edges[2] * edges[0])
    return turned.apply(points), turned.apply(normals), np.full(count, area / count)


def local(points: Array, grasp: Grasp) -> Array:
    """Return points in the frame of a grasp: across the fingers, along the closing axis, up."""
    return Rotation.from_euler("z", -grasp.yaw).apply(points - np.array(grasp.position))


def check(points: Array, normals: Array, areas: Array, grasp: Grasp, jaw: ParallelJaw = JAW) -> None:
    """Look at every sample, one by one, beside the pads of a grasp."""
    cone = np.arctan(FRICTION)
    assert grasp.width + 2.0 * MARGIN <= grasp.opening + 1e-12 <= jaw.opening + 2e-12
    assert grasp.position[2] - jaw.tip >= MARGIN - 1e-12
    x, n = local(points, grasp), Rotation.from_euler("z", -grasp.yaw).apply(normals)
    between = (abs(x[:, 0]) <= 0.5 * jaw.pad_width + 1e-9) & (abs(x[:, 2]) <= 0.5 * jaw.pad_length + 1e-9)
    assert np.ptp(x[between, 1]) == pytest.approx(grasp.width)
    sides = []
    for side, contact in zip((1.0, -1.0), local(np.array(grasp.contacts), grasp), strict=True):
        pressed = between & (side * x[:, 1] >= 0.5 * grasp.width - min(DEPTH, 0.25 * grasp.width) - 1e-9)
        weight = areas * pressed * np.maximum(side * n[:, 1], 0.0)
        mean = weight @ n / np.linalg.norm(weight @ n)
        assert np.arccos(np.clip(side * mean[1], -1.0, 1.0)) <= cone
        np.testing.assert_allclose(weight @ x / weight.sum(), contact, atol=1e-9)
        assert weight.sum() >= grasp.area - 1e-12
        sides.append(contact)
    way = sides[0] - sides[1]
    assert np.arccos(way[1] / np.linalg.norm(way)) <= cone
    assert 0.0 <= grasp.angle <= cone and 0.0 < grasp.score <= 1.0
    # The fingers come straight down: nothing of the object is in the way of either, and nothing under the palm.
    above = x[:, 2] > -jaw.tip
    for side in (1.0, -1.0):
        out = side * x[:, 1]
        finger = (abs(x[:, 0]) < 0.5 * jaw.finger_width) & (out > 0.5 * grasp.opening) & above
        assert not (finger & (out < 0.5 * grasp.opening + jaw.thickness)).any()
    palm = (abs(x[:, 0]) <= jaw.palm[0]) & (abs(x[:, 1]) <= jaw.palm[1])
    assert (x[palm, 2] <= jaw.reach - jaw.tip - MARGIN + 1e-9).all()


@pytest.mark.parametrize(
    "name", rest_but({*NAMES, *OBJECTS} - DEAR, [*NAMES, *OBJECTS], slow=["mug, capture", "thin neck, capture"])
)
def test_shapes_are_grasped_within_friction_opening_and_room(name: str) -> None:
    """Every grasp of a shape is antipodal, fits the opening, hits neither table nor object; equal calls agree."""
    points, normals, areas = surface(name)
    found = plan_grasps(points, normals, areas, JAW, friction=FRICTION)
    assert 1 <= len(found) <= 5 and [g.score for g in found] == sorted((g.score for g in found), reverse=True)
    for grasp in found:
        check(points, normals, areas, grasp)
    assert plan_grasps(points, normals, areas, JAW, friction=FRICTION) == found


def test_there_are_twenty_shapes() -> None:
    """As many as the suite says."""
    assert len(NAMES) >= 20


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.3, 2.5])
def test_a_block_is_taken_across_its_narrow_side(turn: float) -> None:
    """A block of 90 x 30 x 40 mm is taken across the 30 mm, within 6 degrees, at its middle."""
    grasp = plan_grasps(*block((0.09, 0.03, 0.04), turn=turn), JAW, weight=1.0, friction=FRICTION)[0]
    off = np.remainder(grasp.yaw - turn + 0.5 * np.pi, np.pi) - 0.5 * np.pi
    assert abs(off) < np.radians(6.0)
    assert grasp.width == pytest.approx(0.03, abs=0.003)
    assert np.hypot(*grasp.position[:2]) < 0.012
    assert JAW.tip + MARGIN <= grasp.position[2] < 0.035


def test_the_hand_turns_as_little_as_it_can() -> None:
    """Of the two turns that are half a turn apart the one near the present yaw is chosen."""
    things = block((0.09, 0.03, 0.04))
    for yaw in (-1.4, 0.2, 3.0):
        assert abs(plan_grasps(*things, JAW, yaw=yaw)[0].yaw - yaw) <= 0.5 * np.pi + 1e-9


def test_a_tall_post_is_taken_below_the_palm() -> None:
    """The palm keeps its margin from the top of a post of 150 mm, whose middle the fingers do not reach."""
    grasp = plan_grasps(*block((0.03, 0.03, 0.15)), JAW)[0]
    assert 0.15 + MARGIN - 1e-9 <= grasp.position[2] - JAW.tip + JAW.reach < 0.15 + 0.5 * JAW.pad_length


def test_a_heavy_bar_is_taken_at_its_centre_of_mass() -> None:
    """The heavier, the nearer; a bar whose mass lies at one end is taken there."""
    points, normals, areas = block((0.30, 0.04, 0.04))
    for centre in (-0.1, 0.0, 0.08):
        given = {"centre": (centre, 0.0, 0.02), "weight": 10.0, "force": 12.0}
        assert abs(plan_grasps(points, normals, areas, JAW, **given)[0].position[0] - centre) < 0.02


def test_what_yields_is_avoided() -> None:
    """Of two equal ends the stiff one is taken: modes in which samples with x > 0 give way by a centimetre a newton."""
    points, normals, areas = block((0.12, 0.04, 0.04))
    modes = np.zeros((len(points), 3, 1))
    modes[points[:, 0] > 0.0, 1, 0] = 0.1 * np.sign(points[points[:, 0] > 0.0, 1])
    assert plan_grasps(points, normals, areas, JAW, modes=modes)[0].position[0] < -0.01
    assert plan_grasps(points, normals, areas, JAW, modes=modes * [[-1.0]])[0].position[0] < -0.01


def test_obstacles_keep_fingers_away() -> None:
    """Walls along the sides of a block force the fingers to its ends; walls all around are told."""
    points, normals, areas = block((0.05, 0.03, 0.04))
    span = np.linspace(-0.06, 0.06, 60)
    height = np.linspace(0.0, 0.05, 20)
    beside = [np.array([x, side * 0.024, z]) for x in span for z in height for side in (-1.0, 1.0)]
    grasp = plan_grasps(points, normals, areas, JAW, obstacles=beside)[0]
    assert abs(np.cos(grasp.yaw)) < 0.3
    check(points, normals, areas, grasp)
    before = [np.array([side * 0.034, y, z]) for y in span for z in height for side in (-1.0, 1.0)]
    with pytest.raises(GraspError, match="no room"):
        plan_grasps(points, normals, areas, JAW, obstacles=[*beside, *before])


@pytest.mark.parametrize(
    ("things", "given", "words"),
    [
        (block((0.12, 0.12, 0.06)), {}, "120 mm wide.*takes 84 mm.*--size times 0.70"),
        (block((0.06, 0.05, 0.002)), {}, "too flat"),
        (surface("cone"), {"friction": 0.05}, "friction"),
        (block((0.12, 0.12, 0.06)), {"friction": 0.0}, "friction"),
        (block((0.05, 0.05, 0.05)), {"count": 0}, "count"),
    ],
)
def test_what_cannot_be_grasped_is_told(things: tuple[Array, Array, Array], given: dict[str, Any], words: str) -> None:
    """Width against opening with the size that fits, flatness, friction; wrong arguments by name."""
    with pytest.raises((GraspError, ConfigError), match=words):
        plan_grasps(*things, JAW, **given)


def test_the_told_size_fits() -> None:
    """What was too wide is grasped once it is as small as the message says."""
    with pytest.raises(GraspError) as caught:
        plan_grasps(*block((0.12, 0.12, 0.06)), JAW)
    factor = float(str(caught.value).rpartition("times ")[2].rstrip("."))
    edges = tuple(0.98 * factor * edge for edge in (0.12, 0.12, 0.06))
    assert plan_grasps(*block(edges), JAW)


def test_arrays_are_checked() -> None:
    """Shapes that do not fit and NaN are refused."""
    points, normals, areas = block((0.05, 0.05, 0.05))
    for broken in ((points[:, :2], normals, areas), (points, normals[1:], areas), (points * np.nan, normals, areas)):
        with pytest.raises(ConfigError, match="points"):
            plan_grasps(*broken, JAW)
