"""Shards survive workers that die or stand still, a cluster that is lost, and damage on the disk; Ray where it is."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from softmode.cluster.ray_tasks import _do, run_shards
from softmode.cluster.shards import Shards, packed
from softmode.errors import AssetError, ConfigError, MissingExtraError, WorkerError
from tests.cluster.work import COUNT, square
from tests.needs import needs

ROOT = Path(__file__).resolve().parents[2]
RESULT = f"done {COUNT} {b''.join(bytes([n]) * n for n in range(COUNT)).hex()}"
ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
    "OMP_NUM_THREADS": "1",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": "0" * 64,
}
JOB = {"work": "square", "bodies": ["a"]}


# -- on the disk ------------------------------------------------------------------------------------------------------


def test_shards_are_kept_and_damage_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """What was put is there the next time; a shard that is cut is named and gone, one that is missing too."""
    folder = tmp_path / "shards"
    with Shards(folder, JOB) as shards:
        for number in range(3):
            shards.put(number, *packed({"n": number}, b"\n" * number))
        assert shards.facts == {number: {"n": number} for number in range(3)}
        content, _ = packed({}, b"")
        with pytest.raises(AssetError, match="damaged"):
            shards.put(3, content, "0" * 64)
        with pytest.raises(ConfigError, match="another run"):
            Shards(folder, JOB)
    cut, lost, _ = sorted(folder.glob("*.shard"))
    cut.write_bytes(cut.read_bytes()[:-1])
    lost.unlink()
    with Shards(folder, JOB) as shards:
        assert cut.name in capsys.readouterr().err and shards.facts == {2: {"n": 2}} and shards.payload(2) == b"\n\n"
        next(folder.glob("*.shard")).unlink()
        with pytest.raises(AssetError, match="cannot be read"):
            shards.payload(2)
        shards.remove()
    assert not any(tmp_path.iterdir())


def test_shards_of_another_job_are_refused(tmp_path: Path):
    """The option that differs is named, and a folder with something else in it is left alone."""
    Shards(tmp_path / "shards", JOB).close()
    with pytest.raises(ConfigError, match="bodies is"):
        Shards(tmp_path / "shards", {**JOB, "bodies": ["b"]})
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").touch()
    with pytest.raises(ConfigError, match="something else"):
        Shards(tmp_path / "mine", JOB)


def test_another_version_is_refused(tmp_path: Path):
    """A worker does nothing for a command of another version."""
    with pytest.raises(ConfigError, match=r"and 0\.0\.0 where"):
        _do(square, JOB, 0, "0.0.0")


@pytest.mark.parametrize(
    ("address", "error"), [("head", ConfigError), ("127.0.0.1:port", ConfigError), ("127.0.0.1:1", WorkerError)]
)
def test_a_cluster_that_is_not_there(tmp_path: Path, address: str, error: type[Exception]):
    """An address that is none, and one where nobody answers; without Ray the extra is named."""
    try:
        import ray  # noqa: F401
    except ImportError:
        error = MissingExtraError
    with Shards(tmp_path / "shards", JOB) as shards, pytest.raises(error):
        run_shards(address, square, JOB, shards, range(2), total=2)


# -- on a cluster -----------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def cluster(port: int, *, workers: int = 2) -> Iterator[int]:
    """Run a cluster on this machine; yield the process group that ends it."""
    with tempfile.TemporaryDirectory(prefix="ray", ignore_cleanup_errors=True) as folder:  # whose path must be short
        words = ["start", "--head", "--block", f"--port={port}", f"--num-cpus={workers}", f"--temp-dir={folder}"]
        words += ["--node-ip-address=127.0.0.1", "--include-dashboard=false", "--object-store-memory=100000000"]
        head = subprocess.Popen(
            [sys.executable, "-m", "ray.scripts.scripts", *words],
            env=ENVIRONMENT,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            wait(lambda: answers(port))
            yield head.pid
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(head.pid, signal.SIGKILL)
            head.wait()


def answers(port: int) -> bool:
    """Return whether something listens on a port."""
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
        return True
    return False


def wait(ready: Any, seconds: float = 120.0) -> None:
    """Wait until something is so."""
    end = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < end, "nothing came"
        time.sleep(0.05)


def driver(port: int, job: dict[str, Any], shards: Path) -> subprocess.Popen[str]:
    """Start the work in a process of its own."""
    words = [f"127.0.0.1:{port}", json.dumps(job), str(shards)]
    command = [sys.executable, "-m", "tests.cluster.work", *words]
    return subprocess.Popen(command, cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True)


def begun(folder: Path) -> list[tuple[int, int]]:
    """Return number and process of every shard that was begun, the last one first."""
    names = [path.name.split("-") for path in folder.iterdir()]
    return [(int(number), int(pid)) for number, pid, _ in sorted(names, key=lambda name: -int(name[2]))]


@needs("ray")
def test_killed_and_stopped_workers_and_a_lost_cluster(tmp_path: Path):
    """Of two workers one is killed and one stopped, then the cluster is lost and started anew: all shards come out."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    work, shards = tmp_path / "work", tmp_path / "shards"
    work.mkdir()
    job = {**JOB, "folder": str(work)}
    with cluster(port) as head:
        first = driver(port, job, shards)
        wait(lambda: len(begun(work)) >= 3)
        number, killed = begun(work)[0]
        os.kill(killed, signal.SIGKILL)
        wait(lambda: any(shards.glob(f"{number:07d}-*.shard")))
        os.killpg(head, signal.SIGKILL)
        assert "WorkerError the" in (told := first.communicate()[0]), told
    before, count = len(list(shards.glob("*.shard"))), len(begun(work))
    assert 0 < before < COUNT
    with cluster(port):
        second = driver(port, job, shards)
        wait(lambda: len(begun(work)) > count)
        _, stopped = begun(work)[0]
        os.kill(stopped, signal.SIGSTOP)
        try:
            assert RESULT in second.communicate()[0]
        finally:
            os.kill(stopped, signal.SIGKILL)
        assert len(begun(work)) - count == COUNT - before + 1  # what was done is not done again
        other = {**job, "bodies": ["a", "b"]}
        assert "ConfigError a worker on" in driver(port, other, tmp_path / "other").communicate()[0]
        with Shards(tmp_path / "other", other) as kept:
            assert len({facts["owner"] for facts in kept.facts.values()}) == 1  # not what another body brought
        assert "StorageError" in driver(port, {**job, "work": "full"}, tmp_path / "full").communicate()[0]
