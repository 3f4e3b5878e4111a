"""Films as arrays: the times that a file has, and films that show nothing."""

from __future__ import annotations

import functools
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from softmode.cli.fit_scene import FitScene
from softmode.errors import AssetError, ConfigError, FitError
from softmode.fitting.film import Clip, find_mattes
from softmode.fitting.holding import Held
from softmode.viz.film import Film
from tests.needs import needs

pytestmark = needs("cv2")
Frames = np.ndarray


def bar_film(swing: float = 6.0, *, count: int = 24, at: int = 20, rate: float = 0.7) -> tuple[Frames, Frames]:
    """Return frames of a bar that swings by so many pixels from the sixth on, and the plate."""
    r = np.random.default_rng(0)
    plate = (120 + 40 * np.sin(np.arange(64) / 5.0)[:, None, None] + np.zeros((64, 64, 3))).astype(np.uint8)
    frames = []
    for k in range(count):
        image = plate.astype(float)
        y = at + swing * (1.0 - np.cos(rate * max(k - 5, 0)))
        rows = np.clip(np.arange(64) - y + 0.5, 0, 1) * np.clip(y + 10.5 - np.arange(64), 0, 1)
        image[:, 16:48] += rows[:, None, None] * (np.array([230, 30, 30]) - image[:, 16:48])
        frames.append(np.clip(image + r.normal(0, 3, image.shape), 0, 255).astype(np.uint8))
    return np.array(frames), plate


def clip_of(frames: Frames) -> Clip:
    """Return the film of frames at 30 per second."""
    return Clip(frames=frames, times=np.arange(len(frames)) / 30.0)


def test_mattes() -> None:
    """The matte has the area of the bar, and the sixth frame is found to be the last one at rest."""
    frames, plate = bar_film()
    found = find_mattes(clip_of(frames), plate)
    assert found.cover[0].sum() == pytest.approx(32 * 10, rel=0.03)  # 9 rows, and a half at both rims
    assert found.noise == pytest.approx(3.0, rel=0.2)
    assert 4 <= found.release <= 6
    assert find_mattes(clip_of(bar_film(15.0, at=8, rate=0.3)[0]), plate).release == 5  # the first 0.7 px of 30 count


@pytest.mark.parametrize(
    ("what", "match"),
    [
        ("still", "nothing moves"),
        ("cut", "is cut"),
        ("camera", "camera or the light"),
        ("leaves", "leaves the picture"),
        ("empty", "cannot be told"),
        ("two", "two things move"),
    ],
)
def test_films_that_show_nothing(what: str, match: str) -> None:
    """What shows nothing is refused with a remedy and a picture: three frames of the film side by side.

    Nothing moves, it is cut, its camera moves, the object leaves, there is none, or there are two.
    """
    frames, plate = bar_film(0.0 if what == "still" else 20.0 if what == "leaves" else 6.0)
    if what == "cut":
        frames[12:] = 255 - frames[12:]
    if what == "camera":
        frames = np.array([np.roll(frame, k // 2, axis=0) for k, frame in enumerate(frames)])
    if what == "empty":
        frames = np.repeat(plate[None], 24, axis=0)
    if what == "two":
        frames[:, 40:] = frames[:, :24]
    with pytest.raises(FitError, match=match) as caught:
        find_mattes(clip_of(frames), plate if what != "two" else np.concatenate([plate[:40], plate[:24]]))
    assert caught.value.hint and caught.value.picture.shape == (64, 192, 3)


def test_a_thing_at_rest_beside_the_object() -> None:
    """What lies apart and does not move is no second object."""
    frames, plate = bar_film(at=28)
    frames[:, 4:12, 4:12] = 20
    assert find_mattes(clip_of(frames), plate).cover[0, 4:12, 4:12].min() > 0.6  # corners of a picture that is blurred


def test_times_come_from_the_file(tmp_path: Path) -> None:
    """A film keeps its rate, a GIF the delay of each frame; slow motion is told, short films are refused."""
    frames, _ = bar_film()
    with Film(tmp_path / "bar.mp4") as film:
        for frame in frames:
            film.add(frame, 24)
        film.publish()
    found = Clip.read(tmp_path / "bar.mp4")
    assert found.frames.shape == frames.shape
    np.testing.assert_allclose(np.diff(found.times), 1.0 / 24.0, atol=2e-3)
    assert np.abs(found.frames.astype(float) - frames).mean() < 10.0
    np.testing.assert_allclose(Clip.read(tmp_path / "bar.mp4", fps_true=60.0).times[-1], 23.0 / 60.0, rtol=0.01)
    pictures = [Image.fromarray(frame) for frame in frames]
    delays = [40 if k % 2 else 100 for k in range(24)]
    pictures[0].save(tmp_path / "bar.gif", save_all=True, append_images=pictures[1:], duration=delays)
    np.testing.assert_allclose(np.diff(Clip.read(tmp_path / "bar.gif").times), np.array(delays[:-1]) / 1000.0)
    with pytest.raises(FitError, match="frames"):
        clip_of(frames[:5])
    for name in ("no.mp4", "no.gif"):
        (tmp_path / name).write_bytes(b"no film")
        with pytest.raises(AssetError, match=name):
            Clip.read(tmp_path / name)


@pytest.mark.parametrize("kind", ["ten_bits", "turned", "rates"])
def test_films_of_phones(tmp_path: Path, kind: str) -> None:
    """Ten bits, a flag that turns the picture, and frames at uneven times are read as they are meant."""
    frames, _ = bar_film()
    out, times = tmp_path / "bar.mp4", np.cumsum([0, *[1 if k % 3 else 4 for k in range(23)]]) / 60.0
    run = functools.partial(subprocess.run, check=True, capture_output=True)
    with Film(tmp_path / "plain.mp4") as film:
        for frame in frames:
            film.add(frame, 24)
        film.publish()
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-y"]
    if kind == "ten_bits":
        run([*ffmpeg, "-i", tmp_path / "plain.mp4", "-pix_fmt", "yuv420p10le", "-c:v", "libx264", out])
    elif kind == "turned":
        run([*ffmpeg, "-display_rotation", "90", "-i", tmp_path / "plain.mp4", "-c", "copy", out])
    else:
        moments = "+".join(f"eq(N\\,{k})*{60 * t:.0f}" for k, t in enumerate(times))
        how = ["-vf", f"settb=1/60,setpts={moments}", "-fps_mode", "vfr", "-enc_time_base", "1/60"]
        run([*ffmpeg, "-i", tmp_path / "plain.mp4", *how, out])
    found = Clip.read(out)
    meant = np.rot90(frames, axes=(1, 2)) if kind == "turned" else frames
    assert np.abs(found.frames.astype(float) - meant).mean() < 10.0
    np.testing.assert_allclose(found.times, times if kind == "rates" else np.arange(24) / 24.0, atol=2e-3)


def test_what_is_told(tmp_path: Path) -> None:
    """Ends that are held, and scene files: what says nothing is refused by name."""
    assert Held.parse("top:0.03") == Held(2, True, 0.03) and Held.parse("-x:0.01") == Held(0, False, 0.01)
    for text in ("top", "left:0.1", "top:0", "+x:-1"):
        with pytest.raises(ConfigError, match="held"):
            Held.parse(text)
    path = tmp_path / "scene.json"
    path.write_text('{"mass": 0.142, "held": "top:0.03", "camera": {"position": [0, -1, 0.2], "target": [0, 0, 0.1]}}')
    scene = FitScene.read(path, held="top:0.02")
    assert scene.held == "top:0.02" and scene.density_of(0.5, 300.0) == (0.284, True)
    assert scene.pinhole(128, 96, 1.0).position == (0, -1, 0.2)
    with pytest.raises(ConfigError, match="kind is 'press'"):
        FitScene(kind="press").check_kind("a film", "held")
    for text, match in (
        ('{"mess": 1}', "mess"),
        ('{"mass": 0}', "mass"),
        ('{"kind": "dropped"}', "thrown, dropped or poked"),
        ('{"free": ["colour"]}', "colour"),
        ('{"exposure": 2}', "exposure"),
        ('{"camera": {"position": [0, 0]}}', "camera"),
    ):
        path.write_text(text)
        with pytest.raises((ConfigError, ValueError), match=match):
            FitScene.read(path).pinhole(128, 96, 1.0)
