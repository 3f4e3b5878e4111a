"""A folder with the shards of a piece of work that are done, each a file that is named by its hash."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from softmode.errors import AssetError, ConfigError
from softmode.files import PendingFile, read_json, storage_errors
from softmode.leftovers import lock

PLAN = "plan.json"
_NAME = re.compile(r"(\d{7})-([0-9a-f]{64})\.shard")


def packed(facts: Mapping[str, Any], payload: bytes) -> tuple[bytes, str]:
    """Return the content of a shard, a line of JSON with what is known of it before its payload, and its hash."""
    content = json.dumps(facts, sort_keys=True).encode() + b"\n" + payload
    return content, hashlib.sha256(content).hexdigest()


class Shards:
    """The shards of a job that are done.

    A shard is whole or not there. One whose content has another hash than its name says is removed and named, and the
    others stay usable. A lock keeps a second run out.

    Args:
        folder: Where they lie; made if it is not there.
        job: What they are shards of, as JSON values.

    Raises:
        ConfigError: If the folder holds something else, shards of another job, or if another run is at work there.
        StorageError: If it cannot be written.
    """

    def __init__(self, folder: Path, job: Mapping[str, Any]) -> None:
        """Take the folder and look at what is there."""
        self.folder = folder
        self.facts: dict[int, dict[str, Any]] = {}
        """What is known of the shards that are done, by number."""
        self._paths: dict[int, Path] = {}
        with storage_errors(f"folder of shards {folder}", hint="choose another place"):
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(folder, os.O_RDONLY)
            try:
                if not lock(self._lock):
                    raise ConfigError(f"{folder} is being written by another run", hint="wait for its end")
                self._check_plan(json.loads(json.dumps(job)))
                for path in sorted(folder.glob("*.shard")):
                    try:
                        facts, number = _opened(path)[0], int(path.name[:7])
                        self.facts[number], self._paths[number] = facts, path
                    except AssetError as error:
                        print(f"softmode: {error.message}; it is done again, the others are used", file=sys.stderr)
                        path.unlink()
            except BaseException:
                self.close()
                raise

    def _check_plan(self, job: dict[str, Any]) -> None:
        """Write what the job is, or compare it with what is there."""
        plan = self.folder / PLAN
        if plan.exists():
            found = dict(read_json(plan, "plan of shards", hint="remove the folder to begin anew"))
            if others := [name for name in job if found.get(name) != job[name]]:
                raise ConfigError(
                    f"{self.folder} holds shards of another command, whose {others[0]} is {found.get(others[0])!r} and "
                    f"not {job[others[0]]!r}",
                    hint="give the same command, remove the folder, or choose another place",
                )
        elif any(self.folder.iterdir()):
            raise ConfigError(f"{self.folder} holds something else than shards", hint="choose another place")
        else:
            with PendingFile(plan) as file:
                file.temporary.write_text(json.dumps(job, indent=1), encoding="utf-8")

    def put(
        self, number: int, content: bytes, digest: str, check: Callable[[dict[str, Any]], None] = lambda facts: None
    ) -> None:
        """Keep a shard, unless the check of what is known of it raises.

        Raises:
            AssetError: If the content has another hash.
            StorageError: If it cannot be written.
        """
        path = self.folder / f"{number:07d}-{digest}.shard"
        with PendingFile(path, "shard") as file:
            file.temporary.write_bytes(content)
            facts = _opened(file.temporary, digest)[0]
            check(facts)
        self.facts[number], self._paths[number] = facts, path

    def payload(self, number: int) -> bytes:
        """Return what a shard holds; raises AssetError if it is damaged or missing."""
        return _opened(self._paths[number])[1]

    def remove(self) -> None:
        """Remove the folder with all shards."""
        self.close()
        with storage_errors(self.folder):
            shutil.rmtree(self.folder)

    def close(self) -> None:
        """Let go of the folder; harmless twice."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def __enter__(self) -> Shards:
        """Return the shards."""
        return self

    def __exit__(self, *_: object) -> None:
        """Let go of the folder."""
        self.close()


def _opened(path: Path, digest: str | None = None) -> tuple[dict[str, Any], bytes]:
    """Return facts and payload of a shard; raises AssetError if its hash is another than its name or caller says."""
    named = _NAME.fullmatch(path.name)
    wanted = digest or (named and named[2])
    try:
        content = path.read_bytes()
    except OSError as error:
        raise AssetError(
            f"shard {path} cannot be read: {error.strerror}", hint="give the same command again"
        ) from error
    if hashlib.sha256(content).hexdigest() != wanted:
        raise AssetError(f"shard {path} is damaged", hint="give the same command again")
    line, _, payload = content.partition(b"\n")
    return json.loads(line), payload
