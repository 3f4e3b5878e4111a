"""Rule ``bad actions``: NaN, numbers beyond the bounds, other shapes."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv

from softmode.errors import EnvironmentCheckError
from softmode.vector_check.episodes import Event, is_continuous
from softmode.vector_check.reference import REFUSALS, Reference, Skip
from softmode.vector_check.values import leaves

_NAN = "refuse actions that are not finite, or end the episode of their world alone"


def nan_action(run: Reference) -> str | None:
    """NaN is refused before anything moves, or harms no other world and is gone after a reset."""
    _for_floats(run)
    subject = run.subject
    world, at = subject.num_envs - 1, _quiet_step(run)
    bad = subject.replace_action(
        subject.actions[at],
        world,
        np.full_like(subject.action_of(subject.actions[at], world), np.nan),
    )
    subject.run(at)
    note, event = None, _tried(run, bad, lenient=world)
    if isinstance(event, Exception):
        _refused(run, event, at, "NaN")
    else:
        what = f"NaN in the action of world {world}"
        run.same_worlds(run.steps[at], event, "bad actions", what, _NAN, without=world, same=True)
        if any(array.dtype.kind == "f" and np.isnan(array).any() for _, array in leaves(event.observation[world])):
            note = "NaN in an action is accepted, and its world's observation is NaN until the next reset"
    run.same_worlds(run.events[0], subject.reset(seed=subject.seed), "bad actions", "a reset after NaN", _NAN)
    return note


def large_action(run: Reference) -> None:
    """Actions beyond the bounds are clipped or refused."""
    _for_floats(run)
    subject = run.subject
    space = subject.env.action_space
    assert isinstance(space, gym.spaces.Box)
    for sign in (1.0, -1.0):
        bound = np.where(np.isfinite(space.high), np.abs(space.high), 1.0)
        subject.run(0)
        found = _tried(run, (sign * (10.0 * bound + 10.0)).astype(space.dtype))
        if isinstance(found, Exception) and not isinstance(found, REFUSALS):
            raise found
    run.same_worlds(
        run.events[0],
        subject.reset(seed=subject.seed),
        "bad actions",
        "a reset after actions beyond the bounds",
        "clip actions to the bounds, or refuse them by a ValueError",
    )


def wrong_shape(run: Reference) -> str | None:
    """Actions of another shape are refused before anything moves."""
    subject = run.subject
    _not_async(run)
    action = subject.actions[_quiet_step(run)]
    items = [subject.action_of(action, world) for world in range(subject.num_envs)]
    shapes = {f"{subject.num_envs + 1} worlds": (items[0], *items)}
    if isinstance(action, np.ndarray):
        shapes = {f"{subject.num_envs + 1} worlds": np.concatenate([action[:1], action])}
        if action.ndim > 1 and not subject.composed:
            shapes["one number more"] = np.concatenate([action, action[..., :1]], axis=-1)
            shapes["no axis of worlds"] = action[0]
    for name, bad in shapes.items():
        subject.run(_quiet_step(run))
        found = _tried(run, bad)
        if not isinstance(found, Exception):
            hint = "compare the action's shape with action_space.shape and raise a ValueError that names both"
            raise EnvironmentCheckError(f"an action of {name} is accepted", rule="bad actions", hint=hint)
        _refused(run, found, _quiet_step(run), f"an action of {name}")
    return "the shape of a single world's action is left to the single environments" if subject.composed else None


def _for_floats(run: Reference) -> None:
    """Skip where actions are no floats."""
    _not_async(run)
    if not is_continuous(run.subject.env.action_space):
        raise Skip("actions are not floating-point numbers")


def _not_async(run: Reference) -> None:
    """Skip where an error ends the worker process."""
    if isinstance(run.subject.env.unwrapped, AsyncVectorEnv):
        raise Skip("an error in a worker closes an AsyncVectorEnv")


def _quiet_step(run: Reference) -> int:
    """Return the index of an early step in which no episode ends."""
    first = len(run.steps) if run.first_end is None else run.first_end
    return max(min(first - 1, 2), 0)


def _tried(run: Reference, action: Any, lenient: int | None = None) -> Event | Exception:
    """Step without the warnings that bad numbers cause; return what came back, or the error of the environment."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return run.subject.step(action, lenient=lenient)
        except EnvironmentCheckError:
            raise
        except Exception as error:
            return error


def _refused(run: Reference, error: Exception, at: int, what: str) -> None:
    """Check that an error is a refusal and that nothing moved."""
    subject = run.subject
    if not isinstance(error, REFUSALS):
        message = f"{what} raises {type(error).__name__}: {error}"
        hint = "check actions first and raise a ValueError or TypeError that says what was expected"
        raise EnvironmentCheckError(message, rule="bad actions", hint=hint) from error
    if subject.composed:
        return  # single environments are stepped in turn, so those before the bad one have moved
    run.same_worlds(
        run.steps[at],
        subject.step(subject.actions[at]),
        "bad actions",
        f"{what}, refused,",
        "check actions before any world moves",
        same=True,
    )
