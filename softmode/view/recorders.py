"""What records a live session while it runs: a video, coordinates to be shown again, or an OpenUSD stage."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import newton
import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.model.namespaces import soft
from softmode.errors import ConfigError, SolverDiverged
from softmode.files import PendingFile
from softmode.objects.soft_object import SoftObject
from softmode.scenes.host import host
from softmode.scenes.scene import Scene
from softmode.splats.camera import CameraOptions, SplatCamera
from softmode.splats.pinhole import PinholeCamera
from softmode.view.live_recording import LiveRecording
from softmode.view.live_types import finite_vector
from softmode.view.picture import LivePicture
from softmode.viz.film import Film

RECORD_HZ = 30
"""Frames per simulated second."""


class CoordinateRecorder:
    """Keeps coordinates and poses in memory and writes them at the end."""

    def __init__(self, path: Path, objects: Sequence[SoftObject]) -> None:
        """Claim the file."""
        self._pending = PendingFile(path, "recording")
        self.path, self.count = path, 0
        self._prints = tuple(thing.body.fingerprint for thing in objects)
        self._frames: list[tuple[float, NDArray[np.float64], NDArray[np.float32]]] = []

    def add(self, time: float, state: newton.State) -> None:
        """Take a frame."""
        poses = host(state.body_q).astype(np.float32).reshape(-1, 7)
        self._frames.append((time, np.array(soft(state).q.numpy(), dtype=np.float64), poses))
        self.count += 1

    def finish(self) -> None:
        """Write the file."""
        times, q, poses = (np.array(column) for column in zip(*self._frames, strict=True))
        recording = LiveRecording(
            times=times.astype(np.float64),
            q=q.astype(np.float64),
            body_q=poses.astype(np.float32).reshape(len(times), -1, 7),
            fingerprints=self._prints,
        )
        recording.save(self._pending.temporary)
        self._pending.publish()

    def discard(self) -> None:
        """Forget the frames and remove what was not published."""
        self._frames.clear()
        self._pending.discard()


class FilmRecorder:
    """Draws every frame with a camera and encodes it."""

    def __init__(self, path: Path, model: newton.Model, picture: LivePicture, camera: PinholeCamera) -> None:
        """Claim the file and make the camera."""
        self._film = Film(path)
        self.path, self.count = path, 0
        try:
            self._camera = SplatCamera(model, picture.bound.arrays, [camera], options=CameraOptions(mesh_samples=4))
        except BaseException:
            self._film.discard()
            raise

    def add(self, time: float, state: newton.State) -> None:
        """Draw a frame."""
        self._camera.render(state)
        self._film.add(self._camera.images(self._camera.cameras[0].name).numpy()[0].copy(), RECORD_HZ)
        self.count += 1

    def finish(self) -> None:
        """Publish video and contact sheet."""
        self._film.publish()

    def discard(self) -> None:
        """Remove what was written."""
        self._film.discard()


class UsdRecorder:
    """Keeps coordinates and writes a stage with handle matrices at the end."""

    def __init__(self, path: Path, model: newton.Model, objects: Sequence[SoftObject]) -> None:
        """Find the objects in the model."""
        from softmode.objects.placed import Placed
        from softmode.usd.animation import UsdAnimation, UsdAnimationOptions

        bodies = [Placed(object=thing) for thing in objects]
        self._animation = UsdAnimation(path, model, bodies, options=UsdAnimationOptions(fps=RECORD_HZ))
        self.path, self.count = path, 0

    def add(self, time: float, state: newton.State) -> None:
        """Take a frame; one that is not finite is left out."""
        with contextlib.suppress(SolverDiverged):
            self._animation.record(state, time)
        self.count += 1

    def finish(self) -> None:
        """Write the stage."""
        self._animation.publish()

    def discard(self) -> None:
        """Nothing was written that is not whole."""


Recorder = CoordinateRecorder | FilmRecorder | UsdRecorder
"""What takes frames until it is finished, which puts the file in place, or discarded, which leaves nothing."""


def make_recorder(path: Path, scene: Scene, picture: LivePicture, camera: Callable[[], PinholeCamera]) -> Recorder:
    """Return what records a scene to a file of that kind.

    Args:
        path: The file: .mp4, .npz, or .usdc, .usd or .usda.
        scene: The scene.
        picture: Its splats.
        camera: Returns the camera of a video.

    Raises:
        ConfigError: If the path has another suffix or cannot be written.
        MissingExtraError: If what encodes videos, or OpenUSD, is not installed.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return CoordinateRecorder(path, scene.objects)
    if suffix == ".mp4":
        return FilmRecorder(path, scene.model, picture, camera())
    if suffix in (".usdc", ".usd", ".usda"):
        return UsdRecorder(path, scene.model, scene.objects)
    raise ConfigError(f"recording {path} is no .mp4, .npz or .usdc file", hint="name it like out/poke.mp4")


def live_camera(
    known: Sequence[PinholeCamera],
    bounds: NDArray[np.float64],
    position: ArrayLike | None,
    target: ArrayLike | None,
    edge: int,
) -> PinholeCamera:
    """Return the camera of a video, square.

    Args:
        known: Cameras that show the scene well; the last one is taken if nothing is asked for.
        bounds: Box to be seen otherwise [m], shape (2, 3).
        position: Where the camera stands [m].
        target: Where it looks [m].
        edge: Width and height [px]; cut to a multiple of 8, which encoders like.

    Raises:
        ConfigError: If a number is not finite or out of range.
    """
    if not isinstance(edge, int | np.integer) or not 64 <= edge <= 1024:
        raise ConfigError(f"edge must be a whole number in 64..1024 px, got {edge!r}")
    edge = int(edge) - int(edge) % 8
    if known and position is None and target is None:
        shown = known[-1]
        x, y = edge / shown.width, edge / shown.height
        lens = {"fx": x * shown.fx, "fy": y * shown.fy, "cx": x * shown.cx, "cy": y * shown.cy}
        return replace(shown, name="live", width=edge, height=edge, **lens)
    middle, reach = bounds.mean(axis=0), float(np.linalg.norm(bounds[1] - bounds[0]))
    eye = middle + reach * np.array([0.9, -1.3, 0.5]) if position is None else finite_vector("position", position)
    at = middle if target is None else finite_vector("target", target)
    (x, y, z), (u, v, w) = eye.tolist(), at.tolist()
    return PinholeCamera.look_at("live", position=(x, y, z), target=(u, v, w), width=edge, height=edge, fov_y=0.7)
