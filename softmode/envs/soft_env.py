"""A task as a Gymnasium environment of one world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, get_args

import gymnasium as gym
import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.deformables.model.status import status_reasons
from softmode.envs.task import EndReason, ObservationType, Task, TaskConfig
from softmode.errors import ConfigError
from softmode.objects.config import ObjectConfig

CONTROL_MODES = ("pose_delta", "joint_delta")


class SoftEnv(gym.Env, gym.utils.EzPickle):
    """One arm at a table with soft objects; subclasses name the task.

    Actions, float32 in [-1, 1], larger ones are clamped: with ``control_mode="pose_delta"`` (x, y, z, yaw, gripper)
    steps of the tool, with ``"joint_delta"`` seven joint steps and the gripper; the gripper entry is +1 open, -1
    squeeze with full force.

    Observations by ``obs_type``:

    - ``"state"``: float32 vector: ``agent_pos`` (see below), object centre (3) [m] and velocity (3) [m/s], centre
      relative to the tool (3), surface points relative to the centre (3 each).
    - ``"pixels"``: uint8 image (image_size, image_size, 3) of the camera.
    - ``"pixels_agent_pos"``: dict of ``pixels`` and ``agent_pos``: tool position (3) [m], cos and sin of its yaw,
      opening [m], finger forces (2) [N], joint angles (7) [rad], lead of the command over the tool (3) [m], sine of
      its lead in yaw, commanded opening [m], and the goal.

    With ``image_outputs`` in the configuration the picture's dict also holds ``depth`` and ``segmentation``. Numbers
    beyond the bounds of ``observation_space`` (an object thrown off the table) are clipped to them.

    The reward is the sum of ``info["reward_terms"]``. ``info`` also holds ``is_success``, the task's figures,
    ``finger_force`` [N], ``parameters`` (what was drawn at reset), ``solver_status`` (the solver's flags),
    ``solver_reasons`` (their names, such as "contact_overflow") and ``end_reason`` (:class:`EndReason`). An episode
    terminates only by failure, named by ``failure``, such as "dropped" or "diverged".

    ``reset`` takes as ``options`` any of the parameters, such as ``position`` (x, y) [m], ``yaw`` [rad],
    ``youngs_modulus`` [Pa]; what is not given is drawn from the configured ranges. Draws depend on the seed and on
    how many episodes were played since it was given.

    Args:
        obs_type: What ``reset`` and ``step`` return.
        render_mode: "rgb_array" or None.
        control_mode: What actions mean.
        splat: Splat file of the object; None for the built-in one.
        size: Longest edge of the object [m].
        preset: Named variant of the task, instead of `config`.
        config: Everything else.
        device: Warp device.
        progress: Reports the build of the object: a callable (stage, fraction), or True or False for a bar or none.

    Raises:
        ConfigError: If an option is unknown or out of range, or there is no such device.
        AssetError: If the splat file cannot be used.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012  (gymnasium's own convention)
    task_class: ClassVar[type[Task]] = Task
    """The task."""

    def __init__(
        self,
        *,
        obs_type: ObservationType = "state",
        render_mode: str | None = None,
        control_mode: str | None = None,
        splat: str | Path | None = None,
        size: float | None = None,
        preset: str | None = None,
        config: TaskConfig | None = None,
        device: Any = None,
        progress: Any = None,
    ) -> None:
        """Build the scene and the spaces."""
        # What a copy is made from when the environment is pickled; a callback cannot travel.
        gym.utils.EzPickle.__init__(
            self,
            obs_type=obs_type,
            render_mode=render_mode,
            control_mode=control_mode,
            splat=splat,
            size=size,
            preset=preset,
            config=config,
            device=None if device is None else str(device),
        )
        self.config = checked_config(self, config, preset, obs_type, render_mode, control_mode, splat, size)
        self.obs_type, self.render_mode = obs_type, render_mode
        self.metadata = {**self.metadata, "render_fps": round(self.config.scene.control_hz)}
        self.task = self.task_class(
            self.config,
            obs_type=obs_type,
            render=render_mode is not None,
            device=checked_device(device),
            progress=progress,
        )
        self.scene = self.task.scene
        self.action_space = self.task.action_space
        self.observation_space = self.task.observation_space()

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        if options is not None and not isinstance(options, Mapping):
            raise ConfigError(f"options is a {type(options).__name__}", hint="give a dict")
        given = self.task.table.check(options)
        fresh = seed is not None or self._np_random is None
        super().reset(seed=seed)
        seeds = np.array([world_seed(self.np_random)]) if fresh else None
        self.task.reset(seeds=seeds, options=given)
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance one control step.

        Raises:
            ConfigError: If the action has another shape or holds NaN; nothing has moved then.
        """
        task = self.task
        task.scene.actions.assign(checked_actions(action, self.action_space)[None])
        task.step()
        info = self._info()
        terminated = bool(task.terminated.numpy()[0])
        if terminated:
            info["failure"] = EndReason(info["end_reason"]).name.lower()
        return self._observe(), float(task.reward.numpy()[0]), terminated, bool(task.truncated.numpy()[0]), info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the views of the rendering cameras side by side, uint8 (render_size, 2 render_size, 3)."""
        if self.render_mode is None:
            return None
        return render_worlds(self.task)[0]

    def _observe(self) -> Any:
        """Return the observation in arrays of its own."""
        return take(observation_arrays(self.task), 0)

    def _info(self) -> dict[str, Any]:
        """Return the info of the present state."""
        info = take(info_arrays(self.task), 0, scalars=True)
        info["solver_reasons"] = status_reasons(info["solver_status"])
        return info


def world_seed(random: np.random.Generator) -> int:
    """Return the seed of a world's draws from the generator that `reset(seed=...)` made."""
    return int(random.integers(2**31))


def checked_config(
    env: Any,
    config: TaskConfig | None,
    preset: str | None,
    obs_type: str,
    render_mode: str | None,
    control_mode: str | None,
    splat: str | Path | None,
    size: float | None,
) -> TaskConfig:
    """Return the configuration with the constructor's shortcuts applied.

    Raises:
        ConfigError: If an option is unknown, or the configuration of another task.
    """
    known = get_args(ObservationType)
    if obs_type not in known:
        raise ConfigError(f"obs_type is {obs_type!r}", hint=f"use one of {', '.join(map(repr, known))}")
    if render_mode not in (None, *env.metadata["render_modes"]):
        raise ConfigError(f"render_mode is {render_mode!r}", hint="use 'rgb_array' or None")
    if control_mode not in (None, *CONTROL_MODES):
        raise ConfigError(f"mode is {control_mode!r}", hint=f"use one of {', '.join(map(repr, CONTROL_MODES))}")
    wanted = env.task_class.config_class
    if config is not None and not isinstance(config, wanted):
        raise ConfigError(
            f"config is a {type(config).__name__}",
            hint=f"pass {wanted.__name__}(image_size=128), of {wanted.__module__}",
        )
    if config is not None and preset is not None:
        raise ConfigError(f"preset {preset!r} and config exclude each other", hint="give one of them")
    chosen = config
    if chosen is None:
        chosen = wanted() if preset is None else wanted.preset(preset)
    scene = chosen.scene
    if control_mode is not None:
        scene = replace(scene, control=replace(scene.control, mode=control_mode))  # type: ignore[arg-type]
    if splat is not None or size is not None:
        given = {name: value for name, value in (("splat", splat), ("size", size)) if value is not None}
        thing = scene.object
        if splat is not None and (thing.extents is not None or thing.mesh is not None or thing.body is not None):
            thing = ObjectConfig(surface_count=thing.surface_count, build=thing.build)
        if thing.extents is not None or thing.body is not None:
            what = f"a {thing.shape} of {thing.extents} m" if thing.body is None else f"the body {thing.body}"
            raise ConfigError(
                f"size given for {what}",
                hint="set the extents of config.scene.object, or give a splat file too",
            )
        scene = replace(scene, object=replace(thing, **given))
    return replace(chosen, scene=scene)


def checked_device(device: Any) -> Any:
    """Return a Warp device.

    Raises:
        ConfigError: If there is no such device.
    """
    if isinstance(device, str) and device == "cuda":
        device = "cuda:0"
    try:
        return wp.get_device(device)
    except (ValueError, RuntimeError) as error:
        known = ", ".join(str(found) for found in wp.get_devices())
        raise ConfigError(f"there is no device {device!r}", hint=f"use one of {known}") from error


def checked_actions(actions: Any, space: gym.Space) -> NDArray[np.float32]:
    """Return actions as an array.

    Raises:
        ConfigError: If they have another shape than those of the space, or a number is not finite.
    """
    try:
        numbers = np.asarray(actions, np.float32)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"action is no array of numbers: {error}", hint="give one number per entry") from error
    if numbers.shape != space.shape:
        raise ConfigError(
            f"action has shape {numbers.shape}, expected {space.shape}",
            hint="give one number in [-1, 1] per entry of env.action_space",
        )
    if not np.isfinite(numbers).all():
        where = f" of worlds {np.flatnonzero(~np.isfinite(numbers).all(axis=1)).tolist()}" if numbers.ndim > 1 else ""
        raise ConfigError(f"action{where} holds NaN or infinity", hint="check the policy that produced it")
    return numbers


# -- reading a task ---------------------------------------------------------------------------------------------------


def observation_arrays(task: Task, *, final: bool = False) -> Any:
    """Return the observation of all worlds as Warp arrays, in the structure of `Task.observation_space`."""
    vector: Any = task.final_observation if final else task.observation
    if task.obs_type == "state":
        keys = task.state_keys()
        return {name: vector[:, columns] for name, columns in keys.items()} if keys else vector
    images: dict[str, Any] = dict(task.final_images if final else task.images)
    if task.obs_type == "pixels_agent_pos":
        images["agent_pos"] = vector[:, : task.agent_size]
    return images["pixels"] if list(images) == ["pixels"] else images


def info_arrays(task: Task, *, final: bool = False) -> dict[str, Any]:
    """Return the infos of all worlds as Warp arrays; with `final`, those of the episodes that ended in this step."""
    metrics: Any = task.metrics
    parameters: Any = task.table.values
    if final:
        metrics, parameters = task.final_metrics, task.final_parameters
    info: dict[str, Any] = {"is_success": task.final_success if final else task.success}
    info["reward_terms"] = {name: task.terms[:, k] for k, name in enumerate(task.term_names)}
    info.update({name: metrics[:, k] for k, name in enumerate(task.metric_names)})
    columns = {name: task.table.columns(name) for name in task.table.parameters}
    info["parameters"] = {
        name: parameters[:, c.start] if c.stop - c.start == 1 else parameters[:, c] for name, c in columns.items()
    }
    vector: Any = task.final_observation if final else task.observation
    info["finger_force"] = vector[:, task.segments["finger_force"][0]]
    info["solver_status"] = task.final_status if final else task.scene.solver.status
    info["end_reason"] = task.end
    return info


def take(tree: Any, world: int, *, scalars: bool = False) -> Any:
    """Return one world of a tree of arrays, in arrays of its own; `scalars` makes single numbers Python's."""
    if isinstance(tree, dict):
        return {name: take(value, world, scalars=scalars) for name, value in tree.items()}
    value = tree.numpy()[world]
    return value.item() if scalars and value.ndim == 0 else value.copy()


def render_worlds(task: Task) -> NDArray[np.uint8]:
    """Return the rendered frame of every world, shape (world_count, height, width, 3)."""
    cameras = task.render_cameras()
    drawn = task.scene.render((cameras[0].width, cameras[0].height))
    return np.concatenate([drawn.images(camera.name).numpy() for camera in cameras], axis=2)
