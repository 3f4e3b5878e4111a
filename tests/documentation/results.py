"""What must hold once a page has run: what its text says of its snippets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

RESULTS: dict[str, Callable[[dict[str, Any], Path], None]] = {}
"""By the page's path below the checkout: a function of the names the page left and of the folder it ran in."""


def _result(page: str) -> Callable[[Callable[[dict[str, Any], Path], None]], None]:
    """Register a function for a page."""

    def register(function: Callable[[dict[str, Any], Path], None]) -> None:
        RESULTS[page] = function

    return register


@_result("docs/camera.md")
def _camera(names: dict[str, Any], folder: Path) -> None:
    """The pixels of the block are on the block in the two worlds not drawn anew."""
    camera = names["camera"]
    assert camera.segmentation_ids("hand/*") == names["hand_ids"] != ()
    assert names["block_pixels"].sum(axis=(1, 2)).min() > 50
    offset = camera.variation.offset.numpy().reshape(2, 4, 7)
    identity = np.array([0, 0, 0, 0, 0, 0, 1], np.float32)
    assert (offset[:, [1, 3]] == identity).all() and (offset[:, [0, 2], :3] != 0.0).all()


@_result("docs/bodies.md")
def _bodies(names: dict[str, Any], folder: Path) -> None:
    """No parameter was clamped, no step of the last scene went wrong, and its grip is on its way up."""
    assert names["flags"].numpy().tolist() == [0] * 16
    assert names["solver"].status.numpy().tolist() == [0]
    gripped = names["state"].particle_q.numpy()[names["body"].surface.points[:, 2] > 0.045][:16]
    rest = names["body"].surface.points[names["body"].surface.points[:, 2] > 0.045][:16]
    assert 1.0 < gripped[:, 2].mean() - rest[:, 2].mean() < 1.021


@_result("docs/deforming_splats.md")
def _deforming(names: dict[str, Any], folder: Path) -> None:
    """The object falls as s = g n (n + 1) dt^2 / 2 says until it lands, is in the picture, and is saved as it lies."""
    from softmode.splats import read_splats

    camera, rest, now = names["camera"], names["rest"], names["now"]
    fall = 9.81 * 30 * 31 / 2 / 240.0**2  # [m], further than it has room for
    drop = rest.bounds()[0, 2] + names["soft"].height + 0.02
    assert fall > drop
    assert abs(now.bounds()[0, 2]) < 2e-3  # [m], on the ground
    assert camera.images("front", "alpha").numpy()[0].max() > 0.9
    saved = read_splats(folder / "landed.ply")
    np.testing.assert_array_equal(saved.means, now.means)
    np.testing.assert_array_equal(saved.means, names["splats"].means.numpy()[0])


@_result("docs/splat_files.md")
def _splat_files(names: dict[str, Any], folder: Path) -> None:
    """They write the files they name; the twist about z keeps the distance of every splat from the axis."""
    from softmode.splats import read_splats

    assert {path.name for path in folder.iterdir()} == {"toy.ply", "toy.spz", "twisted.ply", "twist.usdc"}
    rest, twisted = read_splats("toy.ply"), read_splats("twisted.ply")
    radius, turned = (np.linalg.norm(splats.means[:, :2], axis=1) for splats in (rest, twisted))
    np.testing.assert_allclose(turned, radius, atol=4 * np.finfo(np.float32).eps * radius.max())
    assert abs(rest.means - twisted.means).max() > 0.1 * radius.max()
    assert read_splats("twist.usdc").count == rest.count


@_result("docs/environments.md")
def _environments(names: dict[str, Any], folder: Path) -> None:
    """The computed reward at the goal is that of the comment."""
    desired = names["desired"]
    np.testing.assert_array_equal(names["env"].unwrapped.compute_reward(desired, desired, {}), np.float32(0.0))


@_result("docs/vector_envs.md")
def _vector_envs(names: dict[str, Any], folder: Path) -> None:
    """The libraries learned for as long as they were told, and the checker checked."""
    assert names["model"].num_timesteps == 64
    assert names["last"].shape == names["envs"].observation_space.shape
    assert names["runner"].current_learning_iteration == 0 and names["observation"].shape[0] == 2
    assert set(names["report"].checked) >= {"autoreset", "time limit", "nan action", "close"}
    names["envs"].close()


@_result("docs/rendering_gradients.md")
def _rendering_gradients(names: dict[str, Any], folder: Path) -> None:
    """Moving the body along v and the camera against it are the same."""
    by_translation, by_twist = names["loss_q"].numpy()[3], names["gradients"].twist.numpy()[0]
    turn = names["views"].world_to_camera.numpy()[0, :3, :3]
    assert np.abs(by_twist).max() > 1.0
    np.testing.assert_allclose(turn @ by_translation, by_twist[:3], atol=1e-4 * np.abs(by_twist).max())


@_result("docs/sensing.md")
def _sensing(names: dict[str, Any], folder: Path) -> None:
    """The right finger, 0.5 mm deep in the cube, is pushed away along -y; the ground carries the weight of the other.

    The patch of the cube at rest is its bottom.
    """
    assert names["fingers"].total_force.numpy()[0, 1, 1] < 0.0
    assert names["surface"].pressure.numpy().max() > 0.0
    force = names["ground"].total_force.numpy()[0, 0]
    weight = names["density"] * names["edge"] ** 3 * 9.81
    np.testing.assert_allclose(force, [0.0, 0.0, -weight], atol=1e-3 * weight)
    np.testing.assert_allclose(names["surface"].total_area.numpy()[0], names["edge"] ** 2, rtol=0.05)


@_result("docs/gradients.md")
def _gradients(names: dict[str, Any], folder: Path) -> None:
    """A gradient for every parameter; in free fall the loss does not depend on the stiffness."""
    assert np.abs(names["error"]).max() > 0.1
    assert np.isfinite(names["gradients"].youngs_modulus.numpy()).all()


@_result("docs/splats_from_mesh.md")
def _splats_from_mesh(names: dict[str, Any], folder: Path) -> None:
    """Ten thousand splats that look like the mesh."""
    assert names["fit"].splats.count == 10_000
    assert names["fit"].psnr > 20.0


@_result("docs/demonstrations.md")
def _demonstrations(names: dict[str, Any], folder: Path) -> None:
    """What is read back is what was written."""
    assert names["data"].columns["action"].shape == (10, 1)
    assert (names["data"].columns["action"] == np.float32(0.5)).all()


@_result("docs/getting_started.md")
def _getting_started(names: dict[str, Any], folder: Path) -> None:
    """The bear is on its way down or on the ground, and in the picture."""
    from PIL import Image

    assert -1e-3 < names["scene"].state.particle_q.numpy()[:, 2].min() < 0.05
    picture = np.asarray(Image.open(folder / "bear.png")).astype(int)
    assert (picture[..., 0] - picture[..., 2] > 60).sum() > 1000  # brown


@_result("docs/howto/own_splat.md")
def _own_splat(names: dict[str, Any], folder: Path) -> None:
    """The capture of 30 cm became a toy of 8 cm that is in the environment."""
    toy = names["toy"]
    assert np.ptp(toy.splats.means, axis=0).max() == abs(np.diff(toy.splats.bounds(), axis=0)).max()
    np.testing.assert_allclose(np.ptp(toy.splats.means, axis=0).max(), 0.08, rtol=0.05)
    assert toy.body.provenance["quadrature_parts"] == 1
    error = toy.body.provenance["cubature_force_error"]
    assert error < 0.03, error  # More than of a bar: functions of the larger space vary more.
    assert names["env"].unwrapped.scene.soft.body.name == toy.body.name


@_result("docs/howto/own_robot.md")
def _own_robot(names: dict[str, Any], folder: Path) -> None:
    """Both fingers are pushed outwards, equally."""
    y = names["press"][:, 1]
    assert np.abs(y).min() > 0.5 and abs(y.sum()) < 0.1 * np.abs(y).max()


@_result("docs/howto/own_env.md")
def _own_env(names: dict[str, Any], folder: Path) -> None:
    """The reward is the sum of its terms; the vector environment keeps its contract."""
    terms = names["info"]["reward_terms"]
    assert set(terms) == {"reach", "moved"}
    np.testing.assert_allclose(sum(terms.values()), names["reward"], rtol=1e-6)
    assert {"autoreset", "same seed", "isolation of actions"} <= set(names["report"].checked)


@_result("docs/howto/tune_a_material.md")
def _tune_a_material(names: dict[str, Any], folder: Path) -> None:
    """A block sinks by rho g h^2 / (2 E), but for the contact's own 0.03 mm; its whole foot has hardly a dent."""
    edge, pressure = names["edge"], names["density"] * 9.81 * names["edge"]
    for modulus, sink in names["sinks"].items():
        assert names["dents"][modulus] < 0.01 * sink
        np.testing.assert_allclose(sink, 0.5 * pressure * edge / modulus, rtol=0.02, atol=5e-5)


@_result("docs/howto/train.md")
def _train(names: dict[str, Any], folder: Path) -> None:
    """The policy acts within the bounds of the environment."""
    action = names["policy"](names["observation"])
    assert names["env"].action_space.contains(np.asarray(action, np.float32))


@_result("docs/body_tool.md")
def _body_tool(names: dict[str, Any], folder: Path) -> None:
    """What the page makes is well."""
    assert names["report"].severity == 0
    np.testing.assert_array_equal(names["toy"].splats.means, names["ring"].splats.means)


@_result("docs/usd.md")
def _usd(names: dict[str, Any], folder: Path) -> None:
    """What the recorded toy plays back is what was simulated: it falls from 0.1 m to the ground."""
    played = names["played"]
    assert names["q"].shape == (10, names["toy"].body.function_count, 3) and np.isfinite(names["q"]).all()
    fallen = names["splats"].means[:, 2].mean() - played.splats_at(0).means[:, 2].mean()
    assert -0.08 < fallen < -0.03  # on the ground its centre is some 4 cm high
    assert played.points_at(9)[:, 2].min() > -2e-3
