"""What workers do for ``record --ray`` and ``evaluate --ray`` is what the commands do here; needs no Ray.

Builds the bodies of PushSoft by its environments, as a worker does.
"""

from __future__ import annotations

import io
import json
import shutil
import tarfile
from pathlib import Path
from typing import Any

import pytest

from softmode.cli import on_ray
from softmode.cli.main import main
from softmode.cluster.shards import Shards, packed
from softmode.demonstrations import read_dataset
from softmode.envs.catalogue import purpose
from softmode.errors import ConfigError
from tests.needs import needs

ENV_ID = "softmode/PushSoft-v0"
POLICY = Path(__file__).resolve().parents[2] / "policies" / "push_soft.npz"


def filled(out: Path, job: dict[str, Any], work: Any, order: tuple[int, ...]) -> dict[int, dict[str, Any]]:
    """Do the shards of a job here; return what is known of each."""
    with Shards(on_ray.folder_of(out), job) as shards:
        for number in order:
            facts, payload = work(job, number)
            shards.put(number, *packed({"processor": "a", **facts}, payload))
        return shards.facts


def nothing() -> bytes:
    """Return what a shard without a success holds."""
    tarfile.open(fileobj=(packed := io.BytesIO()), mode="w").close()
    return packed.getvalue()


@needs("pyarrow")
def test_shards_make_the_dataset_of_one_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Three episodes in shards of two, done in any order, give the bytes of `softmode record`; damage is done again."""
    words = ["record", ENV_ID, "--obs-type", "state", "--episodes", "3", "--noise", "0.3"]
    assert main([*words, "-o", str(tmp_path / "here")]) == 0
    job: dict[str, Any] = {"env": ENV_ID, "env_options": {"obs_type": "state"}, "task": purpose(ENV_ID), "seed": 0}
    job |= {"episodes": 3, "noise": 0.3, "only_successes": False, "states": False, "pictures": "video", "shard": 2}
    job = on_ray.job_of("scripted", **job, device="cpu", robot="softmode_arm", owner=None)
    out = tmp_path / "there"
    facts = filled(out, job, on_ray.record_shard, (1, 0))
    assert [len(facts[number]["outcomes"]) for number in (0, 1)] == [2, 1] and facts[0]["owner"]["task"] == "PushSoft"
    origin = {"env": ENV_ID, "env_options": job["env_options"]}
    assert on_ray.record_on_ray("127.0.0.1:1", job, out, origin).attempts == 3  # all is there: nobody is asked
    for path in (tmp_path / "here").rglob("*.*"):
        assert path.read_bytes() == (out / path.relative_to(tmp_path / "here")).read_bytes(), path
    assert sorted(path.name for path in tmp_path.iterdir()) == ["here", "there"]
    _, payload = on_ray.record_shard(job, 0)  # of successes the first by their seeds are taken, across shards
    few = {**job, "only_successes": True, "episodes": 1}
    with Shards(on_ray.folder_of(tmp_path / "few"), few) as shards:
        for number, outcomes, kept in ((0, [False, False], nothing()), (1, [False, True, True], payload)):
            facts = {"processor": "a", "outcomes": outcomes, "episodes": sum(outcomes)}
            shards.put(number, *packed(facts, kept))
    assert on_ray.record_on_ray("127.0.0.1:1", few, tmp_path / "few", origin).attempts == 4
    assert len(read_dataset(tmp_path / "few").episode_start) == 1
    shutil.copy(POLICY, tmp_path / "policy.npz")
    other = {**job, **on_ray.job_of(tmp_path / "policy.npz")}
    (tmp_path / "policy.npz").write_bytes(b"another")
    with pytest.raises(ConfigError, match="another file"):
        on_ray.record_shard(other, 0)
    for words in (["--ray", "auto", "--append"], ["--ray", "auto", "--ray-shard", "0"]):
        assert main(["record", ENV_ID, "-o", str(tmp_path / "x"), *words]) == 2


@needs("torch")
def test_shards_of_an_evaluation_are_its_worlds(tmp_path: Path):
    """Every world of a shard plays the episode of its seed; the shards of all options make a line each."""
    from softmode.learning.policy import evaluate

    with pytest.raises(ConfigError, match="no list"):
        on_ray.combinations({"size": 0.05})
    over = {"max_episode_steps": [3, 5]}
    job = {"env": ENV_ID, "env_options": {"obs_type": "state"}, "over": over, "device": "cpu", "seed": 7}
    job = on_ray.job_of(POLICY, **job, episodes=3, num_envs=2)
    filled(tmp_path / "e", job, on_ray.evaluate_shard, (3, 0, 2, 1))
    found = list(on_ray.evaluate_on_ray("127.0.0.1:1", job, tmp_path / "e"))
    assert [chosen for chosen, _ in found] == [{"max_episode_steps": 3}, {"max_episode_steps": 5}]
    assert [result.mean_length for _, result in found] == [3.0, 5.0]
    assert all(result.episodes == 3 and result.failed_seeds == (7, 8, 9) for _, result in found)
    env, policy = on_ray._worlds(json.dumps(job, sort_keys=True), 1)
    first, last = (evaluate(env, policy, count, seed=seed) for count, seed in ((2, 7), (1, 9)))
    assert found[1][1].mean_return == pytest.approx((2.0 * first.mean_return + last.mean_return) / 3.0, rel=1e-6)
    assert not any(tmp_path.iterdir())
