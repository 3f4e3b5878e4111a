"""LiftSoft: pick a soft object from a table and hold it at a goal height."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from softmode.deformables import status as bits
from softmode.deformables.rkpm import sample_farthest
from softmode.envs.table_scene import TableScene, TableSceneConfig
from softmode.errors import ConfigError
from softmode.splats.camera import CameraOptions, PinholeCamera

ObservationType = Literal["state", "pixels", "pixels_agent_pos"]
POINT_COUNT = 16
"""Surface points of the object in a state observation."""


@dataclass(frozen=True, kw_only=True)
class LiftSoftConfig:
    """Task, randomisation and pictures of LiftSoft."""

    scene: TableSceneConfig = field(default_factory=TableSceneConfig)
    """Object, robot and physics."""
    goal_height: float = 0.15
    """How far the object's centre of mass is to rise [m]."""
    goal_tolerance: float = 0.02
    """Distance from the goal height that counts as there [m]."""
    hold_steps: int = 15
    """Control steps in a row at the goal, held by both fingers, that make a success."""
    position_range: tuple[float, float] = (0.05, 0.08)
    """Half-width of the object's random position in x and y [m]."""
    yaw_range: float = np.pi
    """Half-width of its random yaw [rad]."""
    youngs_modulus_range: tuple[float, float] = (2.0e4, 2.0e6)
    """Range of the random Young's modulus [Pa], log-uniform."""
    image_size: int = 96
    """Edge of a pixel observation [px]."""
    render_size: int = 256
    """Edge of each half of a rendered frame [px]."""
    mesh_samples: int = 1
    """Rays per pixel for robot and table, in observations and renderings: 1, or 4 for smooth edges."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        low, high = self.youngs_modulus_range
        if not 0.0 < low <= high < np.inf:
            raise ConfigError(f"youngs_modulus_range must satisfy 0 < low <= high, got {self.youngs_modulus_range}")
        if not 0.0 < self.goal_height <= 0.4:
            raise ConfigError(f"goal_height must lie in 0..0.4 m, got {self.goal_height}")
        if not 0.0 < self.goal_tolerance < self.goal_height:
            raise ConfigError(f"goal_tolerance must lie in 0..goal_height, got {self.goal_tolerance}")
        if self.hold_steps < 1:
            raise ConfigError(f"hold_steps must be at least 1, got {self.hold_steps}")
        if not (min(self.position_range) >= 0.0 and self.yaw_range >= 0.0):
            raise ConfigError(f"position_range {self.position_range} and yaw_range {self.yaw_range} must be >= 0")
        if not 36 <= self.image_size <= 640:
            raise ConfigError(f"image_size must lie in 36..640 px, got {self.image_size}")
        if not 64 <= self.render_size <= 1024:
            raise ConfigError(f"render_size must lie in 64..1024 px, got {self.render_size}")
        if self.mesh_samples not in (1, 4):
            raise ConfigError(f"mesh_samples must be 1 or 4, got {self.mesh_samples}")


class LiftSoftEnv(gym.Env, gym.utils.EzPickle):
    """One arm, one soft object.

    Actions, float32 in [-1, 1], larger ones are clamped: with ``control_mode="pose_delta"`` (x, y, z, yaw, gripper)
    steps of the tool, with ``"joint_delta"`` seven joint steps and the gripper; the gripper entry is +1 open, -1
    squeeze with full force.

    Observations by ``obs_type``:

    - ``"state"``: float32 vector: proprioception (see below), object centre (3) and velocity (3), 16 surface points
      (48), goal height (1).
    - ``"pixels"``: uint8 image (image_size, image_size, 3) of the camera in front.
    - ``"pixels_agent_pos"``: dict of ``pixels`` and ``agent_pos``, the proprioception: tool position (3) [m], cos and
      sin of its yaw, opening [m], finger forces (2) [N], joint angles (7) [rad].

    Numbers beyond the bounds of ``observation_space`` (an object thrown off the table) are clipped to them.

    The reward is the sum of ``info["reward_terms"]``: ``reach`` (0..1, tool to object), ``grasp`` (0 or 0.5, both
    fingers touch), ``lift`` (0..2, share of the goal height while grasped), ``hold`` (0 or 2, at the goal). ``info``
    also holds ``is_success`` (the object is held at the goal, and has been for ``hold_steps`` steps), ``object_height``
    (rise of its centre of mass [m]), ``finger_force`` [N], ``youngs_modulus`` [Pa], ``solver_status`` (the solver's
    flags) and ``solver_reasons`` (their names, such as "contact_overflow"). An episode terminates only by failure,
    named by ``failure``: "dropped" (off the table) or "diverged".

    ``reset`` takes ``options``: ``position`` (x, y) [m], ``yaw`` [rad], ``youngs_modulus`` [Pa]; what is not given is
    drawn at random from the configured ranges.

    Args:
        obs_type: What ``reset`` and ``step`` return.
        render_mode: "rgb_array" or None.
        control_mode: What actions mean.
        splat: Splat file of the object; None for the built-in plush.
        size: Longest edge of the object [m].
        config: Everything else.
        device: Warp device.
        progress: Reports the build of the object: a callable (stage, fraction), or True or False for a bar or none.

    Raises:
        ConfigError: If an option is unknown or out of range.
        AssetError: If the splat file cannot be used.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012  (gymnasium's own convention)

    def __init__(
        self,
        *,
        obs_type: ObservationType = "state",
        render_mode: str | None = None,
        control_mode: Literal["pose_delta", "joint_delta"] | None = None,
        splat: str | Path | None = None,
        size: float | None = None,
        config: LiftSoftConfig | None = None,
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
            config=config,
            device=None if device is None else str(device),
        )
        if obs_type not in get_args(ObservationType):
            raise ConfigError(
                f"obs_type is {obs_type!r}", hint=f"use one of {', '.join(map(repr, get_args(ObservationType)))}"
            )
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(f"render_mode is {render_mode!r}", hint="use 'rgb_array' or None")
        if config is not None and not isinstance(config, LiftSoftConfig):
            raise ConfigError(
                f"config is a {type(config).__name__}", hint="pass LiftSoftConfig(image_size=128), of this module"
            )
        self.config = _configured(config or LiftSoftConfig(), control_mode, splat, size)
        self.obs_type, self.render_mode = obs_type, render_mode
        self.metadata = {**self.metadata, "render_fps": round(self.config.scene.control_hz)}
        cameras = []
        if obs_type != "state":
            cameras.append(_front_camera("pixels", self.config.image_size))
        if render_mode == "rgb_array":
            cameras += [_front_camera("front", self.config.render_size), _overview(self.config.render_size)]
        self.scene = TableScene(
            self.config.scene,
            cameras=cameras,
            camera_options=CameraOptions(mesh_samples=self.config.mesh_samples),
            device=device,
            progress=progress,
        )
        actions = self.config.scene.control.action_size
        self.action_space = gym.spaces.Box(-1.0, 1.0, (actions,), np.float32)
        self.observation_space = self._make_observation_space()
        self._points = sample_farthest(self.scene.soft.body.surface_points, POINT_COUNT, first=0)
        self._rest_height = self.scene.soft.height
        self._held = 0
        self._youngs_modulus = self.config.scene.material.youngs_modulus

    def _make_observation_space(self) -> gym.Space:
        """Return the space of the chosen type; every bound is finite."""
        edge = self.config.image_size
        pixels = gym.spaces.Box(0, 255, (edge, edge, 3), np.uint8)
        if self.obs_type == "pixels":
            return pixels
        reach, force, angle = 2.0, 200.0, 3.5  # [m], [N], [rad]
        low = [-reach] * 3 + [-1.0] * 2 + [-0.1] + [0.0] * 2 + [-angle] * 7
        high = [reach] * 3 + [1.0] * 2 + [0.5] + [force] * 2 + [angle] * 7
        if self.obs_type == "state":
            bound = [reach] * 3 + [20.0] * 3 + [reach] * 3 * POINT_COUNT  # centre, velocity [m/s], points
            low += [-x for x in bound] + [0.0]
            high += [*bound, 1.0]
        numbers = gym.spaces.Box(np.array(low, np.float32), np.array(high, np.float32))
        self._bounds = numbers.low, numbers.high
        return numbers if self.obs_type == "state" else gym.spaces.Dict({"pixels": pixels, "agent_pos": numbers})

    # -- episode ------------------------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Put the object somewhere else, the arm back home."""
        given = self._checked_options(options)
        super().reset(seed=seed)
        config, random = self.config, self.np_random
        x, y = self.config.scene.object_position
        drawn = {
            "position": np.array([x, y]) + random.uniform(-1.0, 1.0, 2) * config.position_range,
            "yaw": random.uniform(-config.yaw_range, config.yaw_range),
            "youngs_modulus": np.exp(random.uniform(*np.log(config.youngs_modulus_range))),
        }
        drawn.update(given)
        self._youngs_modulus = float(drawn["youngs_modulus"])
        self._held = 0
        self.scene.reset(
            position=np.array([drawn["position"]], float),
            yaw=np.array([drawn["yaw"]], float),
            youngs_modulus=np.array([self._youngs_modulus]),
        )
        return self._observe(), self._info(self._reward_terms())

    def _checked_options(self, options: Mapping[str, Any] | None) -> dict[str, Any]:
        """Return the options of a reset, or raise before anything changes."""
        given = dict(options or {})
        unknown = sorted(set(given) - {"position", "yaw", "youngs_modulus"})
        if unknown:
            raise ConfigError(f"unknown reset options {unknown}", hint="use position, yaw and youngs_modulus")
        sizes = {"position": 2, "yaw": 1, "youngs_modulus": 1}
        for name, value in given.items():
            try:
                number = np.asarray(value, float).reshape(-1)
            except (TypeError, ValueError):
                number = np.empty(0)
            if number.shape != (sizes[name],) or not np.isfinite(number).all():
                raise ConfigError(
                    f"{name} must be {'two finite numbers' if sizes[name] == 2 else 'a finite number'}, got {value!r}"
                )
            given[name] = number if sizes[name] == 2 else float(number[0])
        if "position" in given:
            control = self.config.scene.control
            low, high = control.workspace_lower[:2], control.workspace_upper[:2]
            if not ((given["position"] >= low) & (given["position"] <= high)).all():
                raise ConfigError(
                    f"position {given['position'].tolist()} lies outside the workspace",
                    hint=f"stay within {low} to {high} m",
                )
        if "youngs_modulus" in given:
            replace(self.config.scene.material, youngs_modulus=given["youngs_modulus"])  # checks its range
        return given

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance one control step.

        Raises:
            ConfigError: If the action has another shape or holds NaN; nothing has moved then.
        """
        try:
            action = np.asarray(action, np.float32)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"action is no array of numbers: {error}", hint="give one number per entry") from error
        if action.shape != self.action_space.shape:
            raise ConfigError(
                f"action has shape {action.shape}, expected {self.action_space.shape}",
                hint="give one number in [-1, 1] per entry of env.action_space",
            )
        if not np.isfinite(action).all():
            raise ConfigError(f"action holds NaN or infinity: {action}", hint="check the policy that produced it")
        self.scene.step(action[None])
        at_goal = abs(self.rise() - self.config.goal_height) <= self.config.goal_tolerance
        self._held = self._held + 1 if at_goal and self._grasped() else 0
        terms = self._reward_terms()
        info = self._info(terms)
        failure = self._failure()
        if failure:
            info["failure"] = failure
        return self._observe(), float(sum(terms.values())), failure is not None, False, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the view of the camera in front beside an overview, uint8 (render_size, 2 render_size, 3)."""
        if self.render_mode is None:
            return None
        edge = self.config.render_size
        camera = self.scene.render((edge, edge))
        return np.concatenate([camera.images("front").numpy()[0], camera.images("overview").numpy()[0]], axis=1)

    # -- parts --------------------------------------------------------------------------------------------------------

    def rise(self) -> float:
        """Rise of the object's centre of mass above where it rests [m]."""
        return float(self.scene.object_position.numpy()[0, 2]) - self._rest_height

    def _finger_force(self) -> NDArray[np.float32]:
        """Size of the contact force on each finger [N], shape (2,)."""
        return np.linalg.norm(self.scene.finger_force.numpy()[0], axis=1).astype(np.float32)

    def _grasped(self) -> bool:
        """Whether both fingers feel the object."""
        return bool((self._finger_force() > 0.02).all())

    def _failure(self) -> str | None:
        """Name the failure that ends the episode, if any."""
        if self.scene.status[0] & bits.WORLD_NOT_FINITE:
            return "diverged"
        if not self.rise() > -0.05:
            return "dropped"
        return None

    def _reward_terms(self) -> dict[str, float]:
        """Compute the terms of the reward."""
        tool = self.scene.controller.tool_pose.numpy()[0, :3]
        distance = np.linalg.norm(tool - self.scene.object_position.numpy()[0])
        reach = 1.0 - np.tanh(10.0 * distance) if np.isfinite(distance) else 0.0
        grasped = self._grasped()
        lift = float(np.clip(self.rise() / self.config.goal_height, 0.0, 1.0)) if grasped else 0.0
        return {
            "reach": float(reach),
            "grasp": 0.5 * grasped,
            "lift": 2.0 * lift,
            "hold": 2.0 * (self._held > 0),
        }

    def _info(self, terms: dict[str, float]) -> dict[str, Any]:
        return {
            "is_success": self._held >= self.config.hold_steps,
            "reward_terms": terms,
            "object_height": self.rise(),
            "finger_force": self._finger_force(),
            "youngs_modulus": self._youngs_modulus,
            "solver_status": int(self.scene.status[0]),
            "solver_reasons": self.scene.status_reasons[0],
        }

    def _agent_pos(self) -> NDArray[Any]:
        """Return the proprioception."""
        scene = self.scene
        pose = scene.controller.tool_pose.numpy()[0]
        x, y, z, w = pose[3:]
        forward = np.array([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w)])  # tool x axis on the table
        heading = -forward / max(float(np.linalg.norm(forward)), 1e-9)
        coord = scene.arm.coord_start
        joints = scene.state.joint_q.numpy()[coord : coord + 7]
        opening = scene.controller.opening.numpy()[0]
        return np.concatenate([pose[:3], heading, [opening], self._finger_force(), joints])

    def _bounded(self, numbers: NDArray[Any]) -> NDArray[np.float32]:
        """Return the numbers as a float32 array inside the bounds of the observation space, zero where not finite."""
        return np.clip(np.nan_to_num(numbers.astype(np.float32), nan=0.0), *self._bounds)

    def _observe(self) -> Any:
        """Return the observation of the chosen type, in arrays of its own."""
        if self.obs_type == "state":
            scene = self.scene
            start = int(scene.model.softmode.particle_start.numpy()[0])
            points = scene.state.particle_q.numpy()[start + self._points]
            parts = [
                self._agent_pos(),
                scene.object_position.numpy()[0],
                scene.object_velocity.numpy()[0],
                points.ravel(),
                [self.config.goal_height],
            ]
            return self._bounded(np.concatenate(parts))
        edge = self.config.image_size
        pixels = self.scene.render((edge, edge)).images("pixels").numpy()[0].copy()
        if self.obs_type == "pixels":
            return pixels
        return {"pixels": pixels, "agent_pos": self._bounded(self._agent_pos())}


def _configured(
    config: LiftSoftConfig, control_mode: str | None, splat: str | Path | None, size: float | None
) -> LiftSoftConfig:
    """Return the configuration with the constructor's shortcuts applied."""
    scene = config.scene
    if control_mode is not None:
        scene = replace(scene, control=replace(scene.control, mode=control_mode))
    if splat is not None or size is not None:
        given = {name: value for name, value in (("splat", splat), ("size", size)) if value is not None}
        scene = replace(scene, object=replace(scene.object, **given))
    return replace(config, scene=scene)


def _front_camera(name: str, edge: int) -> PinholeCamera:
    """Return the camera that looks at the object from the front."""
    return PinholeCamera.look_at(
        name, position=(0.86, 0.34, 0.25), target=(0.44, 0.0, 0.11), width=edge, height=edge, fov_y=0.60
    )


def _overview(edge: int) -> PinholeCamera:
    """Return the camera that sees arm and table."""
    return PinholeCamera.look_at(
        "overview", position=(1.05, -0.85, 0.60), target=(0.30, 0.0, 0.25), width=edge, height=edge, fov_y=0.60
    )
