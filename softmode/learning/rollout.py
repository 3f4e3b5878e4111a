"""Rollouts: what all worlds went through between two updates, and statistics of the episodes that ended."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from softmode.learning.distributed import Ranks
from softmode.learning.moments import RunningMoments
from softmode.learning.networks import PRIVILEGED, ActorCritic, Observation
from softmode.learning.vector_tensors import Step, TensorVectorEnv


class Rollout:
    """Transitions of all worlds, time first.

    ``observation[key]`` has shape (steps + 1, n, ...), the rest (steps, n, ...). Transitions that only reset a world
    (NEXT_STEP) have ``valid`` 0.
    """

    def __init__(self, steps: int, first: Observation, action_size: int, same_step: bool) -> None:
        """Allocate for observations like ``first``."""
        some = next(iter(first.values()))
        count, device = len(some), some.device
        self.steps, self.count = steps, count
        self.observation = {
            key: torch.empty((steps + 1, *value.shape), dtype=value.dtype, device=device)
            for key, value in first.items()
        }
        self.sample = torch.zeros(steps, count, action_size, device=device)
        self.mean = torch.zeros(steps, count, action_size, device=device)
        self.log_std = torch.zeros(action_size, device=device)
        self.reward = torch.zeros(steps, count, device=device)
        self.terminated = torch.zeros(steps, count, dtype=torch.bool, device=device)
        self.truncated = torch.zeros(steps, count, dtype=torch.bool, device=device)
        self.valid = torch.ones(steps, count, device=device)
        self.final_value = torch.zeros(steps, count, device=device) if same_step else None

    def store_observation(self, t: int, observation: Observation) -> None:
        """Store what is seen before step ``t``."""
        for key, value in observation.items():
            self.observation[key][t].copy_(value)

    def flat(self, index: Tensor) -> Observation:
        """Return the observations of the transitions ``index`` (into steps times worlds)."""
        return {key: value[:-1].flatten(0, 1)[index] for key, value in self.observation.items()}


class EpisodeStatistics:
    """Sums over the episodes that ended and over steps, kept on the device until they are read."""

    def __init__(self, count: int, device: torch.device) -> None:
        """Start all worlds' episodes."""
        self.episode_return = torch.zeros(count, device=device)
        self.episode_length = torch.zeros(count, device=device)
        self.sums = torch.zeros(5, device=device)  # episodes, returns, lengths, successes, valid steps
        self.term_sums: dict[str, Tensor] = {}
        self.knows_success = False

    def add(self, step: Step, valid: Tensor) -> None:
        """Count a step of all worlds; ``valid`` is 0 where it only reset a world."""
        done = (step.terminated | step.truncated).float()
        self.episode_return += step.reward * valid
        self.episode_length += valid
        success = torch.zeros_like(done) if step.success is None else step.success
        self.knows_success |= step.success is not None
        ended = torch.stack([torch.ones_like(done), self.episode_return, self.episode_length, success])
        self.sums += torch.cat([(ended * done).sum(1), valid.sum()[None]])
        self.episode_return *= 1.0 - done
        self.episode_length *= 1.0 - done
        for name, value in step.terms.items():
            if name not in self.term_sums:
                self.term_sums[name] = torch.zeros((), device=done.device)
            self.term_sums[name] += (value * valid).sum()

    def take(self) -> Tensor:
        """Return the sums, terms of the reward behind the first five, and start again."""
        taken = torch.cat([self.sums, *(value[None] for value in self.term_sums.values())])
        self.sums.zero_()
        for value in self.term_sums.values():
            value.zero_()
        return taken


class Collector:
    """Steps all worlds with the policy.

    Args:
        env: The worlds.
        model: Actor and critic.
        first: Observation after the reset of all worlds.
        steps: Steps of a rollout.
        discount: Discount of the return whose spread scales rewards.
    """

    def __init__(
        self, env: TensorVectorEnv, model: ActorCritic, first: Observation, steps: int, discount: float
    ) -> None:
        """Allocate a rollout."""
        self.env, self.model, self.discount = env, model, discount
        self.observation = self._seen(first)
        self.rollout = Rollout(steps, self.observation, env.interface.action_size, env.same_step)
        self.statistics = EpisodeStatistics(env.count, env.device)
        self.discounted = torch.zeros(env.count, device=env.device)
        self.returns = torch.zeros(steps, env.count, device=env.device)
        self._done = torch.zeros(env.count, dtype=torch.bool, device=env.device)
        self._turn = self._turns = 0

    def stagger(self, limit: int) -> None:
        """Reset each world once, evenly over the next ``limit`` steps: all parts of episodes are there at once then."""
        self._turn, self._turns = 0, limit

    def _reset_some(self) -> None:
        """Reset the worlds whose turn it is."""
        mask = (np.arange(self.env.count) * self._turns // self.env.count) == self._turn
        self._turn += 1
        if self._turn == 1 or not mask.any():  # the first ones were just reset
            return
        self.observation = self._seen(self.env.reset_some(mask))
        where = torch.from_numpy(mask).to(self.env.device)
        self._done &= ~where
        for running in (self.discounted, self.statistics.episode_return, self.statistics.episode_length):
            running.masked_fill_(where, 0.0)

    def _seen(self, observation: Observation) -> Observation:
        """Return the observation, the full state beside it where there is one that the critic reads."""
        reads = self.model.critic.reads_state and bool(self.model.actor.encoder.pictures)
        state = self.env.privileged() if reads else None
        return observation if state is None else {**observation, PRIVILEGED: state}

    @torch.no_grad()
    def collect(self, generator: torch.Generator) -> Rollout:
        """Fill the rollout and return it; it is overwritten by the next call."""
        actor, rollout = self.model.actor, self.rollout
        rollout.log_std.copy_(actor.log_std)
        std = actor.log_std.exp()
        for t in range(rollout.steps):
            if self._turn < self._turns:
                self._reset_some()
            rollout.store_observation(t, self.observation)
            mean = rollout.mean[t]
            mean.copy_(actor.mean(actor.encoder(self.observation)))
            noise = torch.randn(mean.shape, generator=generator, device=mean.device)
            torch.addcmul(mean, std, noise, out=rollout.sample[t])
            step = self.env.step(actor.to_action(rollout.sample[t]))
            done = step.terminated | step.truncated
            valid = rollout.valid[t]
            if not self.env.same_step:
                valid.copy_(~self._done)  # after an end this step only reset the world
            rollout.reward[t] = step.reward
            rollout.terminated[t] = step.terminated
            rollout.truncated[t] = step.truncated
            if rollout.final_value is not None and step.final is not None:
                rollout.final_value[t] = self.model.values(step.final)
            self.discounted.mul_(self.discount).add_(step.reward)
            self.returns[t] = self.discounted
            self.discounted *= (~done).float()
            self.statistics.add(step, valid)
            self._done = done
            self.observation = self._seen(step.observation)
        rollout.store_observation(rollout.steps, self.observation)
        return rollout

    def update_moments(self, reward_moments: RunningMoments, ranks: Ranks) -> None:
        """Merge the last rollout into the moments of observations and discounted returns."""
        encoders = [self.model.actor.encoder]
        if self.model.critic.reads_state:
            encoders.append(self.model.critic.encoder)
        for encoder in encoders:
            for key, moments in encoder.moments.items():
                moments.update(self.rollout.observation[key][:-1].flatten(0, 1), ranks)  # type: ignore[operator]
        reward_moments.update(self.returns.flatten(), ranks, self.rollout.valid.flatten())


def generalized_advantage(
    reward: Tensor, value: Tensor, next_value: Tensor, terminated: Tensor, done: Tensor, discount: float, decay: float
) -> Tensor:
    """Return advantages by generalised advantage estimation (Schulman et al. 2016, equation 16).

    A terminated episode has no value beyond its end; a truncated one has that of its last state, so ``next_value`` must
    be the value of the state that the step led to, not of the state after a reset.

    Args:
        reward: Rewards, shape (steps, n).
        value: Values of the states acted in, shape (steps, n).
        next_value: Values of the states arrived at, shape (steps, n).
        terminated: Whether the episode terminated, shape (steps, n).
        done: Whether it terminated or was truncated, shape (steps, n).
        discount: Discount per step.
        decay: Decay lambda.
    """
    delta = reward + discount * next_value * (~terminated).to(value.dtype) - value
    keep = discount * decay * (~done).to(value.dtype)
    advantage = torch.empty_like(delta)
    running = torch.zeros_like(delta[0])
    for t in range(len(delta) - 1, -1, -1):
        running = delta[t] + keep[t] * running
        advantage[t] = running
    return advantage
