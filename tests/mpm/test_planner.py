"""Morphs: the loss falls, worlds are independent, failures keep what was reached."""

from __future__ import annotations

import numpy as np
import pytest

from softmode.errors import ConfigError
from softmode.mpm import MorphOptions, MorphPlanner, morph
from tests.mpm.scenes import ball, torus


def test_ball_becomes_a_torus() -> None:
    """A hundred frames with an eighth of the paper's particles take away 70 % of the loss, falling in every segment."""
    run = morph(ball(6.93, 1.0), torus(7.0, 3.2, 1.0), MorphOptions(frame_count=100), device="cpu")
    assert (np.diff(run.losses) < 0.0).all()
    assert run.accuracy > 0.7
    assert run.positions.shape == (11, ball(6.93, 1.0).count, 3)


def test_worlds_are_planned_alike_alone_and_together() -> None:
    """Two morphs side by side have the bits that each has alone, other line searches notwithstanding."""
    target = torus(3.5, 1.4)
    bodies = [ball(2.6), ball(2.9)]
    options = MorphOptions(frame_count=30)
    together = MorphPlanner(bodies, target, options, device="cpu").run()
    for body, run in zip(bodies, together, strict=True):
        alone = MorphPlanner(body, target, options, device="cpu").run()[0]
        assert np.array_equal(alone.positions, run.positions)
        assert np.array_equal(alone.losses, run.losses)


def test_stops_at_the_accuracy_asked_for() -> None:
    """A morph ends with the segment that reaches its accuracy."""
    options = MorphOptions(frame_count=400, target_accuracy=0.2)
    run = morph(ball(6.93, 1.0), torus(7.0, 3.2, 1.0), options, device="cpu")
    assert run.accuracy >= 0.2
    assert 1.0 - run.losses[-2] / run.losses[0] < 0.2


def test_line_search_never_accepts_a_rise() -> None:
    """With a step a hundred times too long the loss does not rise within a segment."""
    target, body = torus(3.5, 1.4), ball(2.9)
    planner = MorphPlanner(body, target, MorphOptions(frame_count=10, step_length=1.0), device="cpu")
    still = MorphPlanner(body, target, MorphOptions(frame_count=10, step_length=1e-12), device="cpu")
    assert planner.run()[0].losses[-1] <= still.run()[0].losses[-1] * (1.0 + 1e-6)


def test_notes_of_unequal_masses() -> None:
    """Masses that differ by more than 30 % are told."""
    planner = MorphPlanner(ball(3.0), ball(2.0), MorphOptions(), device="cpu")
    assert any("masses differ" in note for note in planner.notes)


def test_bad_options() -> None:
    """Options out of range are named."""
    with pytest.raises(ConfigError, match="target_accuracy"):
        MorphOptions(target_accuracy=1.5)
    with pytest.raises(ConfigError, match="frame_count"):
        MorphOptions(frame_count=0)


def test_a_morph_that_fails_keeps_what_it_reached() -> None:
    """A body thrown at the border of the grid ends with its last good segment, a warning and a note."""
    body = ball(3.0)
    planner = MorphPlanner(body, torus(3.5, 1.4), MorphOptions(frame_count=60), device="cpu")
    planner.simulation.start(v=np.tile([150.0, 0.0, 0.0], (1, body.count, 1)))
    with pytest.warns(RuntimeWarning, match="left the grid"):
        run = planner.run()[0]
    assert 2 <= len(run.losses) < 7
    assert np.isfinite(run.positions).all()
    assert "ended after" in run.notes[-1]
