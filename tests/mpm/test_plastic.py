"""Plasticity of particles: the return to the yield surface, and what a body does that yields."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.errors import MaterialError
from softmode.mpm import MpmOptions
from softmode.mpm.plastic_kernels import return_to_yield
from tests.mpm.scenes import ball, moving
from tests.mpm.test_kernels import stress

MU, LAM, YIELD = 3.0, 2.0, 0.3


def returned(model: MaterialModel, F: np.ndarray) -> np.ndarray:
    """Return deformation gradients (N, 3, 3) after the flow."""
    rows = [np.full((1, len(F)), value) for value in (1.0, MU, LAM, YIELD)]
    inputs = [wp.array(row, dtype=wp.float64, device="cpu") for row in rows]
    out = wp.array(F[None], dtype=wp.mat33d, device="cpu")
    active = wp.ones(1, dtype=int, device="cpu")
    wp.launch(return_to_yield, (1, len(F)), inputs=[*inputs, int(model), active, out], device="cpu")
    return out.numpy()[0]


@pytest.mark.parametrize("model", list(MaterialModel), ids=lambda m: m.name)
def test_return_to_the_yield_surface(model: MaterialModel) -> None:
    """|dev tau| is sqrt(2/3) times the yield stress, det F stays, both to 1e-12; what is elastic keeps its bits."""
    rng = np.random.default_rng(0)
    F = np.eye(3) + np.tile([0.005, 0.25], 50)[:, None, None] * rng.standard_normal((100, 3, 3))
    F[1::2] = F[1::2] @ np.diag([1.6, 0.7, 0.9])
    F = F[np.linalg.det(F) > 0.3]

    def shear(F: np.ndarray) -> np.ndarray:
        tau = stress(model, F, F)[0]
        return np.linalg.norm(tau - np.trace(tau, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3), axis=(1, 2))

    limit = np.sqrt(2.0 / 3.0) * YIELD
    after, flows = returned(model, F), shear(F) > limit
    assert 20 < flows.sum() < len(F) - 20
    assert np.array_equal(after[~flows], F[~flows])
    np.testing.assert_allclose(shear(after[flows]), limit, rtol=1e-12)
    np.testing.assert_allclose(np.linalg.det(after), np.linalg.det(F), rtol=1e-12)
    np.testing.assert_allclose(returned(model, after), after, rtol=0.0, atol=1e-12)


def test_a_bar_yields_at_its_stress() -> None:
    """Neo-Hookean, free sides: tau_1 - tau_2 = mu (l_1^2 - l_2^2) and tau_2 = 0, up to tau_1 = the yield stress.

    Beyond, however far it is stretched, the elastic stretches are those of the onset.
    """
    from scipy.optimize import brentq

    def side(along: float) -> float:
        return float(brentq(lambda t: MU * (t * t - 1.0) + LAM * np.log(along * t * t), 0.5, 1.5, xtol=1e-15))

    onset = float(brentq(lambda a: MU * (a * a - side(a) ** 2) - YIELD, 1.0, 1.5, xtol=1e-15))
    at = np.diag([onset, side(onset), side(onset)])
    below = np.diag([1.0 + 0.999 * (onset - 1.0)] + [side(1.0 + 0.999 * (onset - 1.0))] * 2)
    flow = [np.diag([a, a**-0.5, a**-0.5]) @ at for a in (1.01, 1.2, 1.5)]  # that of volume stays
    found = returned(MaterialModel.NEO_HOOKEAN, np.stack([below, *flow]))
    assert np.array_equal(found[0], below)
    np.testing.assert_allclose(found[1:], np.broadcast_to(at, (3, 3, 3)), atol=1e-12)


def test_below_its_yield_stress_a_body_has_the_bits_of_an_elastic_one() -> None:
    """What never yields moves as ever; what does, does not."""
    ends = [
        moving(replace(ball(2.2), yield_stress=limit), MpmOptions(), step_count=8) for limit in (None, 1.0e9, 1.0e3)
    ]
    for s in ends:
        s.forward()
    elastic, strong, weak = (s.last.F.numpy() for s in ends)
    assert np.array_equal(elastic, strong) and not np.array_equal(elastic, weak)


def test_a_yield_stress_is_positive() -> None:
    """Zero or less, or no number, is refused with the remedy."""
    for wrong in (0.0, -1.0, float("nan")):
        with pytest.raises(MaterialError, match=r"yield_stress must be .* > 0 Pa.*None for an elastic body"):
            replace(ball(2.2), yield_stress=wrong)
