"""The folder of a run: its configuration, the table of its progress, its checkpoints."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from softmode.errors import AssetError, RunError, needs_extra
from softmode.files import free_name, read_file, read_json, storage_errors, whole_file

CONFIG, PROGRESS, LATEST, BEST = "config.json", "progress.csv", "latest.npz", "best.npz"
"""Names of the files of a run."""


def checkpoint_in(path: Path, which: str = "best") -> Path:
    """Return the best or latest checkpoint of a run's folder; of another path the path itself."""
    return path / f"{which}.npz" if path.is_dir() else path


class RunFolder:
    """A folder that one run writes to.

    Args:
        path: The folder.
        resume: Whether it must hold a run to go on with, or must not be there.
        writes: Whether this process makes the folder, or another did.

    Raises:
        RunError: If it is there and should not be, is missing and should be there, or cannot be made.
    """

    def __init__(self, path: Path, *, resume: bool, writes: bool = True) -> None:
        """Make the folder or find the run in it."""
        self.path = path
        self._writer: Any = None
        self._columns: list[str] | None = None
        if resume and writes and not ((path / CONFIG).is_file() and (path / LATEST).is_file()):
            hint = "give the folder of a run, or drop --resume to start one"
            raise RunError(f"{path} holds no run to go on with ({CONFIG} and {LATEST})", hint=hint)
        if resume or not writes:
            return
        if path.exists():
            raise RunError(f"run folder {path} exists", hint="choose another one, or go on with its run: --resume")
        with storage_errors(f"run folder {path}", hint="choose another folder", error=RunError):
            path.mkdir(parents=True)

    @staticmethod
    def name_for(root: Path, env: str, name: str | None) -> Path:
        """Return ``root/<Env>/<YYYYmmdd-HHMMSS>[_name]``, a folder that is not there yet."""
        task = env.rpartition(":")[2].rpartition("/")[2]
        return free_name(root / task / (time.strftime("%Y%m%d-%H%M%S") + (f"_{name}" if name else "")))

    def write_config(self, config: dict[str, Any]) -> None:
        """Write the configuration of the run."""
        self.write(CONFIG, json.dumps(config, indent=2).encode() + b"\n")

    def read_config(self) -> dict[str, Any]:
        """Return the configuration of the run.

        Raises:
            RunError: If it cannot be read.
        """
        config = read_json(self.path / CONFIG, "configuration", hint="start a new run", error=RunError)
        if not isinstance(config, dict):
            raise RunError(f"{self.path / CONFIG} is no configuration", hint="start a new run")
        return config

    def write(self, name: str, content: bytes) -> None:
        """Write a file; it appears complete or not at all.

        Raises:
            RunError: If it cannot be written; what was there before stays.
        """
        with self.writing(name), whole_file(self.path / name, make_folders=False) as file:
            file.write(content)

    def writing(self, name: str) -> AbstractContextManager[None]:
        """Return the context in which a file of the run is written; what cannot be written raises RunError there."""
        hint = f"earlier checkpoints are intact: free some space and go on with --run-dir {self.path} --resume"
        return storage_errors(self.path / name, hint=hint, error=RunError)

    def forget_after(self, iteration: int) -> None:
        """Drop rows of the table behind the checkpoint that the run goes on from."""
        try:
            text = read_file(self.path / PROGRESS, "progress", hint="start a new run").decode()
            rows = list(csv.reader(io.StringIO(text, newline="")))
        except (AssetError, ValueError, csv.Error):
            return
        if not rows:
            return
        kept = [row for row in rows[1:] if len(row) == len(rows[0]) and re.fullmatch(r"\d+", row[0])]
        kept = [row for row in kept if int(row[0]) <= iteration]
        table = io.StringIO()
        csv.writer(table, lineterminator="\n").writerows([rows[0], *kept])
        self.write(PROGRESS, table.getvalue().encode())
        self._columns = rows[0]

    def log(self, row: dict[str, float | int | None]) -> None:
        """Append a row to the table and to TensorBoard; the first entry is the iteration.

        Raises:
            RunError: If it cannot be written.
        """
        with self.writing(PROGRESS), (self.path / PROGRESS).open("a" if self._columns else "w") as file:
            if self._columns is None:
                self._columns = list(row)
                file.write(",".join(self._columns) + "\n")
            cells = (row.get(name) for name in self._columns)
            texts = ("" if cell is None else f"{cell:.6g}" if isinstance(cell, float) else str(cell) for cell in cells)
            file.write(",".join(texts) + "\n")
        if self._writer is None:
            return
        with self.writing("tensorboard"):
            for name, value in row.items():
                if value is not None and name not in ("iteration", "env_steps"):
                    self._writer.add_scalar(name, value, row["env_steps"])

    def start_tensorboard(self, purge_after: int | None) -> None:
        """Write scalars for TensorBoard too.

        Args:
            purge_after: Environment step behind which earlier scalars are hidden, for runs that go on.

        Raises:
            MissingExtraError: If tensorboard is not installed.
        """
        with needs_extra("rl", "TensorBoard scalars need tensorboard"):
            from torch.utils.tensorboard import SummaryWriter
        self._writer = SummaryWriter(os.fspath(self.path / "tensorboard"), purge_step=purge_after)

    def close(self) -> None:
        """Flush TensorBoard."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
