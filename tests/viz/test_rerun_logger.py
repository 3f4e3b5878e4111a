"""Recordings for rerun, read back from their files: what is there, when, and whether it is what the scene did."""

from __future__ import annotations

import io
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import newton
import numpy as np
import pytest
from PIL import Image

import softmode  # noqa: F401  (registers the environments)
from softmode.cli.main import main
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.tools.energies import SoftEnergies
from softmode.deformables.tools.sensing import ContactSensor
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig
from softmode.errors import ConfigError, MissingExtraError, StorageError
from softmode.learning.players import policy_factory
from softmode.objects import load
from softmode.scenes import BoundSplats, SplatFrame
from softmode.splats.splats import rotations_from_quats
from softmode.viz.rerun_logger import RerunLogger, RerunOptions
from softmode.viz.rerun_sources import RerunScene
from tests.needs import needs
from tests.scenes import GRAVITY, Scene

pytestmark = needs("rerun")


TWICE = np.array([1, 2, 2, 1, 2, 1])
"""How often an entry of xx xy xz yy yz zz stands in the matrix."""


class Recording:
    """What a file holds: values by entity, component and step; static ones have no step."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        reader = RrdReader(path)
        self.blueprints = len(reader.blueprints())
        self.times: dict[int, float] = {}
        self.chunks = 0
        self._values: dict[str, dict[str, dict[int | None, Any]]] = {}
        for chunk in reader.stream():
            batch = chunk.to_record_batch()
            self.chunks += 1
            entity = self._values.setdefault(chunk.entity_path.strip("/"), {})
            steps = [None] * chunk.num_rows if chunk.is_static else batch.column("step").to_pylist()
            if not chunk.is_static:
                seconds = batch.column("sim_time").cast("int64").to_numpy() * 1e-9
                self.times |= {int(s): float(t) for s, t in zip(batch.column("step").to_pylist(), seconds, strict=True)}
            for name in batch.schema.names:
                if ":" in name:
                    column = entity.setdefault(name, {})
                    column |= {
                        s: v for s, v in zip(steps, batch.column(name).to_pylist(), strict=True) if v is not None
                    }

    @property
    def entities(self) -> set[str]:
        """All entity paths."""
        return set(self._values)

    def of(self, entity: str, component: str) -> dict[int | None, Any]:
        """Return the values of a component by step."""
        return {step: np.array(value) for step, value in self._values[entity][component].items()}

    def scalars(self, entity: str) -> dict[int | None, Any]:
        """Return single numbers by step."""
        return {step: value[0] for step, value in self.of(entity, "Scalars:scalars").items()}


def full(six: np.ndarray) -> np.ndarray:
    """Return symmetric matrices (N, 3, 3) of xx xy xz yy yz zz."""
    return six[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def gaussians(scales: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """Return the covariances of scales and quaternions."""
    axes = rotations_from_quats(quats)
    return np.einsum("nij,nj,nkj->nik", axes, np.asarray(scales, float) ** 2, axes)


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    """Return the lift task with cameras."""
    made = gym.make("softmode/LiftSoft-v0", render_mode="rgb_array", config=LiftSoftConfig(render_size=64))
    yield made
    made.close()


def test_episode_is_what_the_environment_did(env: Any, tmp_path: Path) -> None:
    """Frame k of the file holds state, info, forces and pictures after step k, and the splats that skinning gives."""
    task, path, steps = env.unwrapped.task, tmp_path / "lift.rrd", 40
    scene, thing = task.scene, task.scene.soft
    splats = BoundSplats(scene.model, [thing])
    sensor, energies = ContactSensor(scene.solver, [-1, *range(scene.model.body_count)]), SoftEnergies(scene.solver)
    truth: list[dict[str, Any]] = []

    def note(reward: float, info: dict[str, Any]) -> None:
        sensor.update()
        energies.update(scene.state)
        splats.update(scene.state)
        frame = splats.frames()[0, 0]
        assert thing.splats.count == len(frame.means)
        force = sensor.force_matrix.numpy()[0].reshape(-1, 3)
        truth.append(
            {
                "reward": reward,
                "info": info,
                "means": frame.means,
                "covariances": full(frame.covariances),
                "poses": scene.state.body_q.numpy().copy(),  # on CPU a view
                "surface": scene.state.particle_q.numpy().copy(),
                "force": force[np.linalg.norm(force, axis=1) > 1e-3],
                "elastic": float(energies.elastic.numpy()[0]),
                "joints": scene.state.joint_q.numpy().copy(),
                "targets": scene.control.joint_target_q.numpy().copy(),
                "observation": task.observation.numpy()[0].copy(),
            }
        )

    observation, info = env.reset(seed=0, options={"youngs_modulus": 3.0e4})
    policy = policy_factory("scripted", env, None)(0)
    with RerunLogger(path, env) as log:
        log.record()
        note(0.0, info)
        for _ in range(steps):
            observation, reward, *_, info = env.step(policy(observation))
            log.record()
            note(reward, info)
        assert log.frame_count == steps + 1
        assert not path.exists()
    file = Recording(path)
    assert file.blueprints == 1
    assert sorted(file.times) == list(range(steps + 1))
    np.testing.assert_allclose([file.times[k] for k in range(steps + 1)], np.arange(steps + 1) / 30.0, atol=1e-8)
    assert {"scene/bodies/arm_link7/palm", "scene/fixed/table", "scene/contacts", "success", "action"} <= file.entities

    centers = file.of("scene/soft/plush", "GaussianSplats3D:centers")
    scales, quats = (file.of("scene/soft/plush", f"GaussianSplats3D:{n}") for n in ("scales", "quaternions"))
    assert scales.keys() == quats.keys() and 0 in scales
    surface, shown = file.of("scene/soft/plush/surface", "Points3D:positions"), 0
    link = file.of("scene/bodies/arm_link7", "Transform3D:translation")
    arrows = file.of("scene/contacts", "Arrows3D:vectors")
    body = list(scene.model.body_label).index("arm/link7")
    touched = 0
    for k, frame in enumerate(truth):
        np.testing.assert_array_equal(centers[k].astype(np.float32), frame["means"])
        shown = k if k in scales else shown
        error = np.linalg.norm(gaussians(scales[shown], quats[shown]) - frame["covariances"], axis=(1, 2))
        assert (error <= 0.051 * np.linalg.norm(frame["covariances"], axis=(1, 2))).all()
        np.testing.assert_array_equal(surface[k].astype(np.float32), frame["surface"])
        np.testing.assert_array_equal(link[k][0].astype(np.float32), frame["poses"][body, :3])
        np.testing.assert_allclose(arrows[k].reshape(-1, 3), 0.02 * frame["force"], atol=1e-7)
        touched = max(touched, len(frame["force"]))
        assert file.scalars("energy/plush/elastic")[k] == frame["elastic"]
        assert file.scalars("success")[k] == float(frame["info"]["is_success"])
        if k:
            assert file.scalars("reward/total")[k] == frame["reward"]
            for name, value in frame["info"]["reward_terms"].items():
                assert file.scalars(f"reward/terms/{name}")[k] == value
        np.testing.assert_array_equal(file.of("joints/position", "Scalars:scalars")[k], frame["joints"])
        np.testing.assert_array_equal(file.of("joints/target", "Scalars:scalars")[k], frame["targets"])
        for name, (columns, _) in task.segments.items():
            seen = file.of(f"observation/{name}", "Scalars:scalars")[k]
            np.testing.assert_array_equal(seen, frame["observation"][columns])
    assert len(file.of("joints/target", "SeriesLines:names")[None]) == scene.model.joint_coord_count
    # one chunk for each entity, one more where static or occasional values stand beside those of every frame
    assert len(file.entities) <= file.chunks <= len(file.entities) + 16
    assert touched >= 2  # the table and a finger
    assert 0 not in file.scalars("reward/total")
    # far fewer than the frames: the object is turned and squeezed in some of them only
    assert 1 < len(scales) < 0.7 * steps

    edge = task.config.render_size
    drawn = scene.render((edge, edge))  # what policies see; env.render() draws the film that people look at
    for name in ("front", "overview"):
        blobs = file.of(f"scene/camera/{name}/rgb", "EncodedImage:blob")
        picture = np.asarray(Image.open(io.BytesIO(np.asarray(blobs[steps][0], np.uint8).tobytes())), float)
        exact = drawn.images(name).numpy()[0].astype(float)
        assert np.abs(picture - exact).mean() < 4.0
        matrix = drawn.extrinsics(name).numpy()[0]  # from the world to the camera
        (place,) = file.of(f"scene/camera/{name}", "Transform3D:translation")[0]
        np.testing.assert_allclose(matrix[:3, :3] @ place, -matrix[:3, 3], atol=1e-6)
        blob = file.of(f"scene/camera/{name}/depth", "EncodedDepthImage:blob")[steps][0]
        depth = np.asarray(Image.open(io.BytesIO(np.asarray(blob, np.uint8).tobytes())), float) * 1e-4
        np.testing.assert_allclose(depth, drawn.images(name, "depth").numpy()[0], atol=5.1e-5)


def test_vector_environment(tmp_path: Path) -> None:
    """Chosen worlds of many are recorded side by side, each with its own rewards; time runs on over a reset."""
    envs: Any = gym.make_vec("softmode/LiftSoft-v0", num_envs=3, max_episode_steps=3)
    try:
        envs.reset(seed=5)
        rewards = []
        with RerunLogger(tmp_path / "many.rrd", envs, worlds=(0, 2), options=RerunOptions(world_spacing=2.0)) as log:
            log.record()
            for _ in range(6):  # the third ends the episode, the fourth begins the next one
                _, reward, *_ = envs.step(np.zeros(envs.action_space.shape, np.float32))
                log.record()
                rewards.append(reward)
        shown = envs.unwrapped.task.scene
        splats = BoundSplats(shown.model, shown.objects, worlds=[2])
        splats.update(shown.state)
        last = splats.frames()[0, 0].means
    finally:
        envs.close()
    file = Recording(tmp_path / "many.rrd")
    assert not any(entity.startswith("world_1") for entity in file.entities)
    shift = [file.of(f"world_{w}/scene", "Transform3D:translation")[None][0] for w in (0, 2)]
    np.testing.assert_allclose(shift, [[0, 0, 0], [0, 2, 0]])
    for w in (0, 2):
        written = file.scalars(f"world_{w}/reward/total")
        assert sorted(k for k in written if k is not None) == [1, 2, 3, 5, 6]  # a reset earns nothing
        assert all(written[k] == rewards[k - 1][w] for k in (1, 2, 3, 5, 6))
    centers = file.of("world_2/scene/soft/plush", "GaussianSplats3D:centers")
    np.testing.assert_array_equal(centers[6].astype(np.float32), last)
    assert not np.array_equal(centers[6], file.of("world_0/scene/soft/plush", "GaussianSplats3D:centers")[6])


@pytest.fixture(scope="module")
def falling() -> Any:
    """Return a plush over the ground in two worlds, and its object."""
    thing = load(size=0.08)

    def populate(world: newton.ModelBuilder) -> None:
        add_reduced_body(
            world, thing.body, material=Material(youngs_modulus=1e5), position=(0.0, 0.0, thing.height + 0.005)
        )

    return Scene(populate, [thing.body], world_count=2, gravity=(0, 0, -GRAVITY), ground=0.8), thing


def test_scene_of_ones_own(falling: Any, tmp_path: Path) -> None:
    """A model with solver and splats is recorded with the states and times given, and numbers of one's own."""
    scene, thing = falling
    scene.restart()
    source = RerunScene(model=scene.model, solver=scene.solver, objects=[thing])
    with RerunLogger(tmp_path / "fall.rrd", source, worlds=(1,)) as log:
        for k in range(10):
            log.record(scene.state, time=k * 4 * scene.dt, scalars={"height": 0.1 * k})
            scene.step(4)
        with pytest.raises(ConfigError, match="needs its state and time"):
            log.record()
    file = Recording(tmp_path / "fall.rrd")
    np.testing.assert_allclose([file.times[k] for k in range(10)], 4 * scene.dt * np.arange(10), atol=1e-8)
    assert file.scalars("height")[7] == pytest.approx(0.7)
    assert file.scalars("world_1/energy/plush/kinetic")[0] == 0.0 < file.scalars("world_1/energy/plush/kinetic")[1]
    assert "world_1/scene/fixed/ground_plane" in file.entities
    assert len(file.of("world_1/scene/soft/plush", "GaussianSplats3D:centers")) == 10
    up = file.of("world_1/scene/contacts", "Arrows3D:vectors")[9].reshape(-1, 3)
    assert len(up) == 1 and up[0, 2] < 0.0  # what the body does to the ground


@pytest.mark.parametrize(("tolerance", "writes"), [(0.05, 1), (0.0, 5)])
def test_covariances_are_written_when_they_change(falling: Any, tolerance: float, writes: int, tmp_path: Path) -> None:
    """A body that turns by 1 degree keeps its first scales and orientations, unless every change is asked for."""
    scene, thing = falling
    scene.restart()
    turn = np.eye(3) + np.cross([0.0, 0.0, 1.0], np.eye(3)).T  # I + the rate of a spin of 1 rad/s
    scene.set(qd=thing.body.affine(turn, np.zeros(3)))
    source = RerunScene(model=scene.model, solver=scene.solver, objects=[thing])
    with RerunLogger(tmp_path / "a.rrd", source, options=RerunOptions(covariance_tolerance=tolerance)) as log:
        for k in range(5):
            log.record(scene.state, time=k * scene.dt)
            scene.step()
    file = Recording(tmp_path / "a.rrd")
    for name, count in (("centers", 5), ("scales", writes), ("quaternions", writes), ("colors", 1)):
        assert len(file.of("world_0/scene/soft/plush", f"GaussianSplats3D:{name}")) == count


def test_axes_give_the_covariances_back() -> None:
    """R diag(s^2) R^T is the covariance to float32 rounding, of needles, discs and balls alike."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(1000, 3, 3)))[0]
    wanted = 10.0 ** rng.uniform(-4.0, -2.0, size=(1000, 3))
    wanted[:100] = wanted[:100, :1]
    covariances = np.einsum("nij,nj,nkj->nik", axes, wanted**2, axes).astype(np.float32)
    six = covariances.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    scales, quats = SplatFrame(means=np.zeros((1000, 3), np.float32), covariances=six).axes("cpu")
    size = np.linalg.norm(covariances, axis=(1, 2))
    assert (np.linalg.norm(gaussians(scales, quats) - covariances, axis=(1, 2)) < 1e-6 * size).all()
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1.0, atol=1e-6)


# -- the file ----------------------------------------------------------------------------------------------------------


def test_whole_or_not_at_all(falling: Any, tmp_path: Path) -> None:
    """An error leaves the old file, or no file and no folder; what is published has the umask's permissions."""
    scene, thing = falling
    source = RerunScene(model=scene.model, solver=scene.solver, objects=[thing])
    old = tmp_path / "old.rrd"
    old.write_bytes(b"old")
    for path in (old, tmp_path / "new" / "deep" / "a.rrd"):
        with pytest.raises(KeyboardInterrupt), RerunLogger(path, source) as log:
            log.record(scene.state, time=0.0)
            raise KeyboardInterrupt
        assert [p.name for p in tmp_path.iterdir()] == ["old.rrd"]
    assert old.read_bytes() == b"old"
    log = RerunLogger(old, source)
    log.record(scene.state, time=0.0)
    log.publish()
    log.publish()
    assert len(Recording(old).times) == 1
    os.umask(mask := os.umask(0))
    assert old.stat().st_mode & 0o777 == 0o666 & ~mask
    with pytest.raises(ConfigError, match="has ended"):
        log.record(scene.state, time=1.0)
    with RerunLogger(tmp_path / "empty.rrd", source):
        pass
    assert Recording(tmp_path / "empty.rrd").times == {}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty.rrd", "old.rrd"]


def test_live_viewer(falling: Any, tmp_path: Path) -> None:
    """What is sent to the address of a viewer arrives there, here at one that saves it."""
    scene, thing = falling
    scene.restart()
    source, path = RerunScene(model=scene.model, solver=scene.solver, objects=[thing]), tmp_path / "seen.rrd"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--port", str(port), "--save", str(path)]
    viewer = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a job in the background ignores it
    )
    try:
        for _ in range(300):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        with RerunLogger(f"rerun+http://127.0.0.1:{port}/proxy", source) as log:
            for k in range(3):
                log.record(scene.state, time=k * scene.dt)
        sizes = [0] * 10
        for _ in range(300):  # until the centres of three frames are there, and for a second nothing has come since
            sizes = [*sizes[1:], path.stat().st_size if path.exists() else 0]
            if min(sizes) == max(sizes) > 3 * 12 * thing.splats.count:
                break
            time.sleep(0.1)
    finally:
        os.killpg(viewer.pid, signal.SIGINT)
        viewer.wait(timeout=30)
    file = Recording(path)
    assert sorted(file.times) == [0, 1, 2] and file.blueprints == 1
    assert len(file.of("world_0/scene/soft/plush", "GaussianSplats3D:centers")) == 3


def test_a_viewer_that_is_not_there(falling: Any) -> None:
    """Nobody listens at the address: an error that says so, before anything is simulated."""
    scene, thing = falling
    source = RerunScene(model=scene.model, solver=scene.solver, objects=[thing])
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))  # bound, but not listening: connections are refused
        nobody = f"rerun+http://127.0.0.1:{probe.getsockname()[1]}/proxy"
        for target in (nobody, "rerun+http://", "rerun+http://127.0.0.1:99999/proxy"):
            with pytest.raises(ConfigError, match="no rerun viewer answers"):
                RerunLogger(target, source)


def test_bad_input_is_refused(falling: Any, env: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What cannot be recorded, or not there, is refused with the name of the argument; nothing is left behind."""
    scene, thing = falling
    source = RerunScene(model=scene.model, solver=scene.solver, objects=[thing])
    for message, target, what, given in (
        ("no .rrd file", "a.mp4", source, {}),
        ("worlds must name", "a.rrd", source, {"worlds": (2,)}),
        ("worlds must name", "a.rrd", source, {"worlds": (0, 0)}),
        ("worlds must name", "a.rrd", source, {"worlds": ()}),
        ("worlds must be whole", "a.rrd", source, {"worlds": (0.5,)}),
        ("scene is a Model", "a.rrd", scene.model, {}),
        (
            "objects names 2 soft bodies",
            "a.rrd",
            RerunScene(model=scene.model, solver=scene.solver, objects=[thing] * 2),
            {},
        ),
    ):
        with pytest.raises(ConfigError, match=message):
            RerunLogger(tmp_path / target, what, **given)
    with pytest.raises(ConfigError, match="takes no state"), RerunLogger(tmp_path / "a.rrd", env) as log:
        log.record(scene.state, time=0.0)
    for given in ({"jpeg_quality": 0}, {"covariance_tolerance": -1.0}, {"force_scale": float("nan")}):
        with pytest.raises(ConfigError, match=next(iter(given))):
            RerunOptions(**given)
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot be written"):
        RerunLogger(tmp_path / "file" / "a.rrd", source)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"softmode\[viz\]"):
        RerunLogger(tmp_path / "a.rrd", source)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.rest
def test_play_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """`softmode play --rerun` writes an episode with both cameras; interrupted, it leaves the file that was there."""
    monkeypatch.setattr(gym.spec("softmode/LiftSoft-v0"), "max_episode_steps", 3)
    path = tmp_path / "new" / "lift.rrd"
    arguments = ["play", "softmode/LiftSoft-v0", "--policy", "zero", "--rerun", str(path)]
    assert main(arguments) == 0
    assert f"wrote {path}" in capsys.readouterr().out
    file = Recording(path)
    assert sorted(file.times) == [0, 1, 2, 3]
    assert {"scene/camera/front/rgb", "scene/camera/overview/depth"} <= file.entities
    before, record, count = path.read_bytes(), RerunLogger.record, [0]

    def fail(log: RerunLogger, *given: Any) -> None:
        record(log, *given)
        count[0] += 1
        if count[0] == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(RerunLogger, "record", fail)
    assert main(arguments) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert [p.name for p in path.parent.iterdir()] == ["lift.rrd"] and path.read_bytes() == before
    assert main([*arguments[:-1], str(tmp_path / "lift.avi")]) == 2
    assert "no .rrd file" in capsys.readouterr().err
