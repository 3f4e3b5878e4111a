"""Trained policies: loading them from a file, and how often they succeed."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
from softmode.learning.networks import Actor, Observation
from softmode.learning.run_folder import checkpoint_in
from softmode.learning.spaces import Interface
from softmode.learning.vector_tensors import TensorVectorEnv, action_range, tensors_of
from softmode.stages import stage

EVALUATION_SEED = 1_000_000_000
"""First seed of evaluation episodes; training draws its seeds below."""
SELECTION_SEED = 1_500_000_000
"""First seed of the episodes by which a run chooses its best checkpoint."""


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

    def act(self, observation: Observation) -> torch.Tensor:
        """Return actions in the environment's range, shape (n, action), for tensors of the interface."""
        return self._center + self._half * self.actor(observation)

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
        action = self.act(tensors)
        action = action[0] if single else action
        given = next(iter(observation.values())) if isinstance(observation, dict) else observation
        return action if isinstance(given, torch.Tensor) else action.cpu().numpy()


def load_policy(path: str | os.PathLike[str], device: str = "cpu") -> Policy:
    """Load a policy from a checkpoint of a run.

    Files of its environment's objects are found again by their fingerprints: where they were, beside the checkpoint, or
    in the working folder.

    Args:
        path: The file, or the folder of the run, whose best one it is then.
        device: Where the policy computes, for example cpu or cuda:0.

    Raises:
        CheckpointError: If the file is missing, damaged, foreign, or of another version.
        ConfigError: If the device is not there.
    """
    path = checkpoint_in(Path(path))
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
    failed_seeds: tuple[int, ...] = ()
    """Seeds of the episodes without success, as far as they were the first ones of their worlds."""

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


class Outcomes(NamedTuple):
    """What came of episodes, each of shape (episodes,)."""

    returns: Any
    """Undiscounted returns."""
    lengths: Any
    """Control steps."""
    seeds: Any
    """Seeds; -1 where an episode was not the first one of its world."""
    successes: Any
    """Whether each ended in success; none where the environment does not tell."""
    safe: Any
    """The same within the limits of force and strain."""


def evaluate(
    env: gym.Env | gym.vector.VectorEnv,
    policy: Callable[[Any], Any],
    episodes: int = 200,
    *,
    seed: int = EVALUATION_SEED,
    device: str | torch.device = "cpu",
) -> Evaluation:
    """Play whole episodes and count; arguments and errors are those of :func:`played`."""
    return summary([played(env, policy, episodes, seed=seed, device=device)])


@torch.no_grad()
@stage("playing episodes")
def played(
    env: gym.Env | gym.vector.VectorEnv,
    policy: Callable[[Any], Any],
    episodes: int = 200,
    *,
    seed: int = EVALUATION_SEED,
    device: str | torch.device = "cpu",
) -> Outcomes:
    """Play whole episodes.

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
        return _played_in_worlds(env, policy, episodes, seed, torch.device(device))
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
    return Outcomes(np.array(returns), np.array(lengths), np.arange(seed, seed + episodes), *known)


def _played_in_worlds(
    env: gym.vector.VectorEnv, policy: Callable[[Any], Any], episodes: int, seed: int, device: torch.device
) -> Outcomes:
    worlds = TensorVectorEnv(env, device)
    n = worlds.count
    # The first worlds play one episode more than the last where the number does not divide.
    quota = torch.tensor([episodes // n + (i < episodes % n) for i in range(n)], device=device)
    played = torch.zeros_like(quota)
    sums = torch.zeros(3, n, device=device)  # running return, length of this episode; unused in the last row
    ended: list[torch.Tensor] = []
    observation, _ = env.reset(seed=seed)
    just_reset = torch.zeros(n, dtype=torch.bool, device=device)
    own = torch.arange(1.0, n + 1.0, device=device)  # number of the world, which its first episode tells
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
        ended.append(torch.stack([counted.float(), sums[0], sums[1], *known, (played == 0).float() * own]))
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
    firsts = table[:, 5].astype(np.int64)
    return Outcomes(table[:, 1], table[:, 2], np.where(firsts > 0, seed - 1 + firsts, -1), successes, safe)


def summary(parts: Sequence[Sequence[Any]]) -> Evaluation:
    """Return the figures of episodes that were played in parts, each the columns of `Outcomes`."""
    columns = [None if column[0] is None else np.concatenate(column) for column in zip(*parts, strict=True)]
    returns, lengths, seeds, successes, safe = columns
    assert returns is not None and lengths is not None and seeds is not None
    failed = () if successes is None else np.sort(seeds[(successes == 0.0) & (seeds >= 0)]).tolist()
    return Evaluation(
        failed_seeds=tuple(failed),
        safe_success_rate=None if safe is None else float(np.mean(safe)),
        episodes=len(returns),
        success_rate=None if successes is None else float(np.mean(successes)),
        mean_return=float(np.mean(returns)),
        std_return=float(np.std(returns)),
        mean_length=float(np.mean(lengths)),
    )


def film_episode(policy: Policy, seed: int, path: Path) -> Path:
    """Film an episode that a policy plays; return the path.

    Args:
        policy: The policy, whose environment is made for it.
        seed: Seed of the reset.
        path: The video (.mp4).

    Raises:
        MissingExtraError: If what encodes it is not installed.
        StorageError: If it cannot be written.
    """
    from softmode.viz.film import Film

    with Film(path) as film:
        env = policy.make(render_mode="rgb_array")
        try:
            observation, _ = env.reset(seed=seed)
            done = False
            while not done:
                observation, _, terminated, truncated, _ = env.step(policy(observation))
                done = terminated or truncated
                film.add(np.asarray(env.render()), env.metadata["render_fps"])
        finally:
            env.close()
        film.publish()
    return path
