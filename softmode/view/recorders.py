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
from softmode.scenes.scene import Scene, marched_fields
from softmode.splats.cameras.camera import CameraOptions, SplatCamera
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.view.live_recording import LiveRecording
from softmode.view.live_types import finite_vector
from softmode.view.picture import LivePicture
from softmode.viz.film import Film

RECORD_HZ = 30
"""Frames per simulated second."""


class Recorder:
    """Takes frames until it is finished, which puts the file in place, or discarded, which leaves nothing.

    Args:
        path: The file.
        take: Takes a time [s] and a state.
        finish: Puts the file in place.
        discard: Removes what was not finished.
    """

    def __init__(
        self, path: Path, take: Callable[[float, newton.State], None], finish: Callable, discard: Callable
    ) -> None:
        """Begin without a frame."""
        self.path, self.count = path, 0
        self._take, self.finish, self.discard = take, finish, discard

    def add(self, time: float, state: newton.State) -> None:
        """Take a frame."""
        self._take(time, state)
        self.count += 1


def _coordinates(path: Path, objects: Sequence[SoftObject]) -> Recorder:
    """Return what keeps coordinates and poses in memory and writes them at the end."""
    pending = PendingFile(path, "recording")
    frames: list[tuple[float, NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]] = []

    def take(time: float, state: newton.State) -> None:
        poses = host(state.body_q).astype(np.float32).reshape(-1, 7)
        q, dent = (np.array(array.numpy()) for array in (soft(state).q, soft(state).dent))
        frames.append((time, q.astype(np.float64), dent.astype(np.float32), poses))

    def finish() -> None:
        times, q, dent, poses = (np.array(column) for column in zip(*frames, strict=True))
        prints = tuple(thing.body.fingerprint for thing in objects)
        body_q = poses.astype(np.float32).reshape(len(times), -1, 7)
        moved = {"q": q, "dent": dent, "body_q": body_q}
        recording = LiveRecording(times=times.astype(np.float64), fingerprints=prints, **moved)
        with pending:
            recording.save(pending.temporary)

    return Recorder(path, take, finish, pending.discard)


def _film(path: Path, scene: Scene, picture: LivePicture, seen: PinholeCamera) -> Recorder:
    """Return what draws every frame with a camera and encodes it; fields that are to be marched are."""
    film = Film(path)
    try:
        fields = marched_fields(scene.solver, scene.objects)
        smooth = CameraOptions(mesh_samples=4)
        camera = SplatCamera(scene.model, picture.bound.arrays, [seen], options=smooth, overlay=fields)
    except BaseException:
        film.discard()
        raise

    def take(time: float, state: newton.State) -> None:
        if fields is not None:
            fields.update(state)
        camera.render(state)
        film.add(camera.images(seen.name).numpy()[0].copy(), RECORD_HZ)

    return Recorder(path, take, film.publish, film.discard)


def _stage(path: Path, model: newton.Model, objects: Sequence[SoftObject]) -> Recorder:
    """Return what keeps coordinates and writes a stage with handle matrices at the end."""
    from softmode.objects.placed import Placed
    from softmode.usd.animation import UsdAnimation, UsdAnimationOptions

    bodies = [Placed(object=thing) for thing in objects]
    animation = UsdAnimation(path, model, bodies, options=UsdAnimationOptions(fps=RECORD_HZ))

    def take(time: float, state: newton.State) -> None:
        with contextlib.suppress(SolverDiverged):  # a frame that is not finite is left out
            animation.record(state, time)

    return Recorder(path, take, animation.publish, lambda: None)  # nothing was written that is not whole


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
        return _coordinates(path, scene.objects)
    if suffix == ".mp4":
        return _film(path, scene, picture, camera())
    if suffix in (".usdc", ".usd", ".usda"):
        return _stage(path, scene.model, scene.objects)
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
