"""`Splats`: validation, covariances and rigid transforms, colour included."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from softmode.errors import AssetError, ConfigError
from softmode.splats import Splats
from softmode.splats.splats import (
    multiply_quats,
    quats_from_rotations,
    rotations_from_quats,
    sh_basis,
)

FLOAT32 = np.finfo(np.float32).eps


def random_splats(count: int = 50, seed: int = 0, coefficients: int = 4) -> Splats:
    """Return splats with random values in all fields."""
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.normal(size=(count, 3)),
        quats=rng.normal(size=(count, 4)),
        scales=rng.uniform(0.01, 0.1, size=(count, 3)),
        opacities=rng.uniform(0.1, 1.0, size=count),
        sh=0.3 * rng.normal(size=(count, coefficients, 3)),
    )


def fields(splats: Splats) -> dict[str, np.ndarray]:
    """Return writable copies of the arrays."""
    return {name: getattr(splats, name).copy() for name in ("means", "quats", "scales", "opacities", "sh")}


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("means", np.nan),
        ("means", np.inf),
        ("quats", np.nan),
        ("scales", 0.0),
        ("scales", -1.0),
        ("scales", np.nan),
        ("opacities", 1.5),
        ("opacities", -0.1),
        ("sh", np.nan),
    ],
)
def test_bad_number_names_field_count_and_remedy(field: str, value: float) -> None:
    """One bad number anywhere is refused with the field, how many splats have it, and a remedy."""
    arrays = fields(random_splats())
    arrays[field].reshape(50, -1)[7, 0] = value
    with pytest.raises(AssetError, match=rf"toy\.ply: {field} of 1 of 50 splats .*first: splat 7.*\. Remove"):
        Splats(**arrays, name="toy.ply")


@pytest.mark.parametrize(
    ("field", "shape"),
    [
        ("means", (50, 2)),
        ("quats", (50, 3)),
        ("scales", (49, 3)),
        ("opacities", (50, 1)),
        ("sh", (50, 3)),
        ("sh", (50, 5, 3)),
    ],
)
def test_bad_shape_names_field(field: str, shape: tuple[int, ...]) -> None:
    """A field of the wrong shape is refused by name."""
    arrays = fields(random_splats()) | {field: np.ones(shape)}
    with pytest.raises(AssetError, match=field):
        Splats(**arrays)


def test_refuses_zero_quaternion_overflow_text_and_nothing() -> None:
    """A quaternion of length zero, float32 overflow, text and an empty asset are refused."""
    arrays = fields(random_splats())
    with pytest.raises(AssetError, match="length zero"):
        Splats(**arrays | {"quats": np.zeros((50, 4))})
    with pytest.raises(AssetError, match="means"):
        Splats(**arrays | {"means": np.full((50, 3), 1e300)})
    with pytest.raises(AssetError, match="no array of numbers"):
        Splats(**arrays | {"means": np.array(["x"])})
    with pytest.raises(AssetError, match="holds no splats"):
        random_splats().subset(np.zeros(50, dtype=bool))


def test_arrays_are_copies_float32_and_read_only() -> None:
    """Later changes of the input do not reach the splats, nor can they be written."""
    arrays = fields(random_splats())
    splats = Splats(**arrays)
    arrays["means"][:] = 0.0
    assert splats.means.any() and splats.means.dtype == np.float32
    with pytest.raises(ValueError, match="read-only"):
        splats.means[0] = 0.0


def test_covariance_is_r_s2_rt() -> None:
    """Sigma = R diag(s^2) R^T, against SciPy's rotations."""
    splats = random_splats()
    r = Rotation.from_quat(splats.quats.astype(np.float64)).as_matrix()
    expected = r @ (splats.scales.astype(np.float64)[:, :, None] ** 2 * r.transpose(0, 2, 1))
    np.testing.assert_allclose(splats.covariances(), expected, atol=1e-12)


@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_quaternions_agree_with_scipy(seed: int) -> None:
    """Matrix to quaternion, back, and product, near half turns too."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(8, 3))
    angle = rng.choice([0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi, 3.0], size=(8, 1))
    r = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis, axis=1, keepdims=True))
    q = quats_from_rotations(r.as_matrix())
    np.testing.assert_allclose(rotations_from_quats(q), r.as_matrix(), atol=1e-12)
    product = rotations_from_quats(multiply_quats(q, q[::-1]))
    np.testing.assert_allclose(product, (r * r[::-1]).as_matrix(), atol=1e-12)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_transform_moves_gaussians_and_turns_colour(coefficients: int) -> None:
    """X' = s R x + t, Sigma' = s^2 R Sigma R^T, and the colour seen along R d equals the old colour along d."""
    splats = random_splats(coefficients=coefficients)
    r = Rotation.from_rotvec([0.7, -1.1, 0.4]).as_matrix()
    t = np.array([1.0, -2.0, 0.5])
    moved = splats.transformed(r, t, 2.5)
    np.testing.assert_allclose(moved.means, 2.5 * splats.means @ r.T + t, atol=20 * FLOAT32)
    np.testing.assert_allclose(moved.covariances(), 2.5**2 * r @ splats.covariances() @ r.T, atol=20 * FLOAT32)
    d = np.random.default_rng(3).normal(size=(40, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    before = np.einsum("mk,nkc->nmc", sh_basis(d, coefficients), splats.sh)
    after = np.einsum("mk,nkc->nmc", sh_basis(d @ r.T, coefficients), moved.sh)
    np.testing.assert_allclose(after, before, atol=100 * FLOAT32)


def test_transform_refuses_what_is_no_rotation() -> None:
    """A mirror, a scaled matrix, a wrong shape and a bad scale are refused."""
    for matrix in (np.diag([1.0, 1.0, -1.0]), 2.0 * np.eye(3), np.eye(2)):
        with pytest.raises(ConfigError, match="rotation"):
            random_splats().transformed(matrix)
    with pytest.raises(ConfigError, match="scale"):
        random_splats().transformed(scale=0.0)


@pytest.mark.parametrize("up", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_oriented_brings_the_axis_to_z(up) -> None:
    """The asset axis `up` ends as +Z, by a proper rotation."""
    arrays = fields(random_splats(1))
    axis = np.zeros(3)
    axis["xyz".index(up[1])] = 1.0 if up[0] == "+" else -1.0
    arrays["means"][0] = axis
    np.testing.assert_allclose(Splats(**arrays).oriented(up).means[0], [0.0, 0.0, 1.0], atol=FLOAT32)


def test_oriented_refuses_unknown_axis() -> None:
    """The message lists the choices."""
    with pytest.raises(ConfigError, match=r"\+x, -x"):
        random_splats().oriented("up")  # type: ignore[arg-type]


def test_crop_bounds_degree_and_colors() -> None:
    """Crops keep what lies inside; quantiles ignore outliers; degree 0 keeps the mean colour."""
    splats = random_splats(500)
    low, high = np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, np.inf])
    inside = splats.cropped(low, high)
    assert 0 < inside.count < 500 and (inside.bounds() >= [low, low]).all() and (inside.bounds()[1] <= high).all()
    assert (splats.bounds(quantile=0.05)[1] < splats.bounds()[1]).all()
    assert splats.with_sh_degree(0).sh.shape == (500, 1, 3) and splats.sh_degree == 1
    np.testing.assert_array_equal(splats.with_sh_degree(0).colors(), splats.colors())
