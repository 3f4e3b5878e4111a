"""A task as a Gymnasium environment of one world."""

from __future__ import annotations

import copy
import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import gymnasium as gym
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.model.status import status_reasons
from softmode.deformables.reduction.build_body import Progress
from softmode.deformables.tools.gaps import warn_of_overlaps
from softmode.envs.arguments import (
    LOOK_ON,
    RENDER_MODES,
    Shortcuts,
    TaskEnv,
    TaskT,
    checked_actions,
    checked_config,
    checked_device,
    checked_options,
    world_seed,
)
from softmode.envs.env_state import EnvState, checked_state, generator_of, generator_state
from softmode.envs.parameters import check_options
from softmode.envs.results import name_of, take
from softmode.envs.reward_kernels import EndReason
from softmode.envs.robots import Robot
from softmode.envs.task_config import ObservationType, TaskConfig
from softmode.envs.worlds import LocalWorlds
from softmode.errors import ConfigError, needs_extra


class SoftEnv(TaskEnv[TaskT], gym.Env, gym.utils.EzPickle):
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
    how gently objects were handled (:class:`softmode.envs.handling.Handling`), ``is_safe_success``,
    ``finger_force`` [N], ``parameters`` (what was drawn at reset), ``solver_status`` (the solver's flags), where there
    are any ``solver_reasons`` (their names, such as "contact_overflow"), and ``end_reason`` (:class:`EndReason`); with
    a set of objects (``TaskConfig.objects``) ``object``, which one is there, and ``object_name``, with several per
    world that of each slot, -1 for none, and a tuple of the names of those that are there. An episode
    terminates only by failure, named by ``failure``, such as "dropped" or "diverged".

    ``reset`` takes as ``options`` any of the parameters, such as ``position`` (x, y) [m], ``yaw`` [rad],
    ``youngs_modulus`` [Pa]; what is not given is drawn from the configured ranges. Draws depend on the seed and on
    how many episodes were played since it was given. ``options={"state": state}`` begins with a state of `get_state`
    instead, with its draws, so without a seed or other options; time counts from zero. ``copy.deepcopy`` copies an
    environment in its state; a pickled one begins anew.

    Args:
        obs_type: What ``reset`` and ``step`` return.
        render_mode: "rgb_array"; "human" for a page in the browser that shows every step, with the extra `[viz]`; or
            None.
        control_mode: What actions mean.
        splat: Splat file of the object; None for the built-in one.
        size: Longest edge of the object [m].
        preset: Named variant of the task, instead of `config`.
        robot: Robot instead of the built-in arm: a name of `softmode.robots.available`, a file, arguments of
            `softmode.robots.load` by name, a `RobotDescription`, or a `TableRobot` of `softmode.robots.place_robot`.
        config: Everything else.
        device: Warp device.
        progress: Reports the build of the object: a callable (stage, fraction), or True or False for a bar or none.
        fields: Fields of the configuration, such as ``image_size=64``; they replace those of `config`.

    Raises:
        ConfigError: If an option is unknown or out of range, or there is no such device.
        AssetError: If the splat file cannot be used.
    """

    metadata = {"render_modes": [*RENDER_MODES, LOOK_ON], "render_fps": 30}  # noqa: RUF012  (gymnasium's own convention)
    task: TaskT
    """The task in one world."""

    def __init__(
        self,
        *,
        obs_type: ObservationType = "state",
        render_mode: str | None = None,
        control_mode: str | None = None,
        splat: str | Path | None = None,
        size: float | None = None,
        preset: str | None = None,
        robot: Robot | None = None,
        config: TaskConfig | None = None,
        device: wp.DeviceLike = None,
        progress: bool | Progress | None = None,
        **fields: Any,
    ) -> None:
        """Build the scene and the spaces."""
        given = Shortcuts(
            obs_type=obs_type,
            render_mode=render_mode,
            control_mode=control_mode,
            splat=splat,
            size=size,
            preset=preset,
            robot=robot,
        )
        # What a copy is made from when the environment is pickled; a callback cannot travel.
        place = None if device is None else str(device)
        gym.utils.EzPickle.__init__(self, **vars(given), config=config, device=place, **fields)
        self.config = checked_config(
            self.task_class.config_class, config, given, self.task_class.any_robot, fields, single=True
        )
        if render_mode == LOOK_ON:
            with needs_extra("viz", 'render_mode="human" needs viser'):
                import viser  # noqa: F401
        self.obs_type, self.render_mode = obs_type, render_mode
        self.metadata = {**self.metadata, "render_fps": round(self.config.scene.control_hz)}
        made = {"config": self.config, "obs_type": obs_type, "render": render_mode is not None}
        self._worlds = LocalWorlds(self.task_class, {**made, "device": checked_device(device), "progress": progress})
        self.task = self._worlds.task  # type: ignore[assignment]  # the one in the brackets
        self.scene, self.device = self.task.scene, self.task.device
        self.action_space, self.observation_space = self._worlds.action_space, self._worlds.observation_space
        self._result = self._worlds.result()
        """What the last reset or step made: always the same memory."""
        self._begun = False
        """Whether an episode has begun."""
        self._page: Any = None
        self._object_names = () if self.config.object_set is None else self.config.object_set.names

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; what starts more than 1 mm inside something else is said in the log "softmode"."""
        given = checked_options(options)
        self._begun = True
        if "state" in given:
            if seed is not None or len(given) > 1:
                raise ConfigError(
                    "a state excludes a seed and other options, it brings its own", hint="give the state alone"
                )
            self._set_state(checked_state(given["state"]), begin=True)
            self._look_on()
            return self._observe(), self._info()
        given = check_options(self.task.table.options, given, 1)
        fresh = seed is not None or self._np_random is None
        super().reset(seed=seed)
        seed = world_seed(self.np_random) if fresh else -1
        self._worlds.reset(np.ones(1, bool), np.array([seed]), given)
        warn_of_overlaps(self.scene.solver, self.scene.state, self.scene.dt)
        self._look_on()
        return self._observe(), self._info()

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance one control step.

        Raises:
            ConfigError: If the action has another shape or holds NaN, or no episode has begun; nothing has moved then.
        """
        if not self._begun:
            raise ConfigError("step comes before the first reset", hint="call reset() first")
        self._worlds.step(checked_actions(action, self.action_space)[None])
        self._look_on()
        info, made = self._info(), self._result
        reward, terminated, truncated = (take(made[n], 0, scalars=True) for n in ("reward", "terminated", "truncated"))
        if terminated:
            info["failure"] = EndReason(info["end_reason"]).name.lower()
        return self._observe(), reward, terminated, truncated, info

    def get_state(self) -> EnvState:
        """Return the state, from which `set_state` goes on with the same bits on CPU.

        Raises:
            ConfigError: If the scene has grips, which are not part of a state.
        """
        owner, arrays = self._worlds.get_state()
        return EnvState(owner=owner, arrays=arrays, random=(generator_state(self._np_random),))

    def set_state(self, state: EnvState | bytes) -> None:
        """Go on from a state, of this environment or of another of the same task, robot and objects.

        Wrappers, such as Gymnasium's time limit, count on.

        Args:
            state: What `get_state` returned, of one world, or its bytes.

        Raises:
            StateError: If it is damaged, or of another version, task, robot or object; nothing has changed then.
        """
        self._set_state(checked_state(state), begin=False)

    def _set_state(self, state: EnvState, *, begin: bool) -> None:
        """Go on from a state; `begin` lets an episode begin there."""
        if state.world_count != 1:
            raise ConfigError(f"the state has {state.world_count} worlds", hint="choose one with state.worlds([0])")
        random = generator_of(state.random[0])
        self._begun = True
        self._worlds.set_state(state.owner, state.arrays, np.ones(1, bool), begin)
        self._np_random = random

    def twin(self, **changes: Any) -> Self:
        """Return another environment in the same state.

        Args:
            changes: Arguments that it is made with in place of those of this one, such as ``render_mode``.
        """
        made = type(self)(*self._ezpickle_args, **{**self._ezpickle_kwargs, **changes})
        made.spec, made._np_random_seed = copy.deepcopy(self.spec), self._np_random_seed
        made.set_state(self.get_state())
        return made

    def __deepcopy__(self, memo: dict[int, object]) -> Self:
        """Return another environment in the same state."""
        memo[id(self)] = made = self.twin()
        return made

    def render(self) -> NDArray[np.uint8] | None:
        """Return the views of the rendering cameras side by side, uint8 (render_size, 2 render_size, 3)."""
        if self.render_mode != "rgb_array":
            return None
        return self._worlds.render()[0]

    @property
    def page_url(self) -> str | None:
        """Where the page of ``render_mode="human"`` is, from the first reset on; None in other modes."""
        return None if self._page is None else self._page.url

    def close(self) -> None:
        """End the page, if there is one."""
        if self._page is not None:
            self._page.close()
            self._page = None

    def _look_on(self) -> None:
        """Show the present state to who looks on."""
        if self.render_mode == LOOK_ON:
            if self._page is None:  # loaded by name: a room above this one
                self._page = importlib.import_module("softmode.view.env_page").EnvPage(self)
            self._page.show()

    def _observe(self) -> Any:
        """Return the observation in arrays of its own."""
        return take(self._result["observation"], 0)

    def _info(self) -> dict[str, Any]:
        """Return the info of the present state."""
        info = take(self._result["info"], 0, scalars=True)
        if info["solver_status"]:
            info["solver_reasons"] = status_reasons(info["solver_status"])
        if self._object_names:
            info["object_name"] = name_of(info["object"], self._object_names)
        return info
