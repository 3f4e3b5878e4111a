"""What a newcomer does first: own capture, own arm, a policy. It comes out, and none is silent for long.

Each journey starts without bodies, in processes of its own; kernels are those of the other tests. What it took is
printed (``pytest -s``). `test_cli_new` has the own task, `benchmarks/first_environment.py` a machine's first start.
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
SILENCE = 30.0
"""Seconds without a word that a user takes for a hang: three are promised on a machine that does nothing else."""


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    """A capture of one's own: a copy of the bundled one."""
    source = bundled("playbot")
    assert source is not None
    return Path(shutil.copytree(source.parent, tmp_path / "toy"))


def go(folder: Path, *words: str) -> str:
    """Run Python words in a folder without built bodies; return what was said, after checking that it never hung."""
    caches = {"SOFTMODE_CACHE": str(folder / "bodies"), "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    environment = {**os.environ, **caches}
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
    assert longest < SILENCE, text
    return text


@pytest.mark.rest
@needs("imageio_ffmpeg")
def test_the_film_of_an_own_capture(tmp_path: Path, toy: Path) -> None:
    """The arm lifts it, and the film is there."""
    play = ("-m", "softmode", "play", "softmode/LiftSoft-v0", "--splat", str(toy), "-o", "toy.mp4")
    assert "success: True" in go(tmp_path, *play)
    assert (tmp_path / "toy.mp4").stat().st_size > 10_000


@pytest.mark.rest
@needs("tyro")
@pytest.mark.skipif("aloha_arm" not in available(), reason="this mujoco-warp ships no ALOHA arm")
def test_an_own_arm_and_an_own_toy(tmp_path: Path, toy: Path) -> None:
    """Another arm lifts it in three episodes of four: the first has the hardest material of all."""
    play = ("-m", "softmode", "play", "softmode/LiftSoft-v0", "--robot", "aloha_arm", "--splat", str(toy))
    assert go(tmp_path, *play, "--size", "0.06", "--episodes", "4").count("success: True") >= 3


@pytest.mark.slow
@needs("torch", "tyro")
def test_a_policy_for_an_own_toy_is_started(tmp_path: Path, toy: Path) -> None:
    """A run has played its first episodes and written a checkpoint."""
    train = ("-m", "softmode", "train", "softmode/LiftSoft-v0", "--splat", str(toy), "--num-envs", "4")
    go(tmp_path, *train, "--total-steps", "2000", "-o", "run")
    assert list((tmp_path / "run").glob("*.npz"))
