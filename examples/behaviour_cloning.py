"""Behaviour cloning: record scripted demonstrations as a LeRobot dataset, learn them, count the successes.

A network maps the normalised state to the next few actions of the script (action chunking, Zhao et al. 2023); each is
played for a fraction of a second before the next are asked for. While recording, the robot is pushed off its way now
and then (DART, Laskey et al. 2017) and the script's corrections are what is learned; without that, errors add up. Writes
the dataset to out/behaviour_cloning and prints how often script and network succeed on objects that they were not shown.

Needs the extras data and rl. Run: ``python examples/behaviour_cloning.py [--env ID] [--demonstrations N] [--short]``
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

import softmode
from softmode.demonstrations import Dataset, DatasetWriter, read_dataset
from softmode.demonstrations.recording import environment_features, record_episodes
from softmode.policies import policy_factory

KEYS = ("observation.state", "observation.environment_state", "action")
CHUNK, PLAYED, NOISE = 8, 4, 0.3
"""Actions predicted at once, those of them played, noise while recording."""


class Clone(torch.nn.Module):
    """A network from states to chunks of actions, with the normalisation of its data."""

    def __init__(self, data: Dataset) -> None:
        """Read mean and standard deviation from the dataset."""
        super().__init__()
        parts = [data.statistics[key] for key in KEYS[:-1] if key in data.columns]
        self.mean = torch.tensor(np.concatenate([part["mean"] for part in parts]), dtype=torch.float32)
        self.scale = torch.tensor(np.concatenate([part["std"] for part in parts]), dtype=torch.float32).clamp(min=1e-3)
        self.actions = data.columns["action"].shape[1]
        layers, width = [], len(self.mean)
        for _ in range(3):
            layers += [torch.nn.Linear(width, 256), torch.nn.GELU()]
            width = 256
        self.net = torch.nn.Sequential(*layers, torch.nn.Linear(width, CHUNK * self.actions))

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        """Return actions of shape (batch, CHUNK, D) for states of shape (batch, D)."""
        return self.net(((state - self.mean) / self.scale).clamp(-5.0, 5.0)).reshape(-1, CHUNK, self.actions)


def train(data: Dataset, steps: int, seed: int = 0) -> Clone:
    """Fit a clone to the demonstrations; the absolute error keeps the script's abrupt actions sharp."""
    torch.manual_seed(seed)
    clone = Clone(data)
    states = torch.from_numpy(np.concatenate([data.columns[k] for k in KEYS[:-1] if k in data.columns], axis=1))
    last = np.repeat(data.episode_stop, data.episode_stop - data.episode_start) - 1
    frames = np.minimum(np.arange(len(last))[:, None] + np.arange(CHUNK), last[:, None])  # the last action is repeated
    actions = torch.from_numpy(data.columns["action"][frames])
    optimizer = torch.optim.AdamW(clone.parameters(), lr=1e-3, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-3, total_steps=steps)
    for _ in range(steps):
        batch = torch.randint(len(states), (512,))
        loss = (clone(states[batch]) - actions[batch]).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    print(f"{len(states)} frames, {steps} steps: mean error of an action {loss.item():.3f}")
    return clone.eval()


def player(clone: Clone) -> Callable[[int], Callable[[Any], Any]]:
    """Return what makes a policy for an episode: it plays the beginning of a chunk, then asks for the next."""

    def start(seed: int) -> Callable[[Any], Any]:
        queue: list[Any] = []

        def act(state: Any) -> Any:
            if not queue:
                with torch.no_grad():
                    queue.extend(clone(torch.from_numpy(state)[None])[0, :PLAYED].clamp(-1.0, 1.0).numpy())
            return queue.pop(0)

        return act

    return start


def successes(env: gym.Env, policy: Callable[[int], Callable[[Any], Any]], episodes: int, seed: int) -> int:
    """Play episodes; return how many ended in success."""
    count = 0
    for episode in range(seed, seed + episodes):
        (state, info), done = env.reset(seed=episode), False
        act = policy(episode)
        while not done:
            state, _, terminated, truncated, info = env.step(act(state))
            done = terminated or truncated
        count += bool(info["is_success"])
    return count


def test_final(data: Dataset, script: int, clone: int, short: bool) -> None:
    """The script succeeds, and the network, given enough of it to learn from, in half of the episodes."""
    assert data.columns["next.success"][data.episode_stop - 1].mean() >= 0.5
    assert script > 0
    assert short or clone > 0.5 * script


def main() -> None:
    """Record, learn, evaluate."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="softmode/LiftSoft-v0", choices=softmode.ENVIRONMENTS)
    parser.add_argument("--demonstrations", type=int, default=100)
    parser.add_argument("--episodes", type=int, default=50, help="episodes of the evaluation")
    parser.add_argument("--noise", type=float, default=NOISE, help="while recording")
    parser.add_argument("--short", action="store_true", help="two demonstrations, one episode")
    args = parser.parse_args()
    demonstrations, episodes, steps = (2, 1, 50) if args.short else (args.demonstrations, args.episodes, 10_000)
    env, out, name = gym.make(args.env), Path("out", "behaviour_cloning"), softmode.ENVIRONMENTS[args.env]
    script = policy_factory("scripted", env)
    with DatasetWriter(out, environment_features(env), fps=env.metadata["render_fps"], append=True) as writer:
        if (missing := demonstrations - writer.episode_count) > 0:  # an interrupted run goes on
            seed = writer.episode_count
            record_episodes(env, script, writer, episodes=missing, task=name, seed=seed, noise=args.noise)
    data = read_dataset(out)
    clone = player(train(data, steps))
    count = {name: successes(env, p, episodes, seed=1_000_000) for name, p in (("script", script), ("clone", clone))}
    print(f"{args.env}, {demonstrations} demonstrations, successes in {episodes} unseen episodes: {count}")
    test_final(data, count["script"], count["clone"], args.short)


if __name__ == "__main__":
    main()
