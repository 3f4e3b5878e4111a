"""Proximal policy optimisation (Schulman et al. 2017): the update from a rollout."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from softmode.learning.distributed import Ranks
from softmode.learning.hyperparameters import Hyperparameters
from softmode.learning.moments import RunningMoments
from softmode.learning.networks import PRIVILEGED, Actor, ActorCritic
from softmode.learning.optimizer import FlatAdam
from softmode.learning.rollout import Rollout, generalized_advantage

MIN_LEARNING_RATE = 1e-5
STATE = "state"
"""Key of the observation of a policy on the state."""


class PPO:
    """Actor, critic and their optimizer.

    Args:
        model: Actor and critic.
        options: Hyperparameters.
        ranks: The processes that train together.
        teacher: An actor that sees the full state, whose actions attract those of the actor: imitation on the states
            that the learner itself visits (Ross et al. 2011), beside the policy gradient.
    """

    LOSSES = ("policy_loss", "value_loss", "entropy", "divergence", "gradient_norm", "clip_fraction", "prediction_loss")
    """What :meth:`update` returns the means of."""

    def __init__(
        self, model: ActorCritic, options: Hyperparameters, ranks: Ranks, teacher: Actor | None = None
    ) -> None:
        """Make the optimizer."""
        self.teacher = teacher
        self.model, self.options, self.ranks = model, options, ranks
        self.optimizer = FlatAdam(model.parameters(), options.learning_rate, options.max_gradient_norm)
        device = self.optimizer.value.device
        self.reward_moments = RunningMoments(()).to(device)

    def advantages(self, rollout: Rollout) -> tuple[Tensor, Tensor]:
        """Return advantages and values, shape (steps, n), in units of scaled rewards."""
        options = self.options
        flat = {key: observed.flatten(0, 1) for key, observed in rollout.observation.items()}
        values = self.model.values(flat).reshape(rollout.steps + 1, rollout.count)
        done = rollout.terminated | rollout.truncated
        next_value = values[1:]
        if rollout.final_value is not None:
            next_value = torch.where(done, rollout.final_value, next_value)
        reward = rollout.reward
        if options.scale_rewards:
            reward = reward / (self.reward_moments.variance + 1e-8).sqrt().float()
        advantage = generalized_advantage(
            reward, values[:-1], next_value, rollout.terminated, done, options.discount, options.gae_lambda
        )
        return advantage, values[:-1]

    def update(self, rollout: Rollout, generator: torch.Generator, progress: float, train_actor: bool) -> Tensor:
        """Improve actor and critic with a rollout; return means of :attr:`LOSSES` on the device.

        Args:
            rollout: What the policy went through.
            generator: Draws the minibatches.
            progress: How much of the run is over, 0 to 1.
            train_actor: Whether the actor learns, or the critic alone.
        """
        options, model, optimizer = self.options, self.model, self.optimizer
        advantage, value = self.advantages(rollout)
        target = advantage + value
        valid = rollout.valid
        # Statistics of the whole rollout, all ranks together; minibatches would each have their own.
        moments = torch.stack([valid.sum(), (advantage * valid).sum()])
        self.ranks.sum(moments)
        mean = moments[1] / moments[0]
        spread = self.ranks.sum(((advantage - mean).square() * valid).sum()[None])[0] / moments[0]
        advantage = (advantage - mean) / (spread.sqrt() + 1e-8)
        weight = valid * (valid.numel() * self.ranks.count / moments[0])
        old = _log_probability(rollout.sample, rollout.mean, rollout.log_std)
        columns = [x.flatten(0, 1) for x in (weight, advantage, value, target, old, rollout.sample, rollout.mean)]
        if options.schedule == "linear":
            optimizer.learning_rate.fill_(options.learning_rate * (1.0 - 0.95 * progress))
        sums = torch.zeros(len(self.LOSSES), device=value.device)
        total = rollout.steps * rollout.count
        for _ in range(options.epochs):
            order = torch.randperm(total, generator=generator, device=value.device)
            for index in order.chunk(options.minibatches):
                parts = [column[index] for column in columns]
                optimizer.zero()
                losses = self._losses(rollout, index, parts, progress, train_actor)
                divergence = optimizer.average(losses[3], self.ranks)
                if options.schedule == "adaptive" and train_actor:
                    optimizer.adapt(divergence, options.desired_kl, (MIN_LEARNING_RATE, options.max_learning_rate))
                losses[4] = optimizer.step()
                model.actor.bound_std(progress)
                sums += losses
        return sums / (options.epochs * min(options.minibatches, total))

    def _losses(
        self, rollout: Rollout, index: Tensor, parts: list[Tensor], progress: float, train_actor: bool
    ) -> Tensor:
        """Add the gradients of a minibatch; return its losses."""
        options, model = self.options, self.model
        weight, advantage, old_value, target, old, sample, old_mean = parts
        observation = rollout.flat(index)
        encoding = model.actor.encoder(observation)
        mean, log_std = model.actor.mean(encoding), model.actor.log_std
        log_ratio = _log_probability(sample, mean, log_std) - old
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1.0 - options.clip, 1.0 + options.clip)
        policy_loss = -(weight * torch.minimum(advantage * ratio, advantage * clipped)).mean()
        entropy = (log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
        value = model.critic(observation, encoding)
        error = (value - target).square()
        if options.clip_value is not None:
            near = old_value + (value - old_value).clamp(-options.clip_value, options.clip_value)
            error = torch.maximum(error, (near - target).square())
        value_loss = (weight * error).mean()
        loss = options.value_coefficient * value_loss
        if train_actor:
            loss = loss + policy_loss - options.entropy_coefficient * (1.0 - 0.9 * progress) * entropy
            if options.bound == "clamp" and options.bound_coefficient:
                outside = (mean.abs() - 1.0).clamp(min=0.0).square().sum(-1)
                loss = loss + options.bound_coefficient * (weight * outside).mean()
        if self.teacher is not None and train_actor:
            with torch.no_grad():
                shown = self.teacher.mean(self.teacher.encoder({STATE: observation[PRIVILEGED]})).clamp(-1.0, 1.0)
            apart = (mean - shown).square().sum(-1)
            loss = loss + options.teacher_coefficient * (1.0 - progress) * (weight * apart).mean()
        prediction_loss = torch.zeros_like(loss)
        if model.predict is not None:
            state = model.critic.encoder.moments[PRIVILEGED](observation[PRIVILEGED])
            prediction_loss = (weight[:, None] * (model.predict(encoding) - state).square()).mean()
            loss = loss + options.state_prediction_coefficient * prediction_loss
        loss.backward()
        with torch.no_grad():
            divergence = (weight * _divergence(old_mean, rollout.log_std, mean, log_std)).mean()
            far = (weight * ((ratio - 1.0).abs() > options.clip).float()).mean()
            zero = torch.zeros_like(loss)
            return torch.stack([policy_loss, value_loss, entropy, divergence, zero, far, prediction_loss]).detach()


def _log_probability(sample: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Return the log density of samples of a diagonal Gaussian; a squashing after it cancels in ratios."""
    scaled = (sample - mean) * (-log_std).exp()
    return -(0.5 * scaled.square() + log_std + 0.5 * math.log(2.0 * math.pi)).sum(-1)


def _divergence(mean: Tensor, log_std: Tensor, new_mean: Tensor, new_log_std: Tensor) -> Tensor:
    """Return the Kullback-Leibler divergence of the new from the old diagonal Gaussian."""
    square = (log_std.exp().square() + (mean - new_mean).square()) / (2.0 * new_log_std.exp().square())
    return (new_log_std - log_std + square - 0.5).sum(-1)
