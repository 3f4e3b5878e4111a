"""A task as a Gymnasium vector environment: all worlds in one captured graph, on CPU in one per process."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self, cast, get_args

import gymnasium as gym
import numpy as np
import warp as wp
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_choice
from softmode.deformables.reduction.build_body import Progress
from softmode.envs.arguments import (
    Shortcuts,
    TaskEnv,
    TaskT,
    checked_actions,
    checked_config,
    checked_count,
    checked_device,
    checked_options,
    checked_processes,
    world_seed,
)
from softmode.envs.env_state import EnvState, checked_state, generator_of, generator_state
from softmode.envs.parameters import check_options
from softmode.envs.results import add_object_names, named_reasons
from softmode.envs.robots import Robot
from softmode.envs.task_config import ObservationType, TaskConfig
from softmode.envs.worlds import LocalWorlds, RemoteWorlds
from softmode.errors import ConfigError, MissingExtraError
from softmode.vector_check.tensors import Tensor, host_array, map_tree

Output = Literal["numpy", "torch"]


class SoftVectorEnv(TaskEnv[TaskT], gym.vector.VectorEnv):
    """`num_envs` worlds of a task; subclasses name the task. See :class:`SoftEnv` for actions, observations and infos.

    Infos are dicts of arrays over the worlds, each with its mask ``_key``. With SAME_STEP autoreset ``final_obs`` and
    ``final_info`` hold the end of the episodes marked in ``_final_obs``; with NEXT_STEP the step after an episode's end
    returns the first observation of the next one, with reward 0, and ignores the action; with DISABLED worlds wait for
    ``reset(options={"reset_mask": mask})``.

    World i of ``reset(seed=s)`` plays what the single environment plays after ``reset(seed=s + i)``.

    Args:
        num_envs: Number of worlds.
        obs_type: What ``reset`` and ``step`` return.
        render_mode: "rgb_array" or None.
        control_mode: What actions mean.
        splat: Splat file of the object; None for the built-in one.
        size: Longest edge of the object [m].
        preset: Named variant of the task, instead of `config`.
        robot: Robot instead of the built-in arm: a name of `softmode.robots.available`, a file, arguments of
            `softmode.robots.load` by name, a `RobotDescription`, or a `TableRobot` of `softmode.robots.place_robot`.
        config: Everything else.
        max_episode_steps: Control steps after which an episode is truncated; None for never.
        autoreset_mode: When the next episode of a world begins.
        output: "numpy", or "torch" for tensors on the device: float32 rewards, no copy to the host, and actions that
            are not finite count as zero (nothing is read back to refuse them).
        processes: Child processes that share the worlds on CPU, each on its own core; 1 keeps them in this process.
        device: Warp device; the default one if None.
        progress: Reports the build of the object.
        fields: Fields of the configuration, such as ``image_size=64``; they replace those of `config`.

    Raises:
        ConfigError: If an option is unknown or out of range, or there is no such device.
        MissingExtraError: If torch is asked for and not installed.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        obs_type: ObservationType = "state",
        render_mode: str | None = None,
        control_mode: str | None = None,
        splat: str | Path | None = None,
        size: float | None = None,
        preset: str | None = None,
        robot: Robot | None = None,
        config: TaskConfig | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        output: Output = "numpy",
        processes: int = 1,
        device: wp.DeviceLike = None,
        progress: bool | Progress | None = None,
        **fields: Any,
    ) -> None:
        """Build the scene, capture the step and make the spaces."""
        self.num_envs = checked_count("num_envs", num_envs)
        if max_episode_steps is not None:
            max_episode_steps = checked_count("max_episode_steps", max_episode_steps)
        require_choice("output", output, get_args(Output))
        try:
            mode = AutoresetMode(autoreset_mode)
        except ValueError as error:
            known = ", ".join(f"AutoresetMode.{choice.name}" for choice in AutoresetMode)
            raise ConfigError(f"autoreset_mode is {autoreset_mode!r}", hint=f"use one of {known}") from error
        given = Shortcuts(
            obs_type=obs_type,
            render_mode=render_mode,
            control_mode=control_mode,
            splat=splat,
            size=size,
            preset=preset,
            robot=robot,
        )
        self._arguments = {
            **vars(given),
            "num_envs": num_envs,
            "config": config,
            "max_episode_steps": max_episode_steps,
            "autoreset_mode": autoreset_mode,
            "output": output,
            "processes": processes,
            "device": device,
            **fields,
        }
        """What a copy is made from; a callback is not."""
        config = checked_config(self.task_class.config_class, config, given, self.task_class.any_robot, fields)
        if output == "torch":
            try:
                import torch  # noqa: F401
            except ImportError as error:
                raise MissingExtraError(
                    "output='torch' needs torch", hint="install it with: pip install 'softmode[rl]'"
                ) from error
        self.config, self.obs_type, self.render_mode, self.output = config, obs_type, render_mode, output
        self.autoreset_mode = mode
        self.metadata = {**self.metadata, "render_fps": round(config.scene.control_hz), "autoreset_mode": mode}
        self.device = checked_device(device)
        self.max_episode_steps = max_episode_steps
        shards = checked_processes(processes, self.num_envs, self.device, output)
        edges = np.linspace(0, self.num_envs, shards + 1).astype(int)
        self._slices = [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]
        common = {
            "obs_type": obs_type,
            "limit": int(max_episode_steps or 0),
            "autoreset_mode": mode,
            "render": render_mode is not None,
            "device": str(self.device),
            "progress": progress,
        }
        arguments = [
            {**common, "config": config.from_world(part.start), "world_count": part.stop - part.start}
            for part in self._slices
        ]
        self._worlds: list[Any] = []
        try:
            for part in arguments:
                self._worlds.append((LocalWorlds if shards == 1 else RemoteWorlds)(self.task_class, part))
            for worlds in self._worlds:
                worlds.connect()
        except BaseException:
            self.close_extras()
            raise
        self._object_names = () if config.object_set is None else config.object_set.names
        self._random: list[np.random.Generator] | None = None
        self._streams: dict[int, Any] = {}
        self._results: list[dict[str, Any]] = []
        self.single_action_space = self._worlds[0].action_space
        self.single_observation_space = self._worlds[0].observation_space
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    # -- gymnasium ----------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes, in all worlds or those of ``options["reset_mask"]``.

        Args:
            seed: Seed s, for s + i in world i; or one per world, None among them to go on; or None.
            options: ``reset_mask`` (num_envs,) bool, and parameters of the task, one value or one per world; or
                ``state`` beside the mask alone: episodes begin with a state, see `set_state`, and count time from zero.
        """
        given = checked_options(options)
        mask = self._checked_mask(given.pop("reset_mask", None))
        if "state" in given:
            if seed is not None or len(given) > 1:
                raise ConfigError(
                    "a state excludes a seed and other options, it brings its own",
                    hint="give the state and reset_mask alone",
                )
            self._set_state(given["state"], mask, begin=True)
            with self._stream():
                return self._gather("observation"), self._masked(self._gather("info"), self._everywhere())
        chosen = check_options(self._worlds[0].parameters, given, self.num_envs)
        seeds = self._seeds(seed, mask)
        with self._stream():
            for worlds, part in zip(self._worlds, self._slices, strict=True):
                mine = {name: numbers[part] for name, numbers in chosen.items()}
                worlds.reset(mask[part], seeds[part], mine)
            self._results = [worlds.result() for worlds in self._worlds]
            return self._gather("observation"), self._infos(self._gather("info"), self._everywhere())

    def step(self, actions: ArrayLike | Tensor) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advance every world by one control step.

        Args:
            actions: Actions in [-1, 1], shape (num_envs, action_size).

        Raises:
            ConfigError: If the actions have another shape, or hold NaN (numpy output only), or no episode has begun;
                nothing has moved then.
            WorkerError: If a child process has died or the environment is closed.
        """
        if self._random is None:
            raise ConfigError("step comes before the first reset", hint="call reset() first")
        numbers = None
        if self.output == "torch":
            self._assign_tensors(actions)
        else:
            numbers = checked_actions(actions, self.action_space)
        with self._stream():
            for worlds, part in zip(self._worlds, self._slices, strict=True):
                worlds.step(None if numbers is None else numbers[part])
            self._results = [worlds.result() for worlds in self._worlds]
            terminated, truncated = self._gather("terminated"), self._gather("truncated")
            infos = self._infos(self._gather("info"), self._everywhere())
            if self.autoreset_mode == AutoresetMode.SAME_STEP:
                self._add_final(infos, terminated | truncated)
            return self._gather("observation"), self._gather("reward"), terminated, truncated, infos

    def get_state(self) -> EnvState:
        """Return the state of all worlds, from which `set_state` goes on with the same bits on CPU.

        Raises:
            ConfigError: If the scene has grips, which are not part of a state.
        """
        with self._stream():
            states = [worlds.get_state() for worlds in self._worlds]
        random = self._random if self._random is not None else [None] * self.num_envs
        parts = [
            EnvState(owner=owner, arrays=arrays, random=tuple(generator_state(one) for one in random[part]))
            for (owner, arrays), part in zip(states, self._slices, strict=True)
        ]
        return EnvState.joined(parts)

    def set_state(self, state: EnvState | bytes, mask: NDArray[np.bool_] | None = None) -> None:
        """Let worlds go on from a state; the others keep every bit.

        Args:
            state: What `get_state` returned, here or of a single environment, or its bytes: of one world, which all
                masked worlds get, or of `num_envs`.
            mask: Which worlds, shape (num_envs,) bool; all if None.

        Raises:
            StateError: If it is damaged, or of another version, task, robot or object; nothing has changed then.
            ConfigError: If mask or number of worlds do not fit, or only some worlds get one before the first reset.
        """
        self._set_state(state, self._checked_mask(mask), begin=False)

    def _set_state(self, given: object, mask: NDArray[np.bool_], *, begin: bool) -> None:
        """Give the masked worlds a state."""
        state = checked_state(given)
        if state.world_count not in (1, self.num_envs):
            hint = f"give the state of 1 or {self.num_envs} worlds, see EnvState.worlds"
            raise ConfigError(f"the state has {state.world_count} worlds, the environment {self.num_envs}", hint=hint)
        if state.world_count < self.num_envs:
            state = state.worlds(np.zeros(self.num_envs, int))
        random = [generator_of(one) for one in state.random]
        with self._stream():
            for worlds, part in zip(self._worlds, self._slices, strict=True):
                rows = {name: values[part] for name, values in state.arrays.items()}
                worlds.set_state(state.owner, rows, mask[part], begin)
            self._results = [worlds.result() for worlds in self._worlds]
        if self._random is None:
            self._random = [np.random.default_rng() for _ in range(self.num_envs)]
        for i in np.flatnonzero(mask):
            self._random[i] = random[i] or self._random[i]

    def __deepcopy__(self, memo: dict[int, object]) -> Self:
        """Return another environment in the same state."""
        made = type(self)(**self._arguments)
        memo[id(self)] = made
        made.spec = copy.deepcopy(self.spec, memo)
        state = self.get_state()
        made.set_state(state)
        if self._random is None:
            made._random = None
        return made

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a frame per world."""
        if self.render_mode is None:
            return None
        with self._stream():
            return tuple(frame for worlds in self._worlds for frame in worlds.render())

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the child processes."""
        for worlds in self.__dict__.get("_worlds", ()):  # gymnasium < 1.4 closes what its constructor refused
            worlds.close()

    @property
    def task(self) -> TaskT:
        """The task, if all worlds live in this process.

        Raises:
            ConfigError: If they do not.
        """
        if not isinstance(self._worlds[0], LocalWorlds):
            raise ConfigError("the worlds live in other processes", hint="make the environment with processes=1")
        return cast(Any, self._worlds[0].task)  # the one in the brackets

    @property
    def state_observation(self) -> Any:
        """The full observation vector of every world whatever `obs_type`, shape (num_envs, D): for a critic.

        Raises:
            ConfigError: If no episode has begun.
        """
        if not self._results:
            raise ConfigError("there is no state before the first reset", hint="call reset() first")
        with self._stream():
            return self._gather("state")

    def task_columns(self, segment: str) -> slice:
        """Return the columns of a segment of the full observation vector, such as "object_offset"."""
        return self._worlds[0].segments[segment]

    # -- arguments ----------------------------------------------------------------------------------------------------

    def _checked_mask(self, mask: object) -> NDArray[np.bool_]:
        """Return which worlds a reset concerns."""
        if mask is None:
            return np.ones(self.num_envs, bool)
        mask = host_array(mask) if isinstance(mask, Tensor) else np.asarray(mask)
        if mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            hint = f"give booleans of shape ({self.num_envs},), at least one of them True"
            raise ConfigError(f"reset_mask is {mask.dtype} of shape {mask.shape}", hint=hint)
        if self._random is None and not mask.all():
            raise ConfigError("the first reset is partial", hint="call reset() for all worlds once")
        return mask

    def _seeds(self, seed: object, mask: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return the seed of every world's draws, -1 where they go on."""
        first = self._random is None
        if seed is None:
            given: list[Any] = [None] * self.num_envs
        elif isinstance(seed, (int, np.integer)):
            given = [int(seed) + i for i in range(self.num_envs)]
        else:
            given = list(seed) if isinstance(seed, (Sequence, np.ndarray)) and not isinstance(seed, str) else []
        if len(given) != self.num_envs or not all(
            s is None or (isinstance(s, (int, np.integer)) and s >= 0) for s in given
        ):
            raise ConfigError(f"seed is {seed!r}", hint=f"give a number >= 0, or {self.num_envs} of them")
        if self._random is None:
            self._random = [np.random.default_rng() for _ in range(self.num_envs)]
        seeds = np.full(self.num_envs, -1, np.int64)
        for i in np.flatnonzero(mask):
            if given[i] is not None:
                self._random[i] = seeding.np_random(int(given[i]))[0]
            if first or given[i] is not None:
                seeds[i] = world_seed(self._random[i])
        return seeds

    def _assign_tensors(self, actions: object) -> None:
        """Copy a tensor of actions to the task, on the device."""
        import torch

        if isinstance(actions, torch.Tensor):
            tensor = actions
        else:
            tensor = torch.from_numpy(checked_actions(actions, self.action_space))
        if tuple(tensor.shape) != self.action_space.shape:
            raise ConfigError(
                f"actions have shape {tuple(tensor.shape)}, expected {self.action_space.shape}",
                hint="give one row per world and one number in [-1, 1] per entry of env.single_action_space",
            )
        wp.to_torch(self.task.scene.actions).copy_(tensor.detach())

    # -- results ------------------------------------------------------------------------------------------------------

    def _stream(self) -> Any:
        """Return the context in which kernels run on torch's stream, if tensors are the output."""
        if self.output == "numpy" or not self.device.is_cuda:
            return wp.ScopedDevice(self.device)
        import torch

        stream = torch.cuda.current_stream(wp.device_to_torch(self.device))
        if stream.cuda_stream not in self._streams:
            self._streams[stream.cuda_stream] = wp.stream_from_torch(stream)
        return wp.ScopedStream(self._streams[stream.cuda_stream])

    def _gather(self, name: str) -> Any:
        """Return part of the last results of all worlds, in memory of its own."""
        return self._join([result[name] for result in self._results])

    def _join(self, trees: list[Any]) -> Any:
        """Return the trees of arrays of all parts as one tree."""
        first = trees[0]
        if isinstance(first, dict):
            return {name: self._join([tree[name] for tree in trees]) for name in first}
        if len(trees) > 1:
            return np.concatenate(trees)
        on_host = isinstance(first, np.ndarray)
        if self.output == "numpy":
            return (first if on_host else first.numpy()).copy()
        import torch

        tensor = torch.from_numpy(first) if on_host else wp.to_torch(first)
        return tensor.clone(memory_format=torch.contiguous_format)

    def _add_final(self, infos: dict[str, Any], ended: Any) -> None:
        """Add the last observation and info of the episodes that ended; always, where nothing may be read back."""
        numpy = self.output == "numpy"
        if numpy and not ended.any():
            return
        final = self._join([worlds.final() for worlds in self._worlds])
        observation = final["observation"]
        if numpy:
            rows = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(ended):
                rows[i] = map_tree(lambda array, i=i: array[i].copy(), observation)
            observation = rows
        infos["final_obs"], infos["_final_obs"] = observation, _copy(ended)
        infos["final_info"], infos["_final_info"] = self._infos(final["info"], ended), _copy(ended)
        # What stays are the infos of the new episodes, which have earned nothing yet.
        terms = [value for name, value in infos["reward_terms"].items() if not name.startswith("_")]
        for values in (*terms, infos["end_reason"]):
            if numpy:
                values[ended] = 0
            else:
                values.masked_fill_(ended, 0)

    def _everywhere(self) -> Any:
        """Return a mask of all worlds."""
        if self.output == "numpy":
            return np.ones(self.num_envs, bool)
        import torch

        return torch.ones(self.num_envs, dtype=torch.bool, device=wp.device_to_torch(self.device))

    def _infos(self, tree: dict[str, Any], mask: Any) -> dict[str, Any]:
        """Return infos with their masks and, where they lie on the host, the names of the solver's flags."""
        infos = self._masked(tree, mask)
        if self.output == "numpy":
            named_reasons(infos)
            if self._object_names:
                add_object_names(infos, self._object_names)
        return infos

    def _masked(self, tree: dict[str, Any], mask: Any) -> dict[str, Any]:
        """Add the mask `_key` of every key."""
        out: dict[str, Any] = {}
        for name, value in tree.items():
            out[name] = self._masked(value, mask) if isinstance(value, dict) else value
            out[f"_{name}"] = _copy(mask)
        return out


def _copy(mask: Any) -> Any:
    """Return a mask in memory of its own."""
    return mask.clone() if hasattr(mask, "clone") else mask.copy()
