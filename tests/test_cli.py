"""The command line: what it writes, what it says, how it fails."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import trimesh
from PIL import Image

import softmode
from softmode.cli.main import main
from softmode.cli.plain import plain_output
from softmode.envs.markers import dots
from softmode.splats import make_plush, write_ply, write_splats
from softmode.viz.film import Film
from tests.bodies import cube

ROOT = Path(__file__).resolve().parents[1]
os.environ.setdefault("SOFTMODE_CACHE", str(ROOT / ".cache" / "softmode"))
PLAY = ["play", "softmode/LiftSoft-v0"]


def listing(folder: Path) -> list[str]:
    """Return the names of all files and folders, hidden ones included."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Return a function that shortens the episodes of the environment."""
    import gymnasium as gym

    def limit(steps: int) -> None:
        monkeypatch.setattr(gym.spec("softmode/LiftSoft-v0"), "max_episode_steps", steps)

    return limit


# -- what it does -----------------------------------------------------------------------------------------------------


def test_play_films_an_episode(tmp_path: Path, capfd: pytest.CaptureFixture[str], short: Callable[[int], None]) -> None:
    """It writes a video of two views and a contact sheet with the umask's permissions, and prints the outcome."""
    short(6)
    video = tmp_path / "new" / "lift.mp4"
    assert main([*PLAY, "--video", str(video), "--seed", "3"]) == 0
    assert listing(tmp_path) == ["new", "new/lift.mp4", "new/lift.png"]
    frames = iio.imread(video)
    assert frames.shape == (6, 320, 640, 3)
    assert np.ptp(frames[-1]) > 100
    with Image.open(video.with_suffix(".png")) as sheet:
        assert sheet.size == (3 * 640, 4 * 320)
    umask = os.umask(0)
    os.umask(umask)
    assert [path.stat().st_mode & 0o777 for path in video.parent.iterdir()] == [0o666 & ~umask] * 2
    out, err = capfd.readouterr()
    for words in ("body 'plush'", "built in", "ms per control step", "return", "success: False", "wrote"):
        assert words in out
    assert "6/6" in err  # the progress bar
    assert "Module" not in out + err  # Warp's report on each module


@pytest.mark.rest
def test_play_films_a_room_as_a_gif(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], short: Callable[[int], None]
) -> None:
    """A looping GIF of the asked width; a wall of splats far behind the table stands where the sky was."""
    short(4)
    points = np.stack(np.meshgrid([-1.2], np.linspace(-2.0, 2.0, 60), np.linspace(-0.5, 2.0, 40)), axis=-1)
    write_splats(tmp_path / "room.ply", dots(0.5 * points.reshape(-1, 3), 0.03, color=(0.8, 0.2, 0.1), opacity=0.99))
    video = tmp_path / "lift.gif"
    room = ["--background", str(tmp_path / "room.ply"), "--background-pose", *"0 0 0 0 0 0 2".split()]
    assert main([*PLAY, "--video", str(video), "--width", "256", *room]) == 0
    with Image.open(video) as gif:
        assert gif.size == (256, 128) and getattr(gif, "n_frames", 1) >= 2 and gif.info["loop"] == 0
        first = np.asarray(gif.convert("RGB")).astype(int)
    red = (first[..., 0] > 150) & (first[..., 1] < 110)
    assert red[:30, 128:].mean() > 0.3 and red[-20:].mean() < 0.05
    capsys.readouterr()
    assert main([*PLAY, "--background", str(tmp_path / "room.ply")]) == 2
    assert "Give --video" in capsys.readouterr().err


@pytest.mark.rest
def test_play_lifts_a_trained_capture(capsys: pytest.CaptureFixture[str]) -> None:
    """The scripted policy lifts the robot out of the bundled capture, and the author is named."""
    assert main([*PLAY, "--splat", "playbot"]) == 0
    said = capsys.readouterr()
    assert "success: True" in said.out and "by Stephane Agullo" in said.err


@pytest.mark.rest
def test_play_lifts_an_inria_ply(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The plush, written as .ply in other units, is read, scaled and lifted."""
    file = tmp_path / "toy.ply"
    write_ply(file, make_plush().transformed(scale=7.0))
    assert main([*PLAY, "--splat", str(file), "--size", "0.075", "--up", "+z"]) == 0
    out = capsys.readouterr().out
    assert "body 'toy.ply'" in out and "success: True" in out


@pytest.mark.parametrize("policy", ["random", "zero"])
def test_other_policies_play(policy: str, capsys: pytest.CaptureFixture[str], short: Callable[[int], None]) -> None:
    """Random and zero actions play several episodes and count the successes."""
    short(3)
    assert main([*PLAY, "--policy", policy, "--episodes", "2", "--youngs-modulus", "1e5"]) == 0
    out = capsys.readouterr().out
    assert "seed 0: E 1e+05 Pa" in out and "seed 1" in out and "0 of 2 episodes succeeded" in out
    assert out.count("success: False, never touched") == 2


def test_play_says_what_the_gripper_cannot_take(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A block of 12 cm: exit code 2, its width, the gripper's, and the size that fits; no episode is told."""
    file = tmp_path / "block.stl"
    trimesh.creation.box((1.0, 1.0, 1.0)).export(file)
    assert main([*PLAY, "--object", str(file), "--size", "0.12"]) == 2
    out, err = capsys.readouterr()
    assert "120 mm wide" in err and "takes 84 mm" in err and "--size times 0.70" in err and "seed 0" not in out


def test_a_task_of_ones_own_plays(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    """module:id imports the module, from the working folder too; its scripted policy is that of its task."""
    (tmp_path / "slow_lift.py").write_text(OWN_TASK)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    given = ["slow_lift:SlowLift-v0", "--youngs-modulus", "1e5"]
    assert main(["play", *given]) == 0
    out = capsys.readouterr().out
    assert "a script of its own" in out and "seed 0: E 1e+05 Pa" in out
    assert main(["play", "SlowLift-v0", "--policy", "zero"]) == 0
    assert main(["play", "CartPole-v1"]) == 2
    assert main(["play", "no_such_module:SlowLift-v0"]) == 2
    err = capsys.readouterr().err
    assert "not made of a softmode task" in err and "no_such_module" in err


OWN_TASK = """
import gymnasium as gym
from softmode.envs.tasks.lift_soft.task import LiftSoft
from softmode.envs.soft_env import SoftEnv

def rest(env):
    print("a script of its own")
    return lambda observation: env.action_space.low * 0

class SlowLift(LiftSoft):
    scripted_policy = rest

class SlowLiftEnv(SoftEnv[SlowLift]):
    pass

gym.register("SlowLift-v0", entry_point=SlowLiftEnv, max_episode_steps=3)
"""


def test_help_is_written_where_there_is_only_ascii(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a terminal cannot show becomes a question mark."""
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, encoding="ascii"))
    with pytest.raises(SystemExit) as end:
        main(["--help"])
    sys.stdout.flush()
    assert end.value.code == 0 and b"list-envs" in shown.getvalue() and b"?" in shown.getvalue()


def test_no_name_from_a_file_steers_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Escapes, controls and turned text in a body's name are shown, not obeyed; an error's colours are not lost."""
    name = "toy\x1b]0;title\x07\x1b[8m\r\x9b2J\u202e"
    file = tmp_path / "toy.npz"
    replace(cube(), name=name).save(file)
    code = main(["body", "check", str(file)])
    out = capsys.readouterr().out
    assert code in (0, 1, 2) and "toy?]0;title??[8m??2J?" in out
    assert not set(out) & set("\x1b\x07\r\x9b\u202e")
    with plain_output():
        print("\x1b[31mbroken\x1b[0m")
        print("\rbar", end="", file=sys.stderr)
    told = capsys.readouterr()
    assert told.out == "\x1b[31mbroken\x1b[0m\n" and told.err == "\rbar"


def test_list_envs_names_every_environment(capsys: pytest.CaptureFixture[str]) -> None:
    """One line per environment, without loading the simulator."""
    assert main(["list-envs"]) == 0
    assert "softmode/LiftSoft-v0  " in capsys.readouterr().out


def test_warp_is_left_as_it_was(short: Callable[[int], None]) -> None:
    """Only the command line quietens Warp: afterwards its log level is the user's own again."""
    import warp as wp

    short(1)
    before = wp.config.log_level
    assert main([*PLAY, "--policy", "zero"]) == 0
    assert wp.config.log_level == before


# -- how it fails -----------------------------------------------------------------------------------------------------


def damaged(kind: str, folder: Path) -> str:
    """Write a splat file that cannot be used; return its path."""
    path = folder / f"{kind}.ply"
    if kind == "missing":
        return str(path)
    plush = make_plush(count=400)
    if kind == "flat":  # a sheet encloses nothing
        means = plush.means * np.array([1.0, 1.0, 0.0], np.float32)
        plush = type(plush)(means=means, quats=plush.quats, scales=plush.scales, opacities=plush.opacities, sh=plush.sh)
    write_ply(path, plush)
    data = path.read_bytes()
    if kind == "truncated":
        data = data[: len(data) // 2]
    path.write_bytes(data)
    return str(path)


FAILURES: dict[str, tuple[list[str], str]] = {
    "policy": (["--policy", "clever"], "policy"),
    "episodes": (["--episodes", "0"], "episodes"),
    "seed": (["--seed", "-1"], "seed"),
    "modulus": (["--youngs-modulus", "-1"], "youngs-modulus"),
    "modulus nan": (["--youngs-modulus", "nan"], "youngs-modulus"),
    "size": (["--size", "0"], "size"),
    "device": (["--device", "abacus:9"], "abacus:9"),
    "crop": (["--crop", "0", "0", "0", "1", "-1", "1"], "crop"),
    "extension": (["--video", "{folder}/film.avi"], "film.avi"),
    "video is a folder": (["--video", "{folder}/taken.mp4"], "taken.mp4"),
    "parent is a file": (["--video", "{folder}/file/film.mp4"], "film.mp4"),
    "missing": (["--splat", "missing"], "missing.ply"),
    "truncated": (["--splat", "truncated"], "truncated.ply"),
    "flat": (["--splat", "flat"], "flat.ply"),
}


@pytest.mark.parametrize("case", FAILURES)
def test_expected_errors_are_one_line_and_leave_nothing(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 2, one line that names the argument and a remedy, no traceback, no new file and no changed one."""
    (tmp_path / "file").write_text("kept")
    (tmp_path / "taken.mp4").mkdir()
    arguments, name = FAILURES[case]
    arguments = [word.replace("{folder}", str(tmp_path)) for word in arguments]
    if arguments[0] == "--splat":
        arguments[1] = damaged(arguments[1], tmp_path)
    if arguments[0] != "--video":
        arguments += ["--video", str(tmp_path / "deep" / "film.mp4")]
    before = listing(tmp_path)
    assert main([*PLAY, *arguments]) == 2
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if line.startswith("softmode: error: ")]
    assert len(lines) == 1 and name in lines[0] and "Traceback" not in error
    assert ". " in lines[0]  # the remedy
    assert listing(tmp_path) == before
    assert (tmp_path / "file").read_text() == "kept"


def test_unknown_environment_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    """The error lists the known ones."""
    assert main(["play", "softmode/Nothing-v0"]) == 2
    assert "use one of softmode/LiftSoft-v0" in capsys.readouterr().err.replace("Use", "use")


@pytest.mark.parametrize("arguments", [["play"], ["dance"], [*PLAY, "--size", "big"], [*PLAY, "--no-such-option"]])
def test_wrong_usage_exits_with_two(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """The parser's own errors also exit with 2."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_a_missing_extra_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without an optional package the command ends with code 2, says what to install, and writes nothing."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert main([*PLAY, "--video", "x.mp4"]) == 2
    assert "pip install 'softmode[demo]'" in capsys.readouterr().err
    assert listing(tmp_path) == []


@pytest.mark.parametrize(
    ("failure", "code"),
    [(KeyboardInterrupt, 130), pytest.param(OSError("No space left on device"), 2, marks=pytest.mark.rest)],
)
def test_interrupted_film_leaves_the_old_one(
    failure: Any,
    code: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    short: Callable[[int], None],
) -> None:
    """Ctrl-C or a full disk in mid-episode keeps the files that were there, and leaves none beside them."""
    short(5)
    video = tmp_path / "lift.mp4"
    video.write_bytes(b"old film")
    video.with_suffix(".png").write_bytes(b"old sheet")
    add, count = Film.add, [0]

    def fail(film: Any, *arguments: Any) -> None:
        add(film, *arguments)
        count[0] += 1
        if count[0] == 3:
            raise failure

    monkeypatch.setattr(Film, "add", fail)
    assert main([*PLAY, "--policy", "zero", "--video", str(video)]) == code
    assert "softmode: " in capsys.readouterr().err
    assert listing(tmp_path) == ["lift.mp4", "lift.png"]
    assert video.read_bytes() == b"old film"
    assert video.with_suffix(".png").read_bytes() == b"old sheet"


def test_the_version_needs_no_package(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """`softmode --version` says it without the packages of the command line."""
    monkeypatch.setitem(sys.modules, "tyro", None)
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"softmode {softmode.__version__}\n"


@pytest.mark.parametrize("module", ["softmode", "softmode.cli", "softmode.cli.main"])
def test_a_process_exits_with_the_code(module: str, tmp_path: Path) -> None:
    """`python -m` of each is the command: the exit code reaches the shell, and errors are written to stderr only."""
    command = [sys.executable, "-m", module, *PLAY, "--policy", "clever"]
    run = subprocess.run(
        command, capture_output=True, text=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert run.returncode == 2 and run.stdout == ""
    assert run.stderr.count("\n") == 1 and run.stderr.startswith("softmode: error: unknown policy")
    assert listing(tmp_path) == []


def test_hints_name_the_commands_own_help(capsys: pytest.CaptureFixture[str]) -> None:
    """An option that is not there, and a file that is not named or named twice, say where help is."""
    for words, told in (
        (["play", "softmode/LiftSoft-v0", "--nonsense"], "softmode play --help"),
        (["splat", "convert", "a.ply", "--nonsense"], "softmode splat convert --help"),
    ):
        with pytest.raises(SystemExit):
            main(words)
        assert told in " ".join(capsys.readouterr().err.split())
    assert main(["splat", "convert", "a.ply"]) == 2
    assert main(["objects", "export", "mug", "a.ply", "-o", "b.ply"]) == 2
    assert capsys.readouterr().err.count("-o out/toy.npz") == 2


def test_a_film_into_a_folder_that_is_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is refused before anything is built."""
    (tmp_path / "out").write_text("")
    assert main([*PLAY, "-o", str(tmp_path / "out" / "film.mp4")]) == 2
    assert "film.mp4" in capsys.readouterr().err
