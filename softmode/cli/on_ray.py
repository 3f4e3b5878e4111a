"""What ``--ray`` does: a recording or an evaluation, cut by seed, on the machines of a Ray cluster."""

from __future__ import annotations

import functools
import io
import itertools
import json
import os
import shutil
import tarfile
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softmode import __version__
from softmode.cluster.ray_tasks import run_shards
from softmode.cluster.shards import Shards
from softmode.demonstrations.recording import ATTEMPTS, Recorded, environment_features, record_episodes
from softmode.errors import ConfigError
from softmode.learning.config_values import with_config
from softmode.learning.players import policy_factory, trained_policy

if TYPE_CHECKING:
    from softmode.learning.policy import Evaluation

OPTIONS = ("noise", "only_successes", "states")
"""Options of a recording that its episodes depend on, beside environment and policy."""


def job_of(policy: str | Path, **rest: Any) -> dict[str, Any]:
    """Return a job, with the content of the policy's file and what softmode it is of."""
    from softmode.objects.fingerprint import file_fingerprint

    path = Path(policy)
    if path.is_file():
        rest |= {"policy": str(path.resolve()), "policy_fingerprint": file_fingerprint(path)}
    return {"policy": str(policy), "policy_fingerprint": None, "version": __version__, **rest}


def owner_of(env: Any) -> dict[str, str] | None:
    """Return task, robot and fingerprints of the bodies of an environment; None of one that is not softmode's."""
    from softmode.envs import env_state

    task = getattr(env.unwrapped, "task", None)
    return None if task is None else env_state.owner_of(task)


def folder_of(out: Path) -> Path:
    """Return where the shards of a result lie until it is there."""
    return out.with_name(out.name + ".shards")


def _check_policy_file(job: Mapping[str, Any]) -> None:
    """Refuse a policy's file that is another one on this machine."""
    if (
        job["policy_fingerprint"] is not None
        and job_of(job["policy"])["policy_fingerprint"] != job["policy_fingerprint"]
    ):
        hint = "copy it to the same path on all machines"
        raise ConfigError(f"{job['policy']} is missing, or another file than where the command was given", hint=hint)


# -- recording --------------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=1)
def _opened(text: str) -> tuple[Any, Any]:
    """Return environment and policy of a job, kept for its next shards."""
    import gymnasium as gym

    job = json.loads(text)
    _check_policy_file(job)
    env = gym.make(job["env"], **with_config(job["env"], {**job["env_options"], "device": job["device"]}))
    return env, policy_factory(job["policy"], env, trained_policy(job["policy"], job["env"]))


def record_shard(job: Mapping[str, Any], number: int) -> tuple[dict[str, Any], bytes]:
    """Record the episodes of a shard; return how many there are, of how many seeds each success, and the dataset.

    Args:
        job: What ``softmode record --ray`` was asked for.
        number: Number of the shard.
    """
    from softmode.demonstrations.writer import DatasetWriter

    if job["states"]:  # those of an environment that has played hold leftovers of its last step, which change nothing
        _opened.cache_clear()
    env, policy = _opened(json.dumps(job, sort_keys=True))
    seeds = _seeds(job)[number]
    outcomes: list[bool] = []
    with tempfile.TemporaryDirectory() as folder:
        features = environment_features(env, pictures=job["pictures"])
        fps = int(env.metadata["render_fps"])
        with DatasetWriter(Path(folder, "dataset"), features, fps=fps, robot_type=job["robot"]) as writer:
            how = {name: job[name] for name in OPTIONS}
            how |= {"episodes": len(seeds), "seeds": len(seeds), "seed": seeds[0], "task": job["task"]}
            record_episodes(env, policy, writer, progress=lambda seed, success, _: outcomes.append(success), **how)
            count = writer.episode_count
        packed = io.BytesIO()
        with tarfile.open(fileobj=packed, mode="w") as archive:
            for path in Path(folder).iterdir():
                archive.add(path, path.name)
    return {"owner": owner_of(env), "outcomes": outcomes, "episodes": count}, packed.getvalue()


def _seeds(job: Mapping[str, Any]) -> list[range]:
    """Return the seeds of every shard that may be needed."""
    last = job["seed"] + job["episodes"] * (ATTEMPTS if job["only_successes"] else 1)
    return [range(k, min(k + job["shard"], last)) for k in range(job["seed"], last, job["shard"])]


def record_on_ray(
    address: str, job: Mapping[str, Any], out: Path, origin: Mapping[str, Any], **options: Any
) -> Recorded:
    """Record a dataset on a cluster, of the first episodes by their seeds: that of a recording here, bit by bit.

    Args:
        address: See :func:`softmode.cluster.ray_tasks.run_shards`, which has the errors too, and further options.
        job: What is to be recorded.
        out: Folder of the dataset, not there yet. Until it is, the shards lie beside it, and the same job goes on from
            them.
        origin: Where the episodes come from, for the dataset.
        options: Of `run_shards`.
    """
    order: list[int] = []  # shards from the first one on without a gap, until there are enough
    have = 0
    with Shards(folder_of(out), job) as shards:

        def enough() -> bool:
            nonlocal have
            while have < job["episodes"] and len(order) in shards.facts:
                have += shards.facts[len(order)]["episodes"]
                order.append(len(order))
            return have >= job["episodes"]

        options |= {"total": job["episodes"], "enough": enough}
        run_shards(address, record_shard, job, shards, range(len(_seeds(job))), **options)
        enough()
        outcomes = [success for number in order for success in shards.facts[number]["outcomes"]]
        wanted = [k for k, success in enumerate(outcomes) if success or not job["only_successes"]][: job["episodes"]]
        counted = [outcomes[k] for k in wanted]
        if counted:
            _merge(shards, order, job["episodes"], out, origin)
            shards.remove()
    if len(wanted) < job["episodes"]:
        raise ConfigError(
            f"only {len(counted)} of {len(outcomes)} episodes succeeded, {job['episodes']} were asked for"
            + ("; they are recorded" if counted else ""),
            hint="use a better policy, or record failures too",
        )
    return Recorded(episodes=len(counted), successes=sum(counted), attempts=wanted[-1] + 1)


def _merge(shards: Shards, order: list[int], episodes: int, out: Path, origin: Mapping[str, Any]) -> None:
    """Make one dataset of shards, which appears whole."""
    from softmode.demonstrations.metadata import read_metadata
    from softmode.demonstrations.schema import INDEX_FEATURES
    from softmode.demonstrations.writer import DatasetWriter

    made, unpacked = shards.folder / "dataset", shards.folder / "unpacked"
    shutil.rmtree(made, ignore_errors=True)
    writer: DatasetWriter | None = None
    try:
        for number in order:
            shutil.rmtree(unpacked, ignore_errors=True)
            with tarfile.open(fileobj=io.BytesIO(shards.payload(number))) as archive:
                archive.extractall(unpacked, filter="data")
            if not (part := unpacked / "dataset").exists():
                continue  # without a success
            if writer is None:
                told = read_metadata(part)
                features = {name: kind for name, kind in told.features.items() if name not in INDEX_FEATURES}
                writer = DatasetWriter(made, features, fps=told.fps, robot_type=told.robot_type, origin=origin)
            writer.take_dataset(part, episodes - writer.episode_count)
    finally:
        if writer is not None:
            writer.close()
    os.sync()
    os.rename(made, out)


# -- evaluation -------------------------------------------------------------------------------------------------------


def combinations(over: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return every combination of options that are given as lists of values.

    Raises:
        ConfigError: If one is no list.
    """
    for name, values in over.items():
        if not isinstance(values, list) or not values:
            raise ConfigError(f"{name} is {values!r}, no list", hint="write it like yaw_range=[0.5,3.0]")
    return [dict(zip(over, chosen, strict=True)) for chosen in itertools.product(*over.values())]


@functools.lru_cache(maxsize=1)
def _worlds(text: str, case: int) -> tuple[Any, Any]:
    """Return vector environment and policy of a combination of options, kept for the next shards."""
    from softmode.learning.distributed import local_device
    from softmode.learning.environments import make_vector_env
    from softmode.learning.policy import load_policy

    job = json.loads(text)
    _check_policy_file(job)
    policy = load_policy(job["policy"], job["device"])
    options = {**job["env_options"], **combinations(job["over"])[case]}
    env = make_vector_env(job["env"], job["num_envs"], local_device(job["device"]), options)
    policy.check(env)
    return env, policy


def evaluate_shard(job: Mapping[str, Any], number: int) -> tuple[dict[str, Any], bytes]:
    """Play an episode in each world; return what came of them.

    Args:
        job: What ``softmode evaluate --ray`` was asked for.
        number: Number of the shard.
    """
    from softmode.learning.policy import played

    case, block = divmod(number, -(-job["episodes"] // job["num_envs"]))
    env, policy = _worlds(json.dumps(job, sort_keys=True), case)
    done = block * job["num_envs"]
    count = min(job["num_envs"], job["episodes"] - done)
    found = played(env, policy, count, seed=job["seed"] + done, device=job["device"])
    outcomes = [None if column is None else column.tolist() for column in found]
    return {"owner": owner_of(env), "case": case, "episodes": count, "outcomes": outcomes}, b""


def evaluate_on_ray(
    address: str, job: Mapping[str, Any], out: Path, **options: Any
) -> Iterator[tuple[dict[str, Any], Evaluation]]:
    """Yield every combination of options and how the policy did with it, each episode from a seed of its own.

    Args:
        address: See :func:`softmode.cluster.ray_tasks.run_shards`, which has the errors too, and further options.
        job: What is to be evaluated.
        out: Where shards are kept, at this name with ``.shards``, until all is done.
        options: Of `run_shards`.
    """
    from softmode.learning.policy import summary

    cases, each = combinations(job["over"]), -(-job["episodes"] // job["num_envs"])
    with Shards(folder_of(out), job) as shards:
        options |= {"total": job["episodes"] * len(cases)}
        run_shards(address, evaluate_shard, job, shards, range(each * len(cases)), **options)
        for case, chosen in enumerate(cases):
            yield chosen, summary([shards.facts[case * each + k]["outcomes"] for k in range(each)])
        shards.remove()
