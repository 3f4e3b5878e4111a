"""Recordings of a live session: a video, coordinates to be shown again, or an OpenUSD stage."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.errors import AssetError, ConfigError, SolverDiverged
from softmode.files import PendingFile, read_arrays
from softmode.splats.camera import CameraOptions, SplatCamera
from softmode.splats.pinhole import PinholeCamera
from softmode.view.live_types import vector3
from softmode.view.picture import LivePicture
from softmode.viz.film import Film

RECORD_HZ = 30
"""Frames per simulated second."""
_FORMAT = "softmode live recording 1"


@dataclass(frozen=True, kw_only=True)
class LiveRecording:
    """Coordinates of a session over time."""

    times: NDArray[np.float64]
    """Simulated time of each frame [s], shape (T,)."""
    q: NDArray[np.float64]
    """Reduced coordinates of all objects, one after another [m], shape (T, functions, 3)."""
    body_q: NDArray[np.float32]
    """Poses of the rigid bodies, position [m] and quaternion xyzw, shape (T, B, 7)."""
    fingerprints: tuple[str, ...]
    """Fingerprints of the bodies."""

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> LiveRecording:
        """Read a file that a session recorded.

        Raises:
            AssetError: If the file is missing, damaged or foreign.
        """
        hint = "record it again"
        names = ("format", "times", "q", "body_q", "fingerprints")
        data = read_arrays(path, names, what="recording", hint=hint)
        if set(names) != set(data):
            raise AssetError(f"recording {path} is not one of a live session", hint=hint)
        times, q, body_q = data["times"], data["q"], data["body_q"]
        good = str(data["format"]) == _FORMAT and times.ndim == 1 and q.ndim == 3 and body_q.ndim == 3
        good = good and len(times) == len(q) == len(body_q) and q.shape[2] == 3 and body_q.shape[2] == 7
        if not good or not all(np.isfinite(x).all() for x in (times, q, body_q)):
            raise AssetError(f"recording {path} is not one of a live session", hint=hint)
        prints = tuple(str(x) for x in data["fingerprints"])
        return cls(times=times, q=q, body_q=body_q.astype(np.float32), fingerprints=prints)


class Recorder(Protocol):
    """What takes frames until it is finished or discarded."""

    path: Path
    count: int

    def add(self, time: float, state: Any) -> None:
        """Take a frame; the picture has been updated."""
        ...

    def finish(self) -> None:
        """Put the file in place."""
        ...

    def discard(self) -> None:
        """Leave nothing behind."""
        ...


class CoordinateRecorder:
    """Keeps coordinates and poses in memory and writes them at the end."""

    def __init__(self, path: Path, bodies: list[Any]) -> None:
        """Claim the file."""
        self._pending = PendingFile(path, "recording")
        self.path, self.count = path, 0
        self._prints = [body.fingerprint for body in bodies]
        self._frames: list[tuple[float, Any, Any]] = []

    def add(self, time: float, state: Any) -> None:
        """Take a frame."""
        poses = np.zeros((0, 7), np.float32) if state.body_q is None else state.body_q.numpy().copy()
        self._frames.append((time, state.softmode.q.numpy().copy(), poses))
        self.count += 1

    def finish(self) -> None:
        """Write the file."""
        times, q, poses = (np.array(column) for column in zip(*self._frames, strict=True))
        with self._pending.temporary.open("wb") as file:
            np.savez_compressed(
                file,
                format=np.array(_FORMAT),
                times=times.astype(np.float64),
                q=q.astype(np.float64),
                body_q=poses.astype(np.float32).reshape(len(times), -1, 7),
                fingerprints=np.array(self._prints),
            )
        self._pending.publish()

    def discard(self) -> None:
        """Forget the frames and remove what was not published."""
        self._frames.clear()
        self._pending.discard()


class FilmRecorder:
    """Draws every frame with a camera and encodes it."""

    def __init__(self, path: Path, model: Any, picture: LivePicture, camera: PinholeCamera) -> None:
        """Claim the file and make the camera."""
        self._film = Film(path)
        self.path, self.count = path, 0
        try:
            self._camera = SplatCamera(model, picture.arrays, [camera], options=CameraOptions(mesh_samples=4))
        except BaseException:
            self._film.discard()
            raise

    def add(self, time: float, state: Any) -> None:
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

    def __init__(self, path: Path, model: Any, objects: Sequence[Any]) -> None:
        """Find the objects in the model."""
        from softmode.usd.animation import UsdAnimation, UsdAnimationOptions
        from softmode.usd.placed import PlacedBody

        bodies = [PlacedBody(body=thing.body, splats=thing.splats) for thing in objects]
        self._animation = UsdAnimation(path, model, bodies, options=UsdAnimationOptions(fps=RECORD_HZ))
        self.path, self.count = path, 0

    def add(self, time: float, state: Any) -> None:
        """Take a frame; one that is not finite is left out."""
        with contextlib.suppress(SolverDiverged):
            self._animation.record(state, time)
        self.count += 1

    def finish(self) -> None:
        """Write the stage."""
        self._animation.publish()

    def discard(self) -> None:
        """Nothing was written that is not whole."""


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
    eye = middle + reach * np.array([0.9, -1.3, 0.5]) if position is None else vector3("position", position)
    at = middle if target is None else vector3("target", target)
    (x, y, z), (u, v, w) = eye.tolist(), at.tolist()
    return PinholeCamera.look_at("live", position=(x, y, z), target=(u, v, w), width=edge, height=edge, fov_y=0.7)
