"""softmode's vector environments in the form that libraries of reinforcement learning take.

`StableBaselinesVecEnv` for Stable-Baselines3, `RslRlVecEnv` for rsl_rl and `SkrlWrapper` for skrl. Each library is
imported when its adapter is first asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softmode.envs.adapters.rsl_rl import RslRlVecEnv
    from softmode.envs.adapters.skrl import SkrlWrapper
    from softmode.envs.adapters.stable_baselines import StableBaselinesVecEnv

__all__ = ["RslRlVecEnv", "SkrlWrapper", "StableBaselinesVecEnv"]

_MODULES = {"RslRlVecEnv": "rsl_rl", "SkrlWrapper": "skrl", "StableBaselinesVecEnv": "stable_baselines"}


def __getattr__(name: str) -> Any:
    """Import an adapter.

    Raises:
        MissingExtraError: If its library is not installed.
    """
    if name in _MODULES:
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
