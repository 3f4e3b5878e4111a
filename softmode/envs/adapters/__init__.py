"""softmode's vector environments in the form that libraries of reinforcement learning take.

`StableBaselinesVecEnv` for Stable-Baselines3, `RslRlVecEnv` for rsl_rl and `SkrlWrapper` for skrl. Each library is
imported when its adapter is first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.envs.adapters.rsl_rl import RslRlVecEnv as RslRlVecEnv
    from softmode.envs.adapters.skrl import SkrlWrapper as SkrlWrapper
    from softmode.envs.adapters.stable_baselines import StableBaselinesVecEnv as StableBaselinesVecEnv

__getattr__, __dir__ = lazy_names(__name__)
