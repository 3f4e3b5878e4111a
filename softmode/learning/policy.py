"""Trained policies: loading them from a file, and how often they succeed."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from softmode.checks import require_number
from softmode.errors import CheckpointError, ConfigError, needs_extra
from softmode.files import damage_errors

with needs_extra("rl", "trained policies need torch"):
    import torch

from softmode.learning.checkpoints import Checkpoint, check_env, read_checkpoint
from softmode.learning.config_values import located_options, with_config
from softmode.learning.distributed import local_device
from softmode.learning.intervals import wilson_interval
from softmode.learning.networks import Actor
from softmode.learning.spaces import Interface
from softmode.learning.vector_tensors import TensorVectorEnv, action_range, tensors_of
from softmode.stages import stage

EVALUATION_SEED = 1_000_000_000
"""First seed of evaluation episodes; training draws its seeds below."""


class Policy:
    """A deterministic policy: the mean of the trained Gaussian.

    Call it with the observation of a single environment or of a vector environment, arrays or tensors; it returns an
    action of the same kind in the environment's own range.

    Args:
        checkpoint: What to load; optimizer and critic are not read.
        device: Where it computes.
        path: Named in errors.

    Raises:
        CheckpointError: If arrays are missing or have other shapes than the header says.
    """

    def __init__(self, checkpoint: Checkpoint, device: torch.device, path: object = "") -> None:
        """Build the actor."""
        self.env = checkpoint.env
        self.env_options = checkpoint.env_options
        self.interface = checkpoint.interface
        self.checkpoint, self.device, self._path = checkpoint, device, path
        self.actor = actor_of(checkpoint, device, path)
        self._center, self._half = action_range(self.interface, device)

    def make(self, **options: Any) -> gym.Env:
        """Return the environment of the policy, with the options it was trained with and further ones.

        Raises:
            CheckpointError: If the environment is of a module that has not been imported: a checkpoint may come from
                anywhere, and to import a module runs it.
        """
        module = self.env.rpartition(":")[0]
        if module and module not in sys.modules:
            raise CheckpointError(
                f"the policy's environment {self.env} is of the module {module}", hint=f"import {module} first"
            )
        return gym.make(self.env, **with_config(self.env, {**self.env_options, **options}))

    def check(self, env: gym.Env | gym.vector.VectorEnv) -> None:
        """Refuse an environment other than the policy's.

        Raises:
            CheckpointError: If id or spaces differ.
        """
        spec = getattr(env, "spec", None)
        check_env(self.checkpoint, self._path, None if spec is None else spec.id, Interface.of(env))

    @torch.no_grad()
    def __call__(self, observation: Any) -> Any:
        """Return the action for one observation or a batch of them."""
        try:
            tensors = tensors_of(observation, self.interface, self.device)
        except KeyError as error:
            raise ConfigError(f"the observation has no {error}", hint="use the obs_type of the policy's run") from error
        shapes = {**{key: (size,) for key, size in self.interface.vectors.items()}, **self.interface.pictures}
        single = all(tensors[key].ndim == len(shape) for key, shape in shapes.items())
        if single:
            tensors = {key: value[None] for key, value in tensors.items()}
        for key, shape in shapes.items():
            if tuple(tensors[key].shape[1:]) != shape:
                raise ConfigError(
                    f"observation {key} has shape {tuple(tensors[key].shape)}, expected (n, *{shape}) or {shape}",
                    hint="use the obs_type of the policy's run",
                )
        action = self._center + self._half * self.actor(tensors)
        action = action[0] if single else action
        given = next(iter(observation.values())) if isinstance(observation, dict) else observation
        return action if isinstance(given, torch.Tensor) else action.cpu().numpy()


def load_policy(path: str | os.PathLike[str], device: str = "cpu") -> Policy:
    """Load a policy from a checkpoint of a run.

    Files of its environment's objects are found again by their fingerprints: where they were, beside the checkpoint, or
    in the working folder.

    Args:
        path: The file.
        device: Where the policy computes, for example cpu or cuda:0.

    Raises:
        CheckpointError: If the file is missing, damaged, foreign, or of another version.
        ConfigError: If the device is not there.
    """
    checkpoint = read_checkpoint(path)
    with damage_errors(f"checkpoint {path}: env_options", hint="use the file of another run", error=CheckpointError):
        options = located_options(checkpoint.env_options, Path(path).absolute().parent)
    return Policy(dataclasses.replace(checkpoint, env_options=options), local_device(device), path)


def actor_of(checkpoint: Checkpoint, device: torch.device, path: object = "") -> Actor:
    """Return the actor of a checkpoint.

    Raises:
        CheckpointError: If arrays are missing or have other shapes than the header says.
    """
    what = f"checkpoint {path} holds other arrays than its header says"
    with damage_errors(what, hint="use the file of another run", error=CheckpointError):
        with torch.device("meta"):  # takes no memory whatever the header says
            actor = Actor(checkpoint.interface, checkpoint.hyperparameters)
        arrays = {name: torch.from_numpy(array) for name, array in checkpoint.part("actor").items()}
        for name, value in actor.state_dict().items():
            if name in arrays and arrays[name].dtype != value.dtype:
                raise ValueError(f"{name} is {arrays[name].dtype}, not {value.dtype}")
        actor.load_state_dict(arrays, strict=True, assign=True)
    return actor.to(device).eval()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluation:
    """How a policy did over whole episodes."""

    episodes: int
    """Number of episodes."""
    success_rate: float | None
    """Share of episodes that ended in success; none where the environment does not tell."""
    mean_return: float
    """Mean undiscounted return."""
    std_return: float
    """Standard deviation of the return."""
    mean_length: float
    """Mean length [control steps]."""
    safe_success_rate: float | None = None
    """Share of episodes that ended in success within the limits of force and strain; none as above."""

    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the success rate (Wilson 1927)."""
        return wilson_interval((self.success_rate or 0.0) * self.episodes, self.episodes)

    def __str__(self) -> str:
        """Return one line for people."""
        line = f"{self.episodes} episodes: return {self.mean_return:.4g} +- {self.std_return:.3g}"
        line += f", length {self.mean_length:.1f}"
        if self.success_rate is None:
            return line
        low, high = self.interval()
        line = f"{line}, success {100 * self.success_rate:.1f} % (95 %: {100 * low:.1f} to {100 * high:.1f})"
        return line if self.safe_success_rate is None else f"{line}, safe success {100 * self.safe_success_rate:.1f} %"


@torch.no_grad()
@stage("playing episodes")
def evaluate(
    env: gym.Env | gym.vector.VectorEnv,
    policy: Callable[[Any], Any],
    episodes: int = 200,
    *,
    seed: int = EVALUATION_SEED,
    device: str | torch.device = "cpu",
) -> Evaluation:
    """Play whole episodes and count.

    Every world plays its share of the episodes, its first ones, however long the others' are: short episodes are not
    counted more often than long ones, as they would be if the first ``episodes`` to end were taken.

    Args:
        env: A single or a vector environment (NEXT_STEP or SAME_STEP).
        policy: Gives actions in the environment's own range, as :class:`Policy` does.
        episodes: Number of episodes.
        seed: Seed of the first world; the others' count up.
        device: Where a vector environment's tensors are.

    Raises:
        ConfigError: If ``episodes`` is not at least 1 or the worlds do not reset themselves.
    """
    require_number("episodes", episodes, at_least=1, hint="give a count like 200")
    if isinstance(env, gym.vector.VectorEnv):
        return _evaluate_vector(env, policy, episodes, seed, torch.device(device))
    returns, lengths, outcomes = [], [], []
    for k in range(episodes):
        observation, info = env.reset(seed=seed + k)
        total, length, done = 0.0, 0, False
        while not done:
            observation, reward, terminated, truncated, info = env.step(policy(observation))
            total, length, done = total + float(reward), length + 1, terminated or truncated
        returns.append(total)
        lengths.append(length)
        outcomes.append((info.get("is_success"), info.get("is_safe_success")))
    known = (np.array(column, float) if None not in column else None for column in zip(*outcomes, strict=True))
    return _summary(np.array(returns), np.array(lengths), *known)


def _evaluate_vector(
    env: gym.vector.VectorEnv, policy: Callable[[Any], Any], episodes: int, seed: int, device: torch.device
) -> Evaluation:
    worlds = TensorVectorEnv(env, device)
    n = worlds.count
    # The first worlds play one episode more than the last where the number does not divide.
    quota = torch.tensor([episodes // n + (i < episodes % n) for i in range(n)], device=device)
    played = torch.zeros_like(quota)
    sums = torch.zeros(3, n, device=device)  # running return, length of this episode; unused in the last row
    ended: list[torch.Tensor] = []
    observation, _ = env.reset(seed=seed)
    just_reset = torch.zeros(n, dtype=torch.bool, device=device)
    knows = [False, False]
    step_index = 0
    while True:
        step = worlds.step_raw(policy(observation))
        observation = step.raw
        done = step.terminated | step.truncated
        valid = torch.ones(n, device=device) if worlds.same_step else (~just_reset).float()
        sums[0] += step.reward * valid
        sums[1] += valid
        counted = done & (played < quota)
        known = [torch.zeros(n, device=device) if given is None else given for given in (step.success, step.safe)]
        knows = [k or given is not None for k, given in zip(knows, (step.success, step.safe), strict=True)]
        ended.append(torch.stack([counted.float(), sums[0], sums[1], *known]))
        played += counted
        sums *= (~done).float()
        just_reset = done
        step_index += 1
        # The host looks only now and then, so that the device is not kept waiting.
        if step_index % 16 == 0 and bool((played >= quota).all()):
            break
    table = torch.stack(ended).permute(0, 2, 1).flatten(0, 1).cpu().numpy()
    table = table[table[:, 0] > 0]
    successes, safe = (table[:, 3 + k] if told else None for k, told in enumerate(knows))
    return _summary(table[:, 1], table[:, 2], successes, safe)


def _summary(
    returns: np.ndarray, lengths: np.ndarray, successes: np.ndarray | None, safe: np.ndarray | None
) -> Evaluation:
    return Evaluation(
        safe_success_rate=None if safe is None else float(np.mean(safe)),
        episodes=len(returns),
        success_rate=None if successes is None else float(np.mean(successes)),
        mean_return=float(np.mean(returns)),
        std_return=float(np.std(returns)),
        mean_length=float(np.mean(lengths)),
    )
