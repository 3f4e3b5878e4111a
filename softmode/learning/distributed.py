"""The ranks of a run: one process, or several started by torchrun."""

from __future__ import annotations

import dataclasses
import os

import torch
import torch.distributed as dist

from softmode.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Ranks:
    """Which of how many processes this is, and what they exchange.

    With one process every method returns its argument.
    """

    rank: int = 0
    count: int = 1

    @staticmethod
    def start(device: torch.device) -> Ranks:
        """Join the processes that torchrun started (NCCL on CUDA, gloo on CPU); alone without torchrun.

        Raises:
            ConfigError: If the variables of torchrun are inconsistent or the backend is not there.
        """
        count = int(os.environ.get("WORLD_SIZE", "1"))
        if count == 1:
            return Ranks()
        if not dist.is_available():
            raise ConfigError("this torch has no torch.distributed", hint="run without torchrun")
        if not dist.is_initialized():
            cuda = device.type == "cuda"
            dist.init_process_group("nccl" if cuda else "gloo", device_id=device if cuda else None)
        return Ranks(dist.get_rank(), dist.get_world_size())

    def stop(self) -> None:
        """Leave the group."""
        if self.count > 1 and dist.is_initialized():
            dist.destroy_process_group()

    def mean(self, buffer: torch.Tensor) -> torch.Tensor:
        """Replace the buffer by its mean over ranks, the same bits on each; return it."""
        return self.sum(buffer).div_(self.count) if self.count > 1 else buffer

    def sum(self, buffer: torch.Tensor) -> torch.Tensor:
        """Replace the buffer by its sum over ranks, the same bits on each; return it."""
        if self.count > 1:
            dist.all_reduce(buffer)
        return buffer

    def gather(self, buffer: torch.Tensor) -> torch.Tensor:
        """Return the buffers of all ranks, shape (ranks, ...)."""
        if self.count == 1:
            return buffer[None]
        gathered = [torch.empty_like(buffer) for _ in range(self.count)]
        dist.all_gather(gathered, buffer.contiguous())
        return torch.stack(gathered)

    def barrier(self) -> None:
        """Wait for the others."""
        if self.count > 1:
            dist.barrier()


def local_device(name: str) -> torch.device:
    """Return the torch device; under torchrun ``cuda`` is the device of the local rank.

    Raises:
        ConfigError: If it is unknown or not there.
    """
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f"unknown device {name!r}", hint="use cpu or cuda:0") from error
    if device.type == "cpu":
        return torch.device("cpu")
    count = torch.cuda.device_count() if device.type == "cuda" else 0
    if "LOCAL_RANK" in os.environ and int(os.environ.get("WORLD_SIZE", "1")) > 1:
        index = int(os.environ["LOCAL_RANK"])
    else:
        index = device.index or 0
    if index >= count:
        known = ", ".join(["cpu", *(f"cuda:{i}" for i in range(count))])
        raise ConfigError(f"device {device.type}:{index} is not available", hint=f"use one of {known}")
    torch.cuda.set_device(index)
    return torch.device("cuda", index)
