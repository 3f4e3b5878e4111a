"""The procedural plush: a closed, graspable, standing shell."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from softmode.errors import ConfigError
from softmode.splats import Splats, make_plush, plush_bounds, plush_signed_distance
from softmode.splats.splats import rotations_from_quats

HEIGHT = 0.08


@pytest.fixture(scope="module")
def plush() -> Splats:
    """The default plush."""
    return make_plush()


def test_same_seed_same_bytes() -> None:
    """The plush is a function of its arguments."""
    first, again, other = make_plush(500, 3), make_plush(500, 3), make_plush(500, 4)
    for field in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(first, field), getattr(again, field))
    assert not np.array_equal(first.means, other.means)


def test_size_fits_the_gripper(plush: Splats) -> None:
    """It is `height` high, stands on z = 0 and is narrower than an 80 mm stroke in both directions."""
    low, high = plush.bounds()
    assert plush.count == 4000
    assert abs(low[2]) < 1e-5 and abs(high[2] - HEIGHT) < 0.01 * HEIGHT
    assert (high - low)[:2].max() < 0.062
    box = plush_bounds()
    assert (low >= box[0] - 1e-5).all() and (high <= box[1] + 1e-5).all()


def test_splats_lie_on_the_surface_and_face_outward(plush: Splats) -> None:
    """|sdf(mean)| is a hundredth of the height at most; the thin axis is normal to the surface."""
    x = plush.means.astype(np.float64)
    assert np.abs(plush_signed_distance(x)).max() < 1e-3 * HEIGHT
    step = 1e-3 * HEIGHT
    normal = rotations_from_quats(plush.quats)[:, :, 2]
    outward = plush_signed_distance(x + 5 * step * normal) - plush_signed_distance(x - 5 * step * normal)
    assert (outward > 0.0).mean() > 0.99


def test_shell_is_closed(plush: Splats) -> None:
    """Every surface point has a splat nearer than twice the mean spacing: no holes."""
    fine = make_plush(6000, seed=9)
    spacing = np.sqrt(4 * np.pi * (0.4 * HEIGHT) ** 2 / plush.count)
    distance = KDTree(plush.means).query(fine.means)[0]
    assert distance.max() < 2.0 * spacing


def test_signed_distance_scales_and_has_volume() -> None:
    """d(s x; s h) = s d(x; h); the inside is a fifth of the bounding box at least, and the outside of it is outside."""
    box = plush_bounds()
    x = np.random.default_rng(0).uniform(box[0], box[1], size=(20_000, 3))
    d = plush_signed_distance(x)
    np.testing.assert_allclose(plush_signed_distance(3 * x, 3 * HEIGHT), 3 * d, rtol=1e-12, atol=1e-15)
    assert 0.2 < (d < 0).mean() < 0.6
    assert (plush_signed_distance(x + np.array([0.0, 0.0, HEIGHT])) > 0).all()


def test_stands_on_its_base(plush: Splats) -> None:
    """The centre of mass lies well over the flat base, so the plush does not tip over."""
    box = plush_bounds()
    x = np.random.default_rng(0).uniform(box[0], box[1], size=(100_000, 3))
    center = x[plush_signed_distance(x) < 0].mean(axis=0)
    means = plush.means
    base = means[means[:, 2] < 0.01 * HEIGHT, :2]
    reach = 0.1 * HEIGHT
    assert (base.min(axis=0) < center[:2] - reach).all() and (base.max(axis=0) > center[:2] + reach).all()
    assert center[2] < 0.45 * HEIGHT


@pytest.mark.parametrize("arguments", [{"count": 10}, {"height": 0.0}, {"height": float("nan")}])
def test_refuses_bad_sizes(arguments: dict[str, float]) -> None:
    """Too few splats or a height that is none are refused."""
    with pytest.raises(ConfigError):
        make_plush(**arguments)  # type: ignore[arg-type]
