"""The rasteriser's adjoint against central differences of the float64 reference, its batching and capturing."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray
from scipy.linalg import expm

from softmode.errors import ConfigError
from softmode.splats.raster import blend_adjoint_cpu_kernels, blend_adjoint_cuda_kernels
from softmode.splats.raster.rasterizer import RasterizerOptions, SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats.raster.rasterizer_adjoint import AdjointRasterizer
from softmode.splats.raster.rasterizer_kernels import vec6
from softmode.splats.splats import quats_from_rotations
from tests.splats import dense_reference
from tests.splats.dense_reference import render_dense
from tests.splats.test_rasterizer import EYES, UNDECIDED, look_at

Array = NDArray[np.float64]
WIDTH, HEIGHT = 21, 19
STEP = 1e-6
TOLERANCE = 2e-5
FULL = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    """Every device that is there."""
    if request.param != "cpu" and not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return request.param


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
    weights: list[Array] | None = None

    @classmethod
    def make(
        cls,
        *,
        count: int = 12,
        coefficients: int = 1,
        antialiased: bool = True,
        mesh: bool = False,
        opacity: float = 0.3,
    ) -> Scene:
        """Return worlds with means of their own, which share covariances, opacities from `opacity` up, and colours."""
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
            opacities=rng.uniform(opacity, 1.0, size=(1, count)),
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
        scene.weights = [w.astype(np.float32).astype(np.float64) for w in weights]
        return scene

    def render(self, view: int) -> Any:
        """Render one view with the reference."""
        world = self.worlds[view]
        pose = np.zeros((4, 4))
        v, w = self.twist[view, :3], self.twist[view, 3:]
        pose[:3, :3], pose[:3, 3] = np.cross(np.eye(3), w), v
        turn = expm(np.cross(np.eye(3), self.rotations[world, 0])) @ self.turn(world)
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
        return np.asarray(expm(np.cross(np.eye(3), [0.4, -0.9, 0.2 + world])), dtype=np.float64)

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

    def slope(self, name: str, along: Array, parts: str = "rgb alpha depth") -> float:
        """Return the central difference of the loss along a direction of one array."""
        array = getattr(self, name)
        step = (0.01 * STEP if name == "covariances" else STEP) * (float(np.abs(array).max()) or 1.0)
        values = []
        for sign in (1, -1):
            setattr(self, name, array + sign * step * along)
            values.append(self.loss(parts))
        setattr(self, name, array)
        return (values[0] - values[1]) / (2 * step)

    def arrays(self, device: str) -> tuple[SplatArrays, ViewArrays]:
        """Upload."""
        turns = np.stack([quats_from_rotations(self.turn(world)) for world in range(2)])
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
def test_matches_central_differences(device: str, antialiased: bool, parts: str) -> None:
    """dL/d(mean, covariance, opacity, colour, pose, intrinsics, background), each image on its own, two worlds."""
    scene = Scene.make(antialiased=antialiased)
    got = scene.gradients(device, parts)
    assert not got["rotations"].any()
    for name in NAMES:
        if parts != "rgb" and name in ("sh", "background"):
            assert not got[name].any()
        else:
            assert deviation(got[name], scene.difference(name, parts)) < TOLERANCE, name


@pytest.mark.parametrize("coefficients", [4, 9, 16])
def test_direction_of_sight(device: str, coefficients: int) -> None:
    """Colour of degree 1 to 3: its coefficients, the centre, the eye, the frame that colours turn with."""
    scene = Scene.make(count=6, coefficients=coefficients)
    got = scene.gradients(device, "rgb")
    for name in ("means", "sh", "twist"):
        assert deviation(got[name], scene.difference(name, "rgb")) < TOLERANCE, name
    # All splats of a world turn together here.
    assert deviation(got["rotations"].sum(axis=1, keepdims=True), scene.difference("rotations", "rgb")) < TOLERANCE


def test_meshes_hide(device: str) -> None:
    """With meshes: only splats in front of them have a gradient, of colour, alpha and the depth that mixes both."""
    scene = Scene.make(mesh=True)
    got = scene.gradients(device)
    assert not got["background"].any()
    for name in ("means", "covariances", "opacities", "sh", "twist"):
        assert deviation(got[name], scene.difference(name, "rgb alpha depth")) < TOLERANCE, name
    assert scene.meshes is not None
    scene.meshes[1][:] = 0.05  # In front of everything.
    for name, values in scene.gradients(device).items():
        assert not values.any(), name


def test_pixels_that_end(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where many opaque splats leave no light, what a pixel does not see has no part: by random directions."""
    scene = Scene.make(count=80, opacity=0.97)
    images = np.stack([scene.render(view).alpha for view in range(3)])
    with monkeypatch.context() as patch:
        patch.setattr(dense_reference, "TRANSMITTANCE_MIN", 1e-30)
        assert (images != np.stack([scene.render(view).alpha for view in range(3)])).mean() > 0.1
    got, rng = scene.gradients(device), np.random.default_rng(0)
    for name in ("means", "covariances", "opacities", "sh"):
        for _ in range(3):
            along = rng.normal(size=got[name].shape)
            assert abs((got[name] * along).sum() - scene.slope(name, along)) < TOLERANCE * np.linalg.norm(got[name])


def test_the_kernel_of_cuda_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """One pixel per thread agrees with tiles in vector registers; sums have another order, the exponential rounding."""
    scene = Scene.make(mesh=True, coefficients=4)
    expected = scene.gradients("cpu")
    kernel = functools.partial(blend_adjoint_cuda_kernels.blend_adjoint_kernel, lanes=1)
    monkeypatch.setattr(blend_adjoint_cpu_kernels, "blend_adjoint_kernel", kernel)
    monkeypatch.setattr(blend_adjoint_cpu_kernels, "TILE_THREADS", blend_adjoint_cuda_kernels.TILE_THREADS)
    for name, values in scene.gradients("cpu").items():
        np.testing.assert_allclose(values, expected[name], atol=1e-5 * max(np.abs(expected[name]).max(), 1e-9))


def test_saturated_alpha_and_black_colour_let_nothing_through(device: str) -> None:
    """An alpha cut at 0.99 does not feel its splat's opacity or shape; a colour cut at zero not its coefficients."""
    scene = Scene.make(count=1, antialiased=False)
    scene.means[:] = 0.0
    scene.covariances[:] = [1e4, 0, 0, 1e4, 0, 1e4]
    scene.opacities[:] = 1.0
    scene.sh[0, 0, 0] = [1.0, -4.0, 0.5]
    got = scene.gradients(device, "rgb")
    assert not got["opacities"].any() and not got["covariances"].any() and not got["means"].any()
    assert (got["sh"][0, 0, 0] != 0.0).tolist() == [True, False, True]


def test_same_bits_captured_and_per_world(device: str) -> None:
    """A captured frame replays the eager one; on CPU to the bit, and world i of many is the single world."""
    scene = Scene.make(coefficients=4)
    scene.covariances = np.repeat(scene.covariances, 2, axis=0)
    run, adjoint = scene.frame(device)
    run()
    eager = adjoint.gradients.numpy()
    for array in vars(adjoint.gradients).values():
        array.fill_(7.0)
    with wp.ScopedCapture(device=device) as capture:
        run()
    for _ in range(2):
        wp.capture_launch(capture.graph)
        for name, values in adjoint.gradients.numpy().items():
            if device == "cpu":
                np.testing.assert_array_equal(values, eager[name], err_msg=name)
            else:
                np.testing.assert_allclose(values, eager[name], atol=1e-5 * np.abs(eager[name]).max(), err_msg=name)
    if device != "cpu":
        return
    # World 1 is seen by view 1 alone.
    splats, views = scene.arrays(device)
    splats = replace(splats, means=splats.means[1:], covariances=splats.covariances[1:], rotations=splats.rotations[1:])
    views = ViewArrays(
        world_to_camera=views.world_to_camera[1:2],
        intrinsics=views.intrinsics[1:2],
        world=wp.zeros(1, dtype=wp.int32, device=device),
        background=views.background[1:2],
    )
    assert scene.weights is not None
    losses = [
        wp.array(w[1:2], dtype=dtype, device=device)
        for w, dtype in zip(scene.weights, (wp.vec3, wp.float32, wp.float32), strict=True)
    ]
    rasterizer = SplatRasterizer(scene.means.shape[1], 1, WIDTH, HEIGHT, device=device)
    alone = AdjointRasterizer(rasterizer, splats, views)
    rasterizer.render(splats, views)
    alone.backward(splats, views, loss_rgb=losses[0], loss_alpha=losses[1], loss_depth=losses[2])
    for name, values in alone.gradients.numpy().items():
        if name not in ("opacities", "sh"):
            np.testing.assert_array_equal(values[0], eager[name][1], err_msg=name)


def test_without_the_camera(device: str) -> None:
    """Splats have the same gradients; twist and intrinsics stay zero."""
    scene = Scene.make()
    expected = scene.gradients(device)
    splats, views = scene.arrays(device)
    rasterizer = SplatRasterizer(scene.means.shape[1], 3, WIDTH, HEIGHT, device=device)
    adjoint = AdjointRasterizer(rasterizer, splats, views, camera=False)
    rasterizer.render(splats, views)
    assert scene.weights is not None
    losses = [
        wp.array(w, dtype=dtype, device=device)
        for w, dtype in zip(scene.weights, (wp.vec3, wp.float32, wp.float32), strict=True)
    ]
    got = adjoint.backward(splats, views, loss_rgb=losses[0], loss_alpha=losses[1], loss_depth=losses[2]).numpy()
    np.testing.assert_allclose(got["means"], expected["means"], atol=1e-6 * np.abs(expected["means"]).max())
    assert not got["twist"].any() and not got["intrinsics"].any()


def test_refuses_arrays_of_other_shapes() -> None:
    """The message names the array."""
    scene = Scene.make(count=3)
    splats, views = scene.arrays("cpu")
    rasterizer = SplatRasterizer(3, 3, WIDTH, HEIGHT, device="cpu")
    adjoint = AdjointRasterizer(rasterizer, splats, views)
    loss = wp.zeros((3, HEIGHT, WIDTH), dtype=wp.vec3, device="cpu")
    with pytest.raises(ConfigError, match="loss_rgb has shape"):
        adjoint.backward(splats, views, loss_rgb=loss[:1])
    with pytest.raises(ConfigError, match="mesh_depth has shape None"):
        adjoint.backward(splats, views, loss_rgb=loss, mesh_rgb=loss)
    with pytest.raises(ConfigError, match="means has shape"):
        adjoint.backward(replace(splats, means=splats.means[:1]), views, loss_rgb=loss)


def test_gain_of_a_view_scales_what_flows_back(device: str) -> None:
    """A view of gain (g, h) has the gradients of opacities h o and a loss g dL/drgb; dL/do is h times that."""
    scene = Scene.make(coefficients=4)
    assert scene.weights is not None
    splats, views = scene.arrays(device)
    black = wp.zeros(1, dtype=wp.vec3, device=device)
    g, h = np.array([1.3, 0.5, 0.8]), 0.6
    gain = wp.array([(*g, h)], dtype=wp.vec4, device=device)
    scaled = replace(splats, opacities=wp.array(h * scene.opacities, dtype=wp.float32, device=device))
    results = []
    for drawn, seen, loss in (
        (splats, replace(views, background=black, splat_gain=gain), scene.weights[0]),
        (scaled, replace(views, background=black), scene.weights[0] * g),
    ):
        rasterizer = SplatRasterizer(scene.means.shape[1], 3, WIDTH, HEIGHT, device=device)
        adjoint = AdjointRasterizer(rasterizer, drawn, seen)
        rasterizer.render(drawn, seen)
        results.append(adjoint.backward(drawn, seen, loss_rgb=wp.array(loss, dtype=wp.vec3, device=device)).numpy())
    got, expected = results
    for name in ("means", "covariances", "opacities", "sh", "rotations", "twist", "intrinsics"):
        factor = h if name == "opacities" else 1.0
        scale = np.abs(expected[name]).max()
        assert scale > 0.0
        np.testing.assert_allclose(got[name], factor * expected[name], atol=1e-5 * scale, err_msg=name)
