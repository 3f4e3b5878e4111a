"""Behaviour cloning: an actor that acts as demonstrations show, as a checkpoint like those of training runs."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from numpy.typing import NDArray

from softmode.checks import require_number
from softmode.errors import ConfigError, needs_extra

with needs_extra("rl", "cloning needs torch"):
    import torch

from softmode.learning.checkpoints import Checkpoint
from softmode.learning.config_values import pinned_options
from softmode.learning.distributed import Ranks, local_device
from softmode.learning.hyperparameters import Hyperparameters
from softmode.learning.networks import Actor
from softmode.learning.spaces import Interface
from softmode.learning.vector_tensors import action_range

ACTOR = Hyperparameters(initial_std=0.1)
"""Widths of an actor that is cloned, and the noise with which it goes on learning."""


def clone(
    env: gym.Env,
    env_options: dict[str, Any],
    observation: dict[str, NDArray[Any]],
    action: NDArray[Any],
    *,
    steps: int = 10_000,
    batch: int = 1024,
    hyperparameters: Hyperparameters = ACTOR,
    seed: int = 0,
    device: str = "cpu",
) -> Checkpoint:
    """Fit an actor to what was done in states; `write_checkpoint` makes it a policy to play, export, and train on.

    The loss is the squared error of the actions as they are played: where one lies at a bound, the mean may lie beyond
    it. The mean of steps that wait for what is not observed moves on; their median would wait for ever.

    Args:
        env: The environment.
        env_options: Keyword arguments as JSON values that it was made with.
        observation: Vectors by the keys of `Interface`, each of shape (frames, size).
        action: What was done there, shape (frames, action).
        steps: Steps of the optimizer, whose rate rises and falls once.
        batch: Frames of a step.
        hyperparameters: Widths of the actor, and the noise that a training begins with.
        seed: Of weights and batches.
        device: Where it computes.

    Raises:
        ConfigError: If these are not the observations and actions of the environment, or it has pictures.
    """
    interface, where = Interface.of(env), local_device(device)
    sizes = {key: value.shape[1] for key, value in observation.items()}
    if interface.pictures or sizes != interface.vectors or action.shape[1:] != (interface.action_size,):
        raise ConfigError(
            f"{sizes} and actions {action.shape[1:]} are not of {interface}", hint="clone states, of the same options"
        )
    require_number("steps", steps, at_least=1, hint="give a count like 1e4")
    torch.manual_seed(seed)
    loss = torch.zeros(())
    actor = Actor(interface, hyperparameters).to(where)
    seen = {key: torch.from_numpy(value).to(where, torch.float32) for key, value in observation.items()}
    middle, half = action_range(interface, where)
    shown = ((torch.from_numpy(action).to(where, torch.float32) - middle) / half).clamp(-1.0, 1.0)
    for key, value in seen.items():
        actor.encoder.moments[key].update(value, Ranks())  # type: ignore[operator]
    with torch.no_grad():
        encoded = actor.encoder(seen)
    optimizer = torch.optim.AdamW(actor.mean.parameters(), lr=1e-3, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-3, total_steps=steps)
    for _ in range(steps):
        chosen = torch.randint(len(shown), (batch,), device=where)
        mean, wanted = actor.mean(encoded[chosen]), shown[chosen]
        beyond = (wanted.abs() >= 1.0) & (mean * wanted > 1.0)
        loss = torch.where(beyond, 0.0, mean - wanted).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    assert env.spec is not None
    return Checkpoint(
        env=env.spec.id,
        env_options=pinned_options(env.spec.id, env_options),
        interface=interface,
        privileged=0,
        hyperparameters=hyperparameters,
        progress={"frames": len(shown), "steps": steps, "loss": loss.item()},
        arrays={f"actor.{name}": value.cpu().numpy() for name, value in actor.state_dict().items()},
    )
