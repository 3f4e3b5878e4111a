"""What `benchmarks/camera` compares is one and the same scene, and its check of the pictures can fail."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import camera
from benchmarks.camera_scene import SceneCamera, blob, handle_scene
from benchmarks.peers_gsplat import deformation_rows
from softmode.splats.splats import rotations_from_quats

TINY = ["--sizes", "16", "--splats", "200", "--worlds", "1", "2", "--repeats", "1"]


def test_every_deformation_is_the_explicit_sum() -> None:
    """SkinSplats in float32 and the peer's matrix product give x and F Sigma F^T of the explicit sum."""
    scene = handle_scene(blob(300), 3)
    skinned = SceneCamera(scene, 16, device="cpu")
    skinned.deform()
    basis_count = 4 * scene.weights.shape[1]
    rows = deformation_rows(scene)
    for world in range(3):
        means, covariances = scene.deformed(world)
        assert np.abs(means - scene.splats.means).max() > 0.05, "it moves"
        np.testing.assert_allclose(skinned.splats.means.numpy()[world], means, atol=1e-6)
        six = covariances[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        np.testing.assert_allclose(skinned.splats.covariances.numpy()[world], six, atol=1e-5 * np.abs(six).max())
        product = np.concatenate([scene.coordinates()[world].T, np.eye(3)], axis=1) @ rows
        product = product.reshape(3, -1, 4)
        np.testing.assert_allclose(product[..., 0].T, means, atol=1e-6)
        factor = product[..., 1:].transpose(1, 0, 2)
        expected = covariances
        np.testing.assert_allclose(factor @ factor.transpose(0, 2, 1), expected, atol=1e-5 * np.abs(expected).max())
    assert rows.shape == (basis_count + 3, 4 * 300)


def test_splats_are_flat_on_a_sphere() -> None:
    """The third axis of every splat is its direction from the centre, and the thinnest."""
    splats = blob(200)
    direction = splats.means / np.linalg.norm(splats.means, axis=1, keepdims=True)
    np.testing.assert_allclose(rotations_from_quats(splats.quats)[:, :, 2], direction, atol=1e-5)
    assert (splats.scales.argmin(axis=1) == 2).mean() > 0.99


def test_tables_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """A run without peers checks the pictures and prints a row per world count."""
    assert camera.main(TINY) == 0
    text = capsys.readouterr().out
    assert text.count(", ok") == 2 and "WRONG" not in text
    rows = [line.split("|")[0].split() for line in text.splitlines() if "pool's peak" in line]
    assert rows == [["16", "1"], ["16", "2"]]


def test_wrong_pictures_fail_the_run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """An error above the tolerance is printed and returned."""
    monkeypatch.setattr(camera, "TOLERANCE", 1e-12)
    assert camera.main([*TINY, "--worlds", "1"]) == 1
    assert "WRONG" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["--sizes", "0"], ["--peer", "unity"], ["--worlds", "-1"]])
def test_refuses_arguments(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """Nonsense ends with a message and code 2."""
    with pytest.raises(SystemExit) as error:
        camera.main(arguments)
    assert error.value.code == 2
    assert arguments[0] in capsys.readouterr().err


def test_gsplat_is_left_out_with_a_reason(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Where gsplat cannot run, the run says why and goes on."""
    from benchmarks import peers_gsplat

    def unavailable() -> None:
        raise peers_gsplat.PeerUnavailable("torch sees no CUDA device")

    monkeypatch.setattr(peers_gsplat, "load", unavailable)
    assert camera.main([*TINY, "--peer", "gsplat"]) == 0
    assert "gsplat left out: torch sees no CUDA device" in capsys.readouterr().err
