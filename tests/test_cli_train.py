"""The commands of training."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from softmode.cli import main as cli
from softmode.cli.train import Train, parse_env_options, parse_overrides
from softmode.errors import ConfigError
from softmode.learning.config_values import config_of
from tests.needs import needs

pytestmark = needs("torch")

QUICK = ["--num-envs", "2", "--total-steps", "128", "--set", "rollout_steps=32", "hidden=[8]", "--eval-episodes"]


def test_train_and_evaluate(tmp_path: Path, capsys):
    """Training prints a line per iteration and an evaluation; evaluate repeats it; another environment is refused."""
    folder = tmp_path / "run"
    assert cli.main(["train", "Pendulum-v1", "--run-dir", str(folder), *QUICK, "3"]) == 0
    out = capsys.readouterr().out
    assert "128 steps" in out and "3 episodes: return" in out
    line = out.splitlines()[-1].partition(", ")[2]
    assert cli.main(["evaluate", "Pendulum-v1", str(folder / "latest.npz"), "--episodes", "3", "--num-envs", "2"]) == 0
    assert capsys.readouterr().out.strip() == line
    assert cli.main(["evaluate", "MountainCarContinuous-v0", str(folder / "latest.npz")]) == 2
    assert "Pendulum-v1" in capsys.readouterr().err
    assert cli.main(["train", "Pendulum-v1", "--run-dir", str(folder), *QUICK, "0"]) == 2
    assert "--resume" in capsys.readouterr().err
    assert cli.main(["play", "softmode/LiftSoft-v0", "--policy", str(folder / "latest.npz")]) == 2
    assert "Pendulum-v1" in capsys.readouterr().err


def test_export(tmp_path: Path, capsys):
    """An exported policy is smaller, plays and evaluates as its checkpoint, starts a run; no file is replaced."""
    folder, policy = tmp_path / "run", tmp_path / "new" / "policy.npz"
    assert cli.main(["train", "Pendulum-v1", "--run-dir", str(folder), *QUICK, "0"]) == 0
    assert cli.main(["export", str(folder / "latest.npz"), str(policy)]) == 0
    assert policy.stat().st_size < 0.5 * (folder / "latest.npz").stat().st_size
    results = []
    for file in (folder / "latest.npz", policy):
        capsys.readouterr()
        assert cli.main(["evaluate", "Pendulum-v1", str(file), "--episodes", "2", "--num-envs", "2"]) == 0
        results.append(capsys.readouterr().out)
    assert results[0] == results[1]
    again = ["--run-dir", str(tmp_path / "again"), "--init", str(policy), *QUICK, "0"]
    assert cli.main(["train", "Pendulum-v1", *again]) == 0
    before = policy.read_bytes()
    assert cli.main(["export", str(folder / "latest.npz"), str(policy)]) == 2
    assert "exists" in capsys.readouterr().err and policy.read_bytes() == before
    assert cli.main(["export", str(policy), str(tmp_path / "policy.pt")]) == 2
    assert "'.onnx'" in capsys.readouterr().err
    assert cli.main(["export", str(folder / "config.json"), str(tmp_path / "other.npz")]) == 2
    assert "config.json" in capsys.readouterr().err and not (tmp_path / "other.npz").exists()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["train", "softmode/Nothing-v0"], "softmode/LiftSoft-v0"),
        (["train", "Pendulum-v1", "--num-envs", "0"], "num_envs"),
        (["train", "Pendulum-v1", "--device", "cuda:99"], "cpu"),
        (["train", "Pendulum-v1", "--set", "discount"], "NAME=VALUE"),
        (["train", "Pendulum-v1", "--set", "gamma=0.9"], "discount"),
        (["train", "Pendulum-v1", "--env-options", "["], "JSON"),
        (["train", "softmode/LiftSoft-v0", "--env-options", '{"config": {"colour": 1}}'], "image_size"),
        (["train", "Pendulum-v1", "--resume"], "--run-dir"),
        (["evaluate", "Pendulum-v1", "missing.npz"], "missing.npz"),
        (["play", "softmode/LiftSoft-v0", "--policy", "missing.npz"], "missing.npz"),
    ],
)
def test_mistakes_name_the_remedy(arguments, named, capsys, tmp_path, monkeypatch):
    """One line, exit code 2, no folder."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == 2
    err = capsys.readouterr().err
    assert named in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.rest
def test_pixels_of_a_softmode_environment(tmp_path: Path, capsys):
    """The camera's picture size comes from JSON, the critic reads the state, and the policy makes its environment."""
    folder = tmp_path / "run"
    arguments = ["train", "softmode/LiftSoft-v0", "--run-dir", str(folder), "--obs-type", "pixels_agent_pos"]
    arguments += ["--env-options", '{"config": {"image_size": 36}, "max_episode_steps": 6}', "--num-envs", "2"]
    arguments += ["--set", "rollout_steps=4", "features=8", "hidden=[8]", "epochs=1", "--total-steps", "32"]
    assert cli.main([*arguments, "--eval-episodes", "2"]) == 0
    assert "reach" in capsys.readouterr().out
    from softmode.learning.policy import load_policy

    policy = load_policy(folder / "latest.npz")
    assert policy.interface.pictures == {"pixels": (36, 36, 3)} and policy.checkpoint.privileged > 8
    env = policy.make()
    try:
        policy.check(env)
        observation, _ = env.reset(seed=0)
        assert env.action_space.contains(policy(observation))
    finally:
        env.close()


def test_values_are_parsed():
    """JSON where it is, words where it is not; dicts become configurations down to the leaves."""
    assert parse_overrides(("discount=0.9", "hidden=[8,8]", "schedule=linear", "clip-value=null")) == {
        "discount": 0.9, "hidden": [8, 8], "schedule": "linear", "clip_value": None,
    }  # fmt: skip
    assert parse_env_options('{"obs_type": "pixels"}') == {"obs_type": "pixels"}
    from softmode.envs.tasks.lift_soft.task import LiftSoftConfig

    config = config_of(LiftSoftConfig, {"image_size": 64, "scene": {"object": {"size": 0.07}}, "goal_range": [0, 0, 0]})
    assert config.image_size == 64 and config.scene.object.size == 0.07 and config.goal_range == (0, 0, 0)
    from softmode.envs.tasks.push_soft.task import PushSoftConfig

    config = config_of(PushSoftConfig, {"scene": {"substeps": 8}})
    assert config.scene == dataclasses.replace(PushSoftConfig().scene, substeps=8)
    with pytest.raises(ConfigError, match="colour"):
        config_of(LiftSoftConfig, {"scene": {"object": {"colour": 1}}})


def test_worlds_in_processes_are_the_same_bits(tmp_path: Path, monkeypatch):
    """A run whose worlds are shared by two processes ends with the networks of the one in a single process."""
    from softmode.learning.checkpoints import read_checkpoint

    found = []
    for count in ("1", "2"):
        folder = tmp_path / count
        arguments = ["train", "softmode/PushSoft-v0", "--run-dir", str(folder), "--processes", count, "--num-envs", "2"]
        arguments += ["--set", "rollout_steps=4", "hidden=[8]", "epochs=1", "--total-steps", "16"]
        assert cli.main([*arguments, "--eval-episodes", "0"]) == 0
        assert json.loads((folder / "config.json").read_text())["processes"] == int(count)
        found.append(read_checkpoint(folder / "latest.npz"))
    one, two = found
    assert two.env_options == {} and set(one.arrays) == set(two.arrays)
    assert all(np.array_equal(array, two.arrays[name]) for name, array in one.arrays.items())


@pytest.mark.parametrize(
    ("given", "environment", "count"),
    [
        ({}, {}, 3),
        ({"num_envs": 2}, {}, 2),
        ({}, {"LOCAL_WORLD_SIZE": "2"}, 1),
        ({"processes": 5}, {}, 5),
        ({"device": "cuda:0"}, {}, 1),
        ({"env": "Pendulum-v1"}, {}, 1),
    ],
)
def test_training_takes_the_cores_there_are(given, environment, count, monkeypatch):
    """One process for each core of a rank, no more than worlds; on a GPU and for other environments one."""
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 2}, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert Train(**{"env": "softmode/LiftSoft-v0", **given}).process_count() == count
