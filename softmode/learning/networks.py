"""Actor and critic: multilayer perceptrons over normalised vectors and the features of pictures."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import nn

from softmode.learning.hyperparameters import Hyperparameters
from softmode.learning.moments import RunningMoments
from softmode.learning.spaces import Interface

Observation = dict[str, torch.Tensor]
"""Tensors by key, worlds first: vectors float32 (n, size), pictures uint8 (n, height, width, channels)."""
PRIVILEGED = "privileged"
"""Key of the full state that only the critic reads."""
ACTIVATIONS = {"elu": nn.ELU, "tanh": nn.Tanh, "relu": nn.ReLU}


def _orthogonal(layer: nn.Linear | nn.Conv2d, gain: float) -> nn.Linear | nn.Conv2d:
    if not layer.weight.is_meta:
        nn.init.orthogonal_(layer.weight, gain)
        assert layer.bias is not None
        nn.init.zeros_(layer.bias)
    return layer


def mlp(inputs: int, hidden: tuple[int, ...], outputs: int, activation: str, output_gain: float) -> nn.Sequential:
    """Return a perceptron with orthogonal weights."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [_orthogonal(nn.Linear(inputs, width), math.sqrt(2.0)), ACTIVATIONS[activation]()]
        inputs = width
    return nn.Sequential(*layers, _orthogonal(nn.Linear(inputs, outputs), output_gain))


class _Residual(nn.Module):
    """x + conv(relu(conv(relu(x))))."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + self.second(torch.relu(self.first(torch.relu(x))))


class PictureEncoder(nn.Module):
    """Features of one picture.

    Args:
        shape: Height, width and channels of the picture.
        kind: nature (Mnih et al. 2015) or impala (the small network of Espeholt et al. 2018, 16-32-32 channels).
        features: Number of features.
        mixed_precision: Run in bfloat16 on CUDA.

    Raises:
        ValueError: If the picture is too small for the strides.
    """

    def __init__(self, shape: tuple[int, int, int], kind: str, features: int, mixed_precision: bool) -> None:
        """Build the layers."""
        super().__init__()
        height, width, channels = shape
        self.mixed_precision = mixed_precision
        if kind == "nature":
            sizes, layers = ((32, 8, 4), (64, 4, 2), (64, 3, 1)), []
            for out, kernel, stride in sizes:
                layers += [_orthogonal(nn.Conv2d(channels, out, kernel, stride), math.sqrt(2.0)), nn.ReLU()]
                height, width, channels = (height - kernel) // stride + 1, (width - kernel) // stride + 1, out
        else:
            layers = []
            for out in (16, 32, 32):
                layers += [nn.Conv2d(channels, out, 3, padding=1), nn.MaxPool2d(3, 2, padding=1)]
                layers += [_Residual(out), _Residual(out)]
                height, width, channels = (height + 1) // 2, (width + 1) // 2, out
            layers.append(nn.ReLU())
        if min(height, width) < 1:
            raise ValueError(f"pictures of {shape} are too small for the encoder {kind!r}")
        self.convolutions = nn.Sequential(*layers)
        self.project = _orthogonal(nn.Linear(height * width * channels, features), math.sqrt(2.0))
        self.norm = nn.LayerNorm(features)

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        """Return features in about -1 to 1, shape (n, features), of uint8 pictures (n, height, width, channels)."""
        cuda = picture.is_cuda and self.mixed_precision
        with torch.autocast(picture.device.type, torch.bfloat16, enabled=cuda):
            # A permuted (n, height, width, channels) array is what torch calls channels last.
            x = picture.permute(0, 3, 1, 2).to(torch.bfloat16 if cuda else torch.float32) / 255.0 - 0.5
            x = self.project(self.convolutions(x).flatten(1))
        return torch.tanh(self.norm(x.float()))


class Encoder(nn.Module):
    """Normalised vectors and features of pictures, joined in the order of their keys."""

    def __init__(self, interface: Interface, options: Hyperparameters) -> None:
        """Build one normaliser per vector and one encoder per kind of picture."""
        super().__init__()
        self.normalize = options.normalize_observations
        self.moments = nn.ModuleDict({key: RunningMoments((size,)) for key, size in sorted(interface.vectors.items())})
        pictures = {
            key: PictureEncoder(shape, options.encoder, options.features, options.mixed_precision)
            for key, shape in sorted(interface.pictures.items())
        }
        self.pictures = nn.ModuleDict(pictures)
        self.size = sum(interface.vectors.values()) + options.features * len(interface.pictures)

    def forward(self, observation: Observation) -> torch.Tensor:
        """Return the input of the perceptrons, shape (n, size)."""
        parts = [m(observation[k]) if self.normalize else observation[k] for k, m in self.moments.items()]
        return torch.cat([*parts, *(encoder(observation[key]) for key, encoder in self.pictures.items())], dim=-1)


class Actor(nn.Module):
    """A Gaussian over actions in units of half the action range, its mean a function of the observation."""

    def __init__(self, interface: Interface, options: Hyperparameters) -> None:
        """Build the encoder and the perceptron."""
        super().__init__()
        size = interface.action_size
        self.squash = options.bound == "tanh"
        stds = (options.min_std, options.max_std, options.final_std or options.max_std)
        self.log_std_bounds = [math.log(std) for std in stds]
        self.encoder = Encoder(interface, options)
        self.mean = mlp(self.encoder.size, options.hidden, size, options.activation, 0.01)
        self.log_std = nn.Parameter(torch.full((size,), math.log(options.initial_std)))

    @torch.no_grad()
    def bound_std(self, progress: float) -> None:
        """Bring the standard deviation back into its range; to be called after every step of the optimizer.

        Args:
            progress: How much of the run is over, 0 to 1.
        """
        low, high, last = self.log_std_bounds
        self.log_std.clamp_(low, high + progress * (last - high))

    def to_action(self, sample: torch.Tensor) -> torch.Tensor:
        """Return the action in [-1, 1] of a sample of the Gaussian."""
        return torch.tanh(sample) if self.squash else sample.clamp(-1.0, 1.0)

    def forward(self, observation: Observation) -> torch.Tensor:
        """Return the deterministic action in [-1, 1], shape (n, action)."""
        return self.to_action(self.mean(self.encoder(observation)))


class Critic(nn.Module):
    """The value of a state, from the full state where it is offered, else from what the actor sees.

    Args:
        interface: Spaces of the environment.
        privileged: Length of the full state, 0 where there is none.
        shared: Width of the actor's encoding, read where pictures are all there is.
        options: Widths.
    """

    def __init__(self, interface: Interface, privileged: int, shared: int, options: Hyperparameters) -> None:
        """Build the encoder and the perceptron."""
        super().__init__()
        self.reads_state = privileged > 0 or not interface.pictures
        if self.reads_state:
            vectors = {PRIVILEGED: privileged} if privileged else interface.vectors
            self.encoder = Encoder(dataclasses.replace(interface, vectors=vectors, pictures={}), options)
            shared = self.encoder.size
        self.value = mlp(shared, options.hidden, 1, options.activation, 1.0)

    def forward(self, observation: Observation, encoding: torch.Tensor | None) -> torch.Tensor:
        """Return the value, shape (n,).

        Args:
            observation: Tensors by key.
            encoding: What the actor's encoder gave; not read where the critic reads the state.
        """
        return self.value(self.encoder(observation) if self.reads_state else encoding)[..., 0]


class ActorCritic(nn.Module):
    """Actor, critic and, where pixels learn beside a full state, a head that predicts that state."""

    def __init__(self, interface: Interface, privileged: int, options: Hyperparameters) -> None:
        """Build both."""
        super().__init__()
        self.actor = Actor(interface, options)
        self.critic = Critic(interface, privileged, self.actor.encoder.size, options)
        predict = privileged and interface.pictures and options.state_prediction_coefficient > 0
        self.predict = _orthogonal(nn.Linear(self.actor.encoder.size, privileged), 1.0) if predict else None

    @torch.no_grad()
    def values(self, observation: Observation, chunk: int = 65536) -> torch.Tensor:
        """Return values of many observations, shape (n,), a chunk at a time."""
        count = len(next(iter(observation.values())))
        step = chunk if self.critic.reads_state else chunk // 8
        parts = []
        for i in range(0, count, step):
            part = {key: value[i : i + step] for key, value in observation.items()}
            parts.append(self.critic(part, None if self.critic.reads_state else self.actor.encoder(part)))
        return torch.cat(parts)
