"""What the adapters share: which environments they take, and infos world by world."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from softmode.errors import ConfigError, MissingExtraError
from softmode.vector_check.tensors import Tensor, host_array, map_tree


def missing(library: str, extra: str) -> MissingExtraError:
    """Return the error for a library that is not installed."""
    return MissingExtraError(f"this adapter needs {library}", hint=f"install it with: pip install 'softmode[{extra}]'")


def checked_env(env: object, adapter: str, *, output: str | None = None) -> VectorEnv:
    """Return an environment that an adapter can take.

    Args:
        env: What the adapter was given.
        adapter: Its name.
        output: The output that it needs, "torch"; None for any.

    Raises:
        ConfigError: If it is no vector environment, does not restart worlds in the step that ends their episode, or
            returns the wrong kind of arrays.
    """
    if not isinstance(env, VectorEnv):
        raise ConfigError(
            f"{adapter} was given a {type(env).__name__}", hint="pass what gymnasium.make_vec('softmode/...') returns"
        )
    wanted = f", output={output!r}" if output else ""
    hint = f"make it with gymnasium.make_vec(..., autoreset_mode=AutoresetMode.SAME_STEP{wanted})"
    mode = env.metadata.get("autoreset_mode")
    if mode is not AutoresetMode.SAME_STEP:
        raise ConfigError(
            f"{adapter} needs an environment that restarts in the same step, its mode is {mode}", hint=hint
        )
    if output and getattr(env.unwrapped, "output", "numpy") != output:
        raise ConfigError(f"{adapter} needs an environment with output={output!r}", hint=hint)
    return env


def to_numpy(tree: object) -> Any:
    """Return a tree of arrays or tensors as NumPy arrays on the host; arrays of objects stay."""
    return map_tree(lambda leaf: host_array(leaf) if isinstance(leaf, Tensor) else np.asarray(leaf), tree)


def infos_of_worlds(infos: Mapping[str, Any], num_envs: int) -> list[dict[str, Any]]:
    """Return the infos of a vector environment as one dict per world, by the masks ``_key``.

    Args:
        infos: Infos with NumPy arrays; numbers become Python's own.
        num_envs: Number of worlds.
    """
    worlds: list[dict[str, Any]] = [{} for _ in range(num_envs)]
    for key, values in infos.items():
        if key.startswith("_") and key[1:] in infos:
            continue
        mask = infos.get(f"_{key}")
        if isinstance(values, Mapping):
            rows: Any = infos_of_worlds(values, num_envs)
        else:
            rows = values.tolist() if values.ndim == 1 else values
        for world in range(num_envs) if mask is None else np.flatnonzero(mask):
            worlds[world][key] = rows[world]
    return worlds
