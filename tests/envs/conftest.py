"""Environments that the tests of this folder share."""

from __future__ import annotations

from collections.abc import Callable

import gymnasium as gym
import pytest

from pytest_softmode import Episodes
from softmode.envs.tasks.lift_soft.task import LiftSoftEnv

__all__ = ["Episodes", "MakeEnv"]

MakeEnv = Callable[..., gym.Env]
"""Type of the fixtures `make_env` and `soft_env`."""


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
