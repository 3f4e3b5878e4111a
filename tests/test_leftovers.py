"""What killed writers leave is removed by the next that writes there, and nothing else is."""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from softmode import leftovers
from softmode.cli.new import write_task
from softmode.errors import MemoryShortError, StorageError, memory_errors
from softmode.files import PendingFile, archive_bytes, free_name, whole_file, write_archive
from softmode.leftovers import Claim
from softmode.viz.film import Film
from tests.faults import at_every_call, die, in_child

SIZE = 1 << 18


def archive(folder: Path) -> None:
    """Write a file as checkpoints and bodies are."""
    write_archive(folder / "latest.npz", {"format": "test", "version": 1}, {"numbers": np.zeros(SIZE, np.uint8)})


def film(folder: Path) -> None:
    """Write a film and its sheet."""
    with Film(folder / "film.mp4") as made:
        for shade in (50, 200):
            made.add(np.full((16, 16, 3), shade, np.uint8), 30)
        made.publish()


def package(folder: Path) -> None:
    """Write the package of a task that is not there yet."""
    write_task(f"slide_{len(list((folder / 'tasks').glob('slide_*')))}", folder / "tasks")


def stream(folder: Path) -> None:
    """Write a file in parts."""
    with whole_file(folder / "deep" / "stream.bin") as file:
        for _ in range(4):
            os.sched_yield()
            file.write(bytes(SIZE // 4))
            file.flush()


KILLED_AT: dict[Callable[[Path], None], tuple[str, ...]] = {
    archive: ("open", "fsync", "replace", "unlink"),
    stream: ("mkdir", "write", "sched_yield", "close"),
    package: ("mkdir", "rename"),
    film: ("fsync", "replace"),
}
"""Writers, and the functions of the system at each of whose calls they are killed."""


@pytest.mark.parametrize("writer", KILLED_AT, ids=lambda writer: writer.__name__)
def test_what_the_killed_leave_is_gone_after_the_next_write(
    writer: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However often writers are killed in a folder, and wherever: the next one leaves what it writes, and no more."""
    hidden = 0
    for name in KILLED_AT[writer]:
        for number in at_every_call(monkeypatch, os, name, die):
            folder = tmp_path / f"{name}{number}"
            folder.mkdir()
            ends = {in_child(lambda folder=folder: writer(folder)) for _ in range(3)}
            assert ends <= {0, -signal.SIGKILL}
            hidden = max(hidden, len(list(folder.rglob(".*"))))
    assert hidden
    for folder in list(tmp_path.iterdir()):
        writer(folder)
        assert not list(folder.rglob(".*")), folder.name


def test_the_living_keep_their_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What this process, another one, or for a day another system writes stays; what is not ours too."""
    foreign = [tmp_path / name for name in (".notes", ".vim-0123456789ab", ".x-0123456789ab.lock.d", ".a.lock")]
    for path in foreign:
        path.write_text("mine")
    with PendingFile(tmp_path / "file.bin") as here:
        here.temporary.write_bytes(b"here")
        read, write = os.pipe()

        def hold() -> None:
            """Write until the parent lets go."""
            os.close(write)
            with PendingFile(tmp_path / "other.bin") as pending:
                pending.temporary.write_bytes(b"other")
                os.read(read, 1)

        child = os.fork()
        if not child:
            hold()
            os._exit(0)
        while not (found := [path for path in tmp_path.glob(".other-*.bin") if path.stat().st_size]):
            pass
        whole(tmp_path / "third.bin")
        assert here.temporary.read_bytes() == b"here" and found[0].read_bytes() == b"other"
        os.close(write)
        assert os.waitpid(child, 0)[1] == 0
    assert {path.name for path in tmp_path.glob("*.bin")} == {"file.bin", "other.bin", "third.bin"}
    assert sorted(tmp_path.glob(".*")) == sorted(foreign)

    assert in_child(lambda: (PendingFile(tmp_path / "far.bin"), die())) == -signal.SIGKILL
    (held,) = tmp_path.glob(".far-*.lock")
    held.write_bytes(b"another system's")
    whole(tmp_path / "third.bin")
    assert len(list(tmp_path.glob(".far-*"))) == 2
    for path in tmp_path.glob(".far-*"):
        os.utime(path, (0.0, path.stat().st_mtime - leftovers._PATIENCE - 1.0))
    whole(tmp_path / "third.bin")
    assert sorted(tmp_path.glob(".*")) == sorted(foreign)


def whole(path: Path) -> None:
    """Write a file."""
    with whole_file(path) as file:
        file.write(b"whole")


def test_no_link_leads_out_of_the_folder(tmp_path: Path) -> None:
    """A lock that is a link or a pipe is let be, and links under a prefix are removed, not what they lead to."""
    folder, outside = tmp_path / "folder", tmp_path / "outside"
    folder.mkdir()
    outside.mkdir()
    (outside / "precious").write_bytes(leftovers._system())
    (folder / ".a-0123456789ab.lock").symlink_to(outside / "precious")
    os.mkfifo(folder / ".b-0123456789ab.lock")
    (folder / ".c-0123456789ab.lock").write_bytes(leftovers._system())
    (folder / ".c-0123456789ab.d").symlink_to(outside)
    whole(folder / "file.bin")
    names = {path.name for path in folder.iterdir()}
    assert names == {".a-0123456789ab.lock", ".b-0123456789ab.lock", "file.bin"}
    assert (outside / "precious").exists()


def test_a_folder_without_locks_keeps_what_is_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the file system knows no locks writing works, and nothing is taken for left behind."""

    def refuse(*arguments: object) -> None:
        raise OSError(38, "no locks here")

    monkeypatch.setattr("fcntl.flock", refuse)
    assert in_child(lambda: (PendingFile(tmp_path / "file.bin"), die())) == -signal.SIGKILL
    whole(tmp_path / "file.bin")
    assert (tmp_path / "file.bin").read_bytes() == b"whole"
    assert len(list(tmp_path.glob(".file-*"))) == 2


def test_a_claim_that_fails_leaves_no_folder(tmp_path: Path) -> None:
    """Folders that were made for it go with it; long names are no matter."""
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError), whole_file(tmp_path / "file" / "deep" / "x.bin"):
        pass
    claim = Claim(tmp_path / "a" / "b" / f"{'long' * 60}.bin")
    assert claim.name(".bin").parent.is_dir()
    claim.release()
    claim.release()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_two_files_of_one_second_have_two_names(tmp_path: Path) -> None:
    """A name is free if nothing is there and nobody is writing it."""
    path = tmp_path / "view-20261128-120000.mp4"
    assert free_name(path) == path
    with PendingFile(path) as pending:
        assert free_name(path).name == "view-20261128-120000-1.mp4"
        pending.temporary.write_bytes(b"film")
    assert free_name(path).name == "view-20261128-120000-1.mp4"


def test_memory_that_is_not_there_is_named() -> None:
    """The error tells the size: NumPy's own, or that of the file to be."""
    with pytest.raises(MemoryShortError, match=r"a table takes more .*EiB"), memory_errors("a table"):
        np.empty(1 << 58)
    array = np.zeros(1 << 28, np.uint8)  # no page of it is there yet

    def write() -> None:
        """Write it with less memory than that."""
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 26), used + (1 << 26)))
        with pytest.raises(MemoryShortError, match=r"0\.537 GB were asked for"):
            archive_bytes({"format": "test", "version": 1}, {"numbers": array})

    assert in_child(write) == 0
