"""The rasteriser as a PyTorch function."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from softmode.errors import ConfigError
from softmode.splats.raster.rasterizer import SplatRasterizer
from softmode.splats.raster.rasterizer_adjoint import AdjointRasterizer
from softmode.splats.raster.rasterizer_torch import INPUTS, render
from softmode.splats.splats import rotations_from_quats
from tests.needs import needs
from tests.splats.dense_reference import render_dense
from tests.splats.test_rasterizer_adjoint import FULL, HEIGHT, TOLERANCE, WIDTH, Scene, deviation

pytestmark = needs("torch")


def case(coefficients: int = 4) -> tuple[Scene, AdjointRasterizer, Any, Any, dict[str, Any]]:
    """Return a scene, its adjoint, arrays, and all of them as tensors that want gradients."""
    import torch

    scene = Scene.make(coefficients=coefficients)
    splats, views = scene.arrays("cpu")
    rasterizer = SplatRasterizer(scene.means.shape[1], 3, WIDTH, HEIGHT, device="cpu")
    adjoint = AdjointRasterizer(rasterizer, splats, views)
    tensors = {
        name: torch.tensor(getattr(splats if hasattr(splats, name) else views, name).numpy(), requires_grad=True)
        for name in INPUTS
    }
    return scene, adjoint, splats, views, tensors


def test_gradients_are_the_adjoint_s() -> None:
    """loss.backward() fills every tensor with the adjoint's gradient; an earlier frame is drawn again."""
    import torch

    scene, adjoint, splats, views, tensors = case()
    assert scene.weights is not None
    weights = [torch.tensor(w, dtype=torch.float32) for w in scene.weights]
    images = render(adjoint, splats, views, **tensors)
    loss = torch.stack([(w * image).sum() for w, image in zip(weights, images, strict=True)]).sum()
    render(adjoint, splats, views, means=tensors["means"].detach() + 0.1)
    loss.backward()
    expected = scene.gradients("cpu")
    for name in ("means", "covariances", "opacities", "sh", "intrinsics", "background"):
        np.testing.assert_allclose(tensors[name].grad.numpy(), expected[name], rtol=1e-6, atol=1e-6)


def test_a_frame_drawn_by_others_is_drawn_again() -> None:
    """Whoever used the rasteriser between a frame and its gradient, be it another adjoint, the gradient is the same."""
    import torch

    _, adjoint, splats, views, tensors = case(1)
    other = AdjointRasterizer(adjoint.rasterizer, splats, views, camera=False)
    moved = tensors["means"].detach() + 0.1
    gradients = []
    for between in (
        lambda: None,
        lambda: render(other, splats, views, means=moved),
        lambda: adjoint.rasterizer.render(replace(splats, means=splats.means[:1]), views),
    ):
        loss = render(adjoint, splats, views, means=tensors["means"])[0].square().sum()
        between()
        gradients.append(torch.autograd.grad(loss, tensors["means"])[0].numpy())
    for gradient in gradients[1:]:
        np.testing.assert_array_equal(gradient, gradients[0])


def test_pose_and_quaternions_as_parameters() -> None:
    """Chained with an axis-angle pose and normalised quaternions: against the float64 reference, difference by six."""
    import torch

    scene, adjoint, splats, views, tensors = case()
    assert scene.weights is not None
    weight = torch.tensor(scene.weights[0], dtype=torch.float32)
    base = tensors["world_to_camera"].detach().double()
    twist = torch.zeros(3, 6, dtype=torch.float64, requires_grad=True)
    v, w = twist[:, :3], twist[:, 3:]
    zero = torch.zeros(3, dtype=torch.float64)
    rows = [
        torch.stack([zero, -w[:, 2], w[:, 1], v[:, 0]], 1),
        torch.stack([w[:, 2], zero, -w[:, 0], v[:, 1]], 1),
        torch.stack([-w[:, 1], w[:, 0], zero, v[:, 2]], 1),
        torch.zeros(3, 4, dtype=torch.float64),
    ]
    pose = torch.linalg.matrix_exp(torch.stack(rows, 1)) @ base
    raw = (2.0 * tensors["rotations"].detach()).requires_grad_(True)
    quats = raw / raw.norm(dim=-1, keepdim=True)
    rgb, _, _ = render(adjoint, splats, views, world_to_camera=pose, rotations=quats)
    (weight * rgb).sum().backward()
    assert deviation(twist.grad.numpy(), scene.difference("twist", "rgb")) < TOLERANCE

    # All quaternions of world 0 move along the same direction.
    direction = np.array([0.3, -0.2, 0.5, 0.4])
    start = raw.detach().double().numpy()[0]
    values = []
    for sign in (1, -1):
        turns = rotations_from_quats(start + sign * 1e-6 * direction)
        total = 0.0
        for view in (0, 2):
            image = render_dense(
                scene.means[0],
                scene.covariances[0][:, FULL],
                scene.opacities[0],
                scene.sh[0],
                base[view].numpy(),
                tuple(scene.intrinsics[view]),
                WIDTH,
                HEIGHT,
                background=tuple(scene.background[view]),
                rotations=turns,
            )
            total += float((scene.weights[0][view] * image.rgb).sum())
        values.append(total)
    expected = (values[0] - values[1]) / 2e-6
    terms = raw.grad.numpy()[0] * direction
    assert abs(terms.sum() - expected) < TOLERANCE * np.abs(terms).sum()


def test_refusals() -> None:
    """Unknown names, and a pose that wants gradients of an adjoint without the camera."""
    _, adjoint, splats, views, tensors = case(1)
    with pytest.raises(ConfigError, match="unknown input 'mean'"):
        render(adjoint, splats, views, mean=tensors["means"])
    blind = AdjointRasterizer(adjoint.rasterizer, splats, views, camera=False)
    with pytest.raises(ConfigError, match="leaves out the camera"):
        render(blind, splats, views, world_to_camera=tensors["world_to_camera"])
