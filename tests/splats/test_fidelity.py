"""Deformed splats against a dense cloud of the same object, moved point by point and drawn four times as large."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.splat_fidelity import (
    SPACING,
    Motion,
    Moved,
    bar_body,
    bend,
    psnr,
    rest,
    rip,
    sample_bar,
    scatter,
    shear,
    spikes,
    twist,
)
from softmode.splats import Splats

SIZE, OVERSAMPLING = 128, 4


@pytest.fixture(scope="module")
def bar() -> Splats:
    """The bar as an asset."""
    return sample_bar(SPACING)


@pytest.fixture(scope="module")
def dense() -> Splats:
    """The bar as a cloud, a third of a pixel apart."""
    return sample_bar(0.0008)


def truth(motion: Motion, dense: Splats) -> np.ndarray:
    """Draw the cloud."""
    cloud = Moved.by(motion, dense, averaged=False)
    return cloud.draw(SIZE, stretch_limit=np.inf, oversampling=OVERSAMPLING)


@pytest.mark.parametrize("motion", [bend(np.pi / 2), bend(np.pi), twist(np.pi), shear(1.0), shear(3.0)])
def test_deformation_costs_no_fidelity(bar: Splats, dense: Splats, motion: Motion) -> None:
    """F Sigma F^T reaches 30 dB, and what the splats reach undeformed to half a decibel; no spikes."""
    floor = psnr(Moved.by(rest, bar).draw(SIZE), truth(rest, dense))
    picture, expected = Moved.by(motion, bar).draw(SIZE), truth(motion, dense)
    assert psnr(picture, expected) >= max(30.0, floor - 0.5)
    assert spikes(picture, expected) == 0.0
    assert psnr(Moved.by(rest, bar).draw(SIZE), expected) < 27.0, "the motion can be seen"


def test_reduced_body_costs_no_fidelity(bar: Splats) -> None:
    """The same with the functions of a body of 16 modes, in truth and frame: 30 dB in bend and twist."""
    values, cloud = bar_body(16).values, sample_bar(0.0015)
    asset, points = Moved(bar, values), Moved(cloud, values, averaged=False)
    for motion in (bend(np.pi), twist(np.pi)):
        q = asset.fit(motion)
        moved = bar.means + asset.basis @ q
        assert np.sqrt(((moved - motion(bar.means.astype(float))) ** 2).sum(axis=1).mean()) < 5e-4, "it is that motion"
        expected = points.draw(SIZE, q, stretch_limit=np.inf, oversampling=2)
        assert psnr(asset.draw(SIZE, q), expected) >= 30.0


def test_tears_draw_no_spikes(dense: Splats) -> None:
    """A seam of 1 mm under splats of 4 mm: F at the centre draws spikes across the picture, averaged functions none."""
    motion, coarse = rip(0.03, 0.0005, 2), sample_bar(0.008)
    expected = truth(motion, dense)
    assert spikes(Moved.by(motion, coarse).draw(SIZE), expected) == 0.0
    assert spikes(Moved.by(motion, coarse, averaged=False).draw(SIZE, stretch_limit=np.inf), expected) > 0.1


def test_limit_is_a_guard(bar: Splats, dense: Splats) -> None:
    """Spikes of F at the centre, as of a failed step, shrink with the limit."""
    motion = rip(0.03, 0.002, 2)
    moved, expected = Moved.by(motion, bar, averaged=False), truth(motion, dense)
    assert spikes(moved.draw(SIZE, stretch_limit=np.inf), expected) > 0.001
    assert spikes(moved.draw(SIZE, stretch_limit=4.0), expected) == 0.0


def test_averaging_closes_gaps(bar: Splats, dense: Splats) -> None:
    """A seam that opens: averaged functions stretch the splats across it, those at the centres leave a hole."""
    motion = rip(0.03, 0.0005)
    expected = truth(motion, dense)
    averaged, centred = (psnr(Moved.by(motion, bar, averaged=a).draw(SIZE), expected) for a in (True, False))
    assert averaged >= 30.0 > centred


def test_scattered_splat_lets_the_same_light_through() -> None:
    """Clouds drawn from one splat have its alpha on average, to a tenth: the sum of Gaussians is its depth."""
    one = Splats(
        means=np.zeros((1, 3)),
        quats=[[0.3, 0.1, -0.2, 0.9]],
        scales=[[0.05, 0.03, 0.02]],
        opacities=[0.9],
        sh=np.full((1, 1, 3), -2.0),
    )
    whole = Moved.by(rest, one).draw(64)
    clouds = np.mean([Moved.by(rest, scatter(one, 32, seed)).draw(64) for seed in range(40)], axis=0)
    # Randomness lets a little more light through than the sum does, and the cut at 1/255 takes the small splats' rims.
    assert np.abs(whole - clouds).max() < 0.12
    assert np.isclose((whole.max() - whole).sum(), (whole.max() - clouds).sum(), rtol=0.1)
