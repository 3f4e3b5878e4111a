"""What a vector environment may return from one call: the rules on spaces, dtypes, shapes and infos."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces.utils import is_space_dtype_shape_equiv
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, iterate
from numpy.typing import NDArray

from softmode.errors import EnvironmentCheckError
from softmode.vector_check.tensors import Tensor, host_array, map_tree


def as_numpy(value: object) -> Any:
    """Return a tree of dicts, tuples and arrays as NumPy copies; tensors of any library come to the host.

    Libraries are recognised by their arrays' methods, so none is imported.
    """
    return map_tree(_copied, value)


def _copied(value: Any) -> Any:
    """Return a leaf of a tree as a NumPy copy."""
    if isinstance(value, Tensor):
        return host_array(value).copy()
    if isinstance(value, np.ndarray) and value.dtype == object:
        copy = np.empty_like(value)
        for index in np.ndindex(value.shape):
            copy[index] = as_numpy(value[index])
        return copy
    if hasattr(value, "__array__") and not np.isscalar(value):
        return np.array(value)
    return value


def leaves(value: object, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (path, array) of every array in a tree, those inside arrays of objects included."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from leaves(item, f"{path}[{key!r}]")
    elif isinstance(value, tuple | list):
        for index, item in enumerate(value):
            yield from leaves(item, f"{path}[{index}]")
    elif isinstance(value, np.ndarray) and value.dtype == object:
        for index in np.ndindex(value.shape):
            yield from leaves(value[index], f"{path}{list(index)}")
    elif hasattr(value, "shape") and hasattr(value, "dtype"):
        yield path, value


def like(action: object, sample: object) -> Any:
    """Return an action as the library of ``sample``, an array that the environment returned, wants it."""
    if not isinstance(sample, Tensor):
        return action
    torch = sys.modules["torch"]  # it is there: the environment returned one of its tensors
    return map_tree(lambda item: torch.as_tensor(np.array(item), device=sample.device), action)


def equal(a: object, b: object) -> bool:
    """Whether two trees of NumPy arrays hold the same bits; NaN equals NaN."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, tuple | list) and isinstance(b, tuple | list):
        return len(a) == len(b) and all(map(equal, a, b))
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        if a.shape != b.shape or a.dtype != b.dtype:
            return False
        if a.dtype == object:
            return all(map(equal, a.ravel(), b.ravel()))
        return np.array_equal(a, b, equal_nan=np.issubdtype(a.dtype, np.inexact))
    if isinstance(a, float | np.floating) and isinstance(b, float | np.floating):
        return bool(a == b or (np.isnan(a) and np.isnan(b)))
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return False
    return bool(a == b)


def worlds(env: VectorEnv, batch: Any) -> list[Any]:
    """Return the observations of the single worlds."""
    return list(iterate(env.observation_space, batch))


# -- rules ------------------------------------------------------------------------------------------------------------


def check_spaces(env: VectorEnv) -> None:
    """Rule ``spaces``: the batched spaces are ``num_envs`` times the single ones."""
    if not isinstance(env.num_envs, int | np.integer) or env.num_envs < 1:
        raise EnvironmentCheckError(
            f"num_envs is {env.num_envs!r}", rule="spaces", hint="set num_envs to the number of worlds"
        )
    for name in ("observation_space", "action_space"):
        single, batched = (getattr(env, prefix + name, None) for prefix in ("single_", ""))
        for prefix, space in (("single_", single), ("", batched)):
            if not isinstance(space, gym.Space):
                raise EnvironmentCheckError(
                    f"{prefix}{name} is {space!r}", rule="spaces", hint="set it to a gymnasium.Space in the constructor"
                )
        assert isinstance(single, gym.Space) and isinstance(batched, gym.Space)
        wanted = batch_space(single, env.num_envs)
        # Gymnasium's own way of saying that bounds differ from world to world.
        different = getattr(env.unwrapped, "observation_mode", "same") != "same" and name == "observation_space"
        if not (is_space_dtype_shape_equiv(batched, wanted) if different else batched == wanted):
            hint = f"use gymnasium.vector.utils.batch_space(single_{name}, num_envs)"
            raise EnvironmentCheckError(f"{name} is {batched}, expected {wanted}", rule="spaces", hint=hint)


def check_metadata(env: VectorEnv) -> AutoresetMode:
    """Rule ``autoreset mode``: metadata says how finished worlds restart."""
    mode = env.metadata.get("autoreset_mode")
    if not isinstance(mode, AutoresetMode):
        hint = "set it to a member of gymnasium.vector.AutoresetMode, in the instance's own copy of metadata"
        raise EnvironmentCheckError(f"metadata['autoreset_mode'] is {mode!r}", rule="autoreset mode", hint=hint)
    return mode


def check_observation(env: VectorEnv, batch: Any, call: str, lenient: int | None = None) -> None:
    """Rule ``observations``: inside the space, of its dtype, world by world.

    Args:
        env: The environment.
        batch: Its observation, as NumPy.
        call: What returned it.
        lenient: A world whose values may lie outside, having been fed NaN.
    """
    shapes = _describe(batch)
    _check_dtypes(env.observation_space, batch, call)
    try:
        items = worlds(env, batch)
    except Exception as error:
        raise EnvironmentCheckError(
            f"{call} returned {shapes} for {env.observation_space}", rule="observations", hint=_INSIDE
        ) from error
    if len(items) != env.num_envs:
        raise EnvironmentCheckError(
            f"{call} returned {shapes} for {env.num_envs} worlds", rule="observations", hint=_INSIDE
        )
    # Bounds may differ from world to world, so the batched space is asked first.
    if env.observation_space.contains(batch):
        return
    for world, item in enumerate(items):
        if world != lenient and not env.single_observation_space.contains(item):
            message = f"{call} returned an observation outside {env.single_observation_space}: {item!r}"
            raise EnvironmentCheckError(message, rule="observations", world=world, hint=_INSIDE)
    if lenient is None:
        raise EnvironmentCheckError(
            f"{call} returned {shapes}, not contained in {env.observation_space}", rule="observations", hint=_INSIDE
        )


_INSIDE = "return what observation_space.contains accepts: its keys, shapes, dtypes and bounds, without NaN"


def _describe(tree: object) -> str:
    """Return shapes and dtypes of a tree."""
    parts = [f"{path} {array.dtype}{tuple(array.shape)}".strip() for path, array in leaves(tree)]
    return ", ".join(parts) or type(tree).__name__


def _check_dtypes(space: gym.Space, batch: object, call: str, path: str = "") -> None:
    """Compare dtypes leaf by leaf; `Space.contains` accepts whatever casts."""
    if isinstance(space, gym.spaces.Dict) and isinstance(batch, Mapping):
        for key in space.spaces.keys() & batch.keys():
            _check_dtypes(space[key], batch[key], call, f"{path}[{key!r}]")
    elif isinstance(space, gym.spaces.Tuple) and isinstance(batch, tuple | list):
        for index, (part, item) in enumerate(zip(space.spaces, batch, strict=False)):
            _check_dtypes(part, item, call, f"{path}[{index}]")
    elif isinstance(space, gym.spaces.Box) and getattr(batch, "dtype", None) != space.dtype:
        message = f"{call} returned{path} {_describe(batch)}, expected dtype {space.dtype}"
        hint = "give the arrays the dtype of the space"
        raise EnvironmentCheckError(message, rule="observations", hint=hint)


def check_reward(env: VectorEnv, reward: object) -> None:
    """Rule ``rewards``: floats, one per world, finite."""
    if not isinstance(reward, np.ndarray) or reward.shape != (env.num_envs,) or reward.dtype.kind != "f":
        message = f"step returned {_describe(reward)} as reward, expected floats of shape ({env.num_envs},)"
        hint = "return one floating-point array with a reward for every world"
        raise EnvironmentCheckError(message, rule="rewards", hint=hint)
    if not np.isfinite(reward).all():
        world = int(np.flatnonzero(~np.isfinite(reward))[0])
        hint = "end the episode of a world that diverges and give it a finite reward"
        raise EnvironmentCheckError(f"the reward is {reward[world]}", rule="rewards", world=world, hint=hint)


def check_flag(env: VectorEnv, flag: object, name: str) -> None:
    """Rule ``flags``: booleans, one per world."""
    if not isinstance(flag, np.ndarray) or flag.shape != (env.num_envs,) or flag.dtype != np.bool_:
        message = f"step returned {_describe(flag)} as {name}, expected bool of shape ({env.num_envs},)"
        hint = f"return {name} as one boolean array"
        raise EnvironmentCheckError(message, rule="flags", hint=hint)


def check_kinds(observation: object, others: Mapping[str, object]) -> None:
    """Rule ``array kind``: observations, rewards and flags come from one library and lie on one device."""

    def kind(array: object) -> tuple[str, str]:
        return type(array).__module__.partition(".")[0], str(getattr(array, "device", "cpu"))

    kinds = {f"observation{path}": kind(array) for path, array in leaves(observation)}
    kinds |= {name: kind(array) for name, array in others.items()}
    if len(set(kinds.values())) > 1:
        listed = ", ".join(f"{name}: {library} on {device}" for name, (library, device) in kinds.items())
        raise EnvironmentCheckError(
            listed, rule="array kind", hint="return all arrays of a step as one library's arrays on one device"
        )


def check_infos(
    num_envs: int, infos: object, seen: dict[str, tuple[tuple[int, ...], np.dtype]], path: str = "infos"
) -> None:
    """Rule ``info masks``: every key has a boolean mask ``_key``, and keeps shape and dtype from call to call.

    Args:
        num_envs: Number of worlds.
        infos: What reset or step returned, as NumPy.
        seen: Shape and dtype of keys met before, updated.
        path: Where in the infos this dict lies.
    """
    if not isinstance(infos, Mapping):
        hint = "return a dict of arrays, not a list of dicts"
        raise EnvironmentCheckError(f"{path} is a {type(infos).__name__}", rule="info masks", hint=hint)
    for key, values in infos.items():
        if not isinstance(key, str):
            raise EnvironmentCheckError(
                f"{path} has the key {key!r}", rule="info masks", hint="use strings as keys of infos"
            )
        where = f"{path}[{key!r}]"
        if key.startswith("_") and key[1:] in infos:
            if not isinstance(values, np.ndarray) or values.dtype != np.bool_ or values.shape != (num_envs,):
                message = f"{where} is {_describe(values)}, expected a mask: bool of shape ({num_envs},)"
                hint = f"set {where}[i] to whether world i has {key[1:]!r}"
                raise EnvironmentCheckError(message, rule="info masks", hint=hint)
            continue
        # Inside a dict, whose own mask says it all, masks may be missing: Gymnasium's RecordEpisodeStatistics has none.
        if f"_{key}" not in infos and (path == "infos" or key.startswith("_")):
            message = f"{where} has no mask {'_' + key!r}" if not key.startswith("_") else f"{where} masks nothing"
            hint = "pair every key with a boolean mask of its name after an underscore, as VectorEnv._add_info does"
            raise EnvironmentCheckError(message, rule="info masks", hint=hint)
        if isinstance(values, Mapping) and key != "final_obs":
            check_infos(num_envs, values, seen, where)
            continue
        if isinstance(values, Mapping | tuple) and key == "final_obs":
            if all(array.shape[:1] == (num_envs,) for _, array in leaves(values)):
                continue
        if not isinstance(values, np.ndarray) or values.shape[:1] != (num_envs,):
            message = f"{where} is {_describe(values)}, expected an array of {num_envs} values"
            hint = "return one array per key, the world being its first axis"
            raise EnvironmentCheckError(message, rule="info masks", hint=hint)
        _check_same_form(values, seen, where)


def _check_same_form(values: NDArray[Any], seen: dict[str, tuple[tuple[int, ...], np.dtype]], where: str) -> None:
    """Compare shape and dtype with those that the key had before; arrays of objects may hold anything."""
    if values.dtype == object:
        return
    form = (values.shape, values.dtype)
    if seen.setdefault(where, form) != form:
        before = seen[where]
        message = f"{where} is {form[1]}{form[0]}, and was {before[1]}{before[0]} before"
        hint = "give a key the same shape and dtype in every call"
        raise EnvironmentCheckError(message, rule="info masks", hint=hint)
