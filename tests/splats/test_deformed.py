"""Deformed splats: covariance F Sigma F^T back to frames and scales, and colour that turns splat by splat."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from softmode.errors import AssetError, ConfigError
from softmode.splats import Splats, read_splats, write_splats
from softmode.splats.principal_axes import nearest_rotations
from softmode.splats.splats import rotate_sh, rotations_from_quats, sh_basis
from tests.splats.test_splats import random_splats

EPSILON = float(np.finfo(np.float32).eps)


def random_gradients(count: int, seed: int = 0, spread: float = 0.5) -> np.ndarray:
    """Return deformation gradients of positive determinant, rotations of any angle included."""
    turns = Rotation.random(count, rng=np.random.default_rng(seed)).as_matrix()
    stretch = np.random.default_rng(seed + 1).uniform(-spread, spread, size=(count, 3, 3))
    return turns @ (np.eye(3) + (stretch + stretch.transpose(0, 2, 1)) / 4.0)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_rigid_gradients_equal_transformed(coefficients: int) -> None:
    """F = s R for all splats is `transformed`: same means, frames in the same order, scales and colour."""
    splats = random_splats(coefficients=coefficients)
    rotation = Rotation.from_rotvec([0.3, -2.0, 1.1]).as_matrix()
    expected = splats.transformed(rotation=rotation, translation=[1, 2, 3], scale=1.5)
    found = splats.deformed(1.5 * splats.means @ rotation.T + [1, 2, 3], 1.5 * rotation)
    np.testing.assert_allclose(found.means, expected.means, atol=8 * EPSILON)
    np.testing.assert_allclose(found.scales, expected.scales, rtol=8 * EPSILON)
    np.testing.assert_allclose(np.abs((found.quats * expected.quats).sum(axis=1)), 1.0, atol=8 * EPSILON)
    np.testing.assert_allclose(found.sh, expected.sh, atol=16 * EPSILON)
    np.testing.assert_array_equal(found.opacities, splats.opacities)


def test_no_deformation_changes_nothing() -> None:
    """F = I returns the same splats, round ones included."""
    splats = dataclasses.replace(random_splats(coefficients=16), scales=np.full((50, 3), 0.05))
    found = splats.deformed(splats.means, np.eye(3))
    np.testing.assert_allclose(found.covariances(), splats.covariances(), atol=8 * EPSILON * 0.05**2)
    np.testing.assert_allclose(found.sh, splats.sh, atol=8 * EPSILON)


@given(seed=st.integers(0, 2**31), thin=st.floats(-4.0, 0.0))
@settings(max_examples=30, deadline=None)
def test_covariance_is_f_sigma_ft(seed: int, thin: float) -> None:
    """Frames are right-handed and rebuild F Sigma F^T, for discs down to 10^-4 of their width."""
    splats = random_splats(20, seed=seed)
    splats = dataclasses.replace(splats, scales=splats.scales * [1.0, 1.0, 10.0**thin])
    gradients = random_gradients(20, seed)
    found = splats.deformed(splats.means, gradients)
    expected = gradients @ splats.covariances() @ gradients.transpose(0, 2, 1)
    size = np.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(found.covariances() / size, expected / size, atol=16 * EPSILON)
    # The determinant sees the thin axis that the sum above hides: det(F Sigma F^T) = det(F)^2 det(Sigma).
    volume = np.linalg.det(gradients) * splats.scales.astype(np.float64).prod(axis=1)
    np.testing.assert_allclose(found.scales.astype(np.float64).prod(axis=1), volume, rtol=16 * EPSILON)


def test_colour_turns_with_each_splat() -> None:
    """Seen from d, splat n shows what it showed at rest from R_n^T d, R_n the rotation of its F: degrees 1 to 3."""
    splats = random_splats(coefficients=16)
    gradients = random_gradients(50)
    turns = nearest_rotations(gradients)
    found = splats.deformed(splats.means, gradients)
    directions = np.random.default_rng(5).normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for n in range(50):
        shown = sh_basis(directions, 16) @ found.sh[n]
        at_rest = sh_basis(directions @ turns[n], 16) @ splats.sh[n]
        np.testing.assert_allclose(shown, at_rest, atol=64 * EPSILON)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_rotation_per_splat_equals_one_by_one(coefficients: int) -> None:
    """Turning all splats, in blocks, equals turning each with the matrix of its own."""
    count = 9000 if coefficients == 4 else 30  # more than two blocks
    sh = np.random.default_rng(0).normal(size=(count, coefficients, 3))
    turns = Rotation.random(count, rng=np.random.default_rng(1)).as_matrix()
    together = rotate_sh(sh, turns)
    for n in (0, 1, count // 2, count - 1):
        np.testing.assert_allclose(together[n], rotate_sh(sh[n : n + 1], turns[n])[0], atol=8 * EPSILON)


def test_nearest_rotation_of_turned_stretch() -> None:
    """The polar factor of R U is R, and that of an inverted gradient is still a proper rotation."""
    turns = Rotation.random(20, rng=np.random.default_rng(3)).as_matrix()
    stretch = np.array([[1.2, 0.1, 0.0], [0.1, 0.8, 0.05], [0.0, 0.05, 1.0]])
    np.testing.assert_allclose(nearest_rotations(turns @ stretch), turns, atol=1e-14)
    inverted = nearest_rotations(turns @ np.diag([1.0, 1.0, -0.1]))
    np.testing.assert_allclose(np.linalg.det(inverted), 1.0, atol=1e-14)
    np.testing.assert_allclose(inverted, turns, atol=1e-14)


def test_covariances_from_skinning_give_the_same() -> None:
    """Covariances and rotations in float32, as skinning leaves them, give what the gradients give."""
    splats = random_splats(coefficients=9)
    gradients = random_gradients(50)
    expected = splats.deformed(splats.means, gradients)
    sigma = gradients @ splats.covariances() @ gradients.transpose(0, 2, 1)
    found = splats.with_covariances(splats.means, sigma.astype(np.float32), nearest_rotations(gradients))
    size = sigma.max()
    np.testing.assert_allclose(found.covariances() / size, expected.covariances() / size, atol=16 * EPSILON)
    np.testing.assert_allclose(found.sh, expected.sh, atol=16 * EPSILON)
    six = sigma.astype(np.float32)[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    quats = Rotation.from_matrix(nearest_rotations(gradients)).as_quat().astype(np.float32)
    rows = splats.with_covariances(splats.means, six, quats)
    np.testing.assert_allclose(rows.covariances() / size, expected.covariances() / size, atol=16 * EPSILON)
    np.testing.assert_allclose(rows.sh, expected.sh, atol=32 * EPSILON)
    still = splats.with_covariances(splats.means, splats.covariances(), [[0.0, 0.0, 0.0, 1.0]])
    np.testing.assert_allclose(still.sh, splats.sh, atol=16 * EPSILON)
    with pytest.raises(ConfigError, match="length zero") as caught:
        splats.with_covariances(splats.means, six, 0.0 * quats)
    assert "skinning" in caught.value.hint


def test_axes_follow_a_slow_deformation() -> None:
    """Over a twist of small steps no splat's quaternion jumps, though the order of its singular values changes."""
    splats = dataclasses.replace(random_splats(200), scales=np.tile([0.02, 0.05, 0.12], (200, 1)))
    previous = splats
    for angle in np.linspace(0.0, np.pi, 31)[1:]:
        twist = angle * splats.means[:, 2].astype(np.float64)
        c, s, zero, one = np.cos(twist), np.sin(twist), np.zeros(200), np.ones(200)
        turn = np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]).transpose(2, 0, 1)
        found = splats.deformed(np.einsum("nij,nj->ni", turn, splats.means), turn)
        step = 2.0 * np.arccos(np.clip(np.abs((found.quats * previous.quats).sum(axis=1)), 0.0, 1.0))
        assert step.max() <= np.pi / 30.0 * np.abs(splats.means[:, 2]).max() + 0.01
        previous = found


def test_flattened_splats_stay_solid() -> None:
    """A gradient of rank two leaves a disc of a millionth of its width; one of rank zero is refused."""
    splats = random_splats(5)
    flat = splats.deformed(splats.means, np.diag([1.0, 1.0, 0.0]))
    np.testing.assert_allclose(flat.scales.min(axis=1), 1e-6 * flat.scales.max(axis=1), rtol=8 * EPSILON)
    with pytest.raises(AssetError, match="scales"):
        splats.deformed(splats.means, np.zeros((3, 3)))


@pytest.mark.parametrize("value", [np.eye(2), np.zeros((4, 3, 3)), np.full((3, 3), np.nan)])
def test_wrong_gradients_are_refused(value: np.ndarray) -> None:
    """Arrays of another shape, and NaN, are refused with the shape that was expected."""
    splats = random_splats(5)
    with pytest.raises(ConfigError, match=r"\(5, 3, 3\)"):
        splats.deformed(splats.means, value)
    for means in (splats.means[:3], np.full((5, 3), np.inf)):
        with pytest.raises(ConfigError, match=r"means must be finite and of shape \(5, 3\)"):
            splats.deformed(means, np.eye(3))


@pytest.mark.parametrize("suffix", [".ply", ".usda"])
def test_deformed_object_is_saved(tmp_path, suffix: str) -> None:
    """A deformed object written and read again is the deformed object."""
    if suffix == ".usda":
        pytest.importorskip("pxr", reason="needs the extra [usd]")
    splats = random_splats(coefficients=16)
    found: Splats = splats.deformed(splats.means, random_gradients(50))
    write_splats(tmp_path / f"a{suffix}", found)
    again = read_splats(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(again.means, found.means)
    np.testing.assert_array_equal(again.sh, found.sh)
    np.testing.assert_allclose(rotations_from_quats(again.quats), rotations_from_quats(found.quats), atol=8 * EPSILON)
