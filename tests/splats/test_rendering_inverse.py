"""Small inverse problems: what made a picture is found from it by the gradients of the rasteriser."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import minimize

from softmode.deformables.skinning.skin_splats import SkinSplats
from softmode.deformables.skinning.skinning_adjoint import AdjointSkinning
from softmode.splats import Splats
from softmode.splats.raster.rasterizer import SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats.raster.rasterizer_adjoint import AdjointRasterizer, exp_twist
from tests.splats.test_rasterizer import look_at

Array = NDArray[np.float64]
WIDTH, HEIGHT = 48, 32


def bar(size: tuple[float, float, float], count: int = 250) -> Splats:
    """Return a bar of round splats whose colour runs along it; half its size in metres."""
    rng = np.random.default_rng(2)
    means = rng.uniform(-1, 1, size=(count, 3)) * size
    phase = 25.0 * means[:, :1] + 60.0 * means[:, 1:2] + [0.0, 2.1, 4.2]
    return Splats(
        means=means,
        quats=np.tile([0, 0, 0, 1.0], (count, 1)),
        scales=np.full((count, 3), 0.007),
        opacities=np.full(count, 0.8),
        sh=1.5 * np.sin(phase)[:, None],
    )


def views(poses: list[Array]) -> ViewArrays:
    """Return views of these poses."""
    lens = np.tile([60.0, 60.0, WIDTH / 2, HEIGHT / 2], (len(poses), 1))
    return ViewArrays(
        world_to_camera=wp.array(poses, dtype=wp.mat44, device="cpu"),
        intrinsics=wp.array(lens, dtype=wp.vec4, device="cpu"),
        world=wp.zeros(len(poses), dtype=wp.int32, device="cpu"),
        background=wp.array([[0.1, 0.1, 0.1]], dtype=wp.vec3, device="cpu"),
    )


POSES = [look_at((0.05, -0.4, 0.15)), look_at((-0.15, 0.25, 0.3))]


def left_jacobian(twist: Array) -> Array:
    """Return J with exp(x + dx) = exp(J dx) exp(x), the integral of exp(s ad(x)) over s in 0..1."""
    v, w = np.cross(np.eye(3), twist[:3]), np.cross(np.eye(3), twist[3:])
    ad = np.block([[w, v], [np.zeros((3, 3)), w]])
    return np.asarray(expm(np.block([[ad, np.eye(6)], [np.zeros((6, 12))]])), dtype=np.float64)[:6, 6:]


def descend(loss: Callable[[Array], tuple[float, Array]], start: Array) -> Array:
    """Return the minimum that L-BFGS finds."""
    return minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": 200, "ftol": 1e-14, "gtol": 1e-9}).x


def test_camera_pose_is_found_from_one_picture() -> None:
    """A camera that is 2 cm and 3 degrees off finds home: less than 1 % of the offset is left."""
    splats = bar((0.15, 0.1, 0.1))
    arrays = SplatArrays.from_splats([splats], device="cpu")
    rasterizer = SplatRasterizer(splats.count, 1, WIDTH, HEIGHT, device="cpu")
    home = views(POSES[:1])
    adjoint = AdjointRasterizer(rasterizer, arrays, home)
    rasterizer.render(arrays, home)
    target = rasterizer.rgb.numpy().astype(np.float64)
    scale = np.array([0.01] * 3 + [0.03] * 3)

    def loss(x: Array) -> tuple[float, Array]:
        moved = views([exp_twist(scale * x) @ POSES[0]])
        rasterizer.render(arrays, moved)
        error = rasterizer.rgb.numpy() - target
        found = adjoint.backward(arrays, moved, loss_rgb=wp.array(error, dtype=wp.vec3, device="cpu"))
        return 0.5 * float((error**2).sum()), scale * (left_jacobian(scale * x).T @ found.twist.numpy()[0])

    start = np.array([1.2, -1.0, 1.3, 1.0, -1.2, 0.8])
    found = descend(loss, start)
    assert np.abs(found).max() < 0.01 * np.abs(start).max()


def test_bend_is_found_from_pictures() -> None:
    """Reduced coordinates of a bent and stretched bar are found from two pictures of it, starting at rest.

    q is compared by what it does: the largest error of a splat's place is less than 1 % of the largest displacement.
    """
    splats = bar((0.15, 0.02, 0.02))
    x = splats.means.astype(np.float64) / 0.15
    one = np.ones(len(x))
    basis = np.stack([x[:, 0], x[:, 1], x[:, 2], one, x[:, 0] ** 2 - 1 / 3, x[:, 0] ** 3 - 0.6 * x[:, 0]], 1)
    grad = np.zeros((len(x), 6, 3))
    grad[:, [0, 1, 2], [0, 1, 2]] = 1.0
    grad[:, 4, 0], grad[:, 5, 0] = 2.0 * x[:, 0], 3.0 * x[:, 0] ** 2 - 0.6
    skin = SkinSplats(splats.means, splats.covariances(), basis, grad / 0.15, device="cpu")
    skin_adjoint = AdjointSkinning(skin, 1)
    arrays = SplatArrays.from_splats([splats], device="cpu")
    cameras = views(POSES)
    rasterizer = SplatRasterizer(splats.count, 2, WIDTH, HEIGHT, device="cpu")
    adjoint = AdjointRasterizer(rasterizer, arrays, cameras, camera=False)
    start = wp.zeros(1, dtype=wp.int32, device="cpu")

    def render(values: Array) -> wp.array:
        q = wp.array(values.reshape(6, 3), dtype=wp.vec3d, device="cpu")
        skin.launch(q, start, arrays.means, arrays.covariances)
        rasterizer.render(arrays, cameras)
        return q

    bent = np.zeros((6, 3))
    bent[4], bent[5], bent[0, 0], bent[3] = [0.0, 0.01, 0.03], [0.0, 0.005, -0.01], 0.01, [0.004, -0.003, 0.006]
    render(bent.ravel())
    target = rasterizer.rgb.numpy().astype(np.float64)

    def loss(values: Array) -> tuple[float, Array]:
        q = render(0.01 * values)
        error = rasterizer.rgb.numpy() - target
        found = adjoint.backward(arrays, cameras, loss_rgb=wp.array(error, dtype=wp.vec3, device="cpu"))
        by_q = wp.zeros_like(q)
        skin_adjoint.backward(q, start, found.means, found.covariances, by_q, loss_rotations=found.rotations)
        return 0.5 * float((error**2).sum()), 0.01 * by_q.numpy().ravel()

    found = 0.01 * descend(loss, np.zeros(18)).reshape(6, 3)
    moved, wrong = basis @ bent, basis @ (found - bent)
    assert np.linalg.norm(wrong, axis=1).max() < 0.01 * np.linalg.norm(moved, axis=1).max()
