"""A grid that follows its particles: the bits of a large one, and an error where it would take too much memory."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest

from softmode.errors import ConfigError
from softmode.mpm import Grid, MorphOptions, MorphPlanner, MorphRun, MpmOptions, ParticleBody, replay
from softmode.mpm.run import ARRAYS
from tests.marks import rest_but
from tests.mpm.scenes import ball, moving, torus

SMALL = Grid(shape=(20, 20, 20), origin=(-9.3, -10.1, -9.7))
"""Holds the ball and the torus, with few cells to spare; its nodes are at no whole numbers."""
LARGE = replace(SMALL, shape=(75, 44, 44), first=(-12, -12, -12))
TORUS = torus(3.5, 1.4)


def planned(
    grid: Grid,
    motion: Literal["fixed", "follow"],
    targets: list[ParticleBody],
    speed: float = 0.0,
    frame_count: int = 40,
    **mpm: Any,
) -> tuple[MorphPlanner, MorphRun]:
    """Return a morph of a ball that flies along x, and its planner."""
    stepped = replace(MorphOptions().mpm, grid=grid, damping=0.5, **mpm)
    options = MorphOptions(frame_count=frame_count, settling=0.0, grid=motion, mpm=stepped)
    planner = MorphPlanner(ball(2.9), targets, options, device="cpu")
    planner.simulation.start(v=np.tile([speed, 0.0, 0.0], (1, planner.simulation.count, 1)))
    return planner, planner.run()[0]


@pytest.mark.parametrize("speed", rest_but([8.0], [8.0, 60.0]))
def test_a_grid_that_follows_has_the_bits_of_a_large_one(speed: float) -> None:
    """A ball that flies off the grid, on the way to two targets, is where it is on a large grid; so are controls.

    The slow one comes near the border, the fast one lies outside of the first grid at the end.
    """
    targets = [TORUS, ball(3.1).moved((8.0, 0.0, 0.0))]
    small, followed = planned(SMALL, "follow", targets, speed)
    _, fixed = planned(LARGE, "fixed", targets, speed)
    assert small.simulation.options.grid != SMALL
    assert followed.segment_count == fixed.segment_count == 8
    if speed > 10.0:
        assert not SMALL.holds(followed.positions[-1].astype(np.float64)).all()
    for name in ARRAYS:
        assert np.array_equal(getattr(followed, name), getattr(fixed, name)), name
    assert (followed.gradient_count, followed.trial_count) == (fixed.gradient_count, fixed.trial_count)


def test_a_large_grid_of_other_origin_is_the_same_to_rounding() -> None:
    """Where the nodes of a large grid are counted from another origin positions differ by rounding alone."""
    _, followed = planned(SMALL, "follow", [TORUS], 8.0, precision="float64")
    x, y, z = LARGE.low.tolist()
    shifted = Grid(shape=LARGE.shape, origin=(x, y, z))
    _, fixed = planned(shifted, "fixed", [TORUS], 8.0, precision="float64")
    assert np.abs(followed.positions - fixed.positions).max() < 1e-8


def test_a_fixed_grid_ends_where_one_that_follows_goes_on() -> None:
    """The same flight ends early on the small grid, with a warning, and goes on where the grid follows."""
    with pytest.warns(RuntimeWarning, match="left the grid"):
        _, fixed = planned(SMALL, "fixed", [TORUS], 60.0)
    _, followed = planned(SMALL, "follow", [TORUS], 60.0)
    assert fixed.segment_count < followed.segment_count == 4


def test_a_grid_that_moves_keeps_its_graph() -> None:
    """A body that flies far with its target near takes another part of the nodes, and no larger arrays."""
    s = moving(ball(2.9), MpmOptions(grid=SMALL), step_count=4, keep_grids=True)
    arrays = [s._scattered, *(moved.mass for moved in s._grids)]
    s.forward()
    at, speed = s.last.x.numpy(), s.last.v.numpy()
    assert not s.place_grid(replace(SMALL, first=(3, -2, 1)))
    assert all(a is b for a, b in zip(arrays, [s._scattered, *(moved.mass for moved in s._grids)], strict=True))
    s.forward()
    s.check()
    assert np.array_equal(s.last.x.numpy(), at) and np.array_equal(s.last.v.numpy(), speed)
    assert s.place_grid(replace(SMALL, shape=(28, 24, 22), first=(-5, -2, -1)))
    s.forward()
    s.check()
    assert np.array_equal(s.last.x.numpy(), at) and np.array_equal(s.last.v.numpy(), speed)
    with pytest.raises(ConfigError, match="spacing and origin"):
        s.place_grid(replace(SMALL, spacing=0.5))


def test_a_grid_is_moved_before_it_grows() -> None:
    """Points that fit with their room move the grid by whole cells; those that do not get nodes, and some to spare."""
    near = np.array([[-2.0, -2.0, -2.0], [2.0, 2.0, 2.0]])
    away = near + np.array([30.0, 0.0, 0.0])
    assert SMALL.reaching(near, room=4) is SMALL
    far, wide = SMALL.reaching(away, room=4), SMALL.reaching(near, away, room=4)
    assert far.shape == SMALL.shape and far.origin == SMALL.origin and far.first[0] > 20
    assert wide.shape[0] > 30 + 4 + 8 and wide.shape[1:] == SMALL.shape[1:]
    for grid, points in ((far, away), (wide, near), (wide, away)):
        for reach in (-4.0, 4.0):
            assert grid.holds(points + reach).all()


def test_a_grid_that_would_be_too_large_is_refused() -> None:
    """At the start it raises; on the way the run ends with its last good segment, a warning and a note."""
    far = [TORUS.moved((400.0, 300.0, 300.0))]
    with pytest.raises(ConfigError, match="memory_limit: states and a grid of"):
        planned(SMALL, "follow", far)
    with pytest.warns(RuntimeWarning, match="memory_limit: states and a grid"):
        _, run = planned(SMALL, "follow", [TORUS], 60.0, memory_limit=2.0e6)
    assert 0 < run.segment_count < 4 and "memory_limit" in run.notes[-1]
    with pytest.raises(ConfigError, match="grid"):
        MorphOptions(grid="grows")  # type: ignore[arg-type]


def test_a_replay_follows() -> None:
    """A replay of a run that left the first grid ends every segment where the run does."""
    planner, run = planned(SMALL, "follow", [TORUS, ball(3.1).moved((8.0, 0.0, 0.0))])
    frames = list(replay(run, ball(2.9), list(planner.targets), planner.options, stride=10, device="cpu"))
    for frame in frames:
        assert np.array_equal(frame.particles, run.positions[frame.step // 10])
