"""Doing shards as Ray tasks; which worker does which, and its retries, are Ray's."""

from __future__ import annotations

import contextlib
import os
import platform
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from softmode import __version__
from softmode.cluster.shards import Shards, packed
from softmode.errors import ConfigError, SoftmodeError, StorageError, WorkerError, needs_extra

Work = Callable[[Mapping[str, Any], int], tuple[dict[str, Any], bytes]]
"""Does a shard of a job, by its number; returns what is known of it, as JSON values, and its payload. Imported by name
on the workers."""

RETRIES = 5
"""Times that Ray does a shard again whose worker was lost, or had no space."""
FIRST_PATIENCE = 900.0
"""Time without a shard after which those that are given out are given out again, before the first one is done [s]:
workers compile kernels."""
LATER = 3.0
"""The same time as multiples of the longest that a shard has taken, once some are done."""


def run_shards(
    address: str,
    work: Work,
    job: Mapping[str, Any],
    shards: Shards,
    numbers: Iterable[int],
    *,
    total: int,
    enough: Callable[[], bool] = lambda: False,
    patience: float = 60.0,
) -> None:
    """Do the shards of a job that are not there yet, on the machines of a Ray cluster.

    A worker that dies has its shard done again by Ray, one that stands still by this function. What a shard holds
    depends on the job and its number alone, so it does not matter who does it. A job whose ``device`` is a CUDA device
    takes a GPU for each shard. Facts that have an ``owner`` (the bodies that the worker has built) must agree with
    those of the other shards of the same ``case``; ``episodes`` is how many there are.

    Args:
        address: HOST:PORT of the head; ``auto`` for the cluster that runs on this machine, ``local`` to start one here.
        work: Does a shard.
        job: What it is part of.
        shards: Where shards go.
        numbers: Which ones, in the order of their need.
        total: Episodes that are wanted, for the bar.
        enough: Whether no more are needed.
        patience: Least time without a shard after which those that are given out are given out again [s].

    Raises:
        ConfigError: If the address is none, or a worker has another softmode or other bodies.
        WorkerError: If the cluster is not there or is lost; the shards stay.
        StorageError: If there is no space here or on the workers.
        MissingExtraError: If Ray is not installed.
    """
    from tqdm import tqdm

    owners = {0: job["owner"]} if job.get("owner") else {}
    processors: dict[str, None] = {}

    def known(facts: dict[str, Any]) -> None:
        owner = facts.get("owner")
        if owner != (wanted := owners.setdefault(facts.get("case", 0), owner)):
            raise ConfigError(
                f"a worker on {facts['host']} has built {owner}, not {wanted}",
                hint="install the same versions and the same files on all machines",
            )
        if facts["processor"] not in processors:
            processors[facts["processor"]] = None
            if len(processors) > 1:
                names = ", ".join(processors)
                print(f"softmode: shards come from several processors, whose bits differ: {names}", file=sys.stderr)
        bar.update(min(facts.get("episodes", 1), total - bar.n))

    with contextlib.ExitStack() as stack:
        kind = work.__name__.partition("_")[0]
        bar = stack.enter_context(tqdm(total=total, desc=kind, unit="episode", mininterval=1.0))
        for facts in shards.facts.values():
            known(facts)
        missing = (number for number in numbers if number not in shards.facts)
        if enough() or (first := next(missing, None)) is None:
            return
        ray, alive = stack.enter_context(_cluster(address, shards.folder))
        options = {"num_cpus": 1, "num_gpus": float(str(job.get("device")).startswith("cuda"))}
        options |= {"max_retries": RETRIES, "retry_exceptions": [StorageError]}
        remote = ray.remote(**options)(_do)
        given: dict[Any, tuple[int, float]] = {}

        def give(number: int) -> None:
            given[remote.remote(work, dict(job), number, __version__)] = (number, time.monotonic())

        give(first)
        longest, last = 0.0, time.monotonic()
        while not enough():
            # Two for each processor: one is worked on, one waits.
            while len(given) < 2 * ray.cluster_resources().get("CPU", 1) and (n := next(missing, None)) is not None:
                give(n)
            if not (awaited := {number for number, _ in given.values()} - set(shards.facts)):
                break
            ready, _ = ray.wait(list(given), timeout=1.0)
            for done in ready:
                number, since = given.pop(done)
                if number in awaited:  # else it was given out twice
                    last = time.monotonic()
                    longest = max(longest, last - since)
                    content, digest = ray.get(done)
                    shards.put(number, content, digest, known)
                    awaited.remove(number)
            if time.monotonic() - last > (max(patience, LATER * longest) if longest else FIRST_PATIENCE):
                last = time.monotonic()
                for number in awaited:
                    give(number)
            alive()
        for left in given:
            ray.cancel(left, force=True)


def _do(work: Work, job: dict[str, Any], number: int, version: str) -> tuple[bytes, str]:
    """Do a shard on a worker; return its content and hash."""
    if version != __version__:
        raise ConfigError(
            f"softmode is {__version__} on {platform.node()}, and {version} where the command was given",
            hint="install one version on all machines",
        )
    facts, payload = work(job, number)
    return packed({**facts, "host": platform.node(), "processor": processor()}, payload)


def processor() -> str:
    """Return the name of this machine's processor."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@contextlib.contextmanager
def _cluster(address: str, folder: Path) -> Iterator[tuple[Any, Callable[[], None]]]:
    """Yield Ray, connected to a cluster, and what raises WorkerError once its head is lost."""
    with needs_extra("ray", "work on several machines needs Ray"):
        import ray
    hint = f"start the cluster and give the same command again, which goes on from what is in {folder}"

    def reach(where: str) -> None:
        host, _, port = where.rpartition(":")
        if not host or not port.isdecimal():
            raise ConfigError(f"{where!r} is no address of a Ray cluster", hint="give HOST:PORT, auto, or local")
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=5.0).close()
        except (OSError, OverflowError) as error:
            raise WorkerError(f"the head of the Ray cluster at {where} does not answer", hint=hint) from error

    if address not in ("auto", "local"):
        reach(address)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        ray.init(address=address, **quiet, **({"include_dashboard": False} if address == "local" else {}))
        yield ray, lambda: reach(ray.get_runtime_context().gcs_address)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, SoftmodeError):
            raise error.cause from None
        raise WorkerError(f"a worker failed: {error}", hint=hint) from error
    except (ray.exceptions.RayError, ConnectionError) as error:
        message = str(error).partition("\n")[0]
        raise WorkerError(f"the Ray cluster failed: {message}", hint=hint) from error
    finally:
        ray.shutdown()
