"""Splats fitted to pictures of a mesh: gradients, steps, and what comes out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from softmode.deformables.quadrature.quadrature import quadrature_from_splats
from softmode.errors import ConfigError
from softmode.objects.mesh_fit import FitOptions, MeshFit, splats_from_mesh
from softmode.splats.colored_mesh import ColoredMesh
from softmode.splats.fit import picture_fit_kernels as kernels
from softmode.splats.fit.reference_views import orbit_poses, render_mesh
from softmode.splats.mesh_samples import sample_mesh
from softmode.splats.raster.rasterizer import SplatArrays, SplatRasterizer
from softmode.splats.splats import Splats
from tests.splats.meshes import bumpy_sphere, painted_box, two_objects

FAST = FitOptions(iterations=40, size=64, view_count=16, held_out_count=6, samples=3, report_every=20)


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    """Every device that is there."""
    if request.param != "cpu" and not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return request.param


def parameters(count: int, seed: int = 0) -> list[np.ndarray]:
    """Return random centres, unit quaternions, log-scales, logits and colours."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    sizes = ((count, 3), (count, 3), (count,), (count, 3))
    center, log_scale, logit, color = (rng.normal(size=size) for size in sizes)
    return [center, quats, 0.3 * log_scale, logit, color]


def upload(values: list[np.ndarray]) -> list[wp.array]:
    """Return the parameters on the device."""
    types = (wp.vec3, wp.quat, wp.vec3, wp.float32, wp.vec3)
    return [wp.array(v.astype(np.float32), dtype=t, device="cpu") for v, t in zip(values, types, strict=True)]


def composed(values: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the six stored covariance entries and the opacities, in float64."""
    _, quats, log_scale, logit, _ = values
    frame = Rotation.from_quat(quats).as_matrix() * np.exp(log_scale)[:, None]
    s = frame @ frame.transpose(0, 2, 1)
    six = np.stack([s[:, 0, 0], s[:, 0, 1], s[:, 0, 2], s[:, 1, 1], s[:, 1, 2], s[:, 2, 2]], axis=1)
    return six, 1.0 / (1.0 + np.exp(-logit))


def adam(
    values: list[np.ndarray], gradients: list[np.ndarray], rate: float, bound: float = 9.0
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Take one step; return the new parameters, the first moments and the counts."""
    count, device = len(values[0]), "cpu"
    by_mean, by_six, by_opacity, by_color = gradients
    arrays = upload(values)
    first, second = (wp.zeros(count, dtype=kernels.vec13, device=device) for _ in range(2))
    steps = wp.zeros(count, dtype=wp.int32, device=device)
    wp.launch(
        kernels.adam_step, dim=count, device=device,
        inputs=[
            wp.array(by_mean[None].astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(by_six[None].astype(np.float32), dtype=kernels.vec6, device=device),
            wp.array(by_opacity[None].astype(np.float32), dtype=wp.float32, device=device),
            wp.array(by_color[None, :, None].astype(np.float32), dtype=wp.vec3, device=device),
            kernels.vec13(*[rate] * 13), wp.vec3(-bound, -bound, -bound), wp.vec3(bound, bound, bound),
            *arrays, first, second, steps,
        ],
    )  # fmt: skip
    return [array.numpy() for array in arrays], first.numpy(), steps.numpy()


# -- gradients and steps ----------------------------------------------------------------------------------------------


def test_parameters_compose_to_covariances_and_opacities() -> None:
    """S = R diag(exp(2 l)) R^T and o = 1 / (1 + exp(-x)), as in float64 to float32's rounding."""
    values = parameters(50)
    splats = SplatArrays(
        means=wp.zeros((1, 50), dtype=wp.vec3, device="cpu"),
        covariances=wp.zeros((1, 50), dtype=kernels.vec6, device="cpu"),
        opacities=wp.zeros((1, 50), dtype=wp.float32, device="cpu"),
        sh=wp.zeros((1, 50, 1), dtype=wp.vec3, device="cpu"),
        object_index=wp.zeros(50, dtype=wp.int32, device="cpu"),
        rotations=wp.zeros((1, 1), dtype=wp.quat, device="cpu"),
    )
    wp.launch(
        kernels.compose_splats, dim=50, inputs=upload(values), device="cpu",
        outputs=[splats.means, splats.covariances, splats.opacities, splats.sh],
    )  # fmt: skip
    six, opacity = composed(values)
    np.testing.assert_allclose(splats.covariances.numpy()[0], six, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(splats.opacities.numpy()[0], opacity, rtol=1e-5)
    np.testing.assert_allclose(splats.means.numpy()[0], values[0], rtol=1e-6)
    np.testing.assert_allclose(splats.sh.numpy()[0, :, 0], values[4], rtol=1e-6)


def test_gradient_by_rotation_scale_and_logit_is_the_difference_quotient() -> None:
    """For L = <A, S> + <b, o>: dL by w in exp([w]) R, by l and by x, central differences in float64."""
    values, rng, h = parameters(20), np.random.default_rng(1), 1e-5
    by_mean, by_six, by_opacity, by_color = (rng.normal(size=size) for size in ((20, 3), (20, 6), (20,), (20, 3)))

    def loss(w: np.ndarray, l: np.ndarray, x: np.ndarray) -> np.ndarray:
        turned = (Rotation.from_rotvec(w) * Rotation.from_quat(values[1])).as_quat()
        six, opacity = composed([values[0], turned, values[2] + l, values[3] + x, values[4]])
        return (six * by_six).sum(axis=1) + opacity * by_opacity

    expected = np.zeros((20, 13))
    expected[:, :3], expected[:, 10:] = by_mean, by_color
    for k in range(7):
        step = np.zeros((20, 7))
        step[:, k] = h
        parts = step[:, :3], step[:, 3:6], step[:, 6]
        expected[:, 3 + k] = (loss(*parts) - loss(*(-part for part in parts))) / (2 * h)
    _, first, _ = adam(values, [by_mean, by_six, by_opacity, by_color], 0.0)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(10.0 * first, expected, atol=1e-5 * scale)  # the first moment is (1 - 0.9) g


def test_first_step_is_the_rate_against_the_sign_and_unseen_splats_stay() -> None:
    """Adam's first step is -rate sign(g); a splat without a gradient keeps parameters, moments and count."""
    values, rng = parameters(10), np.random.default_rng(2)
    by_mean, by_six, by_opacity, by_color = (rng.normal(size=size) for size in ((10, 3), (10, 6), (10,), (10, 3)))
    for gradient in (by_mean, by_six, by_opacity, by_color):
        gradient[::2] = 0.0
    after, first, count = adam(values, [by_mean, by_six, by_opacity, by_color], 1e-3)
    assert (count == np.tile([0, 1], 5)).all() and (first[::2] == 0.0).all()
    for old, new in zip(values, after, strict=True):
        np.testing.assert_array_equal(new[::2], old[::2].astype(np.float32))
    for old, new, gradient in ((values[0], after[0], by_mean), (values[4], after[4], by_color)):
        np.testing.assert_allclose(new[1::2] - old[1::2], -1e-3 * np.sign(gradient[1::2]), atol=1e-6)
    np.testing.assert_allclose(after[3][1::2] - values[3][1::2], -1e-3 * np.sign(by_opacity[1::2]), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(after[1], axis=1), 1.0, atol=1e-6)
    bounded, _, _ = adam(values, [by_mean, by_six, by_opacity, by_color], 1.0, bound=0.1)
    assert np.abs(bounded[2][1::2]).max() <= 0.1 + 1e-7


# -- what comes out ---------------------------------------------------------------------------------------------------


def psnr_from_scratch(mesh: ColoredMesh, splats: Splats, size: int, views: int = 4) -> float:
    """Measure PSNR apart from the fit: other cameras, farther away, before black, with 8 x 8 rays per pixel."""
    low, high = mesh.corners.min(axis=(0, 1)), mesh.corners.max(axis=(0, 1))
    radius, center = 0.5 * float(np.linalg.norm(high - low)), 0.5 * (low + high)
    poses = orbit_poses(views, 3.5 * radius, np.random.default_rng(77))
    poses[:, :3, 3] -= np.einsum("nij,j->ni", poses[:, :3, :3], center)
    focal = 1.6 * size
    lens = (focal, focal, 0.5 * size, 0.5 * size)
    pictures = render_mesh(mesh, poses, lens, width=size, height=size, samples=8)
    rasterizer = SplatRasterizer(splats.count, views, size, size)
    rasterizer.render(SplatArrays.from_splats([splats]), pictures.view_arrays(range(views), [(0.0, 0.0, 0.0)]))
    error = rasterizer.rgb.numpy() - pictures.on((0.0, 0.0, 0.0))
    return float(np.mean(-10.0 * np.log10((error**2).mean(axis=(1, 2, 3)))))


@pytest.fixture(scope="module")
def fitted() -> MeshFit:
    """Fit 1,500 splats to the bumpy sphere."""
    return splats_from_mesh(bumpy_sphere(), count=1500, options=FAST)


def test_the_fit_raises_the_psnr_of_views_it_has_not_seen(fitted: MeshFit) -> None:
    """By 6 dB or more, to 30 dB or more, by its own held-out pictures and by others measured apart from it."""
    assert [iteration for iteration, _ in fitted.history] == [0, 20, 40]
    assert fitted.psnr == fitted.history[-1][1]
    assert fitted.psnr > max(fitted.history[0][1] + 6.0, 30.0)
    mesh = ColoredMesh.from_trimesh(bumpy_sphere())
    before, after = (psnr_from_scratch(mesh, s, 64) for s in (sample_mesh(mesh, 1500), fitted.splats))
    assert after > before + 4.0


def test_fitted_splats_stay_flat_on_the_surface(fitted: MeshFit) -> None:
    """Nine of ten centres lie within half a spacing of the surface, and splats remain three times as wide as thick."""
    mesh = bumpy_sphere()
    spacing = np.sqrt(mesh.area / fitted.splats.count)
    distance, _ = KDTree(trimesh.sample.sample_surface(mesh, 100_000, seed=0)[0]).query(fitted.splats.means)
    assert np.quantile(distance, 0.9) < 0.5 * spacing
    scales = np.sort(fitted.splats.scales, axis=1)
    assert np.median(scales[:, 1] / scales[:, 0]) > 3.0
    assert fitted.splats.sh_degree == 0 and fitted.splats.count == 1500


def test_fitted_splats_enclose_the_volume_of_the_mesh(fitted: MeshFit) -> None:
    """They serve as a soft object: the solid they enclose has the volume of the mesh to 10 %."""
    splats = fitted.splats
    quadrature = quadrature_from_splats(splats.means, splats.scales, splats.quats, splats.opacities)
    assert quadrature.volume == pytest.approx(bumpy_sphere().volume, rel=0.1)


@pytest.mark.parametrize("source", [painted_box, two_objects])
def test_vertex_colors_and_scenes_are_fitted(
    device: str, source: Callable[[], trimesh.Trimesh | trimesh.Scene]
) -> None:
    """The PSNR of a painted box, and of a scene of a box and a textured sphere, rises by 4 dB or more."""
    fit = splats_from_mesh(source(), count=1000, options=FAST, device=device)
    assert fit.psnr > fit.history[0][1] + 4.0


def test_unit_and_place_of_the_mesh_do_not_matter(tmp_path: Path) -> None:
    """A mesh in millimetres far from the origin, read from a file, gives the same splats, moved and scaled."""
    options = FitOptions(iterations=3, size=32, view_count=2, held_out_count=1, samples=2)
    near = painted_box()
    far = near.copy()
    far.apply_scale(1000.0)
    far.apply_translation([3000.0, 0.0, -2000.0])
    file = tmp_path / "far.ply"
    far.export(file)
    first, second = (splats_from_mesh(mesh, count=200, options=options) for mesh in (near, file))
    moved = first.splats.transformed(scale=1000.0, translation=(3000.0, 0.0, -2000.0))
    np.testing.assert_allclose(second.splats.means, moved.means, atol=1.0)  # [mm]
    np.testing.assert_allclose(second.splats.scales, moved.scales, rtol=0.01)
    assert second.psnr == pytest.approx(first.psnr, abs=0.05)


def test_the_fit_repeats_in_every_bit_and_the_seed_matters() -> None:
    """Equal seeds give equal bits on CPU; another seed, or none of the steps, another result."""
    options = dict(iterations=4, size=32, view_count=3, held_out_count=1, samples=2)
    losses: list[float] = []
    fits = [
        splats_from_mesh(
            painted_box(), count=150, options=FitOptions(seed=seed, **options), device="cpu",
            progress=lambda _, loss: losses.append(loss),
        )
        for seed in (1, 1, 2)
    ]  # fmt: skip
    assert len(losses) == 12 and losses[:4] == losses[4:8]
    for field in ("means", "quats", "scales", "opacities", "sh"):
        a, b, c = (getattr(fit.splats, field) for fit in fits)
        assert np.array_equal(a, b) and not np.array_equal(a, c)
    sampled = splats_from_mesh(painted_box(), count=150, options=FitOptions(**{**options, "iterations": 0}, seed=1))
    assert len(sampled.history) == 1 and not np.array_equal(sampled.splats.means, fits[0].splats.means)


@pytest.mark.parametrize("wrong", [{"iterations": -1}, {"size": 3}, {"views_per_step": 9, "view_count": 8}])
def test_options_out_of_range_are_refused(wrong: dict) -> None:
    """Each names the option."""
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        FitOptions(**wrong)


@pytest.mark.slow
@pytest.mark.parametrize("count", [2500, 10_000])
def test_default_fit_of_a_smooth_texture_exceeds_30_db(count: int) -> None:
    """The default options reach 30 dB on held-out pictures of 128 px, and at least 10 dB above the sampled splats."""
    fit = splats_from_mesh(bumpy_sphere(), count=count)
    assert fit.psnr > max(30.0, fit.history[0][1] + 10.0)
    assert psnr_from_scratch(ColoredMesh.from_trimesh(bumpy_sphere()), fit.splats, 128) > 30.0
