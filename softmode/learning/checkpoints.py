"""Checkpoint files: one .npz without pickle, arrays by name and everything else in a JSON header."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from softmode import __version__
from softmode.errors import CheckpointError
from softmode.files import damage_errors, read_archive, write_archive
from softmode.learning.hyperparameters import Hyperparameters
from softmode.learning.spaces import Interface

FORMAT = "softmode.Checkpoint"
FORMAT_VERSION = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A policy and, unless it was exported without, what training goes on from."""

    env: str
    """Id of the environment."""
    env_options: dict[str, Any]
    """Keyword arguments that it was made with."""
    interface: Interface
    """Spaces of the environment."""
    privileged: int
    """Length of the full state that the critic reads, 0 if it reads what the actor sees."""
    hyperparameters: Hyperparameters
    """Hyperparameters of the run."""
    progress: dict[str, Any]
    """Counters of the run: iteration, env_steps, seconds, seed, best and others."""
    arrays: dict[str, NDArray[Any]]
    """Arrays by name: ``actor.*``, ``critic.*``, ``predict.*``, ``optimizer.*``, ``reward.*``."""

    def part(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return the arrays below a prefix, without it."""
        return {name[len(prefix) + 1 :]: a for name, a in self.arrays.items() if name.startswith(prefix + ".")}


def write_checkpoint(checkpoint: Checkpoint, path: str | os.PathLike[str]) -> None:
    """Write a checkpoint; the file appears complete or not at all.

    Args:
        checkpoint: What to write.
        path: The file.

    Raises:
        StorageError: If it cannot be written; what was there before stays.
    """
    said = dataclasses.asdict(dataclasses.replace(checkpoint, arrays={})) | {"arrays": sorted(checkpoint.arrays)}
    header = {"format": FORMAT, "version": FORMAT_VERSION, "softmode": __version__, **said}
    write_archive(path, header, checkpoint.arrays, "checkpoint")


def policy_only(checkpoint: Checkpoint) -> Checkpoint:
    """Return the policy of a checkpoint without what only training needs: optimizer, critic and scale of rewards."""
    arrays = {name: array for name, array in checkpoint.arrays.items() if name.startswith("actor.")}
    return dataclasses.replace(checkpoint, arrays=arrays)


def read_checkpoint(path: str | os.PathLike[str]) -> Checkpoint:
    """Read a file that :func:`write_checkpoint` wrote. No code in it is ever run.

    Raises:
        CheckpointError: If the file is missing, damaged, foreign, or of another version.
    """
    hint = "give the policy.npz, best.npz or latest.npz of a run of this version of softmode"
    if os.fspath(path).endswith(".onnx"):
        raise CheckpointError(f"{path} is an ONNX graph, which softmode does not play", hint=hint)
    header, stored = read_archive(path, FORMAT, FORMAT_VERSION, what="checkpoint", hint=hint, error=CheckpointError)
    with damage_errors(f"checkpoint {path}", hint=hint, error=CheckpointError):
        if header["arrays"] != sorted(stored):
            raise ValueError("arrays are missing or were added")
        progress, privileged = header["progress"], header["privileged"]
        env_options = header["env_options"]
        if not (isinstance(progress, dict) and isinstance(env_options, dict) and isinstance(header["env"], str)):
            raise TypeError("a field has another type")
        if not isinstance(privileged, int) or isinstance(privileged, bool) or not 0 <= privileged < 2**31:
            raise TypeError("privileged is no length")
        for name, array in stored.items():
            if not np.all(np.isfinite(array)):
                raise ValueError(f"{name} is not finite")
        interface = Interface.from_json(header["interface"])
        hyperparameters = Hyperparameters.from_json(header["hyperparameters"])
        said = {name: header[name] for name in ("env", "env_options", "privileged", "progress")}
        return Checkpoint(**said, interface=interface, hyperparameters=hyperparameters, arrays=stored)


def same_env(one: str, other: str) -> bool:
    """Return whether two names are of one id; the module in front of a colon only says who registers it."""
    return one.rpartition(":")[2] == other.rpartition(":")[2]


def check_id(trained: str, path: object, env: str) -> None:
    """Refuse a policy of another environment, or of another version of it.

    Raises:
        CheckpointError: If it is one.
    """
    if not same_env(trained, env):
        there = trained.rpartition(":")[2] in gym.registry
        hint = f"play {trained}" if there else f"train anew: this version of softmode has no {trained}"
        raise CheckpointError(f"checkpoint {path} is of {trained}, not of {env}", hint=hint)


def check_env(checkpoint: Checkpoint, path: object, env: str | None, interface: Interface) -> None:
    """Refuse a checkpoint of another environment or other spaces.

    Raises:
        CheckpointError: If it is one.
    """
    if env is not None:
        check_id(checkpoint.env, path, env)
    if checkpoint.interface != interface:
        raise CheckpointError(
            f"checkpoint {path} was trained with other spaces: {_describe(checkpoint.interface)}, "
            f"the environment has {_describe(interface)}",
            hint="use the obs_type, action type and picture size of its run, see config.json there",
        )


def _describe(interface: Interface) -> str:
    seen = interface.vectors | interface.pictures
    return f"observation {seen}, action {interface.action_size} in {interface.action_low} to {interface.action_high}"
