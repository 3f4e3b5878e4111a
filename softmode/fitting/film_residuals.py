"""What a film and a twin differ in: coverage by pixels and tracks by points, most of their mean over time taken off."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from softmode.deformables.materials.material import Material
from softmode.fitting.film import Clip, Mattes, blurred, cv2
from softmode.fitting.least_squares import Space
from softmode.fitting.pictures import CoverPictures, project
from softmode.fitting.tracks import Track
from softmode.fitting.worlds import PHYSICS, HeldWorlds, physics_rows
from softmode.objects.soft_object import SoftObject
from softmode.splats.raster.pinhole import PinholeCamera

Array = NDArray[np.float64]
NAMES = (
    *(*PHYSICS, "start"),
    *("camera_rx", "camera_ry", "camera_rz", "camera_x", "camera_y", "camera_z", "edge"),
    *("holder_x", "holder_y", "holder_z"),
)
"""Parameters: `PHYSICS`, start of motion [s], turn and move of the camera in its own axes [rad, m], where the matte
ends [px], where the holder goes at release [m]."""
START, EDGE = NAMES.index("start"), NAMES.index("edge")
CAMERA, HOLDER = slice(START + 1, EDGE), slice(EDGE + 1, len(NAMES))
STATIC_SHARE = 0.9
"""How much of the mean over time is taken off: what is wrong in every frame is no motion."""
COVER_NOISE, TRACK_NOISE = 0.25, 1.5
"""Standard deviations of coverage, and of tracks [px], whose places drift for many frames."""
WORLDS, STEP = 5, 1.0 / 240.0
"""Worlds that run at a time: one place and its derivatives by four numbers; and their step [s]."""
HOLDER_TIME = 0.08
"""How fast the holder gives way at release [s]."""


def film_space(release: float, interval: float, material: Material) -> Space:
    """Return the parameters of a film whose last still frame is at a time, with frames at an interval [s]."""
    inf = np.inf
    start = (release, 0.7 * interval, 0.003, release - 2.5 * interval, release + 2.5 * interval)
    turn, move, holder = (0.0, 0.02, 0.003, -inf, inf), (0.0, 0.012, 0.002, -inf, inf), (0.0, 0.002, 0.001, -inf, inf)
    rows = [start, turn, turn, turn, move, move, (0.0, 0.012, 0.003, -inf, inf), (0.0, 0.5, 0.05, -inf, inf)]
    return Space.of(physics_rows(material) | dict(zip(NAMES[START:], [*rows, holder, holder, holder], strict=True)))


class FilmResiduals:
    """Residuals of a batch of parameters.

    Args:
        thing: The object, with its end held.
        material: What is not fitted.
        clip: The film.
        mattes: What covers its background.
        camera: Where the camera should be, in the axes of the body frame, for the size of the film.
        exposure: For how long a frame sees [s].
        free: How many of `FREE` are fitted.
        device: Warp device.
    """

    def __init__(
        self,
        thing: SoftObject,
        material: Material,
        clip: Clip,
        mattes: Mattes,
        camera: PinholeCamera,
        *,
        exposure: float = 0.0,
        free: int = 0,
        device: wp.DeviceLike = None,
    ) -> None:
        """Allocate the worlds and the pictures."""
        self.thing, self.camera, self.clip = thing, camera, clip
        self.worlds = HeldWorlds(thing.body, material, WORLDS + free, dt=STEP, device=device)
        self._shots = exposure * np.array([-0.5, 0.5]) / np.sqrt(3.0) if exposure else np.zeros(1)  # Gauss's points
        self.pictures = CoverPictures(thing, camera, device=device)
        self.after: Callable[[], None] = lambda: None
        """Called after each batch."""
        self.tracks: list[tuple[Track, int]] = []
        """Tracks that are compared, with the splat of each."""
        self.frames = np.arange(len(clip.times))
        """Frames that are compared."""
        self.moving = False
        """Whether most of the mean over time is taken off."""
        self.cover = mattes.cover
        self.mask(np.ones(mattes.cover.shape[1:]))

    def mask(self, mask: Array) -> None:
        """Compare pixels where a mask (H, W) is 1, and near the object."""
        self.region, self._target = mask, blurred(self.cover * mask)[:, ::2, ::2]
        near = cv2.dilate((self._target.max(axis=0) > 0.02).astype(np.uint8), np.ones((9, 9))) > 0
        self._pixels = near & (blurred(mask[None])[0, ::2, ::2] > 0.99)

    def states(self, sets: Array, shots: ArrayLike = 0.0) -> Array:
        """Return coordinates of parameters (W, p) in the frames, at so many times about each [s], (W, F S, n, 3)."""
        return self.worlds.states(sets[:, : len(PHYSICS)], sets[:, START], self._times(shots))

    def _times(self, shots: ArrayLike) -> Array:
        """Return the times of the frames and of some about each [s], (F S,)."""
        return np.add.outer(self.clip.times[self.frames], np.atleast_1d(shots)).ravel()

    def poses(self, sets: Array, shots: ArrayLike = 0.0) -> Array:
        """Return from the world to the camera, with what the holder does, shape (W, F S, 4, 4)."""
        times = self._times(shots)
        poses = np.empty((len(sets), len(times), 4, 4))
        for x, out in zip(sets, poses, strict=True):
            moved = np.eye(4)
            moved[:3, :3] = Rotation.from_rotvec(x[CAMERA][:3]).as_matrix()
            moved[:3, 3] = -x[CAMERA][3:]
            out[:] = moved @ self.camera.world_to_camera
            gone = 1.0 - np.exp(-np.maximum(times - x[START], 0.0) / HOLDER_TIME)
            out[:, :3, 3] += (gone[:, None] * x[HOLDER]) @ out[0, :3, :3].T
        return poses

    def __call__(self, sets: Array) -> Array:
        """Return the residuals (W, M) of parameters (W, p), in units of their noise."""
        q, poses = self.states(sets, self._shots), self.poses(sets, self._shots)
        count, frames = len(sets), len(self.frames)
        drawn = self.pictures.draw(q.reshape(-1, *q.shape[2:]), poses.reshape(-1, 4, 4))
        q, poses = (a.reshape(count, frames, -1, *a.shape[2:]).mean(axis=2) for a in (q, poses))
        drawn = drawn.reshape(count * frames, -1, *drawn.shape[1:]).mean(axis=1)
        small = blurred(drawn * self.region)[:, ::2, ::2].reshape(count, frames, *self._target.shape[1:])
        rows, columns = np.gradient(small, axis=(2, 3))
        slope = np.hypot(rows, columns)
        r = (small + sets[:, EDGE, None, None, None] * slope - self._target[self.frames])[:, :, self._pixels]
        if self.moving:
            r = r - STATIC_SHARE * r.mean(axis=1, keepdims=True)
        out = [r.reshape(count, -1) / COVER_NOISE, *self._track_residuals(q, poses)]
        self.sizes = [part.shape[1] for part in out]
        self.after()
        return np.concatenate(out, axis=1)

    def _track_residuals(self, q: Array, poses: Array) -> list[Array]:
        """Return those of each track."""
        place, out = {int(f): k for k, f in enumerate(self.frames)}, []
        for track, splat in self.tracks:
            some = [k for k, f in enumerate(track.frames) if int(f) in place]
            if len(some) < 3:
                continue
            at = [place[int(track.frames[k])] for k in some]
            x = self.thing.visible_splats.means[splat] + np.einsum("k,wfkc->wfc", self.thing.basis[splat], q[:, at])
            r = project(self.camera, poses[:, at], x)[0] - track.places[some]
            out.append((r - r.mean(axis=1, keepdims=True)).reshape(len(q), -1) / TRACK_NOISE)
        return out

    def anchor(self, tracks: list[Track], x: Array) -> None:
        """Give each track the visible splat that lies nearest to its first place; one that has none is left."""
        self.tracks, means = [], self.thing.visible_splats.means
        q, poses = self.states(x[None])[0], self.poses(x[None])[0]
        for track in tracks:
            k = int(track.frames[0])
            moved = means + np.einsum("sk,kc->sc", self.thing.basis, q[k])
            pixel, depth = project(self.camera, poses[k], moved)
            off = np.linalg.norm(pixel - track.places[0], axis=1)
            near = np.flatnonzero(off < 2.5)
            if len(near):
                front = near[depth[near] < depth[near].min() + 0.1 * np.ptp(depth)]
                self.tracks.append((track, int(front[off[front].argmin()])))

    def blocks(self) -> list[NDArray[np.intp]]:
        """Return residuals that may err together: of three frames, or of a track."""
        groups = np.array_split(np.arange(self.sizes[0]).reshape(len(self.frames), -1), max(len(self.frames) // 3, 2))
        ends = np.cumsum(self.sizes)
        return [g.ravel() for g in groups] + [np.arange(a, b) for a, b in itertools.pairwise(ends)]
