"""The adjoint of skinning against central differences of the float64 twin of skinning."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from softmode.deformables.skinning.skinning_adjoint import AdjointSkinning
from softmode.deformables.skinning.skinning_kernels import vec6
from softmode.errors import BasisError
from tests.deformables.test_skinning import WORLDS, Case, M, N

SIX = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
PAD = 4


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    """Every device that is there."""
    if request.param != "cpu" and not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return request.param


class Loss:
    """A linear loss of the deformed centres and covariances, and of the rotations of F."""

    def __init__(self, rotations: bool, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        # Weights of about one per length that moves: a metre, and the square of a splat's size.
        self.means = rng.normal(size=(WORLDS, PAD + N, 3)).astype(np.float32).astype(np.float64)
        self.covariances = (1e5 * rng.normal(size=(WORLDS, PAD + N, 6))).astype(np.float32).astype(np.float64)
        self.rotations = rng.normal(size=(WORLDS, N, 3, 3)) if rotations else None

    def value(self, case: Case, limit: float) -> float:
        """Return the loss in float64."""
        x = case.means + np.einsum("nk,wka->wna", case.basis, case.q)
        f = case.gradients()
        u, s, v = np.linalg.svd(f)
        cut = u * np.minimum(s, limit)[..., None, :] @ v
        sigma = cut @ case.covariances @ cut.transpose(0, 1, 3, 2)
        total = (self.means[:, PAD:] * x).sum() + (self.covariances[:, PAD:] * sigma[..., SIX[0], SIX[1]]).sum()
        if self.rotations is not None:
            total += (self.rotations * nearest_rotation(f)).sum()
        return float(total)

    def turned(self, case: Case) -> np.ndarray | None:
        """Return the loss by the rotation vectors: <A, [phi] R>."""
        if self.rotations is None:
            return None
        m = self.rotations @ nearest_rotation(case.gradients()).transpose(0, 1, 3, 2)
        axial = np.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1)
        return np.concatenate([np.zeros((WORLDS, PAD, 3)), axial], axis=1)


def nearest_rotation(f: np.ndarray) -> np.ndarray:
    """Return the proper rotations of the polar decomposition."""
    u, _, v = np.linalg.svd(f)
    u[..., 2] *= np.linalg.det(u @ v)[..., None]
    return u @ v


def backward(case: Case, loss: Loss, device: str, **kwargs: Any) -> np.ndarray:
    """Return dL/dq by the adjoint, shape (WORLDS, M, 3)."""
    q = case.flat(case.q, device)
    loss_q = wp.zeros_like(q)
    turned = loss.turned(case)
    AdjointSkinning(case.skin(device, **kwargs), WORLDS).backward(
        q,
        case.starts(device),
        wp.array(loss.means, dtype=wp.vec3, device=device),
        wp.array(loss.covariances, dtype=vec6, device=device),
        loss_q,
        loss_rotations=None if turned is None else wp.array(turned, dtype=wp.vec3, device=device),
        first_splat=PAD,
    )
    out = loss_q.numpy().reshape(WORLDS, case.pad + M, 3)
    assert not out[:, : case.pad].any()
    return out[:, case.pad :]


def differences(case: Case, loss: Loss, limit: float, step: float = 1e-6) -> np.ndarray:
    """Return central differences of the loss by q."""
    out = np.zeros_like(case.q)
    for at in np.ndindex(case.q.shape):
        value, values = case.q[at], []
        for sign in (1, -1):
            case.q[at] = value + sign * step
            values.append(loss.value(case, limit))
        case.q[at] = value
        out[at] = (values[0] - values[1]) / (2 * step)
    return out


@pytest.mark.parametrize(
    ("amplitude", "limit", "rotations"), [(0.05, 1e9, False), (0.3, 3.0, False), (0.05, 1e9, True)]
)
def test_matches_central_differences(device: str, amplitude: float, limit: float, rotations: bool) -> None:
    """dL/dq of centres, covariances and rotations, where the limit cuts stretches too."""
    case, loss = Case(amplitude=amplitude), Loss(rotations)
    singular = np.linalg.svd(case.gradients(), compute_uv=False)
    assert (singular > limit).any() == (limit < 1e9)
    got, expected = backward(case, loss, device, stretch_limit=limit), differences(case, loss, limit)
    assert np.abs(got - expected).max() < 1e-5 * np.abs(expected).max()


def test_worlds_runs_and_objects(device: str) -> None:
    """World i of three has the bits of the single world, two runs agree, and a second object adds."""
    case, loss = Case(), Loss(False)
    got = backward(case, loss, device)
    np.testing.assert_array_equal(got, backward(case, loss, device))
    single = Case()
    single.q[:] = case.q[1]
    same = Loss(False)
    same.means[:], same.covariances[:] = loss.means[1], loss.covariances[1]
    np.testing.assert_array_equal(got[1], backward(single, same, device)[0])

    q = case.flat(case.q, device)
    loss_q = wp.ones_like(q)
    AdjointSkinning(case.skin(device), WORLDS).backward(
        q,
        case.starts(device),
        wp.array(loss.means, dtype=wp.vec3, device=device),
        wp.array(loss.covariances, dtype=vec6, device=device),
        loss_q,
        loss_rotations=wp.zeros((1, 1), dtype=wp.vec3, device=device),
        first_splat=PAD,
    )
    np.testing.assert_array_equal(loss_q.numpy().reshape(WORLDS, -1, 3)[:, case.pad :], 1.0 + got)


def test_refuses_shapes_that_do_not_belong_together() -> None:
    """The message names the array."""
    case, loss = Case(), Loss(False)
    loss.covariances = loss.covariances[:, 1:]
    with pytest.raises(BasisError, match="loss_covariances has shape"):
        backward(case, loss, "cpu")
