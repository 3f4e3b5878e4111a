"""`softmode record`: what it records, what it says, how it fails."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from softmode import ENVIRONMENTS
from softmode.cli.main import main
from softmode.demonstrations import read_dataset
from tests.faults import signalled
from tests.marks import rest_but
from tests.needs import needs

pytestmark = needs("pyarrow")


ID = "softmode/LiftSoft-v0"
os.environ.setdefault("SOFTMODE_CACHE", str(Path(__file__).resolve().parents[1] / ".cache" / "softmode"))


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Return a function that shortens the episodes of the environment."""

    def limit(steps: int) -> None:
        monkeypatch.setattr(gym.spec(ID), "max_episode_steps", steps)

    return limit


def record(folder: Path, *arguments: str) -> int:
    """Run the command."""
    return main(["record", ID, "-o", str(folder), *arguments])


def test_recorded_actions_reproduce_the_recorded_states(
    tmp_path: Path, short: Callable[[int], None], capfd: pytest.CaptureFixture[str]
):
    """Frame t holds the state before action t and the reward after it: playing the actions again gives the same."""
    short(7)
    assert record(tmp_path / "d", "--obs-type", "state", "--episodes", "2", "--seed", "5") == 0
    out, _ = capfd.readouterr()
    assert "0 of 2 recorded episodes succeeded" in out and "holds 2 episodes" in out
    found = read_dataset(tmp_path / "d")
    assert found.tasks == (ENVIRONMENTS[ID],)
    assert (found.episode_count, found.frame_count) == (2, 14)
    env = gym.make(ID)
    assert found.fps == env.metadata["render_fps"]
    for number in range(2):
        part = found.episode(number)
        state, _ = env.reset(seed=5 + number)
        for k, action in enumerate(part["action"]):
            stored = np.concatenate([part["observation.state"][k], part["observation.environment_state"][k]])
            np.testing.assert_array_equal(stored, state)
            state, reward, terminated, truncated, _ = env.step(action)
            assert part["next.reward"][k] == np.float32(reward)
            assert part["next.done"][k] == (terminated or truncated) == (k == 6)
    env.close()


def test_noise_moves_the_robot_and_not_the_record(tmp_path: Path, short: Callable[[int], None]):
    """A policy that does nothing is recorded as doing nothing, while pushes move the tool."""
    short(40)
    arguments = ("--obs-type", "state", "--policy", "zero", "--episodes", "1", "--seed", "1")
    assert record(tmp_path / "still", *arguments) == 0
    assert record(tmp_path / "pushed", *arguments, "--noise", "0.5") == 0
    still, pushed = read_dataset(tmp_path / "still").columns, read_dataset(tmp_path / "pushed").columns
    assert not still["action"].any() and not pushed["action"].any()
    place = [np.ptp(columns["observation.state"][:, :3], axis=0).max() for columns in (still, pushed)]
    assert place[1] > 10.0 * place[0] + 0.005


@pytest.mark.parametrize("pictures", rest_but(["png"], ["video", "png"]))
def test_pictures(tmp_path: Path, short: Callable[[int], None], pictures: str):
    """Pictures and proprioception are recorded; PNG ones equal the camera's."""
    short(4)
    assert record(tmp_path / "d", "--episodes", "1", "--policy", "random", "--pictures", pictures) == 0
    found = read_dataset(tmp_path / "d").columns
    env = gym.make(ID, obs_type="pixels_agent_pos")
    observation, _ = env.reset(seed=0)
    env.close()
    assert "observation.environment_state" not in found
    np.testing.assert_array_equal(found["observation.state"][0], observation["agent_pos"])
    difference = np.abs(found["observation.images.front"][0].astype(float) - observation["pixels"])
    assert difference.mean() < 3.0 if pictures == "video" else not difference.any()
    assert len(found["observation.images.front"]) == 4


@pytest.mark.parametrize(
    ("number", "code"), rest_but([(signal.SIGTERM, 143)], [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
)
def test_append_and_interruption(
    tmp_path: Path, short: Callable[[int], None], capfd: pytest.CaptureFixture[str], number: signal.Signals, code: int
):
    """Interrupted, it says what is there and how to go on; going on adds episodes."""
    short(4)
    arguments = ("--obs-type", "state", "--policy", "zero")
    with signalled(number, (tmp_path / "d").exists):
        assert record(tmp_path / "d", *arguments, "--episodes", "10000") == code
    assert [path.name for path in tmp_path.iterdir()] == ["d"] and not list((tmp_path / "d").glob(".*"))
    count = read_dataset(tmp_path / "d").episode_count
    assert 1 <= count < 10_000
    _, err = capfd.readouterr()
    assert f"holds {count} complete episodes" in err and f"--append --seed {count}" in err
    assert record(tmp_path / "d", *arguments, "--episodes", "2", "--append", "--seed", str(count)) == 0
    assert read_dataset(tmp_path / "d").episode_count == count + 2


@pytest.mark.parametrize(
    "arguments",
    [
        ("--policy", "nobody"),
        ("--episodes", "0"),
        ("--seed", "-1"),
        ("--noise", "2"),
        ("--noise", "nan"),
        ("--device", "cuda:99"),
    ],
)
def test_bad_options(tmp_path: Path, capfd: pytest.CaptureFixture[str], arguments: tuple[str, ...]):
    """One line that names the remedy, exit code 2, and nothing on the disk."""
    assert record(tmp_path / "d", *arguments) == 2
    _, err = capfd.readouterr()
    assert err.count("softmode: error:") == 1 and "Traceback" not in err
    assert not list(tmp_path.iterdir())


def test_existing_folder_and_unknown_environment(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    """Neither is touched or guessed."""
    (tmp_path / "notes").write_text("mine")
    assert record(tmp_path) == 2
    assert main(["record", "softmode/Nothing-v0", "-o", str(tmp_path / "d")]) == 2
    _, err = capfd.readouterr()
    assert "exists" in err and "unknown environment" in err
    assert [path.name for path in tmp_path.iterdir()] == ["notes"]


def test_only_successes(tmp_path: Path, short: Callable[[int], None], capfd: pytest.CaptureFixture[str]):
    """A policy that never succeeds is given up after ten attempts per episode, and no failure is recorded."""
    short(2)
    assert record(tmp_path / "d", "--obs-type", "state", "--policy", "zero", "--episodes", "1", "--only-successes") == 2
    _, err = capfd.readouterr()
    assert "only 0 of 10 episodes succeeded" in err
    assert not list(tmp_path.iterdir())
