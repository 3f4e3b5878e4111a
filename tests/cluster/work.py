"""Work without physics for the tests of clusters, and a driver that runs in a process of its own."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softmode.cluster.ray_tasks import run_shards
from softmode.cluster.shards import Shards
from softmode.errors import SoftmodeError, StorageError

COUNT = 14


def square(job: Mapping[str, Any], number: int) -> tuple[dict[str, Any], bytes]:
    """Say in a file who works on which shard, take some time, return bytes that depend on the number alone."""
    begun = Path(job["folder"], f"{number}-{os.getpid()}-{time.monotonic_ns()}")
    begun.touch()
    time.sleep(0.5)
    return {"owner": job["bodies"][number % len(job["bodies"])]}, bytes([number]) * number


def full(job: Mapping[str, Any], number: int) -> tuple[dict[str, Any], bytes]:
    """Fail as a worker without space does."""
    Path(job["folder"], f"{number}-{os.getpid()}-{time.monotonic_ns()}").touch()
    raise StorageError("dataset cannot be written (No space left on device)", hint="free some space")


def drive(address: str, job: dict[str, Any], shards: Path) -> None:
    """Do the shards of a job, and print what comes of it."""
    try:
        with Shards(shards, job) as kept:
            run_shards(address, globals()[job["work"]], job, kept, range(COUNT), total=COUNT, patience=4.0)
            print("done", len(kept.facts), b"".join(kept.payload(n) for n in range(COUNT)).hex())
    except SoftmodeError as error:
        print(type(error).__name__, error)


if __name__ == "__main__":
    drive(sys.argv[1], json.loads(sys.argv[2]), Path(sys.argv[3]))
