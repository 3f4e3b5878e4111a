"""SIGTERM: commands finish, keep what they have, leave nothing else, and end in time with all that they started."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from pathlib import Path

import pytest

from softmode.cli.main import main
from tests import faults
from tests.marks import rest_but
from tests.needs import needs

HELD = """
import hashlib, sys, threading, time
from softmode import interrupts
interrupts.GRACE = float(sys.argv[2])
with interrupts.ending_on_sigterm() as ended:
    try:
        threading.Timer(0.3, print, ("ready",), {"flush": True}).start()
        if sys.argv[1] == "compiled":  # one call that Python cannot end
            hashlib.pbkdf2_hmac("sha256", b"", b"", 2_000_000_000)
        time.sleep(60.0)
    except KeyboardInterrupt:
        print("asked", flush=True)
        if sys.argv[1] == "stuck":
            time.sleep(60.0)
sys.exit(ended[0])
"""
COMMAND = "import sys; from softmode.cli.main import main; sys.exit(main(sys.argv[1:]))"


def test_a_second_sigterm_ends_at_once() -> None:
    """What does not end after the first is ended by the second, long before its time is over."""
    process = faults.start(HELD, "stuck", 50.0)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGTERM)
    assert process.stdout.readline() == "asked\n"
    assert faults.end_at(process, lambda line: True, signal.SIGTERM, read=False)[0] == 143


@pytest.mark.parametrize(("kind", "grace"), [("willing", 50.0), ("compiled", 0.2)])
def test_a_process_ends_in_time(kind: str, grace: float) -> None:
    """By itself where it can; where it is within compiled code, when its time is over."""
    code, written = faults.end_at(faults.start(HELD, kind, grace), lambda line: True, signal.SIGTERM)
    assert code == 143 and ("asked" in written) == (kind == "willing")


def test_children_made_by_a_fork_end_by_themselves(tmp_path: Path) -> None:
    """They do not handle the signal, and do not tell the parent of theirs."""
    from softmode.interrupts import ending_on_sigterm

    with ending_on_sigterm() as ended:

        def sleep() -> None:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5.0)

        assert faults.in_child(sleep) == -signal.SIGTERM
    assert not ended
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


@pytest.mark.rest
def test_a_film_that_is_not_finished_goes(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """`play --video` leaves neither film nor hidden file nor the folder it made."""
    made = tmp_path / "out"
    with faults.signalled(signal.SIGTERM, lambda: any(path.stat().st_size > 40 for path in made.glob(".film-*.mp4"))):
        code = main(["play", "softmode/PushSoft-v0", "--episodes", "100", "--video", str(made / "film.mp4")])
    assert code == 143 and not list(tmp_path.iterdir())
    assert "nothing was written" in capfd.readouterr().err


@pytest.mark.rest
def test_a_body_that_is_not_built_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`body build` ends within the build."""
    from softmode.objects import loader

    begun, real = threading.Event(), loader.build_object

    def build(*arguments: object, **given: object) -> object:
        begun.set()
        return real(*arguments, **given)

    monkeypatch.setattr(loader, "build_object", build)
    with faults.signalled(signal.SIGTERM, begun.is_set):
        code = main(["body", "build", "mug", "--points", "2000", "-o", str(tmp_path / "mug.npz")])
    assert code == 143 and not list(tmp_path.iterdir())


def gone(session: int, seconds: float = 20.0) -> bool:
    """Return whether no process of a session is left, after that time at most."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = []
        for stat in Path("/proc").glob("[0-9]*/stat"):
            try:
                fields = stat.read_text().rpartition(")")[2].split()
            except OSError:
                continue
            found += [stat.parent.name] if int(fields[3]) == session and fields[0] != "Z" else []
        if not found:
            return True
        time.sleep(0.1)
    return False


@needs("torch")
@pytest.mark.parametrize("number", rest_but([], [signal.SIGTERM, signal.SIGKILL], slow=[signal.SIGTERM]))
def test_processes_that_hold_worlds_end_with_training(tmp_path: Path, number: signal.Signals) -> None:
    """None is left whether the parent ends or is killed, and a run that was asked to end can go on."""
    folder = tmp_path / "run"
    command = ["train", "softmode/PushSoft-v0", "--num-envs", "2", "--processes", "2", "--run-dir", str(folder)]
    command += ["--set", "rollout_steps=4", "minibatches=1", "hidden=[8]"]
    process = faults.start(COMMAND, *command, session=True)
    code, written = faults.end_at(process, lambda line: line.strip().startswith("2 "), number)
    assert code == (143 if number == signal.SIGTERM else -number), written
    assert gone(process.pid)
    if number == signal.SIGTERM:
        names = {path.name for path in folder.iterdir()}
        assert {"latest.npz", "best.npz"} <= names and not [name for name in names if name.startswith(".")]


@pytest.mark.rest
@needs("torch")
def test_the_first_of_several_ranks_alone_writes(tmp_path: Path) -> None:
    """A signal to all, as torchrun sends it: both end, the run has a whole checkpoint and can go on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    folder = tmp_path / "run"
    command = ["train", "Pendulum-v1", "--num-envs", "2", "--eval-episodes", "0", "--run-dir", str(folder)]
    command += ["--set", "rollout_steps=32", "hidden=[8]", "--total-steps", "1e9"]
    group = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": "2"}
    ranks = [
        faults.start(COMMAND, *command, environment={**group, "RANK": str(k), "LOCAL_RANK": str(k)}) for k in range(2)
    ]
    first, second = ranks
    assert first.stdout is not None
    while not first.stdout.readline().strip().startswith("5 "):
        assert first.poll() is None
    second.send_signal(signal.SIGTERM)
    first_code, first_written = faults.end_at(first, lambda line: True, signal.SIGTERM, read=False)
    second_written = second.communicate(timeout=30.0)[0]
    assert (first_code, second.returncode) == (143, 143), first_written + second_written
    assert "interrupted after iteration" in first_written and "interrupted after" not in second_written
    names = {path.name for path in folder.iterdir()} - {"tensorboard"}
    assert names == {"config.json", "progress.csv", "latest.npz", "best.npz"}
