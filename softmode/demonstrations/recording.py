"""Recording episodes of an environment while a policy plays it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

from softmode.checks import SEED_MAX, require_number
from softmode.demonstrations.schema import GOALS, Feature
from softmode.demonstrations.writer import DatasetWriter
from softmode.errors import ConfigError

ATTEMPTS = 10
"""Episodes played per episode to record, at most, when only successes are recorded."""

PUSH_STEPS, PUSH_SHARE = 5, 0.2
"""Control steps of a push, and about which share of all steps is pushed."""


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What a recording brought."""

    episodes: int
    """Episodes recorded."""
    successes: int
    """Successes among them."""
    attempts: int
    """Episodes played."""


def environment_features(
    env: gym.Env, *, pictures: Literal["video", "png"] = "video", camera: str = "front"
) -> dict[str, Feature]:
    """Return the features of an environment's demonstrations.

    The proprioception is ``observation.state``, the rest of a state vector ``observation.environment_state``, pictures
    are ``observation.images.CAMERA``; further there are ``action`` and what it led to, ``next.reward``, ``next.done``
    and ``next.success``. Goals are ``observation.achieved_goal`` and ``observation.desired_goal``.

    Args:
        env: An environment whose observations are a vector, a picture, a dict of ``pixels`` and ``agent_pos``, or one
            with goals.
        pictures: How pictures are stored.
        camera: Name of the camera.

    Raises:
        ConfigError: If its observations or actions are something else.
    """
    space, actions = env.observation_space, env.action_space
    if not isinstance(actions, Box) or len(actions.shape) != 1:
        raise ConfigError(f"actions {actions} are no vector", hint="record an environment of this package")
    parts = dict(space.spaces) if isinstance(space, gym.spaces.Dict) else {"": space}
    task = getattr(env.unwrapped, "task", None)
    features: dict[str, Feature] = {}
    for key, part in parts.items():
        if isinstance(part, Box) and part.dtype == np.uint8 and len(part.shape) == 3 and key in ("", "pixels"):
            kind = "video" if pictures == "video" else "image"
            features[f"observation.images.{camera}"] = Feature(dtype=kind, shape=part.shape)
        elif isinstance(part, Box) and key in GOALS:
            features[f"observation.{key}"] = Feature(dtype="float32", shape=part.shape)
        elif isinstance(part, Box) and len(part.shape) == 1 and key in ("", "agent_pos", "observation"):
            # The leading numbers are the robot's own; all, if the environment does not tell.
            names, count, total = _names(task), 1 << 30 if task is None else task.layout.agent_size, part.shape[0]
            if key == "observation":  # of an environment with goals, which has its own order
                names, count = None, total
            for name, columns in (
                ("observation.state", slice(0, min(count, total))),
                ("observation.environment_state", slice(count, total)),
            ):
                if size := len(range(total)[columns]):
                    chosen = None if names is None else names[columns]
                    features[name] = Feature(dtype="float32", shape=(size,), names=chosen)
        else:
            raise ConfigError(
                f"observation {key} {part} cannot be recorded", hint="use obs_type 'state' or 'pixels_agent_pos'"
            )
    return {
        **features,
        "action": Feature(dtype="float32", shape=actions.shape, names=_action_names(task)),
        "next.reward": Feature(dtype="float32", shape=(1,)),
        "next.done": Feature(dtype="bool", shape=(1,)),
        "next.success": Feature(dtype="bool", shape=(1,)),
    }


def _action_names(task: Any) -> tuple[str, ...] | None:
    """Return a name for every number of an action, or None if the environment does not tell."""
    return getattr(getattr(getattr(task, "scene", None), "controller", None), "action_names", None)


def _names(task: object) -> tuple[str, ...] | None:
    """Return a name for every number of a state, or None if the environment does not tell."""
    segments = getattr(task, "segments", None)
    if not isinstance(segments, Mapping):
        return None
    return tuple(f"{name}.{k}" for name, (part, _) in segments.items() for k in range(part.stop - part.start))


def observation_columns(observation: Any, features: Mapping[str, Feature]) -> dict[str, Any]:
    """Return the columns of an observation.

    Args:
        observation: What the environment returned.
        features: What :func:`environment_features` returned for it.
    """
    parts = observation if isinstance(observation, Mapping) else {"": observation}
    columns: dict[str, Any] = {}
    for key, part in parts.items():
        part = np.asarray(part)
        if key in GOALS:
            columns[f"observation.{key}"] = part
        elif part.ndim == 3:
            (name,) = (name for name in features if name.startswith("observation.images."))
            columns[name] = part
        else:
            size = features["observation.state"].shape[0]
            columns["observation.state"] = part[:size]
            if len(part) > size:
                columns["observation.environment_state"] = part[size:]
    return columns


def check_recording(episodes: int, seed: int, noise: float) -> None:
    """Raise ConfigError if a number of :func:`record_episodes` is out of range."""
    require_number("episodes", episodes, at_least=1, hint="give a count like 100")
    require_number("seed", seed, at_least=0, at_most=SEED_MAX, hint="give a whole number like 0")
    require_number("noise", noise, at_least=0.0, at_most=1.0, hint="give a part of the action range, like 0.1")


def record_episodes(
    env: gym.Env,
    policy: Callable[[int], Callable[[Any], Any]],
    writer: DatasetWriter,
    *,
    episodes: int,
    task: str,
    seed: int = 0,
    noise: float = 0.0,
    only_successes: bool = False,
    states: bool = False,
    seeds: int | None = None,
    progress: Callable[[int, bool, int], None] | None = None,
) -> Recorded:
    """Play episodes and record them.

    With ``noise`` the robot is pushed off its way now and then: for :data:`PUSH_STEPS` steps something random is added
    to the actions played, all but the gripper's, the last. The policy's own action is what is recorded, so that the
    demonstrations show how to come back (DART, Laskey et al. 2017, with pushes instead of white noise, which would keep
    a policy that waits until it is within a millimetre waiting).

    Args:
        env: The environment; its seeds count up from ``seed``.
        policy: Returns, for the seed of an episode that was just reset, what turns observations into actions.
        writer: Where the episodes go; its features are those of :func:`environment_features`.
        episodes: Episodes to record.
        task: What was to be done, as a sentence.
        seed: Seed of the first episode.
        noise: Standard deviation of a push, in the unit of the actions.
        only_successes: Record only episodes that end in success.
        states: Record the state in which each episode begins as well, of an environment of softmode's; see
            `Dataset.state`.
        seeds: Play no more seeds than these, and take what they bring; :data:`ATTEMPTS` per episode if None.
        progress: Told after every episode played its seed, whether it succeeded, and how many are recorded.

    Raises:
        ConfigError: If a number is out of range, or fewer than one in ten attempts succeeds; what was recorded stays.
        StorageError: If the dataset cannot be written; the episodes before stay.
    """
    check_recording(episodes, seed, noise)
    base: Any = env.unwrapped
    if states and not hasattr(base, "get_state"):
        raise ConfigError(f"{base} has no get_state", hint="record without states")
    recorded = successes = attempts = 0
    while recorded < episodes and (seeds is None or attempts < seeds):
        if attempts >= ATTEMPTS * episodes:
            raise ConfigError(
                f"only {recorded} of {attempts} episodes succeeded, {episodes} were asked for; they are recorded",
                hint="use a better policy, or record failures too",
            )
        writer.discard_episode()
        observation, _ = env.reset(seed=seed + attempts)
        state = base.get_state().to_bytes() if states else None
        success = _play(env, policy, writer, observation, seed + attempts, noise)
        attempts += 1
        if success or not only_successes:
            writer.save_episode(task, state=state)
            recorded, successes = recorded + 1, successes + success
        else:
            writer.discard_episode()
        if progress:
            progress(seed + attempts - 1, success, recorded)
    return Recorded(episodes=recorded, successes=successes, attempts=attempts)


def _play(
    env: gym.Env,
    policy: Callable[[int], Callable[[Any], Any]],
    writer: DatasetWriter,
    observation: Any,
    seed: int,
    noise: float,
) -> bool:
    """Play an episode, which has just begun with an observation, into the writer; return whether it succeeded."""
    act, random = policy(seed), np.random.default_rng((seed, 0xDA27))
    done, info, push, left = False, {}, np.float32(0.0), 0
    while not done:
        action = np.asarray(act(observation), np.float32)
        played = action.copy()
        if not left and random.random() < PUSH_SHARE / PUSH_STEPS:
            push, left = random.normal(0.0, noise, len(action) - 1).astype(np.float32), PUSH_STEPS
        if left:
            played[:-1] += push
            left -= 1
        frame = {**observation_columns(observation, writer.features), "action": action}
        observation, reward, terminated, truncated, info = env.step(played)
        done = terminated or truncated
        frame |= {
            "next.reward": np.float32(reward),
            "next.done": done,
            "next.success": bool(info.get("is_success", False)),
        }
        writer.add_frame(frame)
    return bool(info.get("is_success", False))
