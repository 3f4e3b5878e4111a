"""Device functions of particles: weights of the nodes, and the derivative of stress where stretches are equal."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from softmode.deformables.materials.material_kernels import MaterialModel
from tests.mpm.probe_kernels import press, weigh


def test_weights_sum_to_one_and_their_slopes_to_zero() -> None:
    """sum_k w_k = 1, sum_k w'_k = 0, sum_k k w_k = f and sum_k k w'_k = 1: a linear field and its slope come back."""
    x = np.random.default_rng(0).uniform(-3.0, 3.0, (400, 3))
    x[:3] = 0.3 * np.arange(3)[:, None] - 1.0  # on a node
    weight, slope = (wp.zeros((len(x), 3, 4), dtype=wp.float64, device="cpu") for _ in range(2))
    inputs = [wp.array(x, dtype=wp.vec3d, device="cpu"), wp.vec3d(-1.0, -1.0, -1.0), wp.float64(0.3), weight, slope]
    wp.launch(weigh, len(x), inputs=inputs, device="cpu")
    w, s, at = weight.numpy(), slope.numpy(), np.arange(-1.0, 3.0)
    fraction = (x + 1.0) / 0.3 - np.floor((x + 1.0) / 0.3)
    assert w.min() >= 0.0
    np.testing.assert_allclose(w.sum(axis=2), 1.0, atol=1e-14)
    np.testing.assert_allclose(s.sum(axis=2), 0.0, atol=1e-14)
    np.testing.assert_allclose(w @ at, fraction, atol=1e-14)
    np.testing.assert_allclose(s @ at, 1.0, atol=1e-14)


def stress(model: MaterialModel, F: np.ndarray, bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the Kirchhoff stress at each F and dL/dF from bar, shapes (N, 3, 3)."""
    given = [wp.array(a, dtype=wp.mat33d, device="cpu") for a in (F, bar)]
    out = [wp.zeros(len(F), dtype=wp.mat33d, device="cpu") for _ in range(2)]
    wp.launch(press, len(F), inputs=[int(model), wp.float64(3.0), wp.float64(2.0), *given, *out], device="cpu")
    return out[0].numpy(), out[1].numpy()


@pytest.mark.parametrize("model", [MaterialModel.ARAP, MaterialModel.COROTATED], ids=lambda m: m.name)
@pytest.mark.parametrize("stretches", [(1.0, 1.0, 1.0), (1.3, 1.3, 1.3), (0.7, 1.2, 1.2)])
def test_derivative_of_the_rotation_at_equal_stretches(model: MaterialModel, stretches: tuple[float, ...]) -> None:
    """Where singular values coincide, at rest too, dL/dF is that of central differences: 1e-7 of its size."""
    rng, count = np.random.default_rng(1), 6
    turn = Rotation.random(2 * count, random_state=2).as_matrix()
    F = turn[:count] @ turn[count:] @ np.diag(stretches) @ turn[count:].transpose(0, 2, 1)
    bar, along = rng.standard_normal((2, count, 3, 3))
    h = 1e-5
    above, below = (stress(model, F + sign * h * along, bar)[0] for sign in (1.0, -1.0))
    expected = (bar * (above - below)).sum(axis=(1, 2)) / (2.0 * h)
    found = (stress(model, F, bar)[1] * along).sum(axis=(1, 2))
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())
