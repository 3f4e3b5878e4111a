"""Running mean and variance of a stream of batches, on the device and over ranks."""

from __future__ import annotations

import torch
from torch import nn

from softmode.learning.distributed import Ranks


class RunningMoments(nn.Module):
    """Mean and variance of all samples seen so far.

    Batches are merged with the formula of Chan, Golub and LeVeque (1983), equation 2.1: in any order the same up to
    rounding.

    Args:
        shape: Shape of one sample.
    """

    mean: torch.Tensor
    variance: torch.Tensor
    count: torch.Tensor

    def __init__(self, shape: tuple[int, ...]) -> None:
        """Start with the standard normal, which the first batch replaces."""
        super().__init__()
        self.register_buffer("mean", torch.zeros(shape, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(shape, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, batch: torch.Tensor, ranks: Ranks, weight: torch.Tensor | None = None) -> None:
        """Merge the batches of all ranks.

        Args:
            batch: Samples, shape (n, ...).
            ranks: The ranks that merge.
            weight: 0 or 1 per sample, shape (n,); all count if omitted.
        """
        samples = batch.double()
        if weight is None:
            weight = torch.ones(len(samples), dtype=torch.float64, device=samples.device)
        weight = weight.double()
        count = weight.sum()
        column = weight.reshape(-1, *(1,) * (samples.ndim - 1))
        mean = (samples * column).sum(0) / count.clamp(min=1.0)
        scatter = ((samples - mean).square() * column).sum(0)
        packed = ranks.gather(torch.cat([count[None], mean.flatten(), scatter.flatten()]))
        size = mean.numel()
        for row in packed:
            self._merge(row[0], row[1 : 1 + size].reshape(mean.shape), row[1 + size :].reshape(mean.shape))

    def _merge(self, count: torch.Tensor, mean: torch.Tensor, scatter: torch.Tensor) -> None:
        total = (self.count + count).clamp(min=1.0)
        shift = mean - self.mean
        scatter = self.variance * self.count + scatter + shift.square() * (self.count * count / total)
        self.mean += shift * (count / total)
        # Before the first sample the variance stays one.
        self.variance.copy_(torch.where(self.count + count > 0, scatter / total, self.variance))
        self.count += count

    def forward(self, samples: torch.Tensor) -> torch.Tensor:
        """Return ``(samples - mean) / std``, clipped to ten; a constant component is divided by 1e-3."""
        std = (self.variance + 1e-6).sqrt().float()
        return ((samples - self.mean.float()) / std).clamp(-10.0, 10.0)
