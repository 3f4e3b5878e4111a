"""View-dependent colour belongs to the material: it turns with the rotation of F, splat by splat."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from softmode.deformables.skinning.skin_splats import SkinSplats
from softmode.errors import ConfigError
from softmode.splats import Splats
from softmode.splats.raster.rasterizer import SplatArrays, SplatRasterizer
from tests.splats.dense_reference import DenseImage, render_dense
from tests.splats.test_rasterizer import BACKGROUND, EYES, assert_matches, ball, dense, device, look_at, views_of

__all__ = ["device"]
SIZE = (48, 40)


def deformed(splats: Splats, basis: Any, grad_basis: Any, q: np.ndarray, device: str) -> SplatArrays:
    """Return the splats moved by q of each world, shape (world_count, n, 3)."""
    arrays = SplatArrays.from_splats([splats], world_count=len(q), device=device)
    skin = SkinSplats(splats.means, splats.covariances(), basis, grad_basis, device=device)
    skin.launch(
        wp.array(q.reshape(-1, 3), dtype=wp.vec3d, device=device),
        wp.array(np.arange(len(q)) * q.shape[1], dtype=wp.int32, device=device),
        arrays.means,
        arrays.covariances,
        rotations=arrays.rotations,
    )
    return arrays


def affine_basis(splats: Splats) -> tuple[np.ndarray, np.ndarray]:
    """Return the functions X, Y, Z, 1 and their gradients at the centres."""
    x = splats.means.astype(np.float64)
    gradient = np.concatenate([np.eye(3), np.zeros((1, 3))])
    return np.concatenate([x, np.ones((len(x), 1))], axis=1), np.tile(gradient, (len(x), 1, 1))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rigid_motion_equals_transformed_splats(device: str, degree: int) -> None:
    """Splats skinned by a rotation are the splats whose colour functions were rotated: f'(d) = f(R^T d)."""
    splats = ball(coefficients=(degree + 1) ** 2)
    turn = np.array([[0.0, -1.0, 0.0], [0.6, 0.0, -0.8], [0.8, 0.0, 0.6]])
    shift = np.array([0.05, -0.1, 0.02])
    q = np.concatenate([(turn - np.eye(3)).T, shift[None]])[None]
    arrays = deformed(splats, *affine_basis(splats), q, device)
    assert arrays.rotations.shape == ((1, splats.count) if degree else (1, 1))
    rasterizer = SplatRasterizer(splats.count, 1, *SIZE, device=device)
    rasterizer.render(arrays, views_of(EYES[:1], *SIZE, device))
    assert_matches(rasterizer, 0, dense(splats.transformed(rotation=turn, translation=shift), EYES[0], *SIZE))
    if degree:
        fixed = dense(splats.transformed(rotation=turn, translation=shift), EYES[0], *SIZE).rgb
        arrays.rotations.fill_(wp.quat_identity())
        rasterizer.render(arrays, views_of(EYES[:1], *SIZE, device))
        assert np.abs(rasterizer.rgb.numpy()[0] - fixed).max() > 0.05, "colours that stay behind can be seen"


def hinge(splats: Splats, angle: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return a basis, its gradients, q and R (N, 3, 3): the halves x < 0 and x > 0 turn about y by -/+ `angle`."""
    functions, gradients = affine_basis(splats)
    side = (splats.means[:, 0] > 0.0)[:, None]
    basis = np.concatenate([np.where(side, 0.0, functions), np.where(side, functions, 0.0)], axis=1)
    gradient = np.concatenate(
        [np.where(side[..., None], 0.0, gradients), np.where(side[..., None], gradients, 0.0)], axis=1
    )
    c, s = np.cos(angle), np.sin(angle)
    right = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    no_shift = np.zeros((1, 3))
    q = np.concatenate([(right.T - np.eye(3)).T, no_shift, (right - np.eye(3)).T, no_shift])
    return basis, gradient, q, np.where(side[..., None], right, right.T)


def reference(splats: Splats, arrays: SplatArrays, world: int, rotations: np.ndarray, eye: Any) -> DenseImage:
    """Render skinned splats with the float64 reference; their means and covariances are as skinning rounded them."""
    width, height = SIZE
    six = arrays.covariances.numpy()[world].astype(np.float64)
    return render_dense(
        arrays.means.numpy()[world].astype(np.float64),
        six[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]],
        splats.opacities.astype(np.float64),
        splats.sh.astype(np.float64),
        look_at(eye),
        (1.1 * height, 1.2 * height, 0.5 * width + 1.5, 0.5 * height - 2.25),
        width,
        height,
        background=BACKGROUND,
        rotations=rotations,
    )


def test_halves_of_a_bend_show_their_own_colours(device: str) -> None:
    """Each half of a hinge, and each world, is seen through its own rotation; world i is bitwise the single world."""
    splats = ball(seed=1, coefficients=9)
    angles = (0.9, -0.4)
    basis, gradient, q0, _ = hinge(splats, angles[0])
    q = np.stack([q0, hinge(splats, angles[1])[2]])
    arrays = deformed(splats, basis, gradient, q, device)
    rasterizer = SplatRasterizer(splats.count, 2, *SIZE, device=device)
    rasterizer.render(arrays, views_of(EYES[:1] * 2, *SIZE, device, worlds=[0, 1]))
    alone = SplatRasterizer(splats.count, 1, *SIZE, device=device)
    for world, angle in enumerate(angles):
        assert_matches(rasterizer, world, reference(splats, arrays, world, hinge(splats, angle)[3], EYES[0]))
        single = deformed(splats, basis, gradient, q[world : world + 1], device)
        alone.render(single, views_of(EYES[:1], *SIZE, device))
        np.testing.assert_array_equal(rasterizer.rgb.numpy()[world], alone.rgb.numpy()[0])


def test_refuses_rotations_of_another_size() -> None:
    """One quaternion per splat is needed where colours depend on the view."""
    splats = ball(100, coefficients=4)
    arrays = SplatArrays.from_splats([splats], device="cpu")
    few = SplatArrays(**{**vars(arrays), "rotations": wp.zeros((1, 99), dtype=wp.quat, device="cpu")})
    rasterizer = SplatRasterizer(100, 1, *SIZE, device="cpu")
    with pytest.raises(ConfigError, match=r"splats\.rotations has shape \(1, 99\)"):
        rasterizer.render(few, views_of(EYES[:1], *SIZE, "cpu"))
