"""Environments that the tests of this folder share: building one takes seconds, a step milliseconds."""

from __future__ import annotations

import functools
from collections.abc import Callable

import gymnasium as gym
import pytest

import softmode  # noqa: F401  (registers the environments)
from softmode.envs.tasks.lift_soft.task import LiftSoftEnv
from softmode.testing.plugin import Episodes

__all__ = ["Episodes", "MakeEnv"]

MakeEnv = Callable[..., gym.Env]
"""Type of the fixture `soft_env`."""


@pytest.fixture(scope="session")
def make_env() -> Callable[[str], gym.Env]:
    """Return a function from obs_type to an environment, made once with `gym.make` and rgb_array rendering."""

    @functools.cache
    def make(obs_type: str) -> gym.Env:
        return gym.make("softmode/LiftSoft-v0", obs_type=obs_type, render_mode="rgb_array")

    return make


@pytest.fixture(scope="session")
def lift(make_env: Callable[[str], gym.Env]) -> LiftSoftEnv:
    """Return the bare environment with state observations."""
    env = make_env("state").unwrapped
    assert isinstance(env, LiftSoftEnv)
    return env


@pytest.fixture(scope="session")
def joints() -> LiftSoftEnv:
    """Return an environment whose actions are joint steps, with a smaller object."""
    return LiftSoftEnv(control_mode="joint_delta", size=0.06)
