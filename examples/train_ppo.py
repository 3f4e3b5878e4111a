"""Train a policy with PPO in one file, from the environment to the evaluation, to read from top to bottom.

Every world stays on its device: observations, rewards and ends are torch tensors, and the host looks at numbers once
per iteration. The worlds reset themselves (NEXT_STEP): the step after the end of an episode only resets, is left out of
the loss, and the last state of an episode is what its value is bootstrapped from if it was cut off by the time limit.
`softmode train` is the same with checkpoints, resumption, several GPUs and pixels.

Run: ``python examples/train_ppo.py --env softmode/LiftSoft-v0 --device cuda:0 --num-envs 4096`` or ``--short``
"""

import argparse
import time
from typing import Any, NamedTuple

import gymnasium as gym
import torch
from torch import nn

import softmode

DISCOUNT, DECAY, CLIP, DESIRED_KL, ENTROPY = 0.98, 0.95, 0.2, 0.01, 0.002
"""Discount and decay of the advantage per step, clip range of the ratio, divergence per update, entropy bonus."""


class Scale(nn.Module):
    """Running mean and variance of a vector."""

    def __init__(self, size: int) -> None:
        """Start with the standard normal."""
        super().__init__()
        self.mean, self.variance, self.count = torch.zeros(size), torch.ones(size), 1e-4

    def update(self, x: torch.Tensor) -> None:
        """Merge a batch (n, size)."""
        total = self.count + len(x)
        shift = x.mean(0) - self.mean
        scatter = self.variance * self.count + x.var(0, correction=0) * len(x) + shift**2 * self.count * len(x) / total
        self.mean, self.variance, self.count = self.mean + shift * len(x) / total, scatter / total, total

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the batch in units of the standard deviation."""
        return ((x - self.mean) / (self.variance + 1e-6).sqrt()).clamp(-10.0, 10.0)


class Agent(nn.Module):
    """A Gaussian policy and a value function."""

    def __init__(self, observed: int, acted: int) -> None:
        """Build two perceptrons; the policy starts near zero."""
        super().__init__()
        self.scale = Scale(observed)
        self.actor, self.critic = (
            nn.Sequential(nn.Linear(observed, 256), nn.ELU(), nn.Linear(256, 128), nn.ELU(), nn.Linear(128, out))
            for out in (acted, 1)
        )
        nn.init.normal_(self.actor[-1].weight, std=0.01)  # type: ignore[arg-type]
        self.log_std = nn.Parameter(torch.full((acted,), -0.5))

    def policy(self, x: torch.Tensor) -> torch.distributions.Normal:
        """Return the distribution of actions."""
        return torch.distributions.Normal(self.actor(self.scale(x)), self.log_std.clamp(-3.0, 0.0).exp())

    def value(self, x: torch.Tensor) -> torch.Tensor:
        """Return the value."""
        return self.critic(self.scale(x))[..., 0]


class Batch(NamedTuple):
    """A rollout, steps and worlds first."""

    observation: torch.Tensor
    action: torch.Tensor
    reward: torch.Tensor
    terminated: torch.Tensor
    done: torch.Tensor
    valid: torch.Tensor


class Worlds:
    """The environment as tensors, with the returns of the episodes that ended."""

    def __init__(self, name: str, count: int, device: torch.device, seed: int) -> None:
        """Make and reset the worlds."""
        own: dict[str, Any] = {"device": str(device), "output": "torch"} if name in softmode.ENVIRONMENTS else {}
        self.env, self.device = gym.make_vec(name, num_envs=count, **own), device
        self.low, self.high = (
            torch.as_tensor(bound, device=device)
            for bound in (self.env.single_action_space.low, self.env.single_action_space.high)  # type: ignore[attr-defined]
        )
        self.own, self.seen = bool(own), self.tensor(self.env.reset(seed=seed)[0])
        self.fresh = torch.zeros(count, dtype=torch.bool, device=device)
        self.running = torch.zeros(count, device=device)
        self.ended = torch.zeros(3, device=device)  # episodes, their returns, their successes

    def tensor(self, x: object) -> torch.Tensor:
        """Return an array or a tensor as float32 on the device."""
        return torch.as_tensor(x, device=self.device).float()

    def step(self, action: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Act in [-1, 1]; return reward, terminated, done, valid."""
        scaled = self.low + (self.high - self.low) * (action.clamp(-1.0, 1.0) + 1.0) / 2.0
        seen, reward, terminated, truncated, info = self.env.step(scaled if self.own else scaled.cpu().numpy())
        reward, terminated = self.tensor(reward), self.tensor(terminated).bool()
        done, valid = terminated | self.tensor(truncated).bool(), (~self.fresh).float()
        self.running += reward * valid
        success = self.tensor(info["is_success"]) if "is_success" in info else torch.zeros_like(reward)
        self.ended += torch.stack([done.float(), done * self.running, done * success]).sum(1)
        self.running *= (~done).float()
        self.seen, self.fresh = self.tensor(seen), done
        return reward, terminated, done, valid


@torch.no_grad()
def collect(worlds: Worlds, agent: Agent, steps: int) -> Batch:
    """Step all worlds with the policy."""
    rows = []
    for _ in range(steps):
        seen, action = worlds.seen, agent.policy(worlds.seen).sample()
        rows.append((seen, action, *worlds.step(action)))
    return Batch(*(torch.stack(column) for column in zip(*rows, strict=True)))


@torch.no_grad()
def advantages(agent: Agent, batch: Batch, last: torch.Tensor, spread: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Return advantages (generalised advantage estimation) and targets of the value, rewards in units of `spread`."""
    value = agent.value(torch.cat([batch.observation, last[None]]))
    alive, going = (~batch.terminated).float(), (~batch.done).float()
    delta = batch.reward / spread + DISCOUNT * value[1:] * alive - value[:-1]
    advantage, running = torch.empty_like(delta), torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        running = delta[t] + DISCOUNT * DECAY * going[t] * running
        advantage[t] = running
    return advantage, advantage + value[:-1]


def update(agent: Agent, adam: torch.optim.Adam, batch: Batch, advantage: torch.Tensor, target: torch.Tensor) -> None:
    """Improve the policy within its trust region, and the value."""
    weight = batch.valid / batch.valid.mean()
    mean = (advantage * weight).mean()
    advantage = (advantage - mean) / (((advantage - mean) ** 2 * weight).mean().sqrt() + 1e-8)
    with torch.no_grad():
        old = agent.policy(batch.observation)
        columns = [batch.observation, batch.action, weight, advantage, target, old.log_prob(batch.action).sum(-1)]
    columns = [column.flatten(0, 1) for column in (*columns, old.loc)]
    for _ in range(5):
        for index in torch.randperm(weight.numel(), device=weight.device).chunk(max(weight.numel() // 8192, 8)):
            seen, action, part, gain, wanted, log_old, center = (column[index] for column in columns)
            policy = agent.policy(seen)
            ratio = (policy.log_prob(action).sum(-1) - log_old).exp()
            surrogate = torch.minimum(gain * ratio, gain * ratio.clamp(1.0 - CLIP, 1.0 + CLIP))
            error = (agent.value(seen) - wanted) ** 2
            outside = ((policy.loc.abs() - 1.0).clamp(min=0.0) ** 2).sum(-1)
            loss = (part * (error - surrogate + 0.01 * outside)).mean() - ENTROPY * policy.entropy().sum(-1).mean()
            adam.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 1.0)
            adam.step()
    # The learning rate follows how far the policy moved; this is the one look of the host at the update.
    moved = float((0.5 * ((policy.loc - center) / policy.scale) ** 2).sum(-1).mean().detach())
    factor = 1.0 / 1.5 if moved > 2.0 * DESIRED_KL else 1.5 if moved < 0.5 * DESIRED_KL else 1.0
    adam.param_groups[0]["lr"] = min(max(adam.param_groups[0]["lr"] * factor, 1e-5), 3e-3)


def test_final(history: list[float]) -> None:
    """The return of episodes has grown: the mean of the last fifth beats that of the first."""
    part = max(len(history) // 5, 1)
    assert sum(history[-part:]) > sum(history[:part]), history


def main() -> None:
    """Train."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="softmode/LiftSoft-v0", help="any id with vectors as observations")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--steps", type=int, default=10_000_000, help="environment steps of all worlds together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--short", action="store_true", help="a few seconds on the pendulum")
    options = parser.parse_args()
    if options.short:
        options.env, options.num_envs, options.steps = "Pendulum-v1", 16, 45_000
    torch.manual_seed(options.seed)
    device = torch.device(options.device)
    worlds = Worlds(options.env, options.num_envs, device, options.seed)
    agent = Agent(worlds.seen.shape[1], len(worlds.low))
    agent.to(device)
    agent.scale.mean, agent.scale.variance = agent.scale.mean.to(device), agent.scale.variance.to(device)
    adam = torch.optim.Adam(agent.parameters(), lr=1e-3)
    length = max(2048 // options.num_envs, 16)
    spread, history, started = torch.ones((), device=device), [], time.perf_counter()
    for iteration in range(1, options.steps // (length * options.num_envs) + 1):
        batch = collect(worlds, agent, length)
        if iteration == 1:  # the first rollout tells the scales only
            agent.scale.update(batch.observation.flatten(0, 1))
            spread = batch.reward.std() / (1.0 - DISCOUNT) ** 0.5 + 1e-3
            continue
        update(agent, adam, batch, *advantages(agent, batch, worlds.seen, spread))
        agent.scale.update(batch.observation.flatten(0, 1))
        episodes, total, successes = worlds.ended.tolist()
        worlds.ended.zero_()
        if episodes:
            history.append(total / episodes)
            rate = iteration * length * options.num_envs / (time.perf_counter() - started)
            print(
                f"{iteration * length * options.num_envs:>10,} steps  {rate:>8,.0f}/s  return {history[-1]:9.2f}  "
                f"success {100.0 * successes / episodes:5.1f} %  std {float(agent.log_std.detach().exp().mean()):.2f}"
            )
    worlds.env.close()
    if options.short:
        test_final(history)


if __name__ == "__main__":
    main()
