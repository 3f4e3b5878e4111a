"""`Clip`: a film as arrays with the times of its frames, and what covers its background."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.checks import require_number
from softmode.errors import AssetError, FitError, needs_extra
from softmode.files import damage_errors
from softmode.objects.fingerprint import file_fingerprint

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
LEAST_FRAMES = 8
LONGEST = 20.0
"""Longest film that is read [s]."""
EDGE = 192
"""Longest edge to which frames are made smaller [px]."""


class _OpenCV:
    """OpenCV, imported when a name of it is first used.

    Raises:
        MissingExtraError: If it is not installed.
    """

    def __getattr__(self, name: str) -> Any:
        """Return a function or a number of it."""
        with needs_extra("fit", "a film is read with OpenCV"):
            import cv2
        return getattr(cv2, name)


cv2 = _OpenCV()


@dataclass(frozen=True, kw_only=True, eq=False)
class Clip:
    """A film of one fixed camera."""

    frames: Image
    """RGB, shape (F, H, W, 3)."""
    times: Array
    """Of the frames, from the first [s], shape (F,)."""
    source: str = "film"
    """What messages call it."""
    fingerprint: str = ""
    """sha256 of its file."""
    shrink: float = 1.0
    """Its pixels over those of the file, along an edge."""

    def __post_init__(self) -> None:
        """Refuse what is no film."""
        if len(self.frames) < LEAST_FRAMES or not self.times[-1] > 0.2:
            what = f"{len(self.frames)} frames of {self.times[-1] if len(self.times) else 0.0:.2f} s"
            raise self.refused(what, hint="film a second or more from before the object is let go")
        if not (np.diff(self.times) > 0.0).all():
            raise self.refused("its times do not increase", hint="export it again at a constant rate")

    def refused(self, what: str, *, hint: str, cover: Array | None = None, twin: Any = None) -> FitError:
        """Return the error that says what is wrong, with a picture: the first frame, the most different one, the last.

        Args:
            what: What is wrong.
            hint: The remedy.
            cover: What covers the background, 0..1, shape (F, H, W); drawn red.
            twin: Where the object should be, 0..1, shape (H, W); drawn blue.
        """
        error = FitError(f"film {self.source}: {what}", hint=hint)
        if len(self.frames):
            off = np.abs(self.frames.astype(np.float32) - self.frames[0]).mean(axis=(1, 2, 3))
            none = np.zeros(self.frames.shape[:3])
            red, blue = none if cover is None else cover, none[0] if twin is None else twin
            shown = [outlined(self.frames[k], red[k], blue) for k in (0, int(off.argmax()), -1)]
            error.picture = np.concatenate(shown, axis=1)
        return error

    @property
    def interval(self) -> float:
        """Usual time between two frames [s]."""
        return float(np.median(np.diff(self.times)))

    def like(self, path: Path) -> Image:
        """Return a picture of the same camera, of the film's size.

        Raises:
            AssetError: If it cannot be read.
        """
        found = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if found is None:
            raise AssetError(f"plate {path}: cannot be read", hint="give a .png or .jpg of the background")
        size = self.frames.shape[2], self.frames.shape[1]
        return cv2.resize(found[..., ::-1], size, interpolation=cv2.INTER_AREA)

    @classmethod
    def read(cls, path: Path, *, fps_true: float | None = None) -> Clip:
        """Read a film: times and rotation as the file has them, frames at most `EDGE` wide and high.

        Args:
            path: A film, or an animated GIF.
            fps_true: Frames per second at which a film was taken that plays slower or faster.

        Raises:
            AssetError: If it is missing or cannot be read.
            FitError: If it is too short, or longer than `LONGEST`.
        """
        if not path.is_file():
            raise AssetError(f"film {path}: no such file", hint="check the path")
        frames, moments, shrink = [], [], 1.0
        for time, frame in _gif(path) if path.suffix.lower() == ".gif" else _video(path):
            if time > LONGEST:
                hint = "cut it: a second before the object is let go, and one to three after"
                raise FitError(f"film {path}: is longer than {LONGEST:g} s", hint=hint)
            small = min(1.0, EDGE / max(frame.shape))
            size = (round(small * frame.shape[1]), round(small * frame.shape[0]))
            frames.append(cv2.resize(frame, size, interpolation=cv2.INTER_AREA) if small < 1.0 else frame)
            moments.append(time)
            shrink = size[0] / frame.shape[1]
        if not frames:
            raise AssetError(f"film {path}: no frame can be read", hint="export it as .mp4 (H.264)")
        times = np.array(moments) - moments[0]
        if fps_true is not None:
            require_number("fps_true", fps_true, above=0.0, at_most=1.0e5, hint="give frames per second, like 240")
            times = times / (np.median(np.diff(times)) if len(times) > 1 else 1.0) / fps_true
        told = {"source": str(path), "fingerprint": file_fingerprint(path)}
        return cls(frames=np.array(frames), times=times, shrink=shrink, **told)


def _video(path: Path) -> Any:
    """Yield times [s] and frames (RGB) of a film."""
    reader = cv2.VideoCapture(str(path))  # turns frames by the file's own flag, and gives 8 bits
    while True:
        good, frame = reader.read()
        if not good:
            reader.release()
            return
        yield 1.0e-3 * reader.get(cv2.CAP_PROP_POS_MSEC), frame[..., ::-1]


def _gif(path: Path) -> Any:
    """Yield times [s] and frames (RGB) of an animated GIF."""
    from PIL import Image as Picture
    from PIL import ImageSequence

    time = 0.0
    with damage_errors(f"film {path}", hint="export it again"), Picture.open(path) as file:
        for frame in ImageSequence.Iterator(file):
            yield time, np.asarray(frame.convert("RGB"))
            time += 1.0e-3 * max(float(frame.info.get("duration", 100.0)), 10.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Mattes:
    """What covers the background of a film."""

    cover: Array
    """0..1, shape (F, H, W)."""
    noise: float
    """Standard deviation of the film's noise, of 255."""
    release: int
    """The last frame before anything moves."""


def find_mattes(clip: Clip, plate: Image | None) -> Mattes:
    """Find what covers the background, when it begins to move, and what speaks against a fit.

    Args:
        clip: The film.
        plate: The picture without the object, (H, W, 3); None takes the median of the film, which shows the object
            where it never leaves.

    Raises:
        FitError: If the camera moves, the film is cut, nothing is there or moves, or it leaves the picture.
    """
    smooth = np.array([cv2.GaussianBlur(f.astype(np.float32), (0, 0), 0.6) for f in clip.frames])
    steps = np.diff(clip.frames.astype(np.float32), axis=0)
    noise = max(float(1.4826 / np.sqrt(2.0) * np.median(np.abs(steps[steps != 0.0]))) if steps.any() else 0.0, 1.0)
    back = np.median(smooth, axis=0) if plate is None else plate.astype(np.float32)
    if back.shape != smooth.shape[1:]:
        raise clip.refused(f"its plate has shape {back.shape[:2]}", hint="take it with the same camera")
    _check_background(clip, smooth, noise)
    level = np.clip((smooth * back).sum(axis=3) / ((back * back).sum(axis=2) + 1e-6), 0.98, 1.02)
    cover = np.array([_matte(f, k * back, noise) for f, k in zip(smooth, level[..., None], strict=True)])
    if (cover > 0.5).mean(axis=(1, 2)).max() < 0.002 or (cover > 0.5).mean() > 0.7:
        hint = "film it before another background, or give the picture without it: --plate empty.png"
        raise clip.refused("the object cannot be told from the background", hint=hint, cover=cover)
    release = _release(clip, cover)
    edge = np.ones(cover.shape[1:], bool)
    edge[2:-2, 2:-2] = False
    if (cover[release:, edge] > 0.5).sum(axis=1).max() > (cover[0, edge] > 0.5).sum() + 6:
        raise clip.refused("the object leaves the picture", hint="film it from farther away", cover=cover)
    _check_alone(clip, cover)
    return Mattes(cover=cover, noise=noise, release=release)


def blurred(pictures: Array) -> NDArray[np.float32]:
    """Return pictures (F, H, W) blurred by 1.2 px."""
    return np.array([cv2.GaussianBlur(p.astype(np.float32), (0, 0), 1.2) for p in pictures])


def _matte(seen: Array, back: Array, noise: float) -> Array:
    """Return what covers the background of a frame, 0..1, shape (H, W), without specks and small holes.

    A pixel of the rim is covered by how far it is from the background, over how far the nearest one inside is; where
    that one is like the background, by whether it is away from it at all.

    Args:
        seen: The frame (H, W, 3).
        back: The background, likewise.
        noise: Standard deviation of the frame's noise, of 255.
    """
    away = np.sqrt(((seen - back) ** 2).mean(axis=2))
    cover = np.clip((away - 3.0 * noise) / (7.0 * noise), 0.0, 1.0)
    hard = (cover > 0.5).astype(np.uint8)
    count, label, stats, _ = cv2.connectedComponentsWithStats(hard)
    keep = np.isin(label, [i for i in range(1, count) if stats[i, 4] >= 25]).astype(np.uint8)
    closed = cv2.morphologyEx(hard, cv2.MORPH_CLOSE, np.ones((5, 5)))
    cover = np.maximum(cover, closed) * cv2.dilate(keep, np.ones((3, 3)))
    outer = 1 - cv2.erode((cover > 0.5).astype(np.uint8), np.ones((5, 5)))
    way, label = cv2.distanceTransformWithLabels(outer, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    inside = np.zeros((label.max() + 1, 3))
    inside[label[outer == 0]] = seen[outer == 0]
    full = np.sqrt(((inside[label] - back) ** 2).mean(axis=2))
    rim = (outer > 0) & (way < 5.0) & (cover > 0.0) & (full > 10.0 * noise)
    return np.where(rim, np.clip(away / np.maximum(full, 1e-6), 0.0, 1.0), cover)


def _check_background(clip: Clip, smooth: Array, noise: float) -> None:
    """Refuse a film whose background changes; the object covers less than half of it."""
    steps = np.median(np.abs(np.diff(smooth, axis=0)), axis=(1, 2, 3))
    limit = 2.0 * float(np.quantile(steps, 0.25)) + 0.5 * noise
    cuts = np.flatnonzero(steps > limit)
    if 0 < len(cuts) <= 2:
        what = f"is cut at {clip.times[cuts[0] + 1]:.2f} s"
        raise clip.refused(what, hint="give one take, from before it is let go")
    if len(cuts) or np.median(np.abs(smooth[-1] - smooth[0])) > limit:
        raise clip.refused("the camera or the light moves", hint="put the camera on a tripod")


def _check_alone(clip: Clip, cover: Array) -> None:
    """Refuse a film in which two things move that lie apart while nothing does; one that rests is no object."""
    near = cv2.dilate((cover[0] > 0.5).astype(np.uint8), np.ones((9, 9)))
    count, label = cv2.connectedComponents(near)
    soft, moved = blurred(cover), []
    for k in range(1, count):
        zone = cv2.dilate((label == k).astype(np.uint8), np.ones((5, 5))) > 0
        area = float(cover[0, label == k].sum())
        change = np.abs(soft[:, zone] - soft[0, zone]).sum(axis=1).max()
        moved.append((change > 0.15 * area) * area)
    if len(moved) > 1 and sorted(moved)[-2] > 0.1 * max(moved):
        raise clip.refused("two things move", hint="film one object, before a background at rest", cover=cover)


def outlined(frame: Image, cover: Array, twin: NDArray[Any]) -> Image:
    """Return a frame with the rim of what covers it in red and that of the object in blue."""
    picture = frame.copy()
    for area, color in ((cover, (255, 0, 0)), (twin, (0, 0, 255))):
        inner = np.pad(area > 0.5, 1)
        rim = inner[2:, 1:-1] | inner[:-2, 1:-1] | inner[1:-1, 2:] | inner[1:-1, :-2]
        picture[rim & ~inner[1:-1, 1:-1]] = color
    return picture


def _release(clip: Clip, cover: Array) -> int:
    """Return the last frame before anything moves; refuse a film in which nothing does."""
    soft = blurred(cover)
    steps = np.sort(np.abs(np.diff(soft, axis=0)).sum(axis=(1, 2)))
    change = np.abs(soft - soft[0]).sum(axis=(1, 2))
    rim = np.sqrt(max(float((cover[0] > 0.5).sum()), 1.0))
    flicker = min(float(np.median(steps[: max(3, len(steps) // 4)])), 0.4 * rim)  # more is motion in every frame
    if np.sort(change)[-5] < 1.6 * flicker + 0.1 * rim:  # of noise alone the largest is twice the smallest
        hint = "let go of one end, hold it so that it sags, or press a stiff object with a scale: --press"
        raise clip.refused("not observable, because nothing moves by more than a pixel", hint=hint, cover=cover)
    away = int(np.argmax(change > 1.3 * flicker + 0.08 * (change.max() - 1.3 * flicker)))
    still = np.flatnonzero(change[:away] <= 1.6 * flicker + 0.25 * rim)  # of a large motion 8 % are many pixels
    return int(still[-1]) if len(still) else 0
