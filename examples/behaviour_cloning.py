"""Behaviour cloning: record scripted demonstrations as a LeRobot dataset, learn them, count the successes.

A network maps the normalised state to the next few actions of the script (action chunking, Zhao et al. 2023); each is
played for a fraction of a second before the next are asked for. While recording, the robot is pushed off its way now
and then (DART, Laskey et al. 2017) and the script's corrections are what is learned; without that, errors add up.
Writes the dataset to out/behaviour_cloning; prints how often both succeed on unseen objects, and how often safely.

Needs the extras data and rl. Run: ``python examples/behaviour_cloning.py [--env ID] [--demonstrations N] [--short]``
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import nn

import softmode
from softmode.demonstrations import Dataset, DatasetWriter, environment_features, read_dataset, record_episodes
from softmode.learning import policy_factory

ORDER = ("observation", "achieved_goal", "desired_goal")  # of the parts where an environment has goals
CHUNK, PLAYED, NOISE = 8, 4, 0.3  # actions predicted at once, those of them played, pushes while recording


class Clone(nn.Module):
    """A network from states to chunks of actions, with the normalisation of its data."""

    def __init__(self, states: torch.Tensor, action_size: int) -> None:
        """Take mean and standard deviation from the states."""
        super().__init__()
        self.mean, self.scale = states.mean(dim=0), states.std(dim=0).clamp(min=1e-3)
        first, last = nn.Linear(len(self.mean), 512), nn.Linear(512, CHUNK * action_size)
        self.net = nn.Sequential(first, nn.GELU(), nn.Linear(512, 512), nn.GELU(), last)

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        """Return actions of shape (batch, CHUNK, D) for states of shape (batch, D)."""
        return self.net(((state - self.mean) / self.scale).clamp(-5.0, 5.0)).unflatten(1, (CHUNK, -1))

    def start(self, seed: int) -> Callable[[Any], Any]:
        """Return the policy for an episode: it plays the beginning of a chunk, then asks for the next."""
        self.queue: list[Any] = []
        return self.act

    def act(self, state: Any) -> Any:
        """Return the next action."""
        if not self.queue:
            with torch.no_grad():
                parts = [state[key] for key in ORDER] if isinstance(state, dict) else [state]
                seen = torch.from_numpy(np.concatenate(parts))[None]
                self.queue = list(self(seen)[0, :PLAYED].clamp(-1.0, 1.0).numpy())
        return self.queue.pop(0)


def train(data: Dataset, steps: int, seed: int = 0) -> Clone:
    """Fit a clone to the demonstrations; the absolute error keeps the script's abrupt actions sharp."""
    torch.manual_seed(seed)
    states = torch.from_numpy(np.concatenate(list(data.observations().values()), axis=1))
    last = np.repeat(data.episode_stop, data.episode_stop - data.episode_start) - 1
    frames = np.minimum(np.arange(len(last))[:, None] + np.arange(CHUNK), last[:, None])  # the last action is repeated
    actions = torch.from_numpy(data.columns["action"][frames])
    clone = Clone(states, actions.shape[2])
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


def successes(env: gym.Env, policy: Callable[[int], Callable[[Any], Any]], episodes: int, seed: int) -> tuple[int, int]:
    """Play episodes; return how many ended in success, and how many of them within the limits of force and strain."""
    count = safe = 0
    for episode in range(seed, seed + episodes):
        (state, info), act, done = env.reset(seed=episode), policy(episode), False
        while not done:
            state, _, *ended, info = env.step(act(state))
            done = any(ended)
        count, safe = count + bool(info["is_success"]), safe + bool(info["is_safe_success"])
    return count, safe


def test_final(data: Dataset, script: int, clone: int, short: bool) -> None:
    """The script succeeds, in part where a push hits its last steps; the network, given enough, half as often."""
    assert script > 0 and data.columns["next.success"][data.episode_stop - 1].mean() >= 0.25
    assert short or clone > 0.5 * script


def main() -> None:
    """Record, learn, evaluate."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="softmode/LiftSoft-v0", choices=softmode.ENVIRONMENTS)
    for name, count in (("--demonstrations", 100), ("--episodes", 50)):
        parser.add_argument(name, type=int, default=count)
    parser.add_argument("--short", action="store_true", help="two demonstrations, one episode")
    args = parser.parse_args()
    demonstrations, episodes, steps = (2, 1, 50) if args.short else (args.demonstrations, args.episodes, 4000)
    env, out = gym.make(args.env), Path("out", "behaviour_cloning", args.env.replace("/", "_"))
    script, task = policy_factory("scripted", env), softmode.ENVIRONMENTS[args.env]
    with DatasetWriter(out, environment_features(env), fps=env.metadata["render_fps"], append=True) as writer:
        if (have := writer.episode_count) < demonstrations:  # an interrupted run left some
            record_episodes(env, script, writer, episodes=demonstrations - have, task=task, seed=have, noise=NOISE)
    data = read_dataset(out)
    policies = (("script", script), ("clone", train(data, steps).start))
    count = {name: successes(env, policy, episodes, seed=1_000_000) for name, policy in policies}
    print(f"{args.env}, {data.episode_count} demonstrations; (successes, safe ones) of {episodes} episodes: {count}")
    test_final(data, count["script"][0], count["clone"][0], args.short)


if __name__ == "__main__":
    main()
