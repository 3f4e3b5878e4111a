"""Adam on one flat buffer of parameters, its learning rate on the device."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import nn

from softmode.learning.distributed import Ranks


class FlatAdam:
    """Adam (Kingma and Ba 2015) on all parameters as one vector.

    Parameters and gradients become views of two flat buffers: a step is a dozen kernels whatever the number of layers,
    one all-reduce averages the gradients of all ranks, and nothing is read back by the host. A step whose gradient is
    not finite changes nothing and is counted in ``skipped``.

    Args:
        parameters: Parameters of a network, on one device.
        learning_rate: Learning rate at the start.
        max_norm: Gradients are shortened to this Euclidean norm.
    """

    BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8
    STATE = ("first", "second", "steps", "learning_rate")
    """Names of the tensors that a checkpoint keeps."""

    def __init__(self, parameters: Iterable[nn.Parameter], learning_rate: float, max_norm: float) -> None:
        """Move the parameters into the flat buffer."""
        listed = [parameter for parameter in parameters if parameter.requires_grad]
        size = sum(parameter.numel() for parameter in listed)
        device = listed[0].device
        self.max_norm = max_norm
        self.value = torch.empty(size, device=device)
        # One more element than parameters: the divergence of the policy travels with the gradients.
        self.buffer = torch.zeros(size + 1, device=device)
        self.gradient = self.buffer[:size]
        start = 0
        for parameter in listed:
            end = start + parameter.numel()
            self.value[start:end] = parameter.data.flatten()
            parameter.data = self.value[start:end].view(parameter.shape)
            parameter.grad = self.gradient[start:end].view(parameter.shape)
            start = end
        self.first = torch.zeros(size, device=device)
        self.second = torch.zeros(size, device=device)
        self.steps = torch.zeros((), device=device)
        self.learning_rate = torch.tensor(learning_rate, device=device)
        self.skipped = torch.zeros((), device=device)

    def zero(self) -> None:
        """Set the gradients to zero."""
        self.buffer.zero_()

    @torch.no_grad()
    def average(self, divergence: torch.Tensor, ranks: Ranks) -> torch.Tensor:
        """Average gradients and divergence over ranks; return the mean divergence."""
        self.buffer[-1] = divergence
        ranks.mean(self.buffer)
        return self.buffer[-1].clone()

    @torch.no_grad()
    def adapt(self, divergence: torch.Tensor, desired: float, bounds: tuple[float, float]) -> None:
        """Let the learning rate fall where the policy moved twice as far as desired, and rise where not half as far."""
        rate = self.learning_rate
        rate = torch.where(divergence > 2.0 * desired, rate / 1.5, rate)
        rate = torch.where((divergence < 0.5 * desired) & (divergence > 0.0), rate * 1.5, rate)
        self.learning_rate.copy_(rate.clamp(*bounds))

    @torch.no_grad()
    def step(self) -> torch.Tensor:
        """Take a step; return the norm of the gradient before it was shortened."""
        norm = torch.linalg.vector_norm(self.gradient)
        finite = torch.isfinite(norm)
        gradient = torch.where(finite, self.gradient * (self.max_norm / (norm + 1e-6)).clamp(max=1.0), 0.0)
        self.skipped += ~finite
        self.steps += finite
        self.first.lerp_(gradient, (1.0 - self.BETA1) * finite)
        self.second.lerp_(gradient.square(), (1.0 - self.BETA2) * finite)
        steps = self.steps.clamp(min=1.0)
        first = self.first / (1.0 - self.BETA1**steps)
        second = self.second / (1.0 - self.BETA2**steps)
        change = self.learning_rate * first / (second.sqrt() + self.EPSILON)
        self.value -= torch.where(finite, change, 0.0)
        return norm

    def restart(self, learning_rate: float) -> None:
        """Forget the gradients so far: a first one after many steps without any would lead several times too far."""
        for moment in (self.first, self.second, self.steps):
            moment.zero_()
        self.learning_rate.fill_(learning_rate)

    def state(self) -> dict[str, torch.Tensor]:
        """Return what a checkpoint keeps."""
        return {name: getattr(self, name) for name in self.STATE}

    @torch.no_grad()
    def load(self, state: dict[str, torch.Tensor]) -> None:
        """Take over what :meth:`state` returned.

        Raises:
            ValueError: If names or shapes differ.
        """
        for name in self.STATE:
            if name not in state or state[name].shape != getattr(self, name).shape:
                raise ValueError(f"optimizer state {name!r}")
        for name in self.STATE:
            getattr(self, name).copy_(state[name])
