"""The rasteriser's adjoint against central differences of the float64 reference, its batching and capturing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray
from scipy.linalg import expm

from softmode.errors import ConfigError
from softmode.splats.rasterizer import RasterizerOptions, SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats.rasterizer_adjoint import AdjointRasterizer
from softmode.splats.rasterizer_kernels import vec6
from softmode.splats.splats import quat_from_rotation
from tests.splats.dense_reference import render_dense
from tests.splats.test_rasterizer import EYES, UNDECIDED, device, look_at  # noqa: F401

Array = NDArray[np.float64]
WIDTH, HEIGHT = 24, 20
STEP = 1e-6
TOLERANCE = 2e-5
FULL = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]


@dataclass
class Scene:
    """Splats of two worlds that share some arrays, three views and a loss, all in float64 of float32 numbers."""

    means: Array
    covariances: Array
    opacities: Array
    sh: Array
    rotations: Array
    twist: Array
    intrinsics: Array
    background: Array
    eyes: Any
    worlds: Any
    antialiased: bool
    meshes: tuple[Array, Array] | None = None
    weights: tuple[Array, Array, Array] | None = None

    @classmethod
    def make(cls, *, count: int = 16, coefficients: int = 1, antialiased: bool = True, mesh: bool = False) -> Scene:
        """Return worlds with means of their own; covariances, opacities and colours are shared."""
        rng = np.random.default_rng(3)
        worlds, eyes = [0, 1, 0], EYES
        root = np.exp(0.7 * rng.normal(size=(count, 1, 3))) * 0.08 * np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
        s = root @ root.transpose(0, 2, 1)
        sh = np.concatenate(
            [rng.uniform(-1, 1.5, size=(count, 1, 3)), 0.3 * rng.normal(size=(count, coefficients - 1, 3))], 1
        )
        scene = cls(
            means=0.3 * rng.normal(size=(2, count, 3)),
            covariances=np.stack([s[:, 0, 0], s[:, 0, 1], s[:, 0, 2], s[:, 1, 1], s[:, 1, 2], s[:, 2, 2]], 1)[None],
            opacities=rng.uniform(0.3, 1.0, size=(1, count)),
            sh=sh[None],
            rotations=np.zeros((2, 1, 3)),
            twist=np.zeros((3, 6)),
            intrinsics=np.tile([1.1 * HEIGHT, 1.2 * HEIGHT, 0.5 * WIDTH + 1.5, 0.5 * HEIGHT - 2.25], (3, 1)),
            background=rng.uniform(size=(3, 3)),
            eyes=eyes,
            worlds=worlds,
            antialiased=antialiased,
        )
        for name in ("means", "covariances", "opacities", "sh", "intrinsics", "background"):
            setattr(scene, name, getattr(scene, name).astype(np.float32).astype(np.float64))
        if mesh:
            depth = np.where(rng.uniform(size=(3, HEIGHT, WIDTH)) < 0.7, rng.uniform(0.2, 1.9, (3, HEIGHT, WIDTH)), 0.0)
            scene.meshes = (
                rng.uniform(size=(3, HEIGHT, WIDTH, 3)).astype(np.float32).astype(np.float64),
                depth.astype(np.float32).astype(np.float64),
            )
        images = [scene.render(view) for view in range(3)]
        # No loss where float64 itself is undecided, and none by a depth that hardly anything is seen at.
        sure = np.stack([image.margin > UNDECIDED for image in images])
        assert sure.mean() > 0.98
        seen = sure & np.stack([image.alpha > 0.05 for image in images])
        weights = (
            rng.normal(size=(3, HEIGHT, WIDTH, 3)) * sure[..., None],
            rng.normal(size=sure.shape) * sure,
            rng.normal(size=sure.shape) * seen,
        )
        scene.weights = tuple(w.astype(np.float32).astype(np.float64) for w in weights)
        return scene

    def render(self, view: int) -> Any:
        """Render one view with the reference."""
        world = self.worlds[view]
        pose = np.zeros((4, 4))
        v, w = self.twist[view, :3], self.twist[view, 3:]
        pose[:3, :3], pose[:3, 3] = np.cross(np.eye(3), w), v
        pose[:3, :3] = -np.cross(np.eye(3), w).T
        turn = expm(-np.cross(np.eye(3), self.rotations[world % len(self.rotations), 0]).T) @ self.turn(world)
        extra: dict[str, Any] = {}
        if self.meshes is not None:
            extra = {"mesh_rgb": self.meshes[0][view], "mesh_depth": self.meshes[1][view]}
        return render_dense(
            self.means[world % len(self.means)],
            self.covariances[world % len(self.covariances)][:, FULL],
            self.opacities[world % len(self.opacities)],
            self.sh[world % len(self.sh)],
            expm(pose) @ look_at(self.eyes[view]),
            tuple(self.intrinsics[view]),
            WIDTH,
            HEIGHT,
            antialiased=self.antialiased,
            background=tuple(self.background[view]),
            rotations=np.repeat(turn[None], self.means.shape[1], axis=0),
            **extra,
        )

    def turn(self, world: int) -> Array:
        """Return the rotation of a world's colours."""
        return expm(np.cross(np.eye(3), [0.4, -0.9, 0.2 + world]))

    def loss(self, parts: str) -> float:
        """Return the loss: the weighted sum of colour, alpha and depth."""
        assert self.weights is not None
        total = 0.0
        for view in range(3):
            image = self.render(view)
            for name, weight in zip(("rgb", "alpha", "depth"), self.weights, strict=True):
                if name in parts:
                    total += float((weight[view] * getattr(image, name)).sum())
        return total

    def difference(self, name: str, parts: str) -> Array:
        """Return central differences of the loss by every entry of one array."""
        array = getattr(self, name)
        out = np.zeros_like(array)
        for at in np.ndindex(array.shape):
            value = array[at]
            # Small against the thinnest splat, or a cut alpha would jump.
            step = (0.01 * STEP if name == "covariances" else STEP) * (float(np.abs(array).max()) or 1.0)
            values = []
            for sign in (1, -1):
                array[at] = value + sign * step
                values.append(self.loss(parts))
            array[at] = value
            out[at] = (values[0] - values[1]) / (2 * step)
        return out

    def arrays(self, device: str) -> tuple[SplatArrays, ViewArrays]:
        """Upload."""
        turns = np.stack([quat_from_rotation(self.turn(world)) for world in range(2)])
        splats = SplatArrays(
            means=wp.array(self.means, dtype=wp.vec3, device=device),
            covariances=wp.array(self.covariances, dtype=vec6, device=device),
            opacities=wp.array(self.opacities, dtype=wp.float32, device=device),
            sh=wp.array(self.sh, dtype=wp.vec3, device=device),
            object_index=wp.zeros(self.means.shape[1], dtype=wp.int32, device=device),
            rotations=wp.array(np.repeat(turns[:, None], self.means.shape[1], 1), dtype=wp.quat, device=device),
        )
        views = ViewArrays(
            world_to_camera=wp.array([look_at(eye) for eye in self.eyes], dtype=wp.mat44, device=device),
            intrinsics=wp.array(self.intrinsics, dtype=wp.vec4, device=device),
            world=wp.array(self.worlds, dtype=wp.int32, device=device),
            background=wp.array(self.background, dtype=wp.vec3, device=device),
        )
        return splats, views

    def frame(self, device: str, parts: str = "rgb alpha depth") -> tuple[Callable[[], None], AdjointRasterizer]:
        """Return what renders and differentiates a frame, and the adjoint."""
        assert self.weights is not None
        splats, views = self.arrays(device)
        options = RasterizerOptions(antialiased=self.antialiased)
        rasterizer = SplatRasterizer(self.means.shape[1], 3, WIDTH, HEIGHT, options=options, device=device)
        adjoint = AdjointRasterizer(rasterizer, splats, views)
        mesh: dict[str, Any] = {}
        if self.meshes is not None:
            mesh = {
                "mesh_rgb": wp.array(self.meshes[0], dtype=wp.vec3, device=device),
                "mesh_depth": wp.array(self.meshes[1], dtype=wp.float32, device=device),
            }
        loss: dict[str, Any] = {"loss_rgb": wp.zeros((3, HEIGHT, WIDTH), dtype=wp.vec3, device=device)}
        for name, weight in zip(("rgb", "alpha", "depth"), self.weights, strict=True):
            if name in parts:
                dtype = wp.vec3 if name == "rgb" else wp.float32
                loss[f"loss_{name}"] = wp.array(weight, dtype=dtype, device=device)

        def run() -> None:
            rasterizer.render(splats, views, **mesh)
            adjoint.backward(splats, views, **loss, **mesh)

        return run, adjoint

    def gradients(self, device: str, parts: str = "rgb alpha depth") -> dict[str, NDArray[Any]]:
        """Return the adjoint's gradients."""
        run, adjoint = self.frame(device, parts)
        run()
        return adjoint.gradients.numpy()


def deviation(got: NDArray[Any], expected: Array) -> float:
    """Return the largest error over the largest entry."""
    assert got.shape == expected.shape
    assert np.abs(expected).max() > 0.0
    return float(np.abs(got - expected).max() / np.abs(expected).max())


NAMES = ("means", "covariances", "opacities", "sh", "twist", "intrinsics", "background")


@pytest.mark.parametrize("antialiased", [True, False])
@pytest.mark.parametrize("parts", ["rgb", "alpha", "depth"])
def test_matches_central_differences(device: str, antialiased: bool, parts: str) -> None:  # noqa: F811
    """dL/d(mean, covariance, opacity, colour, pose, intrinsics, background), each image on its own, two worlds."""
    scene = Scene.make(antialiased=antialiased)
    got = scene.gradients(device, parts)
    for name in NAMES:
        if parts != "rgb" and name in ("sh", "background"):
            assert not got[name].any()
        else:
            assert deviation(got[name], scene.difference(name, parts)) < TOLERANCE, name
