"""Runs: folders, resumption after a kill, the guard against values that are not finite, a full disk."""

from __future__ import annotations

import csv
import json
import signal
from pathlib import Path

import numpy as np
import pytest

from softmode.cli.main import main
from softmode.errors import CheckpointError, ConfigError, RunError, TrainingDiverged
from softmode.learning.checkpoints import read_checkpoint
from softmode.learning.hyperparameters import Hyperparameters
from softmode.learning.train_options import TrainOptions
from tests import faults
from tests.learning.point_env import PointVectorEnv
from tests.needs import needs

pytestmark = needs("torch")

SMALL = Hyperparameters(rollout_steps=8, epochs=2, minibatches=2, hidden=(16,), discount=0.9)


def run(folder: Path | None, steps: int, *, lines: list[str] | None = None, spoil=None, **kwargs):
    """Train eight points."""
    from softmode.learning.trainer import train

    options = {"env": "Point", "num_envs": 8, "total_steps": steps, "run_dir": folder, "eval_episodes": 0}
    options |= {"hyperparameters": SMALL, "tensorboard": False, "checkpoint_seconds": 0.0, **kwargs}
    report = (lambda line: None) if lines is None else lines.append
    return train(
        TrainOptions(**options),
        make=lambda name, count, device, _: PointVectorEnv(count, **(spoil or {})),
        report=report,
    )


def rows(folder: Path) -> list[dict[str, str]]:
    """Return the table of progress."""
    with (folder / "progress.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_what_a_run_leaves(tmp_path: Path, monkeypatch):
    """A folder by environment and time, its configuration, a table, checkpoints, scalars, the evaluation."""
    import torch

    pytest.importorskip("tensorboard")
    monkeypatch.chdir(tmp_path)
    lines: list[str] = []
    result = run(None, 640, lines=lines, name="first", tensorboard=True, eval_episodes=16)
    assert result.run_dir.parent == Path("runs/Point") and result.run_dir.name.endswith("_first")
    assert {path.name for path in result.run_dir.iterdir()} == {
        "config.json", "progress.csv", "latest.npz", "best.npz", "evaluation.json", "tensorboard",
    }  # fmt: skip
    config = json.loads((result.run_dir / "config.json").read_text())
    assert config["hyperparameters"] == json.loads(json.dumps(SMALL.to_json())) and config["num_envs"] == 8
    assert config["versions"]["torch"] == torch.__version__ and config["seed"] == 0
    table = rows(result.run_dir)
    assert [int(row["env_steps"]) for row in table] == list(range(64, 641, 64))
    assert float(table[-1]["success"]) >= 0.0 and float(table[-1]["reward/distance"]) < 0.0
    assert sum("steps" in line and "success" in line for line in lines) == 10 - 1  # no episode ends in the first
    evaluation = json.loads((result.run_dir / "evaluation.json").read_text())
    assert evaluation["episodes"] == 16 and evaluation["success_rate"] == result.evaluation.success_rate
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(result.run_dir / "tensorboard"))
    events.Reload()
    last = events.Scalars("return")[-1]
    assert last.step == 640 and last.value == pytest.approx(float(table[-1]["return"]), rel=1e-5)
    with pytest.raises(RunError, match="exists"):
        run(result.run_dir, 64)


def test_resumption_goes_on_where_the_run_was(tmp_path: Path):
    """Networks, optimizer, scales and counters are those of the checkpoint; worlds get fresh episodes."""
    folder = tmp_path / "run"
    run(folder, 640)
    before = read_checkpoint(folder / "latest.npz")
    with (folder / "progress.csv").open("a") as file:
        file.write("11,704,half a row")  # what a killed process may leave
    run(folder, 1, resume=True)  # nothing is left to do
    for name, array in before.arrays.items():
        assert np.array_equal(read_checkpoint(folder / "latest.npz").arrays[name], array)
    result = run(folder, 1280, resume=True, num_envs=3, seed=9)  # the run's own worlds and seed are kept
    after = read_checkpoint(folder / "latest.npz")
    assert result.env_steps == 1280 and after.progress["resumed"] == 1 and after.progress["seed"] == 0
    assert float(after.arrays["optimizer.steps"]) == float(before.arrays["optimizer.steps"]) + 10 * 4 - 2 * 4
    assert [int(row["iteration"]) for row in rows(folder)] == list(range(1, 21))
    seconds = [float(row["seconds"]) for row in rows(folder)]
    assert seconds == sorted(seconds)


def test_evaluations_choose_the_best(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With `eval_every` the best is that of the evaluations, on seeds of their own, and failures are filmed.

    What training itself counts goes on after a resumption: its last episodes are in the checkpoint.
    """
    from softmode.learning import trainer
    from softmode.learning.policy import Evaluation, load_policy

    scores, seeds, films = iter([0.2, 0.9, 0.5, 1.0]), [], []

    def evaluate(env, policy, episodes, *, seed=trainer.EVALUATION_SEED, device):
        """Return a made-up result."""
        seeds.append((env.num_envs, episodes, seed))
        numbers = {"mean_return": 0.0, "std_return": 0.0, "mean_length": 12.0, "failed_seeds": (seed + 3, seed + 5)}
        return Evaluation(episodes=episodes, success_rate=next(scores), **numbers)

    monkeypatch.setattr(trainer, "evaluate", evaluate)
    monkeypatch.setattr(trainer, "film_episode", lambda policy, seed, path: films.append((seed, path.name)) or path)
    folder, lines = tmp_path / "run", []
    run(folder, 320, eval_every=2, eval_episodes=5, video_every=2, lines=lines, checkpoint_seconds=1e9)
    assert seeds == [(5, 5, trainer.SELECTION_SEED)] * 3 + [(8, 5, trainer.EVALUATION_SEED)]
    best = read_checkpoint(folder / "best.npz").progress
    assert best["iteration"] == 4 and best["best_success"] == 0.9
    assert films == [(trainer.SELECTION_SEED + 3, "failed-4-1500000003.mp4")]
    assert any("evaluation at iteration 4" in line for line in lines)
    assert load_policy(folder).checkpoint.progress["iteration"] == 4
    window = read_checkpoint(folder / "latest.npz").progress["window"]
    assert sum(entry[0] for entry in window) > 0
    monkeypatch.undo()
    run(folder, 384, resume=True)
    assert read_checkpoint(folder / "latest.npz").progress["window"][: len(window)] == window


@pytest.mark.parametrize(
    ("given", "named"),
    [({"eval_every": 5, "eval_episodes": 0}, "no episodes"), ({"video_every": 5}, "without evaluations")],
)
def test_evaluations_without_episodes_are_refused(given: dict[str, int], named: str):
    """The message names what is missing."""
    with pytest.raises(ConfigError, match=named):
        TrainOptions(env="Point", **given)


TRAIN = ["train", "Pendulum-v1", "--num-envs", "2", "--eval-episodes", "0", "--set", "rollout_steps=32", "hidden=[8]"]


def test_a_killed_run_goes_on(tmp_path: Path):
    """SIGKILL in the middle leaves a whole checkpoint that the command resumes from."""
    folder = tmp_path / "run"
    command = [*TRAIN, "--run-dir", str(folder), "--checkpoint-seconds", "0"]
    code = "import sys; from softmode.cli.main import main; sys.exit(main(sys.argv[1:]))"
    process = faults.start(code, *command, "--total-steps", "1e9")
    faults.end_at(process, lambda line: line.strip().startswith("20 "), signal.SIGKILL)
    reached = read_checkpoint(folder / "latest.npz").progress["env_steps"]
    assert reached >= 19 * 64
    assert main([*command, "--total-steps", str(reached + 640), "--resume"]) == 0
    assert read_checkpoint(folder / "latest.npz").progress["env_steps"] == reached + 640
    steps = [int(row["env_steps"]) for row in rows(folder)]
    assert steps == list(range(64, reached + 641, 64))


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_an_ended_run_keeps_its_last_iteration(tmp_path: Path, number: signal.Signals, code: int, capfd):
    """SIGTERM and Ctrl-C write what the last whole iteration left, though no checkpoint was due, and no more."""
    folder = tmp_path / "run"
    with faults.signalled(number, lambda: (folder / "progress.csv").exists() and len(rows(folder)) >= 3):
        assert main([*TRAIN, "--run-dir", str(folder), "--total-steps", "1e9"]) == code
    out, err = capfd.readouterr()
    reached = read_checkpoint(folder / "latest.npz").progress["iteration"]
    assert reached >= 2 and len(rows(folder)) - reached in (0, 1)  # it may end between the row and what is kept
    assert f"interrupted after iteration {reached}" in out and "Traceback" not in err
    assert not list(folder.glob(".*"))
    assert main([*TRAIN, "--run-dir", str(folder), "--total-steps", str(64 * (reached + 2)), "--resume"]) == 0
    assert [int(row["iteration"]) for row in rows(folder)] == list(range(1, reached + 3))


def test_resumption_is_refused_where_it_cannot_work(tmp_path: Path):
    """No run, another environment, a damaged checkpoint or configuration."""
    with pytest.raises(ConfigError, match="folder"):
        TrainOptions(env="Point", resume=True)
    with pytest.raises(RunError, match="no run"):
        run(tmp_path / "none", 640, resume=True)
    folder = tmp_path / "run"
    run(folder, 64)
    with pytest.raises(CheckpointError, match="Point"):
        run(folder, 640, resume=True, env="Other")
    content = (folder / "latest.npz").read_bytes()
    (folder / "latest.npz").write_bytes(content[:-100])
    with pytest.raises(CheckpointError, match="damaged"):
        run(folder, 640, resume=True)
    (folder / "latest.npz").write_bytes(content)
    (folder / "config.json").write_text("{")
    with pytest.raises(RunError, match=r"config\.json"):
        run(folder, 640, resume=True)
    assert (folder / "latest.npz").read_bytes() == content


def test_init_starts_from_a_policy(tmp_path: Path):
    """The actor is the given one while the critic warms up, with the noise asked for; other spaces are refused."""
    first = run(tmp_path / "first", 640)
    options = Hyperparameters(**{**SMALL.to_json(), "hidden": (16,), "critic_warmup": 100})
    more = {"hyperparameters": options, "overrides": {"initial_std": 0.3}}
    second = run(tmp_path / "second", 320, init=first.run_dir / "latest.npz", **more)
    old, new = (read_checkpoint(r.run_dir / "latest.npz").arrays for r in (first, second))
    assert np.array_equal(old["actor.mean.0.weight"], new["actor.mean.0.weight"])
    np.testing.assert_allclose(np.exp(new["actor.log_std"]), 0.3, rtol=1e-6)
    assert not np.array_equal(old["critic.value.0.weight"], new["critic.value.0.weight"])
    with pytest.raises(CheckpointError, match="Point"):
        run(tmp_path / "third", 64, env="Other", init=first.run_dir / "latest.npz")
    wide = Hyperparameters(**{**SMALL.to_json(), "hidden": (32,)})
    with pytest.raises(CheckpointError, match="other networks"):
        run(tmp_path / "fourth", 64, init=first.run_dir / "latest.npz", hyperparameters=wide)
    assert not (tmp_path / "fourth").exists()


def test_what_an_actor_has_learnt_survives_its_first_update(tmp_path: Path):
    """However long the critic warmed up, and though the noise is small, it moves by no more than the schedule wants."""
    narrow = {**SMALL.to_json(), "hidden": (256,), "max_std": 0.03, "initial_std": 0.03}
    first = run(tmp_path / "first", 640, hyperparameters=Hyperparameters(**narrow))
    options = Hyperparameters(**{**narrow, "critic_warmup": 30})
    run(tmp_path / "second", 64 * 34, init=first.run_dir / "latest.npz", hyperparameters=options)
    moved = [float(row["divergence"]) for row in rows(tmp_path / "second")]
    assert max(moved[:31]) < 1e-6 < max(moved[31:]) < 4.0 * options.desired_kl, moved


@pytest.mark.parametrize("reward_nan", [False, True])
def test_the_guard_writes_what_led_to_a_bad_value(tmp_path: Path, reward_nan: bool):
    """World 5 is spoilt in step 45: the file holds its last steps up to there, the earlier checkpoint stays."""
    folder = tmp_path / "run"
    with pytest.raises(TrainingDiverged, match="worlds 5 are") as caught:
        run(folder, 6400, nan_guard=True, spoil={"nan_at": (45, 5), "reward_nan": reward_nan})
    (path,) = folder.glob("nonfinite-*.npz")
    assert str(path) in str(caught.value)
    with np.load(path) as file:
        assert file["world"].tolist() == [5]
        reward, action, seen = file["reward"][:, 0], file["action"], file["next_observation_state"][:, 0]
        first = int(file["first_bad"][0])
    assert len(reward) == len(action) == first + 1 and first >= 32
    assert np.all(np.isfinite(reward[:first])) and np.all(np.isfinite(seen[:first]))
    assert not np.isfinite(reward[first] if reward_nan else seen[first].sum())
    assert read_checkpoint(folder / "latest.npz").progress["iteration"] == 5


def test_without_the_guard_a_bad_loss_stops_too(tmp_path: Path):
    """The update is skipped, the checkpoint before it can be loaded, and the error names the remedy."""
    from softmode.learning.policy import load_policy

    with pytest.raises(TrainingDiverged, match="nan-guard"):
        run(tmp_path / "run", 6400, spoil={"nan_at": (45, 5)})
    load_policy(tmp_path / "run" / "latest.npz")


def test_a_full_disk_leaves_the_earlier_checkpoint(tmp_path: Path):
    """Files may grow to 24 kB only, as on a full disk: a typed error, and the checkpoint of before."""
    folder = tmp_path / "run"
    run(folder, 64)
    kept = (folder / "latest.npz").read_bytes()
    code = """
import sys
from pathlib import Path
from softmode.errors import RunError
from tests.learning.test_runs import run
try:
    run(Path(sys.argv[1]), 6400, resume=True)
except RunError as error:
    print(error)
"""
    _, written = faults.run(code, folder, disk=4096)
    assert len(kept) > 4096
    assert "cannot be written" in written and "--resume" in written, written
    assert (folder / "latest.npz").read_bytes() == kept
    assert not list(folder.glob(".*"))
    run(folder, 640, resume=True)


def test_a_time_limit_ends_a_run(tmp_path: Path):
    """Training ends with the first iteration behind the limit."""
    result = run(tmp_path / "run", 10**9, time_limit=0.3)
    table = rows(tmp_path / "run")
    assert result.env_steps < 10**9 and float(table[-1]["seconds"]) >= 0.3
    assert len(table) < 2 or float(table[-2]["seconds"]) < 0.3


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"num_envs": 0}, "num_envs"),
        ({"device": "tpu"}, "device"),
        ({"device": "cuda:99"}, "cuda:99"),
        ({"seed": -1}, "seed"),
        ({"time_limit": 0.0}, "time_limit"),
        ({"env_options": {"config": object()}}, "env_options"),
        ({"overrides": {"momentum": 1}}, "momentum"),
        ({"overrides": {"discount": "high"}}, "discount"),
        ({"name": "a/b"}, "name"),
    ],
)
def test_bad_options_are_refused(tmp_path: Path, wrong, named):
    """Before a folder is made."""
    with pytest.raises(ConfigError, match=named):
        run(tmp_path / "run", 64, **wrong)
    assert not (tmp_path / "run").exists()
