"""softmode's tasks in LeRobot: ``lerobot-eval --env.type=softmode --env.task=LiftSoft-v0``."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import gymnasium as gym

from lerobot_env_softmode.worlds import SoftmodeWorlds, check_version, make_worlds, named_space
from softmode.envs import env_spec

check_version(version("lerobot"))  # before its names are imported, which move
# ruff: noqa: E402

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

__all__ = ["SoftmodeEnv", "SoftmodeWorlds", "make_worlds"]


@EnvConfig.register_subclass("softmode")
@dataclass
class SoftmodeEnv(EnvConfig):
    """A task of softmode, or one of your own that is made of a softmode task.

    Args:
        task: Name of the task, such as "LiftSoft-v0", or an id with its namespace, such as "module:mine/Task-v0".
        obs_type: What is observed: "pixels_agent_pos", "pixels" or "state".
        image_size: Edge of the pictures [px].
        camera: The camera's name.
        splat: Splat file of the object.
        size: Its longest edge [m].
        robot: Another robot than the built-in arm: a name or a file.
        control_mode: What actions mean.
        device: Warp device, such as "cpu" or "cuda:0".
        episode_length: Control steps of an episode; the task's own if None.
    """

    task: str | None = "LiftSoft-v0"
    obs_type: str = "pixels_agent_pos"
    image_size: int = 96
    camera: str = "front"
    splat: str | None = None
    size: float | None = None
    robot: str | None = None
    control_mode: str | None = None
    device: str | None = None
    episode_length: int | None = None

    @property
    def gym_id(self) -> str:
        """The environment's id."""
        return self.task if "/" in (self.task or "") else f"softmode/{self.task}"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment; what is None is the environment's own."""
        names = ("obs_type", "splat", "size", "robot", "control_mode", "device")
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        if self.obs_type != "state":
            given["image_size"] = self.image_size
        if self.episode_length is not None:
            given["max_episode_steps"] = self.episode_length
        return given

    def __post_init__(self) -> None:
        """Tell LeRobot what is observed, which depends on task, robot and object; nothing is built for it."""
        found = env_spec(
            self.gym_id, **({} if self.obs_type == "state" else {"camera": self.camera}), **self.gym_kwargs
        )
        vector = found.vector_space if self.obs_type == "state" else None
        space = named_space(found.observation_space, vector, found.agent_size, self.camera)
        self.features[ACTION] = PolicyFeature(FeatureType.ACTION, found.action_space.shape)
        self.features_map[ACTION] = ACTION
        self.fps = found.fps
        kinds = {
            "agent_pos": (FeatureType.STATE, OBS_STATE),
            "environment_state": (FeatureType.ENV, OBS_ENV_STATE),
        }
        for key, part in space.spaces.items():
            if key == "pixels":
                for camera, picture in part.spaces.items():
                    self.features[f"pixels/{camera}"] = PolicyFeature(FeatureType.VISUAL, picture.shape)
                    self.features_map[f"pixels/{camera}"] = f"{OBS_IMAGES}.{camera}"
            else:
                kind, self.features_map[key] = kinds[key]
                self.features[key] = PolicyFeature(kind, part.shape)

    def _make(self, count: int) -> SoftmodeWorlds:
        return make_worlds(self.gym_id, count, camera=self.camera, **self.gym_kwargs)

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Make the environment with all worlds in it; asynchronous ones are not needed."""
        return {self.type: {0: self._make(n_envs)}}
