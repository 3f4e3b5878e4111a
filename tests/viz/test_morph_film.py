"""Films of morphs: F Sigma F^T, colours that cross, and what is filmed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial import KDTree

from softmode.cli.main import main
from softmode.errors import ConfigError
from softmode.mpm import MorphOptions, MorphRun, morph
from softmode.mpm.run import is_morph
from softmode.objects.solids import filled, solid_of
from softmode.usd import write_splat_animation
from softmode.usd.openusd import openusd
from softmode.viz.morph_film import MorphScene
from softmode.viz.morph_film_kernels import ride
from softmode.viz.morph_recording import record_morph


def test_splats_ride() -> None:
    """Covariances are F Sigma F^T; a stretch over the limit is cut to it, a turn is none."""
    rng = np.random.default_rng(0)
    F = np.eye(3) + 0.1 * rng.standard_normal((5, 3, 3))
    F[4] = 4.0 * np.eye(3)
    root = rng.standard_normal((5, 3, 3))
    rest = root @ root.transpose(0, 2, 1)
    x = rng.standard_normal((5, 3))
    means = wp.zeros((1, 5), dtype=wp.vec3, device="cpu")
    six = wp.zeros((1, 5), dtype=wp.types.vector(6, wp.float32), device="cpu")
    arrays = [
        wp.array(a.astype(np.float32), dtype=t, device="cpu")
        for a, t in ((x, wp.vec3), (F, wp.mat33), (rest, wp.mat33))
    ]
    wp.launch(ride, 5, inputs=[*arrays, 2.0, means, six], device="cpu")
    F[4] = 2.0 * np.eye(3)
    expected = (F @ rest @ F.transpose(0, 2, 1))[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    assert np.allclose(six.numpy()[0], expected, rtol=1e-4, atol=1e-4)
    assert np.allclose(means.numpy()[0], x, atol=1e-6)


@pytest.fixture(scope="module")
def scenes() -> list[MorphScene]:
    """Return a short morph as splats, and as particles."""
    solids, bodies = filled([solid_of("sphere"), solid_of("torus")], spacing=None, count=800)
    options = MorphOptions(frame_count=20)
    run = morph(*bodies, options, device="cpu")
    return [MorphScene(run, solids, bodies, options, as_particles=only, device="cpu") for only in (False, True)]


def test_colors_cross_to_the_target(scenes: list[MorphScene]) -> None:
    """Colours begin as the source's and end as those of the target's nearest splats; particles show the same."""
    scene, alone = scenes
    frames = list(scene.frames(stride=5))
    assert len(frames) == 5
    first, last = frames[0][3], frames[-1][3]
    assert np.allclose(first, scene.splats.sh[:, 0], atol=1e-6)
    known = np.unique(np.round(solid_of("torus").splats.sh[:, 0], 4), axis=0)
    distance = np.abs(last[::50, None] - known[None]).max(axis=2).min(axis=1)
    assert distance.max() < 1e-3
    between = frames[2][3]
    assert 0.0 < np.abs(between - first).sum() < np.abs(last - first).sum()
    assert alone.splats.count == alone.run.positions.shape[1] < scene.splats.count


def test_a_recording_holds_splats_particles_and_the_loss(scenes: list[MorphScene], tmp_path: Path) -> None:
    """Every frame has its step; splats, or points, lie where they do in the film, and the loss after each segment."""
    pytest.importorskip("rerun", reason="the extra viz is not installed")
    from tests.viz.test_rerun_logger import Recording

    for scene, component in zip(scenes, ("GaussianSplats3D:centers", "Points3D:positions"), strict=True):
        file = tmp_path / "morph.rrd"
        steps: list[int] = []
        scene.progress = steps.append
        record_morph(file, scene, stride=5)
        scene.progress = None
        assert steps == [0, 5, 10, 15, 20]
        found = Recording(file)
        centers = found.of("scene/morph", component)
        last = list(scene.splat_frames(stride=5))[-1][1]
        assert sorted(centers) == steps
        assert np.allclose(centers[20], last.means, atol=1e-6)
        assert list(found.scalars("loss")) == [0, 10, 20]
        assert list(found.scalars("loss").values()) == pytest.approx(scene.run.losses.tolist())


def test_a_stage_holds_every_frame(scenes: list[MorphScene], tmp_path: Path) -> None:
    """Splats, points, or a closed mesh of the particles' volume in their colours, are sampled at whole time codes."""
    pytest.importorskip("pxr", reason="the extra usd is not installed")
    Usd, UsdGeom = openusd("Usd", "UsdGeom")
    for scene, points in zip(scenes, (False, True), strict=True):
        file = tmp_path / "stage" / f"morph_{points}.usdc"
        frames = [splats for _, splats in scene.splat_frames(stride=5)]
        assert write_splat_animation(file, frames, name="morph", shown="points" if points else "splats") == 5
        stage = Usd.Stage.Open(str(file))
        prim = stage.GetPrimAtPath("/World/morph")
        assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 4.0)
        name = "points" if points else "positions"
        assert prim.GetAttribute(name).GetTimeSamples() == [0.0, 1.0, 2.0, 3.0, 4.0]
        for code in (0, 4):
            assert np.allclose(prim.GetAttribute(name).Get(code), frames[code].means, atol=1e-6)
        if points:
            made = UsdGeom.Points(prim)
            assert np.allclose(made.GetWidthsAttr().Get(), 2.0 * frames[4].scales[:, 0])
            assert np.allclose(made.GetDisplayColorAttr().Get(4), frames[4].colors(), atol=1e-6)
        else:
            assert np.allclose(prim.GetAttribute("scales").Get(4), frames[4].scales)
            sh = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get(4))
            assert np.allclose(sh, frames[4].sh[:, 0], atol=1e-6)
    file = tmp_path / "mesh.usdc"
    write_splat_animation(file, frames, name="morph", shown="mesh")
    stage = Usd.Stage.Open(str(file))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/morph"))
    for code in (0, 4):
        x, faces = (np.array(a.Get(code)) for a in (mesh.GetPointsAttr(), mesh.GetFaceVertexIndicesAttr()))
        made = trimesh.Trimesh(x, faces.reshape(-1, 3))
        assert made.is_watertight and len(mesh.GetFaceVertexCountsAttr().Get(code)) == len(made.faces)
        assert made.volume == pytest.approx(scene._bodies[0].mass / scene._bodies[0].material.density, rel=0.15)
        near = KDTree(frames[code].means).query(x)[1]
        assert np.allclose(mesh.GetDisplayColorAttr().Get(code), frames[code].colors()[near], atol=1e-6)
    with pytest.raises(ConfigError, match="one or more"):
        write_splat_animation(tmp_path / "none.usdc", [])
    with pytest.raises(ConfigError, match="frame 1 has 3 splats"):
        write_splat_animation(tmp_path / "none.usdc", [frames[0], frames[1].subset(np.arange(3))])
    few = frames[0].subset(np.arange(9))
    far = replace(few, means=few.means + np.where(np.arange(9) == 8, 1.0e3, 0.0)[:, None])
    for odd, match in ((few.subset(np.zeros(2, int)), "at different places"), (far, "frame 0 spans")):
        with pytest.raises(ConfigError, match=match):
            write_splat_animation(tmp_path / "none.usdc", [odd], shown="mesh")
    assert not (tmp_path / "none.usdc").exists()


@pytest.mark.rest
def test_the_command_films_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It writes film, contact sheet and run; a second call plans nothing again, and another morph is refused there."""
    pytest.importorskip("imageio_ffmpeg", reason="the extra demo is not installed")
    film, out = tmp_path / "morph.mp4", tmp_path / "run.npz"
    words = ["morph", "sphere", "box", "--frames", "20", "--particles", "800", "--out", str(out), "--width", "96"]
    assert main([*words, "--video", str(film)]) == 0
    assert film.stat().st_size > 1000 and film.with_suffix(".png").exists()
    run = MorphRun.load(out)
    assert run.names == ("sphere", "box") and run.segment_count == 2 and is_morph(out)
    assert main([*words, "--rerun", str(tmp_path / "morph.rrd"), "--usd", str(tmp_path / "morph.usdc")]) == 0
    assert (tmp_path / "morph.rrd").stat().st_size > 1000 and (tmp_path / "morph.usdc").stat().st_size > 1000
    assert np.array_equal(MorphRun.load(out).positions, run.positions)
    words[2] = "torus"
    assert main(words) == 2
    assert "another source, target or options" in capsys.readouterr().err
    assert main(["morph", "sphere"]) == 2
    assert main(["morph", "sphere", "nothing", "--out", str(tmp_path / "b.npz")]) == 2
    assert json.dumps(run.notes) == "[]"


def test_the_page_plays_a_run(tmp_path: Path) -> None:
    """The page shows the ends of segments as the run has them and what lies between; the command serves it."""
    pytest.importorskip("viser", reason="the extra viz is not installed")
    from softmode.view.app import ViewOptions
    from softmode.view.morph_page import MorphPage

    _, bodies = filled([solid_of("sphere"), solid_of("box")], spacing=None, count=800)
    out = tmp_path / "run.npz"
    run = morph(*bodies, MorphOptions(frame_count=20), file=out, device="cpu")
    with MorphPage(run, ViewOptions(port=0)) as page:
        assert np.array_equal(page.at(1.0), run.positions[1])
        assert np.array_equal(page.at(2.0), run.positions[2])
        assert np.allclose(page.at(0.5), 0.5 * (run.positions[0] + run.positions[1]), atol=1e-6)
        before = page.time.value
        page.play(0.3)
        assert page.time.value > before
    assert main(["view", str(out), "--port", "0", "--no-open", "--duration", "0.2"]) == 0
