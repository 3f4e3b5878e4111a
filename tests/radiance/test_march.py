"""Rays through fields: closed forms, rigid motion, deformed bodies against splats, worlds, graphs, and compositing."""

from __future__ import annotations

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from softmode.deformables import InverseMap, SolverReduced, add_reduced_body
from softmode.deformables.model.namespaces import soft
from softmode.errors import ConfigError
from softmode.objects import SoftObject
from softmode.radiance import MarchOptions, RadianceGrid, RadianceMarch, render_radiance, splats_from_radiance
from softmode.radiance.march import holds_of
from softmode.scenes import BoundSplats
from softmode.splats import PinholeCamera, SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats.fit.picture_fit import FitOptions
from tests.radiance.fields import bent, block_body, block_field, camera, psnr

WHITE = np.ones(3)


def drawn(field, eye: PinholeCamera, **options) -> np.ndarray:
    """Return the picture of a field at rest before white."""
    lens = (eye.fx, eye.fy, eye.cx, eye.cy)
    views = render_radiance(field, [eye.world_to_camera], lens, width=eye.width, height=eye.height, **options)
    return views.on(WHITE)[0]


def layers(q, eye: PinholeCamera, degree: int = 0, **options) -> tuple[np.ndarray, np.ndarray]:
    """Return the layer of the block at coordinates, and its depth times coverage."""
    field, body = block_field(degree), block_body()
    inverse = InverseMap(None, body, within=holds_of(field), turns=degree > 0, device="cpu")
    march = RadianceMarch([(inverse, field)], options=MarchOptions(**options))
    inverse.move(wp.array(q, dtype=wp.vec3d, device="cpu"))
    march.mark()
    layer, depth, _ = march.march(ViewArrays.from_cameras([eye], device="cpu"), (eye.height, eye.width))
    return layer.numpy()[0, 0], depth.numpy()[0, 0]


def moved(q, eye: PinholeCamera, degree: int = 0, **options) -> np.ndarray:
    """Return the picture of the block at coordinates before white."""
    layer = layers(q, eye, degree, **options)[0]
    return layer[..., :3] + (1.0 - layer[..., 3:]) * WHITE


def test_absorption():
    """Through a slab of density sigma and thickness l the coverage is 1 - exp(-sigma l), whatever the step."""
    density = np.zeros((9, 9, 33))
    density[:, :, 8:25] = 60.0
    slab = RadianceGrid.from_bounds(density, np.zeros((*density.shape, 1, 3)), [[-1, -1, -0.032], [1, 1, 0.032]])
    eye = PinholeCamera.look_at(
        "c", position=(0, 0, 3.0), target=(0, 0, 0), up=(0, 1, 0), width=3, height=3, fov_y=0.01
    )
    for step in (0.1, 0.6):
        lens = (eye.fx, eye.fy, eye.cx, eye.cy)
        views = render_radiance(slab, [eye.world_to_camera], lens, width=3, height=3, step=step)
        alpha = views.alpha.numpy()[0, 1, 1]
        assert alpha == pytest.approx(1.0 - np.exp(-60.0 * 17 * 0.002), abs=0.01)
        np.testing.assert_allclose(views.rgb.numpy()[0, 1, 1], 0.5 * alpha, atol=1e-5)


def test_steps_converge():
    """Half the step and four rays per pixel change the picture little: 35 dB."""
    eye = camera()
    assert psnr(drawn(block_field(), eye), drawn(block_field(), eye, step=0.1)) > 38.0
    assert psnr(drawn(block_field(), eye), drawn(block_field(), eye, step=0.2, samples=4)) > 28.0


@pytest.mark.parametrize("degree", [0, 2])
def test_rigid_motion(degree):
    """The field of a rigidly moved body is the field at rest before the camera that moved along: 50 dB."""
    turn, shift = Rotation.from_rotvec([0.4, -0.3, 0.8]).as_matrix(), np.array([0.05, -0.02, 0.3])
    eye, body = camera(), block_body()
    place = turn @ np.array(eye.position) + shift
    quat = (Rotation.from_matrix(turn) * Rotation.from_quat(eye.quat)).as_quat()
    lens = eye.matrix
    carried = PinholeCamera.from_matrix(
        "c", lens, width=eye.width, height=eye.height, position=tuple(place), quat=tuple(quat)
    )
    field = block_field(degree)
    assert psnr(moved(body.affine(turn, shift), carried, degree), drawn(field, eye)) > 50.0
    assert np.abs(drawn(field, eye) - 1.0).max() > 0.4


def test_dents_are_seen():
    """A block whose whole skin is dented by 4 mm upwards has the outline of one that is moved by as much: 39 dB.

    As a state of a solver has it. Without its dents 17 dB.
    """
    body, field, eye = block_body(), block_field(), camera()
    builder = newton.ModelBuilder()
    for place in ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0)):
        add_reduced_body(builder, body, position=place)
    solver = SolverReduced(builder.finalize(device="cpu"), [body])
    state, shift = solver.model.state(), np.array([0.0, 0.0, 0.004])
    march = RadianceMarch.of_bodies(solver, [(1, field)])
    wanted = layers(body.affine(np.eye(3), shift), eye)[0][..., 3]
    found = []
    for dent in (shift, 0.0 * shift):
        soft(state).dent.fill_(wp.vec3())
        soft(state).dent[body.surface_count :].fill_(wp.vec3(*dent))
        march.update(state)
        layer = march.march(ViewArrays.from_cameras([eye], device="cpu"), (eye.height, eye.width))[0]
        found.append(psnr(layer.numpy()[0, 0, ..., 3], wanted))
    assert found[0] > 35.0 and found[1] < 20.0


def test_scale_keeps_the_look():
    """A body twice as large looks the same from twice as far: opacity is counted at rest."""
    eye = camera()
    far = PinholeCamera.look_at("c", position=tuple(2.0 * np.array(eye.position)), target=(0.0, 0.0, 0.02),
                                width=eye.width, height=eye.height, fov_y=0.6)  # fmt: skip
    assert psnr(moved(block_body().affine(2.0 * np.eye(3)), far), drawn(block_field(), eye)) > 40.0


def test_bake_against_march():
    """Baked splats beside marched rays: 32 dB at rest, 30 dB bent by 90 degrees."""
    options = FitOptions(iterations=40, view_count=16, held_out_count=4, size=96)
    fit = splats_from_radiance(block_field(), count=6000, options=options)
    assert fit.psnr > 32.0 and fit.psnr > fit.history[0][1]
    body, eye = block_body(), camera()
    thing = SoftObject(body=body, splats=fit.splats)
    for q, least in ((np.zeros((body.function_count, 3)), 32.0), (body.project(lambda x: bent(x) - x), 30.0)):
        bound = BoundSplats(None, [thing], device="cpu")
        bound.move(wp.array(q, dtype=wp.vec3d, device="cpu"))
        rasterizer = SplatRasterizer(fit.splats.count, 1, eye.width, eye.height, device="cpu")
        rasterizer.render(bound.arrays, ViewArrays.from_cameras([eye], background=(1.0, 1.0, 1.0), device="cpu"))
        assert psnr(rasterizer.rgb.numpy()[0], moved(q, eye, samples=3)) > least


def test_bake_keeps_view_dependence():
    """Splats of a field of degree 2 look from two sides as the field does, better than its mean colour would."""
    field, options = block_field(2), FitOptions(iterations=0, view_count=2, held_out_count=4, size=64)
    full = splats_from_radiance(field, count=6000, options=options).splats
    assert full.sh_degree == 2
    flat = full.with_sh_degree(0)
    eye = camera()
    errors = []
    for splats in (full, flat):
        rasterizer = SplatRasterizer(splats.count, 1, eye.width, eye.height, device="cpu")
        views = ViewArrays.from_cameras([eye], background=(1.0, 1.0, 1.0), device="cpu")
        rasterizer.render(SplatArrays.from_splats([splats], device="cpu"), views)
        errors.append(psnr(rasterizer.rgb.numpy()[0], drawn(field, eye)))
    assert errors[0] > errors[1] + 3.0


def test_graph_and_worlds():
    """World i of two is the single world, and a captured frame the eager one, to the bit."""
    field, body, eye = block_field(), block_body(), camera(48)
    states = [np.zeros((body.function_count, 3)), body.project(lambda x: bent(x) - x)]
    inverse = InverseMap(None, body, within=holds_of(field), world_count=2, device="cpu")
    march = RadianceMarch([(inverse, field)])
    q = wp.array(np.concatenate(states), dtype=wp.vec3d, device="cpu")
    views = ViewArrays.from_cameras([eye, eye], world=[0, 1], device="cpu")

    def frame():
        inverse.move(q)
        march.mark()
        return march.march(views, (48, 48))[0]

    both = frame().numpy().copy()
    for world, state in enumerate(states):
        np.testing.assert_array_equal(both[0, world], layers(state, eye)[0])
    with wp.ScopedCapture(device="cpu") as capture:
        layer = frame()
    layer.zero_()
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(layer.numpy(), both)


@pytest.mark.parametrize(("wall", "seen"), [(0.05, "wall"), (2.0, "block")])
@pytest.mark.parametrize("nearer", [True, False])
def test_layers_by_depth(wall, seen, nearer):
    """A pixel shows the nearest of mesh, splats and field; depth and coverage follow."""
    q, eye = np.zeros((block_body().function_count, 3)), camera(32)
    field, body = block_field(), block_body()
    inverse = InverseMap(None, body, within=holds_of(field), device="cpu")
    march = RadianceMarch([(inverse, field)])
    inverse.move(wp.array(q, dtype=wp.vec3d, device="cpu"))
    march.mark()
    shape = (1, 32, 32)

    def image(value, dtype):
        return wp.array(np.broadcast_to(np.asarray(value, np.float32), (*shape, *np.shape(value))).copy(), dtype=dtype)

    before, splat = 0.1 if nearer else 1.0, np.array([0.0, 1.0, 0.0])
    mesh_rgb, mesh_depth = image(np.array([1.0, 0.0, 0.0]), wp.vec3), image(wall, float)
    shown = before < wall
    cover = 0.5 if shown else 0.0
    rgb = image(cover * splat + (1.0 - cover) * np.array([1.0, 0.0, 0.0]), wp.vec3)
    depth, alpha = image(cover * before + (1.0 - cover) * wall, float), image(cover, float)
    views = ViewArrays.from_cameras([eye], device="cpu")
    march.draw(views, mesh_rgb=mesh_rgb, mesh_depth=mesh_depth, rgb=rgb, depth=depth, alpha=alpha)
    layer, deep = (x[16, 16] for x in layers(q, eye))
    assert layer[3] > 0.99
    block = layer[:3] / layer[3]
    if seen == "wall":
        wanted, z = np.array([1.0, 0.0, 0.0]), wall
    elif nearer:
        wanted, z = 0.5 * splat + 0.5 * block, 0.5 * before + 0.5 * deep
    else:
        wanted, z = block, deep
    np.testing.assert_allclose(rgb.numpy()[0, 16, 16], wanted, atol=0.02)
    assert depth.numpy()[0, 16, 16] == pytest.approx(z, abs=0.02)


def test_bad_input():
    """What cannot be drawn is refused by name."""
    body = block_body()
    plain = InverseMap(None, body, device="cpu")
    with pytest.raises(ConfigError, match="0 fields"):
        RadianceMarch([])
    with pytest.raises(ConfigError, match="turns"):
        RadianceMarch([(plain, block_field(2))])
    with pytest.raises(ConfigError, match="step"):
        MarchOptions(step=0.0)
    with pytest.raises(ConfigError, match="empty"):
        drawn(block_field(), camera(), samples=0)


@pytest.mark.gpu
def test_cuda_agrees():
    """CUDA draws what the CPU draws, to 45 dB: rays at silhouettes differ."""
    eye = camera()
    assert psnr(drawn(block_field(2), eye, device="cuda:0"), drawn(block_field(2), eye, device="cpu")) > 45.0
