"""The inverse map: from places back to rest points, on bars bent and twisted, folded, in worlds and in graphs."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from softmode.deformables import (
    InverseMap,
    SolverReduced,
    add_reduced_body,
)
from softmode.deformables.contact.dents import dent_weights
from softmode.deformables.tools.inverse_map import FOLDED, FOUND, OUTSIDE
from softmode.errors import ConfigError
from tests.bodies import cube, long_bar
from tests.scenes import Scene

SIZE = (1.0, 0.2, 0.2)
LENGTH = float(np.linalg.norm(SIZE))


def bent(x, angle):
    """Return points of the bar bent about Y to an arc of an angle [rad]."""
    turn, radius = angle * x[:, 0], 1.0 / angle - x[:, 2]
    return np.stack([np.sin(turn) * radius, x[:, 1], 1.0 / angle - np.cos(turn) * radius], axis=1)


def twisted(x, angle):
    """Return points of the bar twisted about X by an angle from end to end [rad]."""
    c, s = np.cos(angle * x[:, 0]), np.sin(angle * x[:, 0])
    return np.stack([x[:, 0], c * x[:, 1] - s * x[:, 2], s * x[:, 1] + c * x[:, 2]], axis=1)


def coordinates(moved, *parameters):
    """Return the coordinates of the bar that are nearest to a deformation."""
    return long_bar().project(lambda x: moved(x, *parameters) - x)


def places(q, count=2000, *, share=1.0):
    """Return random rest points of the bar, or of its middle, and where coordinates take them."""
    rest = share * np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3)) * SIZE
    return rest, rest + long_bar().evaluate(rest)[0] @ q


def map_of(q, **options) -> InverseMap:
    """Return the inverse map of the bar at coordinates."""
    made = InverseMap(None, long_bar(), device="cpu", **options)
    made.move(wp.array(q, dtype=wp.vec3d, device="cpu"))
    return made


DEFORMED = {"bent": (bent, np.pi / 2), "twisted": (twisted, np.pi)}


@pytest.mark.parametrize("name", DEFORMED)
def test_round_trip(name):
    """x(X) back to X: 2e-4 L in the mean square from 24 nodes, 1e-6 L at most with the true step."""
    q = coordinates(*DEFORMED[name])
    rest, moved = places(q)
    inverse = map_of(q)
    found, flags = inverse.rest_points(moved)
    assert (flags == FOUND).all()
    error = np.linalg.norm(found - rest, axis=1)
    assert np.sqrt((error**2).mean()) < 2e-4 * LENGTH
    exact, flags = inverse.rest_points(moved, q=q)
    assert np.linalg.norm(exact - rest, axis=1).max() < 1e-6 * LENGTH


def test_places_have_dents():
    """Under a dent of 4 mm in a bent bar rest points of what one sees are found to 0.2 mm in the mean square.

    With the true step to 0.05 mm. A map that knows nothing of the dent is off by 0.5 mm, both ways.
    """
    q, body = coordinates(*DEFORMED["bent"]), long_bar()
    samples = body.surface.points
    near = np.exp(-((samples - [0.1, 0.0, 0.1]) ** 2).sum(axis=1) / 0.15**2) * (samples[:, 2] > 0.09)
    dent = (4e-3 * near[:, None] * [0.3, 0.0, -1.0]).astype(np.float32)
    rest, moved = places(q)
    left = dent_weights(body, rest)
    moved = moved + np.einsum("nk,nkd->nd", left.weights, dent[left.samples])
    inverse, errors = InverseMap(None, body, device="cpu"), []
    for given in (dent, None):
        on_device = None if given is None else wp.array(given, dtype=wp.vec3, device="cpu")
        inverse.move(wp.array(q, dtype=wp.vec3d, device="cpu"), on_device)
        for step in ({}, {"q": q, "dent": given}):
            found, flags = inverse.rest_points(moved, **step)
            assert (flags == FOUND).all()
            errors.append(np.sqrt(((found - rest) ** 2).sum(axis=1).mean()))
    assert errors[0] < 2e-4 and errors[1] < 5e-5 and min(errors[2:]) > 5e-4


def offset_by_warp(slope, bend, moved):
    """Return d with (slope + bend d / 2) d = moved by Newton's iteration; slope (3, 3), bend (3, 3, 3), moved (3,)."""
    d = np.zeros(3)
    for _ in range(20):
        d = d - np.linalg.solve(slope + bend @ d, slope @ d + 0.5 * (bend @ d) @ d - moved)
    return d


def test_matrix_of_the_papers_warp():
    """Rest offsets from a neighbour X_k, A d = x(X) - x(X_k): A = F + grad F d / 2 is exact to the third order in d.

    Feng et al. 2024, equations 19 to 21, print A = grad u + grad F d / 2, which loses d itself: it is zero at rest.
    """
    q, step = coordinates(*DEFORMED["bent"]), 1e-4
    rest, moved = places(q, 20, share=0.8)
    gradient = lambda x: np.einsum("nkj,ki->nij", long_bar().evaluate(x)[1], q)  # noqa: E731
    F = np.eye(3) + gradient(rest)
    shifts = step * np.eye(3)
    bend = np.stack([(gradient(rest + s) - gradient(rest - s)) / (2.0 * step) for s in shifts], axis=-1)
    errors = []
    for reach in (0.01, 0.005):  # halved from 0.02 on the error falls by 5.6, 6.7 and 7.3
        away = reach * np.random.default_rng(1).uniform(-1.0, 1.0, rest.shape)
        there = rest + away
        apart = there + long_bar().evaluate(there)[0] @ q - moved
        found = [offset_by_warp(*row) for row in zip(F, bend, apart, strict=True)]
        errors.append(np.linalg.norm(np.array(found) - away, axis=1).max())
    assert errors[0] < 1e-3 * LENGTH and errors[1] < errors[0] / 6.0
    quadratic = 0.5 * np.einsum("nija,na->nij", bend, away)
    right, printed = (np.einsum("nij,nj->ni", A + quadratic, away) - apart for A in (F, F - np.eye(3)))
    assert np.linalg.norm(right, axis=1).max() < 0.01 * np.linalg.norm(away, axis=1).min()
    np.testing.assert_allclose(printed, -away, atol=np.abs(right).max() * (1.0 + 1e-9))


def test_affine_motion_is_exact():
    """Under x = A X + t the lattice interpolates exactly: float32 rounding of places a metre away."""
    matrix = np.array([[1.2, 0.3, 0.0], [-0.2, 0.9, 0.1], [0.1, 0.0, 1.1]])
    q = long_bar().affine(matrix, (0.5, -1.0, 0.7))
    rest, moved = places(q)
    found, flags = map_of(q).rest_points(moved)
    assert (flags == FOUND).all()
    np.testing.assert_allclose(found, rest, atol=20 * np.finfo(np.float32).eps)


def test_nodes_of_the_grid():
    """Every node of the grid that has a rest point is where the body takes that point, to 3e-3 L."""
    q = coordinates(bent, np.pi / 2)
    grid = map_of(q, turns=True).grid
    size = np.array(grid.size.numpy()[0])
    index = np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), axis=-1).reshape(-1, 3)
    place = grid.low.numpy()[0] + grid.edge.numpy()[0] * index
    flag, rest = grid.flag.numpy()[0, : len(index)], grid.rest.numpy()[0, : len(index)].astype(float)
    known = (flag == FOUND) & long_bar().covers(rest)
    assert known.sum() > 1000
    back = rest[known] + long_bar().evaluate(rest[known])[0] @ q
    assert np.linalg.norm(back - place[known], axis=1).max() < 3e-3 * LENGTH
    # the rotation of F: that of the arc
    middle = known & (np.abs(rest) < (0.4, 0.1, 0.1)).all(axis=1)
    x, y, z, w = grid.turn.numpy()[0, : len(index)][middle].T
    np.testing.assert_allclose(2.0 * np.arctan2(y, w), -np.pi / 2 * rest[middle, 0], atol=0.05)
    assert np.abs(np.stack([x, z])).max() < 0.05


def test_outside():
    """Places off the body have no rest point, also within its box, and are given back."""
    q = coordinates(bent, np.pi / 2)
    off = np.array([[0.0, 0.0, 0.4], [3.0, 0.0, 0.0], [0.0, 0.5, 0.1]])
    found, flags = map_of(q).rest_points(off)
    assert (flags == OUTSIDE).all()
    np.testing.assert_array_equal(found, off)


def test_folds_are_flagged():
    """A bar bent by 400 degrees lies in itself: where it does there are two rest points. A mirrored bar is folded."""
    q = coordinates(bent, 400 / 360 * 2 * np.pi)
    rest, moved = places(q)
    flags = map_of(q).rest_points(moved)[1]
    ends, middle = np.abs(rest[:, 0]) > 0.47, np.abs(rest[:, 0]) < 0.3
    assert (flags[ends] == FOLDED).mean() > 0.8
    assert (flags[middle] == FOUND).mean() > 0.95
    mirror = long_bar().affine(np.diag([1.0, 1.0, -1.0]))
    assert (map_of(mirror).rest_points(places(mirror)[1])[1] == FOLDED).all()


def test_worlds_and_graphs():
    """World i of three is the single world, and a captured frame is the eager one, to the bit."""
    states = [coordinates(bent, 0.7), coordinates(twisted, 1.0), long_bar().affine(np.eye(3), (0.0, 2.0, 0.0))]
    together = InverseMap(None, long_bar(), world_count=3, device="cpu")
    q = wp.array(np.concatenate(states), dtype=wp.vec3d, device="cpu")
    together.move(q)
    for i, state in enumerate(states):
        alone = map_of(state)
        assert together.grid.size.numpy()[i].tolist() == alone.grid.size.numpy()[0].tolist()
        for name in ("flag", "rest", "low"):
            np.testing.assert_array_equal(getattr(together.grid, name).numpy()[i], getattr(alone.grid, name).numpy()[0])
        rest, moved = places(state, 200)
        np.testing.assert_allclose(together.rest_points(moved, world=i)[0], rest, atol=1e-3)
    kept = together.grid.rest.numpy().copy()
    with wp.ScopedCapture(device="cpu") as capture:
        together.move(q)
    together.grid.rest.zero_()
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(together.grid.rest.numpy()[together.grid.flag.numpy() > 0],
                                  kept[together.grid.flag.numpy() > 0])  # fmt: skip


def test_bodies_of_a_solver():
    """With a solver the body is named by its index in a world; it follows the state."""
    thing = cube()

    def populate(world) -> None:
        add_reduced_body(world, thing, position=(0.0, 0.0, 0.5))
        add_reduced_body(world, thing, position=(0.5, 0.0, 0.5), scale=2.0)

    scene = Scene(populate, [thing], world_count=2)
    assert isinstance(scene.solver, SolverReduced)
    inverse = InverseMap(scene.solver, 1)
    inverse.update(scene.state)
    rest = np.random.default_rng(0).uniform(-0.04, 0.04, (50, 3))
    for world in (0, 1):
        found, flags = inverse.rest_points((0.5, 0.0, 0.5) + 2.0 * rest, world=world)
        assert (flags == FOUND).all()
        np.testing.assert_allclose(found, rest, atol=1e-6)
    with pytest.raises(ConfigError, match="no world has a body 2"):
        InverseMap(scene.solver, 2)


def box_distance(x):
    """Return the signed distance to the bar at rest."""
    away = np.abs(x) - 0.5 * np.array(SIZE)
    return np.linalg.norm(np.maximum(away, 0.0), axis=1) + np.minimum(away.max(axis=1), 0.0)


def test_signed_distance_and_picking():
    """Across a stretched, shifted bar: z distances doubled with the stretch; rays stop at its top and at its bend."""
    q = long_bar().affine(np.diag([1.0, 1.0, 2.0]), (0.0, 0.0, 1.0))
    inverse = map_of(q)
    height = np.array([1.05, 1.15, 1.21])
    x = np.stack([np.full(3, 0.1), np.zeros(3), height], axis=1)
    np.testing.assert_allclose(inverse.signed_distance(x[1:], box_distance), height[1:] - 1.2, atol=2e-3)
    assert inverse.signed_distance([[0.0, 0.0, 3.0]], box_distance)[0] == np.inf
    found = inverse.pick((0.1, 0.02, 3.0), (0.0, 0.0, -2.0), box_distance)
    assert found is not None
    np.testing.assert_allclose(found[0], (0.1, 0.02, 1.2), atol=1e-3)
    np.testing.assert_allclose(found[1], (0.1, 0.02, 0.1), atol=1e-3)
    assert inverse.pick((0.1, 0.5, 3.0), (0.0, 0.0, -1.0), box_distance) is None
    q = coordinates(bent, np.pi / 2)
    found = map_of(q).pick((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), box_distance)
    assert found is not None
    np.testing.assert_allclose(found[1], (0.0, 0.0, 0.1), atol=5e-3)


def test_states_that_are_no_numbers():
    """A body that is nowhere has no rest points."""
    q = np.full((long_bar().function_count, 3), np.nan)
    assert (map_of(q).rest_points(np.zeros((3, 3)))[1] == OUTSIDE).all()


def test_bad_input():
    """What cannot be is refused by name."""
    with pytest.raises(ConfigError, match="nodes"):
        InverseMap(None, long_bar(), nodes=2)
    with pytest.raises(ConfigError, match="within"):
        InverseMap(None, long_bar(), within=lambda x: np.zeros(len(x), dtype=bool), device="cpu")
    with pytest.raises(ConfigError, match="solver"):
        InverseMap(None, 0)
    inverse = map_of(long_bar().affine(np.eye(3)))
    with pytest.raises(ConfigError, match="points"):
        inverse.rest_points([[0.0, np.inf, 0.0]])
    one, two = (wp.zeros((1, n), dtype=wp.vec3, device="cpu") for n in (1, 2))
    with pytest.raises(ConfigError, match="shapes"):
        inverse.find(one, two, wp.zeros((1, 1), dtype=int, device="cpu"))


@pytest.mark.gpu
def test_cuda_agrees():
    """CUDA gives the rest points of the CPU to float32 rounding."""
    q = coordinates(bent, np.pi / 2)
    moved = places(q)[1]
    made = InverseMap(None, long_bar(), device="cuda:0")
    made.move(wp.array(q, dtype=wp.vec3d, device="cuda:0"))
    np.testing.assert_allclose(made.rest_points(moved)[0], map_of(q).rest_points(moved)[0], atol=1e-5)
