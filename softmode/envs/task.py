"""A task in any number of worlds: scene, draws at reset, observation, reward and ends of episodes, as one graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, ClassVar, Literal, Self, get_args

import gymnasium as gym
import numpy as np
import warp as wp
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.body.rkpm import sample_farthest
from softmode.deformables.model import status as bits
from softmode.deformables.solver.parameters import set_parameters
from softmode.envs import task_kernels as kernels
from softmode.envs.parameters import Parameter, ParameterTable
from softmode.errors import ConfigError
from softmode.scenes.table_scene import GAP, TableScene, TableSceneConfig
from softmode.splats.camera import CameraOptions
from softmode.splats.camera_randomization import CameraRandomization
from softmode.splats.pinhole import PinholeCamera
from softmode.splats.splats import Splats

ObservationType = Literal["state", "pixels", "pixels_agent_pos"]
CameraName = Literal["front", "wrist"]
ImageOutput = Literal["depth", "segmentation"]
FALL = 0.05
"""How far under its resting height on the table object 0 counts as dropped [m]."""
MATERIAL = ("youngs_modulus", "poissons_ratio", "density", "friction", "scale")
"""Parameters of the soft bodies, in the order of their columns."""


class EndReason(IntEnum):
    """Why an episode ended, ``info["end_reason"]``; what comes after TIME_LIMIT is a failure and terminates.

    The limit of a single environment is that of Gymnasium's ``TimeLimit`` around it, which info does not tell.
    """

    RUNNING = 0
    TIME_LIMIT = 1
    DIVERGED = 2
    """A number of the world's state was not finite."""
    DROPPED = 3
    """The object fell off the table."""
    SPILLED = 4
    """Another object left the container that it belongs in."""


@dataclass(frozen=True)
class Segment:
    """A named part of the observation vector."""

    name: str
    """What it holds."""
    size: int
    """How many numbers."""
    low: float | tuple[float, ...]
    """Bound below, in the unit of the quantity."""
    high: float | tuple[float, ...]
    """Bound above."""


PROPRIOCEPTION = (
    Segment("tool_position", 3, -2.0, 2.0),
    Segment("tool_heading", 2, -1.0, 1.0),
    Segment("opening", 1, -0.1, 0.5),
    Segment("finger_force", 2, 0.0, 200.0),
    Segment("joint_angles", 7, -3.5, 3.5),
    Segment("command_lead", 3, -1.0, 1.0),
    Segment("command_turn", 1, -1.0, 1.0),
    Segment("command_opening", 1, -0.5, 0.5),
)


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """Scene, randomisation and pictures, common to all tasks."""

    scene: TableSceneConfig = field(default_factory=TableSceneConfig)
    """Objects, robot and physics."""
    position_range: tuple[float, float] = (0.05, 0.08)
    """Half-width of the object's random position in x and y [m]."""
    yaw_range: float = math.pi
    """Half-width of its random yaw [rad]."""
    youngs_modulus_range: tuple[float, float] | None = (2.0e4, 2.0e6)
    """Range of the random Young's modulus [Pa], log-uniform; None keeps the scene's material, as for all of these."""
    poissons_ratio_range: tuple[float, float] | None = None
    """Range of the random Poisson's ratio."""
    density_range: tuple[float, float] | None = None
    """Range of the random density [kg/m^3], log-uniform."""
    friction_range: tuple[float, float] | None = None
    """Range of the random friction coefficient of the object."""
    scale_range: tuple[float, float] | None = None
    """Range of the random size of the objects, as a factor."""
    camera: CameraName = "front"
    """Camera of pixel observations: one in front of the table, or one on the hand."""
    image_size: int = 96
    """Edge of a pixel observation [px]."""
    image_outputs: tuple[ImageOutput, ...] = ()
    """What pixel observations hold beside colours: "depth" [m], "segmentation" (int32, see ``SplatCamera.labels``)."""
    camera_randomization: CameraRandomization | None = None
    """Random pose, lens, light and colours of every episode."""
    render_size: int = 256
    """Edge of each half of a rendered frame [px]."""
    mesh_samples: int = 1
    """Rays per pixel for robot and table, in observations and renderings: 1, or 4 for smooth edges."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not (min(self.position_range) >= 0.0 and self.yaw_range >= 0.0):
            raise ConfigError(f"position_range {self.position_range} and yaw_range {self.yaw_range} must be >= 0")
        limits = {
            "youngs_modulus_range": (0.0, np.inf),
            "poissons_ratio_range": (-1.0, 0.5),
            "density_range": (0.0, np.inf),
            "friction_range": (-1e-9, np.inf),
            "scale_range": (0.49, 2.01),
        }
        for name, (least, most) in limits.items():
            chosen = getattr(self, name)
            if chosen is not None and not least < chosen[0] <= chosen[1] < most:
                raise ConfigError(f"{name} must satisfy {max(least, 0)} < low <= high < {most}, got {chosen}")
        if self.camera not in get_args(CameraName):
            raise ConfigError(f"camera is {self.camera!r}", hint="use 'front' or 'wrist'")
        if not set(self.image_outputs) <= set(get_args(ImageOutput)):
            raise ConfigError(f"image_outputs is {self.image_outputs}", hint="name 'depth', 'segmentation' or nothing")
        if not 36 <= self.image_size <= 640:
            raise ConfigError(f"image_size must lie in 36..640 px, got {self.image_size}")
        if not 64 <= self.render_size <= 1024:
            raise ConfigError(f"render_size must lie in 64..1024 px, got {self.render_size}")
        if self.mesh_samples not in (1, 4):
            raise ConfigError(f"mesh_samples must be 1 or 4, got {self.mesh_samples}")

    @classmethod
    def preset(cls, name: str) -> Self:
        """Return a named variant of the task.

        Raises:
            ConfigError: If there is none of that name.
        """
        known = cls.presets()
        if name not in known:
            names = ", ".join(map(repr, known)) or "none"
            raise ConfigError(f"{cls.__name__} has no preset {name!r}", hint=f"there are: {names}")
        return known[name]

    @classmethod
    def presets(cls) -> dict[str, Self]:
        """Return the named variants of the task."""
        return {}


class Task:
    """A task in `world_count` worlds; subclasses add goals and rewards.

    A subclass names its `terms` and `metrics`, may extend `parameters` and `goal_segments`, and overrides the methods
    of the section "what a task adds", which only launch kernels, because `step` is captured as one graph.

    Args:
        config: The task's configuration.
        obs_type: What observations are made of; "state" draws no pictures.
        world_count: Number of worlds.
        limit: Control steps per episode, 0 for no limit.
        autoreset_mode: When a world whose episode ended starts the next one; DISABLED leaves that to `reset`.
        render: Whether `render` will be asked for.
        device: Warp device.
        progress: Reports the build of the objects.

    Attributes:
        observation: Bounded observation vector, float32, shape (world_count, D).
        final_observation: That at the end of the last episode, before the reset of SAME_STEP.
        terms: Reward terms, shape (world_count, T), `term_names`.
        metrics: Task-specific figures, shape (world_count, M), `metric_names`.
        reward: Sum of the terms, shape (world_count,).
        terminated: Whether the episode ended by a failure.
        truncated: Whether it ended by its limit.
        success: Whether the task counts as solved now.
        end: `EndReason` of the step.
        done: terminated or truncated.
    """

    config_class: ClassVar[type[TaskConfig]] = TaskConfig
    """Class of the configuration."""
    term_names: ClassVar[tuple[str, ...]] = ()
    """Names of the reward's terms."""
    metric_names: ClassVar[tuple[str, ...]] = ()
    """Names of the figures in info."""
    end_reasons: ClassVar[type[EndReason]] = EndReason
    """What the numbers in `end` mean."""
    scripted_policy: ClassVar[Callable[[Any], Callable[[Any], Any]] | None] = None
    """Makes the policy that `--policy scripted` plays, from observation to action, for an environment."""
    point_count: ClassVar[int] = 16
    """Surface points of the object in the observation."""

    def __init__(
        self,
        config: TaskConfig,
        *,
        obs_type: ObservationType = "state",
        world_count: int = 1,
        limit: int = 0,
        autoreset_mode: AutoresetMode = AutoresetMode.DISABLED,
        render: bool = False,
        device: Any = None,
        progress: Any = None,
    ) -> None:
        """Build the scene and allocate what a step writes."""
        self.config, self.obs_type, self.world_count = config, obs_type, world_count
        self.limit, self.autoreset_mode = limit, autoreset_mode
        cameras = []
        if obs_type != "state":
            cameras.append(self.observation_camera())
        if render:
            cameras += self.render_cameras()
        self.scene = TableScene(
            self.scene_config(),
            world_count=world_count,
            cameras=cameras,
            camera_options=CameraOptions(
                mesh_samples=config.mesh_samples, segmentation="segmentation" in config.image_outputs
            ),
            camera_randomization=config.camera_randomization,
            marker=self.marker() if cameras else None,
            device=device,
            progress=progress,
        )
        self.device = self.scene.device
        self.table = ParameterTable(self.parameters(), world_count, self.device)
        soft = self.scene.soft
        self.points = sample_farthest(soft.body.surface_points, self.point_count, first=0)
        """Surface samples of object 0 in the observation."""
        self._points = wp.array(self.points, dtype=int, device=self.device)
        self._lay_out()
        self._allocate()
        self.build()
        self.reset()
        self._step()  # compiles what the graph needs
        with wp.ScopedCapture(device=self.device) as capture:
            self._step()
        self.graph: Any = capture.graph
        """The step as a captured graph."""

    def _lay_out(self) -> None:
        """Give every segment of the observation its columns."""
        reach = 2.0
        body = (
            Segment("object_position", 3, -reach, reach),
            Segment("object_velocity", 3, -20.0, 20.0),
            Segment("object_offset", 3, -2.0 * reach, 2.0 * reach),
            Segment("object_points", 3 * self.point_count, -reach, reach),
        )
        self.segments: dict[str, tuple[slice, Segment]] = {}
        """Columns of each segment: proprioception, goal, object, and what a task adds about it."""
        column = 0
        for segment in (*PROPRIOCEPTION, *self.goal_segments(), *body, *self.object_segments()):
            self.segments[segment.name] = (slice(column, column + segment.size), segment)
            column += segment.size
        chosen = [segment for _, segment in self.segments.values()]
        low = [np.broadcast_to(np.array(segment.low, np.float32), segment.size) for segment in chosen]
        high = [np.broadcast_to(np.array(segment.high, np.float32), segment.size) for segment in chosen]
        self.low, self.high = np.concatenate(low), np.concatenate(high)
        self.agent_size = self.column("object_position")
        """Leading columns of the observation that do not see the object: proprioception and goal."""

    def column(self, segment: str) -> int:
        """Return the first column of a segment of the observation."""
        return self.segments[segment][0].start

    def _allocate(self) -> None:
        """Make the arrays that a step writes."""
        worlds, device = self.world_count, self.device

        def zeros(*shape: int, dtype: Any = float) -> wp.array:
            return wp.zeros((worlds, *shape), dtype=dtype, device=device)

        self.seed, self.episode, self.elapsed, self.end, self.failure = (zeros(dtype=int) for _ in range(5))
        self.held = zeros(dtype=int)
        """Control steps in a row in which the goal was met, counted by `evaluate`."""
        self.terminated, self.truncated, self.success, self.done, self.finite = (zeros(dtype=wp.bool) for _ in range(5))
        self.final_success = zeros(dtype=wp.bool)
        self.observation, self.final_observation = zeros(len(self.low)), zeros(len(self.low))
        self.reward = zeros()
        self.terms = zeros(max(len(self.term_names), 1))
        self.metrics, self.final_metrics = (zeros(max(len(self.metric_names), 1)) for _ in range(2))
        self.final_parameters = wp.zeros_like(self.table.values)
        self.final_status = wp.zeros_like(self.scene.solver.status)
        self._never, self._fresh = zeros(dtype=wp.bool), zeros(dtype=wp.bool)
        self.any_done = wp.zeros(1, dtype=int, device=device)
        instances = worlds * len(self.scene.objects)
        self._material = wp.zeros((len(MATERIAL), instances), dtype=float, device=device)
        self._solver_mask = wp.zeros(worlds + 1, dtype=wp.bool, device=device)
        self._low = wp.array(self.low, dtype=float, device=device)
        self._high = wp.array(self.high, dtype=float, device=device)
        self.images: dict[str, wp.array] = {}
        """Pictures of the observation by key: pixels, depth, segmentation; shape (world_count, height, width, ...)."""
        self.final_images: dict[str, wp.array] = {}
        if self.obs_type != "state":
            edge = self.config.image_size
            camera = self.scene.cameras[edge, edge]
            self.images["pixels"] = camera.images("pixels")
            for name in self.config.image_outputs:
                self.images[name] = camera.images("pixels", name)
            if self.autoreset_mode == AutoresetMode.SAME_STEP:
                self.final_images = {name: wp.zeros_like(image) for name, image in self.images.items()}

    # -- what a task adds ---------------------------------------------------------------------------------------------

    def scene_config(self) -> TableSceneConfig:
        """Return what the scene is built from: the configured one, and what a task adds to it."""
        return self.config.scene

    def build(self) -> None:
        """Allocate what the subclass needs; called once, when the scene stands."""

    def parameters(self) -> tuple[Parameter, ...]:
        """Return what is drawn at reset."""
        config, scene = self.config, self.config.scene
        (x, y), (dx, dy) = scene.object_position, config.position_range
        material = scene.material
        least, most = scene.control.workspace_lower, scene.control.workspace_upper

        def ranged(name: str, least: float, most: float, *, log: bool = False) -> Parameter:
            given = getattr(config, f"{name}_range")
            low, high = (getattr(material, name, 1.0),) * 2 if given is None else given
            return Parameter(name=name, low=(low,), high=(high,), log=log, least=(least,), most=(most,))

        return (
            Parameter(name="position", low=(x - dx, y - dy), high=(x + dx, y + dy), least=least[:2], most=most[:2]),
            Parameter(
                name="yaw", low=(-config.yaw_range,), high=(config.yaw_range,), least=(-math.tau,), most=(math.tau,)
            ),
            ranged("youngs_modulus", 1.0e2, 1.0e11, log=True),
            ranged("poissons_ratio", -0.9, 0.499),
            ranged("density", 1.0, 2.0e4, log=True),
            ranged("friction", 0.0, 10.0),
            ranged("scale", 0.5, 2.0),
        )

    def goal_segments(self) -> tuple[Segment, ...]:
        """Return the segments of the observation that say what to reach."""
        return ()

    def object_segments(self) -> tuple[Segment, ...]:
        """Return more segments that see the object; the last ones of the observation."""
        return ()

    def place(self) -> None:
        """Write `place_position` and `place_yaw` of all objects of the worlds in `scene.world_mask`."""
        self.place_object(0, "position", "yaw")

    def clear(self) -> None:
        """Reset `held`, and counters of the subclass, in the worlds of `scene.world_mask`."""
        self.launch(kernels.forget_held, [self.scene.world_mask], [self.held])

    def observe(self) -> None:
        """Write the goal segments of `observation` and the `metrics`, functions of the state alone."""

    def evaluate(self) -> None:
        """Write `terms`, `success` and, for failures of the task's own, `failure` (an `EndReason`); once per step."""

    def marker(self) -> Splats | None:
        """Return the splats that mark the goal in pictures; `observe` writes `scene.marker_place`."""
        return None

    def observation_camera(self) -> PinholeCamera:
        """Return the camera of pixel observations, named "pixels"."""
        edge = self.config.image_size
        return front_camera("pixels", edge) if self.config.camera == "front" else wrist_camera("pixels", edge)

    def render_cameras(self) -> list[PinholeCamera]:
        """Return the cameras whose pictures stand side by side in a rendered frame."""
        edge = self.config.render_size
        return [front_camera("front", edge), overview("overview", edge)]

    # -- helpers for subclasses ---------------------------------------------------------------------------------------

    def launch(self, kernel: Any, inputs: Sequence[Any], outputs: Sequence[Any], dim: Any = None) -> None:
        """Launch a kernel over the worlds."""
        dim = self.world_count if dim is None else dim
        wp.launch(kernel, dim=dim, inputs=list(inputs), outputs=list(outputs), device=self.device)

    def place_object(self, index: int, position: str, yaw: str, ground: float = 0.0) -> None:
        """Put an object where two parameters say, standing on the table or on `ground` [m] above it."""
        scene, table = self.scene, self.table
        self.launch(
            kernels.place_object,
            [
                scene.world_mask,
                table.values,
                table.column(position),
                table.column(yaw),
                table.column("scale"),
                scene.objects[index].height,
                GAP + ground,
                len(scene.objects),
                index,
            ],
            [scene.place_position, scene.place_yaw],
        )

    # -- episodes -----------------------------------------------------------------------------------------------------

    def reset(
        self,
        *,
        world_mask: NDArray[np.bool_] | None = None,
        seeds: ArrayLike | None = None,
        options: dict[str, NDArray[np.float32]] | None = None,
    ) -> None:
        """Start new episodes in the chosen worlds.

        Args:
            world_mask: Which worlds, shape (world_count,); all if None.
            seeds: Seed of each world, shape (world_count,), whose episodes count from zero again; None goes on.
            options: Checked values of parameters, see `check_options`; the others are drawn.
        """
        mask = np.ones(self.world_count, bool) if world_mask is None else np.asarray(world_mask, bool)
        if seeds is not None:
            chosen, count = self.seed.numpy().copy(), self.episode.numpy().copy()
            chosen[mask] = np.asarray(seeds, np.int64)[mask] & 0x7FFFFFFF
            count[mask] = -1
            self.seed.assign(chosen)
            self.episode.assign(count)
            for camera in self.scene.cameras.values():
                camera.variation.seed(chosen, mask)
        self.scene.world_mask.assign(mask)
        self._draw()
        if options:
            values = self.table.values.numpy().copy()
            for name, numbers in options.items():
                values[mask, self.table.columns(name)] = numbers[mask]
            self.table.values.assign(values)
        self._start()
        terms, end = self.terms.numpy().copy(), self.end.numpy().copy()
        terms[mask], end[mask] = 0.0, EndReason.RUNNING
        self.terms.assign(terms)
        self.end.assign(end)
        self._observe()
        self._draw_pictures()

    def _draw(self) -> None:
        """Draw the parameters of the worlds in `scene.world_mask`."""
        table = self.table
        self.launch(
            kernels.draw_parameters,
            [self.scene.world_mask, self.seed, table.low, table.high, table.log],
            [self.episode, table.values],
        )

    def _start(self) -> None:
        """Set those worlds up from their parameters."""
        scene, table = self.scene, self.table
        mask, stride = scene.world_mask, len(scene.objects)
        self.launch(
            kernels.spread_materials,
            [table.values, table.column(MATERIAL[0]), stride],
            [self._material],
            self.world_count * stride,
        )
        wp.copy(self._solver_mask, mask, count=self.world_count)
        values: Any = self._material
        set_parameters(scene.solver, self._solver_mask, **{name: values[k] for k, name in enumerate(MATERIAL)})
        self.place()
        scene.reset_worlds()
        for camera in scene.cameras.values():
            camera.randomize(mask)
        self.launch(kernels.clear_worlds, [mask], [self.elapsed, self.done, self.success, self.failure])
        self.clear()

    def _observe(self) -> None:
        """Write the observation and the metrics of all worlds."""
        scene = self.scene
        controller, state, data = scene.controller, scene.state, scene.model.softmode
        self.launch(
            kernels.observe_arm,
            [
                controller.coord_start,
                state.joint_q,
                controller.tool_pose,
                controller.opening,
                scene.finger_force,
                controller.target_position,
                controller.target_yaw,
                controller.commanded_q,
            ],
            [self.observation],
        )
        self.launch(
            kernels.observe_object,
            [
                scene.object_position,
                scene.object_velocity,
                controller.tool_pose,
                data.particle_start,
                state.particle_q,
                self._points,
                len(scene.objects),
                self.column("object_position"),
            ],
            [self.observation],
        )
        self.observe()
        self.launch(kernels.bound_observation, [self._low, self._high], [self.observation, self.finite])

    def _draw_pictures(self) -> None:
        """Draw the picture of a pixel observation."""
        if self.obs_type != "state":
            edge = self.config.image_size
            self.scene.draw(self.scene.cameras[edge, edge])

    # -- the step -----------------------------------------------------------------------------------------------------

    def step(self) -> None:
        """Advance all worlds by one control step with the actions in `scene.actions`."""
        wp.capture_launch(self.graph)

    def _step(self) -> None:
        """Simulate, judge, start the episodes that are due, observe."""
        scene = self.scene
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            wp.copy(self._fresh, self.done)
            scene.control_step()
            self._restart(self._fresh)
            self._observe()
            self._finish(self._fresh)
            self.clear()  # what `evaluate` counted in worlds that only started
        else:
            scene.control_step()
            self._observe()
            self._finish(self._never)
            if self.autoreset_mode == AutoresetMode.SAME_STEP:
                if self.images:
                    wp.capture_if(self.any_done, on_true=self._keep_pictures)
                wp.copy(self.final_observation, self.observation)
                wp.copy(self.final_metrics, self.metrics)
                wp.copy(self.final_success, self.success)
                wp.copy(self.final_parameters, self.table.values)
                wp.copy(self.final_status, scene.solver.status)
                wp.copy(self._fresh, self.done)
                self._restart(self._fresh)
                self._observe()
        self._draw_pictures()

    def _restart(self, mask: wp.array) -> None:
        """Start new episodes in the worlds of the mask."""
        wp.copy(self.scene.world_mask, mask)
        self._draw()
        self._start()

    def _finish(self, fresh: wp.array) -> None:
        """Judge the step."""
        scene = self.scene
        self.failure.zero_()
        self.any_done.zero_()
        self.evaluate()
        self.launch(
            kernels.finish_step,
            [
                fresh,
                self.limit,
                bits.WORLD_NOT_FINITE,
                scene.solver.status,
                self.finite,
                scene.object_position,
                scene.soft.height - FALL,
            ],
            [
                self.terms,
                self.elapsed,
                self.failure,
                self.reward,
                self.terminated,
                self.truncated,
                self.end,
                self.done,
                self.any_done,
            ],
        )

    def _keep_pictures(self) -> None:
        """Draw the last picture of the episodes that end."""
        self._draw_pictures()
        for name, image in self.images.items():
            wp.copy(self.final_images[name], image)

    # -- spaces -------------------------------------------------------------------------------------------------------

    @property
    def action_space(self) -> gym.spaces.Box:
        """Actions of one world, in [-1, 1]."""
        return gym.spaces.Box(-1.0, 1.0, (self.config.scene.control.action_size,), np.float32)

    def state_keys(self) -> dict[str, slice]:
        """Return the columns of each key of a state observation that is a dict; empty for one that is a vector."""
        return {}

    def observation_space(self) -> gym.Space:
        """Return the space of one world's observation; every bound is finite."""
        if self.obs_type == "state":
            keys = self.state_keys()
            if keys:
                return gym.spaces.Dict({name: self.state_space(columns) for name, columns in keys.items()})
            return self.state_space(slice(0, len(self.low)))
        edge = self.config.image_size
        spaces: dict[str, gym.Space] = {"pixels": gym.spaces.Box(0, 255, (edge, edge, 3), np.uint8)}
        if "depth" in self.images:
            spaces["depth"] = gym.spaces.Box(0.0, 10.0, (edge, edge), np.float32)
        if "segmentation" in self.images:
            count = len(self.scene.cameras[edge, edge].labels)
            spaces["segmentation"] = gym.spaces.Box(-1, count, (edge, edge), np.int32)
        if self.obs_type == "pixels_agent_pos":
            spaces["agent_pos"] = self.state_space(slice(0, self.agent_size))
        return spaces["pixels"] if list(spaces) == ["pixels"] else gym.spaces.Dict(spaces)

    def state_space(self, columns: slice) -> gym.spaces.Box:
        """Return the space of some columns of the observation vector."""
        return gym.spaces.Box(self.low[columns], self.high[columns], dtype=np.float32)


def front_camera(name: str, edge: int) -> PinholeCamera:
    """Return the camera that looks at the object from the front."""
    return PinholeCamera.look_at(
        name, position=(0.86, 0.34, 0.25), target=(0.44, 0.0, 0.11), width=edge, height=edge, fov_y=0.60
    )


def wrist_camera(name: str, edge: int) -> PinholeCamera:
    """Return the camera on the hand that looks between the fingers."""
    return PinholeCamera.look_at(
        name,
        position=(0.12, 0.0, 0.02),
        target=(0.0, 0.0, 0.14),
        up=(-1.0, 0.0, 0.0),
        width=edge,
        height=edge,
        fov_y=1.1,
        body="link7",
    )


def overview(name: str, edge: int) -> PinholeCamera:
    """Return the camera that sees arm and table."""
    return PinholeCamera.look_at(
        name, position=(1.05, -0.85, 0.60), target=(0.30, 0.0, 0.25), width=edge, height=edge, fov_y=0.60
    )
