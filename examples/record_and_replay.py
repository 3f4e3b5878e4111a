"""Record scripted episodes as a LeRobot dataset, read it back, play its actions again and get the same observations.

Seed and actions are all that an episode is: replayed, every number and every pixel returns, bit for bit on a CPU. With
the object three centimetres aside the same actions miss the goal: the script looks, its record does not.

Needs the extras data and demo. Run: ``python examples/record_and_replay.py [--episodes 3] [--short]``
writes the dataset ``out/record_and_replay`` and a film of its pictures, ``out/record_and_replay.mp4``
"""

import argparse
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import warp as wp

import softmode
from softmode.demonstrations import (
    Dataset,
    DatasetWriter,
    environment_features,
    observation_columns,
    read_dataset,
    record_episodes,
)
from softmode.learning import policy_factory
from softmode.viz import Film

ENV, OUT, SEED, ASIDE = "softmode/PushSoft-v0", Path("out/record_and_replay"), 100, 0.03


def record(env: gym.Env, episodes: int) -> Dataset:
    """Record the script without pushes, so that the actions are those played; pictures as exact PNG."""
    if OUT.exists():
        shutil.rmtree(OUT)
    features = environment_features(env, pictures="png")
    with DatasetWriter(OUT, features, fps=env.metadata["render_fps"], robot_type="softmode_arm") as writer:
        policy = policy_factory("scripted", env)
        record_episodes(env, policy, writer, episodes=episodes, task=softmode.ENVIRONMENTS[ENV], seed=SEED)
    return read_dataset(OUT)


def replay(env: gym.Env, data: Dataset, number: int, **options: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Play the actions of an episode; return what was observed before each of them, and the last info."""
    seen: dict[str, list[Any]] = {}
    observation, info = env.reset(seed=SEED + number, options=options)
    for action in data.episode(number)["action"]:
        for name, value in observation_columns(observation, data.features).items():
            seen.setdefault(name, []).append(value)
        observation, *_, info = env.step(action)
    return {name: np.array(values) for name, values in seen.items()}, info


def test_final(
    data: Dataset, replays: list[dict[str, np.ndarray]], ends: dict[str, Any], aside: dict[str, Any]
) -> None:
    """All recorded observations return bit for bit and reach the goal; from another place the actions do not."""
    for number, seen in enumerate(replays):
        episode = data.episode(number)
        assert {"observation.state", "observation.images.front"} <= set(seen)
        for name, values in seen.items():
            np.testing.assert_array_equal(values, episode[name], err_msg=f"{name} of episode {number}")
    assert data.columns["next.success"][data.episode_stop - 1].all()
    assert ends["is_success"]
    assert aside["goal_distance"] > ends["goal_distance"] + 0.3 * ASIDE


def main(arguments: list[str] | None = None) -> None:
    """Record, read, replay, compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--short", action="store_true", help="one episode")
    given = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    env = gym.make(ENV, obs_type="pixels_agent_pos")
    data = record(env, 1 if given.short else given.episodes)
    size = sum(file.stat().st_size for file in OUT.rglob("*") if file.is_file())
    print(f"{OUT}: {data.episode_count} episodes, {data.frame_count} frames, {1e-6 * size:.1f} MB")
    replays = [replay(env, data, number) for number in range(data.episode_count)]
    ends = replays[0][1]
    _, aside = replay(env, data, 0, position=ends["parameters"]["position"] + [0.0, ASIDE])
    print(f"replayed, the first ends {1e3 * ends['goal_distance']:.1f} mm from its goal, and")
    print(f"{1e3 * aside['goal_distance']:.1f} mm with the object moved by {1e3 * ASIDE:.0f} mm at the start")
    test_final(data, [seen for seen, _ in replays], ends, aside)
    with Film(OUT.with_suffix(".mp4")) as film:
        for picture in data.columns["observation.images.front"]:
            film.add(picture, data.fps)
        film.publish()


if __name__ == "__main__":
    main()
