"""The rasteriser against the dense float64 reference, and its batching and capturing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from softmode.errors import ConfigError
from softmode.splats import Splats, make_plush
from softmode.splats.raster.rasterizer import RasterizerOptions, SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats.splats import quats_from_rotations, rotations_from_quats
from tests.splats.dense_reference import DenseImage, render_dense

DEVICES = ["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)]
# A decision that float64 takes within this relative distance of its threshold may fall the other way in float32.
UNDECIDED = 1e-4
TOLERANCE = 1e-5
BACKGROUND = (0.2, 0.4, 0.6)


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    """Every device that is there."""
    if request.param != "cpu" and not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return request.param


def ball(count: int = 400, seed: int = 0, coefficients: int = 1) -> Splats:
    """Return a ball of random splats of half a metre, needles and discs among them."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3))
    means *= 0.5 * rng.uniform(size=(count, 1)) ** (1 / 3) / np.linalg.norm(means, axis=1, keepdims=True)
    sh = np.concatenate(
        [rng.uniform(-1, 1.5, size=(count, 1, 3)), 0.3 * rng.normal(size=(count, coefficients - 1, 3))], 1
    )
    return Splats(
        means=means,
        quats=rng.normal(size=(count, 4)),
        scales=0.03 * rng.lognormal(sigma=0.7, size=(count, 3)),
        opacities=rng.beta(3, 1.2, size=count),
        sh=sh,
    )


def look_at(eye: Any, target: Any = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the world-to-camera matrix, OpenCV axes, z up in the picture."""
    eye, target = np.asarray(eye, dtype=float), np.asarray(target, dtype=float)
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, np.cross(z, x), z])
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    return matrix.astype(np.float32).astype(np.float64)


EYES = [(1.6, 0.3, 0.5), (-0.9, 1.2, -0.2), (0.35, -0.1, 0.1)]


def views_of(eyes: Any, width: int, height: int, device: str, worlds: Any = None) -> ViewArrays:
    """Return views that look at the origin from the eyes, with an off-centre axis."""
    matrices = np.stack([look_at(eye) for eye in eyes]).astype(np.float32)
    lens = np.tile(np.float32([1.1 * height, 1.2 * height, 0.5 * width + 1.5, 0.5 * height - 2.25]), (len(eyes), 1))
    return ViewArrays(
        world_to_camera=wp.array(matrices, dtype=wp.mat44, device=device),
        intrinsics=wp.array(lens, dtype=wp.vec4, device=device),
        world=wp.array(np.zeros(len(eyes)) if worlds is None else worlds, dtype=wp.int32, device=device),
        background=wp.array([BACKGROUND], dtype=wp.vec3, device=device),
    )


def dense(splats: Splats, eye: Any, width: int, height: int, **kwargs: Any) -> DenseImage:
    """Render one view with the reference."""
    return render_dense(
        splats.means.astype(np.float64),
        splats.covariances(),
        splats.opacities.astype(np.float64),
        splats.sh.astype(np.float64),
        look_at(eye),
        (1.1 * height, 1.2 * height, 0.5 * width + 1.5, 0.5 * height - 2.25),
        width,
        height,
        background=BACKGROUND,
        **kwargs,
    )


def assert_matches(rasterizer: SplatRasterizer, view: int, expected: DenseImage) -> None:
    """Compare all outputs where float64 itself is decided; hardly any pixel may be undecided."""
    sure = expected.margin > UNDECIDED
    assert sure.mean() > 0.98
    assert np.abs(rasterizer.rgb.numpy()[view] - expected.rgb)[sure].max() < TOLERANCE
    assert np.abs(rasterizer.alpha.numpy()[view] - expected.alpha)[sure].max() < TOLERANCE
    depth = rasterizer.depth.numpy()[view]
    # Expected depth divides by the coverage, and its rounding with it.
    seen = sure & (expected.alpha > 0.01)
    assert np.abs(depth - expected.depth)[seen].max() < 1e2 * TOLERANCE
    assert (depth[sure & (expected.depth == 0.0)] == 0.0).all()
    if rasterizer.options.object_ids:
        assert (rasterizer.object_id.numpy()[view] == expected.object_id)[sure].mean() > 0.999
    if rasterizer.options.median_depth:
        np.testing.assert_allclose(rasterizer.median_depth.numpy()[view][sure], expected.median_depth[sure], rtol=1e-5)


@pytest.mark.parametrize("antialiased", [True, False])
@pytest.mark.parametrize(("width", "height"), [(48, 40), (37, 53)])
def test_matches_dense_reference(device: str, antialiased: bool, width: int, height: int) -> None:
    """rgb, both depths, alpha and object id of three views, one of them inside the ball, to 1e-5; odd sizes too."""
    splats = ball()
    ids = np.arange(splats.count) % 3
    options = RasterizerOptions(antialiased=antialiased, object_ids=True, median_depth=True)
    rasterizer = SplatRasterizer(splats.count, len(EYES), width, height, options=options, device=device)
    arrays = replace(
        SplatArrays.from_splats([splats], device=device),
        object_index=wp.array(ids, dtype=wp.int32, device=device),
    )
    rasterizer.render(arrays, views_of(EYES, width, height, device))
    for view, eye in enumerate(EYES):
        assert_matches(rasterizer, view, dense(splats, eye, width, height, antialiased=antialiased, object_ids=ids))


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_spherical_harmonics_turn_with_the_object(device: str, coefficients: int) -> None:
    """Colour is evaluated along R^T d, for all degrees."""
    splats = ball(200, coefficients=coefficients)
    quat = np.array([0.3, -0.5, 0.1, 0.8]) / np.linalg.norm([0.3, -0.5, 0.1, 0.8])
    turns = np.repeat(rotations_from_quats(quat[None]), splats.count, axis=0)
    arrays = SplatArrays.from_splats([splats], device=device)
    arrays = replace(arrays, rotations=wp.full((1, splats.count), wp.quat(*quat), dtype=wp.quat, device=device))
    rasterizer = SplatRasterizer(splats.count, 1, 40, 32, device=device)
    rasterizer.render(arrays, views_of(EYES[:1], 40, 32, device))
    assert_matches(rasterizer, 0, dense(splats, EYES[0], 40, 32, rotations=turns))


def test_rigid_motion_of_splats_and_camera_changes_nothing(device: str) -> None:
    """Turning an object of degree 3 together with the camera leaves the picture as it was."""
    splats = ball(200, coefficients=16)
    angle = 0.8
    c, s = np.cos(angle), np.sin(angle)
    r = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    images = []
    for turned in (False, True):
        arrays = SplatArrays.from_splats([splats], device=device)
        eye = np.array(EYES[0])
        if turned:
            # Means and covariances move, coefficients stay in the rest frame: what skinning does.
            moved = SplatArrays.from_splats([splats.transformed(r)], device=device)
            quat = wp.quat(*quats_from_rotations(r))
            rotations = wp.full((1, splats.count), quat, dtype=wp.quat, device=device)
            arrays = replace(arrays, means=moved.means, covariances=moved.covariances, rotations=rotations)
            eye = r @ eye
        rasterizer = SplatRasterizer(splats.count, 1, 40, 32, device=device)
        rasterizer.render(arrays, views_of([eye], 40, 32, device))
        images.append(rasterizer.rgb.numpy())
    # Rounding may flip the 1/255 cut of single splats: at most alpha = 1/255 of a colour.
    difference = np.abs(images[0] - images[1]).max(axis=-1)
    assert difference.max() < 3 / 255 and np.median(difference) < TOLERANCE


def test_an_off_centre_lens_shows_a_crop(device: str) -> None:
    """A lens whose axis lies outside its image shows what the corner of a large picture of the same lens shows."""
    splats, large, small, first = ball(300), 96, 32, 64
    matrix = look_at((1.6, 0.3, 0.5)).astype(np.float32)
    matrix[:2, 3] += 0.42
    pictures = []
    for edge, center in ((large, 0.5 * large), (small, 0.5 * large - first)):
        views = ViewArrays(
            world_to_camera=wp.array(matrix[None], dtype=wp.mat44, device=device),
            intrinsics=wp.array([(80.0, 80.0, center, center)], dtype=wp.vec4, device=device),
            world=wp.zeros(1, dtype=wp.int32, device=device),
            background=wp.array([BACKGROUND], dtype=wp.vec3, device=device),
        )
        rasterizer = SplatRasterizer(splats.count, 1, edge, edge, device=device)
        rasterizer.render(SplatArrays.from_splats([splats], device=device), views)
        pictures.append((rasterizer.rgb.numpy()[0], rasterizer.alpha.numpy()[0]))
    (rgb, alpha), (crop_rgb, crop_alpha) = pictures
    assert (crop_alpha > 0.5).mean() > 0.3
    # Splats whose centres lie far outside of the crop are linearised a little nearer to it.
    np.testing.assert_allclose(crop_alpha, alpha[first:, first:], atol=2e-3)
    np.testing.assert_allclose(crop_rgb, rgb[first:, first:], atol=2e-3)


def test_antialiasing_keeps_the_energy_of_small_splats(device: str) -> None:
    """A splat far smaller than a pixel adds its area times its opacity; the classic mode adds that of the filter."""
    sigma, depth, focal = 1e-3, 2.0, 40.0
    splats = Splats(
        means=[[0.0, 0.0, 0.0]], quats=[[0, 0, 0, 1]], scales=[[sigma] * 3], opacities=[0.9], sh=np.ones((1, 1, 3))
    )  # fmt: skip
    views = views_of([(depth, 0.0, 0.0)], 32, 32, device)
    views = replace(views, intrinsics=wp.array([[focal, focal, 16.0, 16.0]], dtype=wp.vec4, device=device))
    variance = (focal / depth * sigma) ** 2
    sums = {}
    for antialiased in (True, False):
        # A large opacity would be cut at 0.99; a wide filter keeps the sum close to the integral.
        options = RasterizerOptions(antialiased=antialiased, dilation=1.0)
        rasterizer = SplatRasterizer(1, 1, 32, 32, options=options, device=device)
        rasterizer.render(SplatArrays.from_splats([splats], device=device), views)
        sums[antialiased] = float(rasterizer.alpha.numpy().sum())
    assert sums[True] == 0.0, "0.9 * variance / 1.0 is below 1/255"
    # The integral of o exp(-d^2/2) up to alpha = 1/255 is 2 pi (variance + 1) (o - 1/255).
    expected = 2 * np.pi * (variance + 1.0) * (0.9 - 1 / 255)
    assert sums[False] == pytest.approx(expected, rel=0.02)


def mesh_images(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return colour and depth of a slanted wall through the ball that covers two thirds of the picture."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    depth = np.where(x > width / 3, 1.3 + 0.6 * y / height, 0.0).astype(np.float32)
    return np.stack([x / width, y / height, 0.5 + 0 * x], axis=-1).astype(np.float32), depth


def test_mesh_cuts_splats_behind_it(device: str) -> None:
    """Splats behind the mesh are gone, it shows through those in front, and its depth enters the expected depth."""
    splats = ball()
    rgb, depth = mesh_images(48, 40)
    options = RasterizerOptions(median_depth=True)
    rasterizer = SplatRasterizer(splats.count, 1, 48, 40, options=options, device=device)
    rasterizer.render(
        SplatArrays.from_splats([splats], device=device),
        views_of(EYES[:1], 48, 40, device),
        mesh_rgb=wp.array(rgb[None], dtype=wp.vec3, device=device),
        mesh_depth=wp.array(depth[None], dtype=wp.float32, device=device),
    )
    expected = dense(splats, EYES[0], 48, 40, mesh_rgb=rgb.astype(float), mesh_depth=depth.astype(float))
    assert_matches(rasterizer, 0, expected)
    free = dense(splats, EYES[0], 48, 40)
    assert (free.alpha - expected.alpha).max() > 0.1, "the wall hides something"
    wall = np.abs(expected.alpha) < 1e-9
    np.testing.assert_array_equal(rasterizer.rgb.numpy()[0][wall & (depth > 0)], rgb[wall & (depth > 0)])
    np.testing.assert_allclose(rasterizer.depth.numpy()[0][wall], depth[wall], rtol=1e-6)


@pytest.mark.parametrize(("count", "eyes"), [(400, 3), (8000, 3), (8000, 1)])
def test_captured_graph_equals_eager(device: str, count: int, eyes: int) -> None:
    """Replaying a captured frame on changed splats gives bitwise the image of an eager one, whichever way it sorts."""
    splats = ball(count)
    arrays = SplatArrays.from_splats([splats], device=device)
    views = views_of(EYES[:eyes], 48, 40, device)
    rasterizer = SplatRasterizer(splats.count, eyes, 48, 40, device=device)
    rasterizer.render(arrays, views)
    with wp.ScopedCapture(device=device) as capture:
        rasterizer.render(arrays, views)
    arrays.means.assign(np.roll(splats.means, 1, axis=0)[None])
    rasterizer.render(arrays, views)
    outputs = ("rgb", "depth", "alpha")
    eager = {name: getattr(rasterizer, name).numpy().copy() for name in outputs}
    for name in outputs:
        getattr(rasterizer, name).fill_(-1)
    wp.capture_launch(capture.graph)
    for name in outputs:
        np.testing.assert_array_equal(getattr(rasterizer, name).numpy(), eager[name], err_msg=name)


def test_world_of_many_equals_the_single_world(device: str) -> None:
    """Two cameras in each of three worlds with their own means, opacity and colour: bitwise the worlds one by one."""
    worlds = [ball(seed=seed, coefficients=4) for seed in range(3)]
    parts = [SplatArrays.from_splats([splats], device=device) for splats in worlds]

    def stack(field: str, dtype: Any) -> wp.array:
        return wp.array(np.concatenate([getattr(part, field).numpy() for part in parts]), dtype=dtype, device=device)

    many = SplatArrays(
        means=stack("means", wp.vec3),
        covariances=stack("covariances", parts[0].covariances.dtype),
        opacities=stack("opacities", wp.float32),
        sh=stack("sh", wp.vec3),
        object_index=parts[0].object_index,
        rotations=parts[0].rotations,
    )
    eyes = [EYES[0]] * 3 + [EYES[1]] * 3
    together = SplatRasterizer(400, 6, 48, 40, device=device)
    together.render(many, views_of(eyes, 48, 40, device, worlds=[0, 1, 2, 0, 1, 2]))
    alone = SplatRasterizer(400, 1, 48, 40, device=device)
    for view, eye in enumerate(eyes):
        alone.render(parts[view % 3], views_of([eye], 48, 40, device))
        np.testing.assert_array_equal(together.rgb.numpy()[view], alone.rgb.numpy()[0])
        np.testing.assert_array_equal(together.depth.numpy()[view], alone.depth.numpy()[0])


def test_a_splat_over_every_tile_is_drawn(device: str) -> None:
    """Thousands of splats that each cover the whole picture fit as well as small ones: every tile lists them all."""
    line = np.linspace(-1.0, 1.0, 1000)[:, None] * [1.0, 0.1, 0.0]
    splats = replace(ball(1000), means=line, scales=np.full((1000, 3), 30.0), opacities=np.full(1000, 0.03))
    rasterizer = SplatRasterizer(1000, 1, 96, 40, device=device)
    rasterizer.render(SplatArrays.from_splats([splats], device=device), views_of([(9.0, 0.0, 0.0)], 96, 40, device))
    assert_matches(rasterizer, 0, dense(splats, (9.0, 0.0, 0.0), 96, 40))


def test_non_finite_and_hidden_splats_are_left_out(device: str) -> None:
    """NaN from a failed step, splats behind the camera and beside the view draw nothing and harm nothing."""
    splats = ball(100)
    arrays = SplatArrays.from_splats([splats], device=device)
    means = splats.means[None].copy()
    means[0, 0] = np.nan
    means[0, 1] = np.inf
    means[0, 2] = [50.0, 0.0, 0.0]
    arrays.means.assign(means)
    rasterizer = SplatRasterizer(100, 1, 48, 40, device=device)
    rasterizer.render(arrays, views_of(EYES[:1], 48, 40, device))
    kept = splats.subset(np.arange(3, 100))
    assert_matches(rasterizer, 0, dense(kept, EYES[0], 48, 40))


def test_an_opacity_that_is_no_number_draws_nothing(device: str) -> None:
    """Opacities above one draw as one, NaN as nothing."""
    splats = ball(100)
    arrays = SplatArrays.from_splats([splats], device=device)
    opacities = splats.opacities[None].copy()
    opacities[0, :2] = np.nan, 2.0
    arrays.opacities.assign(opacities)
    rasterizer = SplatRasterizer(100, 1, 48, 40, device=device)
    rasterizer.render(arrays, views_of(EYES[:1], 48, 40, device))
    kept = replace(splats, opacities=np.nan_to_num(opacities[0]).clip(0.0, 1.0)).subset(np.arange(1, 100))
    assert_matches(rasterizer, 0, dense(kept, EYES[0], 48, 40))


@pytest.mark.parametrize("ahead", [900, 8000, 70000])
def test_a_picture_does_not_depend_on_the_ranks_of_its_splats(device: str, ahead: int) -> None:
    """What lies behind many splats in the corner is drawn as without them: lists go on beyond any number of ranks."""
    behind = ball(40)
    eye, width, height = (3.0, 0.0, 0.0), 64, 48
    x, y = np.meshgrid(np.linspace(0.72, 0.78, 10), np.linspace(0.52, 0.58, 10))  # up to the right of the ball
    corner = np.tile(np.stack([np.full(100, 1.0), x.ravel(), y.ravel()], axis=1), (ahead // 100, 1))
    front = Splats(
        means=corner,
        quats=np.tile([0.0, 0.0, 0.0, 1.0], (ahead, 1)),
        scales=np.full((ahead, 3), 0.01),
        opacities=np.full(ahead, 0.1),
        sh=np.ones((ahead, 1, 3)),
    )
    views = views_of([eye, eye], width, height, device)
    images = []
    for objects in ([behind], [front, behind]):
        arrays = SplatArrays.from_splats(objects, device=device)
        rasterizer = SplatRasterizer(arrays.means.shape[1], 2, width, height, device=device)
        rasterizer.render(arrays, views)
        images.append((rasterizer.rgb.numpy(), rasterizer.alpha.numpy()))
    (rgb, alpha), (together, covered) = images
    same = (together == rgb).all(axis=(0, 3))
    assert (covered[:, ~same] > 0.9).any(axis=0).any(), "the corner is drawn"
    corner_rows, corner_columns = np.nonzero(~same)
    seen = alpha[0] > 0.0
    assert seen.sum() > 100 and same[seen].all() and corner_rows.max() < height // 2
    assert corner_columns.min() > np.nonzero(seen)[1].max() or corner_rows.max() < np.nonzero(seen)[0].min()


def test_several_objects_share_a_frame(device: str) -> None:
    """Objects of different degree are drawn together, each with its id."""
    near = ball(100).transformed(translation=(0.5, 0.0, 0.0), scale=0.3)
    far = ball(100, seed=1, coefficients=4).transformed(translation=(-1.5, 0.0, 0.0))
    arrays = SplatArrays.from_splats([far, near], device=device)
    options = RasterizerOptions(object_ids=True)
    rasterizer = SplatRasterizer(200, 1, 64, 64, options=options, device=device)
    rasterizer.render(arrays, views_of([(1.6, 0.0, 0.0)], 64, 64, device))
    ids = rasterizer.object_id.numpy()[0]
    assert set(np.unique(ids)) == {-1, 0, 1}
    depth = rasterizer.depth.numpy()[0]
    assert np.median(depth[ids == 1]) < 1.5 < 2.5 < np.median(depth[ids == 0])


def test_plush_is_solid() -> None:
    """The default object hides what is behind it: no light through its middle."""
    plush = make_plush()
    rasterizer = SplatRasterizer(plush.count, 1, 96, 96, device="cpu")
    views = views_of([(0.25, 0.05, 0.04)], 96, 96, "cpu")
    rasterizer.render(SplatArrays.from_splats([plush], device="cpu"), views)
    alpha = rasterizer.alpha.numpy()[0]
    covered = alpha > 0.5
    assert covered.sum() > 500
    # All but the silhouette, one or two pixels wide, is opaque.
    inner = covered[1:-1, 1:-1] & covered[2:, 1:-1] & covered[:-2, 1:-1] & covered[1:-1, 2:] & covered[1:-1, :-2]
    assert np.quantile(alpha[1:-1, 1:-1][inner], 0.1) > 0.98


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 1, 32, 32), "0 splats"),
        ((10, 0, 32, 32), "0 views"),
        ((10, 1, 0, 32), "0 x 32"),
        ((10, 1, 5000, 32), "5000 x 32"),
        ((2**24, 100, 32, 32), "out of range"),
        ((1, 128, 4096, 4096), "out of range"),
    ],
)
def test_refuses_sizes_out_of_range(arguments: Any, message: str) -> None:
    """Sizes that the buffers cannot hold are refused before anything is allocated."""
    with pytest.raises(ConfigError, match=message):
        SplatRasterizer(*arguments, device="cpu")


@pytest.mark.parametrize("options", [{"near": 0.0}, {"near": -1.0}, {"near": float("nan")}, {"dilation": -0.1}])
def test_refuses_options_out_of_range(options: Any) -> None:
    """Near planes behind the camera and negative variances."""
    with pytest.raises(ConfigError, match=next(iter(options))):
        RasterizerOptions(**options)


def test_refuses_arrays_of_another_size() -> None:
    """Arrays that do not fit the buffers are named."""
    rasterizer = SplatRasterizer(100, 1, 32, 32, device="cpu")
    arrays, views = SplatArrays.from_splats([ball(100)], device="cpu"), views_of(EYES[:1], 32, 32, "cpu")
    with pytest.raises(ConfigError, match=r"splats\.means"):
        rasterizer.render(SplatArrays.from_splats([ball(99)], device="cpu"), views)
    with pytest.raises(ConfigError, match=r"views\.world_to_camera"):
        rasterizer.render(arrays, views_of(EYES, 32, 32, "cpu"))
    for part, field, shape in (
        (arrays, "sh", (1, 99, 1)),
        (arrays, "sh", (1, 100, 2)),
        (views, "background", (2,)),
        (views, "splat_gain", (3,)),
    ):
        other = wp.zeros(shape, dtype=wp.vec4 if field == "splat_gain" else wp.vec3, device="cpu")
        changed = replace(part, **{field: other})
        with pytest.raises(ConfigError, match=field):
            rasterizer.render(
                changed if part is arrays else arrays, changed if part is views else views
            )  # fmt: skip
    worlds = SplatArrays.from_splats([ball(100)], world_count=3, device="cpu")
    few = replace(worlds, covariances=worlds.covariances[:2])
    with pytest.raises(ConfigError, match=r"splats\.covariances has shape \(2, 100\), expected \(3, 100\)"):
        rasterizer.render(few, views)
    with pytest.raises(ConfigError, match="mesh_rgb has shape None"):
        rasterizer.render(arrays, views, mesh_depth=wp.zeros((1, 32, 32), device="cpu"))
    for name, value in (("world_count", 0), ("sh_degree", 4)):
        with pytest.raises(ConfigError, match=name):
            SplatArrays.from_splats([make_plush(200)], **{name: value}, device="cpu")
    with pytest.raises(ConfigError, match="no list"):
        SplatArrays.from_splats(make_plush(200), device="cpu")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="objects is empty"):
        SplatArrays.from_splats([], device="cpu")
