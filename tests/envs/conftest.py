"""Environments that the tests of this folder share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import pytest

from softmode.envs.tasks.lift_soft.task import LiftSoftEnv
from softmode.testing.plugin import Episodes

__all__ = ["Episodes", "MakeEnv"]

MakeEnv = Callable[..., gym.Env]
"""Type of the fixtures `make_env` and `soft_env`."""

ROOT = Path(__file__).resolve().parents[2]

# Before the first body is built: the cache lies in the checkout, so that a run leaves nothing outside it.
os.environ.setdefault("SOFTMODE_CACHE", str(ROOT / ".cache" / "softmode"))


@pytest.fixture(scope="session")
def lift(make_env: MakeEnv) -> LiftSoftEnv:
    """Return the bare environment with state observations."""
    env = make_env("LiftSoft").unwrapped
    assert isinstance(env, LiftSoftEnv)
    return env


@pytest.fixture(scope="session")
def joints() -> LiftSoftEnv:
    """Return an environment whose actions are joint steps, with a smaller object."""
    return LiftSoftEnv(control_mode="joint_delta", size=0.06)
