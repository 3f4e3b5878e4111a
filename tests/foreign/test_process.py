"""The process that reads foreign files: it is kept, ends with what it reads, and harms nobody by ending."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from softmode.errors import AssetError
from softmode.foreign import process
from softmode.objects.mesh_file import read_mesh

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n"


def kept() -> int:
    """Return the number of the process that is kept."""
    assert process._kept is not None
    return process._kept[1].pid


def test_one_process_reads_all(tmp_path: Path) -> None:
    """A second file, a damaged one and one that exceeds the limits are read by the process of the first."""
    good, bad = tmp_path / "a.obj", tmp_path / "a.stl"
    good.write_text(SQUARE)
    bad.write_bytes(bytes(90))
    assert read_mesh(good).area == pytest.approx(1.0)
    first = kept()
    with pytest.raises(AssetError):
        read_mesh(bad)
    limits = process.Limits(memory=2**20, memory_per_byte=0.0)
    (tmp_path / "b.obj").write_text(SQUARE * 50_000)
    with pytest.raises(AssetError, match="more memory than is given"):
        process.read("mesh", tmp_path / "b.obj", name="a", limits=limits, want="colors")
    assert read_mesh(good).area == pytest.approx(1.0) and kept() == first


def test_a_process_that_dies_is_replaced(tmp_path: Path) -> None:
    """Killed from outside, it is started again for the next file."""
    (tmp_path / "a.obj").write_text(SQUARE)
    read_mesh(tmp_path / "a.obj")
    first = kept()
    os.kill(first, signal.SIGKILL)
    process._kept[1].wait()  # type: ignore[index]
    assert len(read_mesh(tmp_path / "a.obj").corners) == 2 and kept() != first


def test_a_fork_has_a_process_of_its_own(tmp_path: Path) -> None:
    """What a fork of this process reads does not come between the answers of this one."""
    (tmp_path / "a.obj").write_text(SQUARE)
    read_mesh(tmp_path / "a.obj")
    first = kept()
    pid = os.fork()
    if not pid:
        code = 1
        try:
            code = 0 if len(read_mesh(tmp_path / "a.obj").corners) == 2 and kept() != first else 2
            process._stop()
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert read_mesh(tmp_path / "a.obj").corners.dtype == np.float32 and kept() == first


@pytest.mark.parametrize(
    "content", [b"", b"{}\n", b'{"arrays": [["O", [1]]]}\n', b'{"arrays": [["d", [4]]]}\n12345678']
)
def test_answers_are_checked(tmp_path: Path, content: bytes) -> None:
    """An answer that is none, that holds objects, or is shorter than it says is refused."""
    (tmp_path / "answer").write_bytes(content)
    with pytest.raises(AssetError, match="answer is incomplete"):
        process.read_answer(str(tmp_path / "answer"), "a")
