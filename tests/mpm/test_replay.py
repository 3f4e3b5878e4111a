"""A replay is the run itself, and points ride as particles do."""

from __future__ import annotations

import numpy as np
import pytest

from softmode.errors import ConfigError
from softmode.mpm import MorphOptions, morph, replay
from tests.mpm.scenes import ball, torus

OPTIONS = MorphOptions(frame_count=20)


def test_a_replay_is_the_run_and_points_ride_as_particles_do() -> None:
    """Particles end every segment where the run has them, to the bit; so do points that began on them.

    The gradient of the motion at such a point is what F of an unsmoothed particle would be: positive, and not that of
    the run, of which smoothing keeps little.
    """
    source, targets = ball(2.9), [torus(3.5, 1.4), ball(3.1)]
    run = morph(source, targets, OPTIONS, device="cpu")
    frames = list(replay(run, source, targets, OPTIONS, points=source.positions[::7], stride=5, device="cpu"))
    assert [frame.step for frame in frames] == list(range(0, 41, 5))
    assert [frame.target for frame in frames] == [0] * 5 + [1] * 4
    for frame in frames[::2]:
        assert np.array_equal(frame.particles, run.positions[frame.step // 10])
        assert np.array_equal(frame.points, frame.particles[::7])
    assert (np.linalg.det(frames[-1].gradients) > 0.0).all()
    moved = frames[-1].gradients - np.eye(3)
    assert np.linalg.norm(moved) > 3.0 * np.linalg.norm(run.deformation[-1][::7] - np.eye(3))
    # Where masses are right nothing is left, and the mean falls on the way to a target.
    assert frames[4].residual.mean() < frames[0].residual.mean()


def test_a_replay_is_of_its_run() -> None:
    """Other bodies and strides that do not divide a segment are named."""
    source, target = ball(2.9), torus(3.5, 1.4)
    run = morph(source, target, MorphOptions(frame_count=10), device="cpu")
    with pytest.raises(ConfigError, match="particles and 1 targets"):
        next(replay(run, ball(2.0), target, device="cpu"))
    with pytest.raises(ConfigError, match="stride"):
        next(replay(run, source, target, stride=3, device="cpu"))
