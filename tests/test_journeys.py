"""What a newcomer does first, from nothing: own capture, own arm, own task, a policy; none is silent for long.

Each journey starts without kernels and bodies, in processes of its own. Limits are seconds of the processor, all
processes together, that two cores can do in the minutes that are promised; what it took is printed.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from softmode.objects.captures import bundled
from softmode.robots import available
from tests.needs import needs

ROOT = Path(__file__).resolve().parents[1]
SILENCE = 10.0
"""Most seconds without a word: three are promised, and other tests take their turns on the same cores."""
pytestmark = pytest.mark.rest


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    """A capture of one's own: a copy of the bundled one."""
    source = bundled("playbot")
    assert source is not None
    return Path(shutil.copytree(source.parent, tmp_path / "toy"))


def go(folder: Path, limit: float, *words: str) -> str:
    """Run Python words in a folder with empty caches; return what was said, after checking seconds and silences."""
    caches = {"WARP_CACHE_PATH": str(folder / "warp"), "SOFTMODE_CACHE": str(folder / "bodies")}
    environment = {**os.environ, **caches, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    told, longest, last = b"", 0.0, time.monotonic()
    command = [sys.executable, *words]
    with subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as run:
        assert run.stdout is not None
        while part := os.read(run.stdout.fileno(), 65536):
            now = time.monotonic()
            told, longest, last = told + part, max(longest, now - last), now
    after, text = resource.getrusage(resource.RUSAGE_CHILDREN), told.decode(errors="replace")
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{' '.join(words[:4])}: {seconds:.0f} s of the processor, {longest:.1f} s of silence at most")
    assert run.returncode == 0, text
    assert seconds < limit and longest < SILENCE, text
    return text


@needs("imageio_ffmpeg")
def test_the_film_of_an_own_capture(tmp_path: Path, toy: Path) -> None:
    """Three minutes: the arm lifts it, and the film is there."""
    play = ("-m", "softmode", "play", "softmode/LiftSoft-v0", "--splat", str(toy), "-o", "toy.mp4")
    assert "success: True" in go(tmp_path, 180.0, *play)
    assert (tmp_path / "toy.mp4").stat().st_size > 10_000


@needs("tyro")
@pytest.mark.skipif("aloha_arm" not in available(), reason="this mujoco-warp ships no ALOHA arm")
def test_an_own_arm_and_an_own_toy(tmp_path: Path, toy: Path) -> None:
    """Five minutes: another arm lifts it."""
    play = ("-m", "softmode", "play", "softmode/LiftSoft-v0", "--robot", "aloha_arm", "--splat", str(toy))
    assert "success: True" in go(tmp_path, 300.0, *play, "--size", "0.06")


@needs("tyro")
def test_an_own_task_is_green(tmp_path: Path) -> None:
    """Five minutes: a new task passes its own tests."""
    go(tmp_path, 30.0, "-m", "softmode", "new", "task", "slide_disc")
    folder = tmp_path / "slide_disc"
    assert "3 passed" in go(folder, 270.0, "-m", "pytest", "-v", "-s", "-p", "no:cacheprovider")


@needs("torch", "tyro")
def test_a_policy_for_an_own_toy_is_started(tmp_path: Path, toy: Path) -> None:
    """Two minutes: a run has played its first episodes and written a checkpoint."""
    train = ("-m", "softmode", "train", "softmode/LiftSoft-v0", "--splat", str(toy), "--num-envs", "4")
    go(tmp_path, 120.0, *train, "--total-steps", "2000", "-o", "run")
    assert list((tmp_path / "run").glob("*.npz"))
