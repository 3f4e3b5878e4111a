"""What a policy sees and does, as a value that can be written into a file and compared."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from softmode.errors import ConfigError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Interface:
    """Shapes of the observation and the range of the action of one world.

    Observations go by key: ``state`` for a Box of floats, ``pixels`` for a Box of uint8 pictures (height, width,
    channels), the keys of a Dict otherwise.
    """

    vectors: dict[str, int]
    """Lengths of the observed vectors."""
    pictures: dict[str, tuple[int, int, int]]
    """Shapes of the observed pictures."""
    action_low: tuple[float, ...]
    """Lower bounds of the action."""
    action_high: tuple[float, ...]
    """Upper bounds of the action."""

    @property
    def action_size(self) -> int:
        """Number of components of the action."""
        return len(self.action_low)

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Interface:
        """Return the interface that :meth:`to_json` wrote.

        Raises:
            ValueError, TypeError, KeyError: If it did not.
        """
        interface = cls(
            vectors={str(key): _length(size) for key, size in values["vectors"].items()},
            pictures={str(key): _picture(shape) for key, shape in values["pictures"].items()},
            action_low=tuple(float(bound) for bound in values["action_low"]),
            action_high=tuple(float(bound) for bound in values["action_high"]),
        )
        low, high = np.array(interface.action_low), np.array(interface.action_high)
        if len(low) == 0 or low.shape != high.shape or not np.all(np.isfinite(high - low)) or np.any(high <= low):
            raise ValueError("range of the action")
        if not interface.vectors and not interface.pictures:
            raise ValueError("no observation")
        return interface

    @classmethod
    def of(cls, env: gym.Env | gym.vector.VectorEnv) -> Interface:
        """Return the interface of an environment or a vector environment.

        Raises:
            ConfigError: If policies cannot act in its spaces.
        """
        observation = getattr(env, "single_observation_space", None) or env.observation_space
        action = getattr(env, "single_action_space", None) or env.action_space
        if not isinstance(action, gym.spaces.Box) or action.dtype.kind != "f" or len(action.shape) != 1:
            raise ConfigError(f"the action space {action} is no Box of floats", hint="use a continuous environment")
        if not action.is_bounded():
            raise ConfigError("the action space has no bounds", hint="wrap it in gymnasium.wrappers.RescaleAction")
        parts = observation.spaces if isinstance(observation, gym.spaces.Dict) else {"": observation}
        vectors: dict[str, int] = {}
        pictures: dict[str, tuple[int, int, int]] = {}
        for key, space in parts.items():
            if isinstance(space, gym.spaces.Box) and space.dtype == np.uint8 and len(space.shape) == 3:
                pictures[key or "pixels"] = tuple(space.shape)  # type: ignore[assignment]
            elif isinstance(space, gym.spaces.Box) and space.dtype.kind == "f" and len(space.shape) == 1:
                vectors[key or "state"] = int(space.shape[0])
            else:
                raise ConfigError(
                    f"a policy cannot read the observation {key!r}: {space}",
                    hint="use vectors of floats and pictures of uint8 (height, width, channels)",
                )
        low, high = (tuple(float(bound) for bound in side) for side in (action.low, action.high))
        return cls(vectors=vectors, pictures=pictures, action_low=low, action_high=high)


def _length(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value < 2**31:
        raise ValueError(f"length {value!r}")
    return value


def _picture(value: Any) -> tuple[int, int, int]:
    height, width, channels = (_length(side) for side in value)
    return height, width, channels
