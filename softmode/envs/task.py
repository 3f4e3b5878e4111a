"""A task in any number of worlds: scene, draws at reset, observation, reward and ends of episodes, as one graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar, cast

import gymnasium as gym
import numpy as np
import warp as wp
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.body.rkpm import sample_farthest
from softmode.deformables.materials.material import Material
from softmode.deformables.model import status as bits
from softmode.deformables.model.compile_ahead import compile_launches, compiling_aside
from softmode.deformables.model.structs import filled
from softmode.deformables.reduction.build_body import Progress
from softmode.deformables.tools.parameters import set_parameters
from softmode.envs import task_kernels as kernels
from softmode.envs.cameras import FollowCamera, overview, square_camera, wrist_camera
from softmode.envs.clutter import Arcs, clutter_parameters
from softmode.envs.end_reason import EndReason
from softmode.envs.observation import (
    ObservationLayout,
    Segment,
    object_part,
    one_hot_part,
    others_part,
    proprioception,
)
from softmode.envs.parameters import Parameter, ParameterTable
from softmode.envs.reward_kernels import StepResult, WorldState
from softmode.envs.task_config import ObservationType, TaskConfig
from softmode.errors import ConfigError, GraspError
from softmode.objects.loader import load
from softmode.objects.rest_grasps import rest_grasps
from softmode.objects.soft_object import SoftObject
from softmode.robots.jaws import ParallelJaw
from softmode.scenes.capture import capture_graph
from softmode.scenes.table_scene import GAP, TableScene, TableSceneConfig
from softmode.splats.cameras.camera import CameraOptions
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.splats import Splats

FALL = 0.05
"""How far under its resting height on the table object 0 counts as dropped [m]."""
HAND = 0.07
"""Radius about the tool that the following camera shows [m]."""
MARKER = 0.02
"""Radius about the goal that the following camera shows [m]."""
MATERIAL = ("youngs_modulus", "poissons_ratio", "density", "friction", "scale")
"""Parameters of the soft bodies."""


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
        reward: Sum of the terms, or as `TaskConfig.reward_mode` says, shape (world_count,).
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
    grasps: ClassVar[bool] = False
    """Whether the gripper is to take object 0."""
    takes_sets: ClassVar[bool] = False
    """Whether object 0 may be another one in every world (`TaskConfig.objects`): what the task reads of it comes from
    `WorldState`, or is one per world, never of `scene.soft`."""
    takes_several: ClassVar[bool] = False
    """Whether worlds may have several objects of the set (`ObjectSet.per_world`): object 0 is that of the task, the
    others lie beside it, see `other_arcs`."""
    any_robot: ClassVar[bool] = False
    """Whether the task has been tried with robots from files, which `robot` names."""
    kernels: ClassVar[Any] = None
    """Device side that `observe` and `evaluate` launch, a module with kernels of these names and a struct `Plan`: first
    columns of parameters (`drawn`) and segments (`columns`), and what has the name of an attribute of the task, its
    configuration, the controller's options or the first object. None where a task overrides both methods."""

    def __init__(
        self,
        config: TaskConfig,
        *,
        obs_type: ObservationType = "state",
        world_count: int = 1,
        limit: int = 0,
        autoreset_mode: AutoresetMode = AutoresetMode.DISABLED,
        render: bool = False,
        device: wp.DeviceLike = None,
        progress: bool | Progress | None = None,
    ) -> None:
        """Build the scene and allocate what a step writes."""
        self.config, self.obs_type, self.world_count = config, obs_type, world_count
        self.object_set = config.object_set
        """The objects of which every world gets one; None where all have the same."""
        if self.object_set is not None and not self.takes_sets:
            raise ConfigError(
                f"{type(self).__name__} cannot have another object in every world, objects is a set of"
                f" {self.object_set.count}",
                hint="give config.scene.object one object; a task of yours may set takes_sets",
            )
        self.slots = 1 if self.object_set is None else self.object_set.number_range[1]
        """How many objects of the set a world has room for."""
        if self.slots > 1 and not self.takes_several:
            raise ConfigError(
                f"{type(self).__name__} has one object per world, objects.per_world asks for {self.slots}",
                hint="leave per_world out, or take LiftSoft, PushSoft or PlaceInBin",
            )
        self.limit, self.autoreset_mode = limit, autoreset_mode
        cameras = []
        if obs_type != "state":
            cameras.append(self.observation_camera())
        if render:
            cameras += self.render_cameras()  # for recorders, in fixed places
        labelled = "segmentation" in config.image_outputs
        options = CameraOptions(mesh_samples=config.mesh_samples, segmentation=labelled)
        with compiling_aside(device):
            self.scene = TableScene(
                self.scene_config(),
                world_count=world_count,
                cameras=cameras,
                film=self.render_cameras() if render else (),
                camera_options=options,
                camera_randomization=config.camera_randomization,
                marker=self.marker() if cameras else None,
                device=device,
                progress=progress,
            )
            self._lay_out()
            compile_launches(self._launches, self.device)
        self.reset()
        self.graph = capture_graph(self._step, self.device)
        """The step as a captured graph."""

    def _lay_out(self) -> None:
        """Lay out observations and parameters, and allocate what a step writes."""
        config, world_count = self.config, self.world_count
        self._follow = FollowCamera(self.render_cameras()[0], world_count)
        self.device = self.scene.device
        self._check_objects()
        kept = [self._kept(material) for material in self.scene.materials]
        self.table = ParameterTable(self.parameters(), world_count, self.device, kinds=kept, kind=self.scene.member)
        self._rows: list[tuple[wp.array, wp.array, bool]] = []
        members = self.scene.members
        points = [sample_farthest(thing.body.surface.points, self.point_count, first=0) for thing in members]
        self._points: NDArray[np.intp] = np.stack(points)
        self.points = self.points_of_worlds[0]
        """Those of world 0, and of all worlds that have the same object."""
        heights = np.array([thing.height for thing in members])
        self.rest_height = self.per_object(heights)
        """Height of the centre of every unscaled object 0 over the table at rest [m], shape (world_count,)."""
        given = self.object_set
        code = one_hot_part(given.count, self.slots) if given is not None and config.objects_one_hot else ()
        beside = others_part(self.slots - 1)
        proprioception_and_goal = (*proprioception(self.scene.controller.joint_count), *self.goal_segments())
        self.layout = ObservationLayout(
            (*proprioception_and_goal, *object_part(self.point_count), *self.object_segments(), *beside, *code)
        )
        self.segments = self.layout.segments
        """Columns of each segment: proprioception, goal, object, and what a task adds about it."""
        self.low, self.high = self.layout.low, self.layout.high
        self.agent_size = sum(segment.size for segment in proprioception_and_goal)
        """Leading columns of the observation that do not see the object: proprioception and goal."""
        self._allocate()
        self.build()
        if self.kernels is not None:
            columns = {
                "drawn": self.table.columns_in(self.kernels.Drawn),
                "columns": self.layout.columns_in(self.kernels.Columns),
            }
            self.plan = filled(self.kernels.Plan, self, config, config.scene.control, self.scene.soft, **columns)
            """What the task's own kernels know beside the state."""

    @property
    def member_names(self) -> tuple[str, ...]:
        """What messages call each member of the scene, see `TableScene.members`."""
        given, scene = self.object_set, self.scene
        if given is None:
            return ("the object",)
        held = range(given.count) if scene.resampled else np.unique(scene.chosen).tolist()
        return tuple(f"objects: {given.names[k]}" for k in held)

    @property
    def points_of_worlds(self) -> NDArray[np.intp]:
        """Surface samples of object 0 in the observation, shape (world_count, point_count)."""
        return self._points[self.scene.member]

    @property
    def reset_options(self) -> dict[str, Parameter]:
        """What a reset option may set, by name: the parameters, and with `ObjectSet.resample` the object."""
        given = self.object_set
        if given is None or not given.resample:
            return self.table.parameters
        low, high = (0.0, *[-1.0] * (self.slots - 1)), (given.count - 1.0,) * self.slots
        return {**self.table.parameters, "object": Parameter(name="object", low=low, high=high)}

    def per_object(self, values: ArrayLike, dtype: type = float, *, every_slot: bool = False) -> wp.array:
        """Return an array with a row per world: that of its object, which follows it where a reset may change it.

        Args:
            values: A row per member of the scene, see `TableScene.members`.
            dtype: Type of the array, of a multiple of 32 bits.
            every_slot: Whether the second axis has an entry per slot, which follows the object there.
        """
        table = np.asarray(values)
        array = wp.array(table[self.scene.member], dtype=dtype, device=self.device)
        if self.scene.resampled:
            self._rows.append((wp.array(table, dtype=dtype, device=self.device), array, every_slot))
        return array

    def column(self, segment: str) -> int:
        """Return the first column of a segment of the observation."""
        return self.layout.column(segment)

    def _allocate(self) -> None:
        """Make the arrays that a step writes."""
        worlds, device = self.world_count, self.device

        def zeros(*shape: int, dtype: type = float) -> wp.array:
            return wp.zeros((worlds, *shape), dtype=dtype, device=device)

        self.seed, self.episode, self.elapsed, self.end, self.failure = (zeros(dtype=int) for _ in range(5))
        self.held = zeros(dtype=int)
        """Control steps in a row in which the goal was met, counted by `evaluate`."""
        self.terminated, self.truncated, self.success, self.done, self.finite = (zeros(dtype=wp.bool) for _ in range(5))
        self.observation = zeros(len(self.low))
        self.reward = zeros()
        self.terms = zeros(max(len(self.term_names), 1))
        self.metrics = zeros(max(len(self.metric_names), 1))
        self.outcome: dict[str, wp.array] = {
            "success": self.success,
            "metrics": self.metrics,
            "parameters": self.table.values,
            "observation": self.observation,
            "status": self.scene.solver.status,
            "object": self.scene.object_index,
        }
        """What a step came to."""
        self.final_outcome = {name: wp.zeros_like(array) for name, array in self.outcome.items()}
        """What the last step of the last episode came to, before the reset of SAME_STEP."""
        self.final_observation = self.final_outcome["observation"]
        self.never = zeros(dtype=wp.bool)
        """A mask of no world."""
        self._fresh = zeros(dtype=wp.bool)
        self.any_done = wp.zeros(1, dtype=int, device=device)
        scene, instances = self.scene, worlds * len(self.scene.objects)
        self._material = wp.zeros((len(MATERIAL), instances), dtype=float, device=device)
        self.materials = {name: cast(wp.array, self._material[k]) for k, name in enumerate(MATERIAL)}
        """Material and scale of every soft object by name, each of shape (world_count * objects,)."""
        columns = [self.table.column(name) for name in MATERIAL]
        self._material_columns = wp.array(columns, dtype=int, device=device)
        self._solver_mask = wp.zeros(worlds + 1, dtype=wp.bool, device=device)
        others = [thing.height for thing in scene.objects[self.slots :]]
        heights = np.array([[*[thing.height] * self.slots, *others] for thing in scene.members])
        self._heights = self.per_object(heights, every_slot=self.slots > 1)
        self._lowest = self.per_object(heights[:, 0] - FALL)
        given = self.object_set
        self._ends = wp.array([1.0] if given is None else given.ends, dtype=float, device=device)
        self._wanted = wp.full(worlds * self.slots, int(kernels.UNASKED), dtype=int, device=device)
        self.object_index = scene.object_index
        """Which object of the set each world has, see `TableScene.object_index`."""
        self._choice: wp.array = scene.object_index.flatten()  # the same memory
        own = [[kept.get(name, math.nan) for name in MATERIAL] for kept in map(self._kept, scene.materials)]
        self._own_materials = wp.array(own, dtype=float, device=device)
        self._no_shift = zeros()
        self._low = wp.array(self.low, dtype=float, device=device)
        self._high = wp.array(self.high, dtype=float, device=device)
        self.state = filled(
            WorldState,
            scene,
            scene.controller,
            scene.model.softmode,
            scene.state,
            parameters=self.table.values,
            points=self.per_object(self._points, int),
            q=scene.state.softmode.q,
            stride=len(scene.objects),
            slots=self.slots,
            occupant=self._choice,
        )
        """What the kernels of a task read."""
        self.result = filled(StepResult, self, marker_place=scene.marker_place)
        """What they write."""
        self._arm = filled(kernels.ArmState, scene.controller, scene.state)
        self._episode = filled(kernels.Episode, self)
        self.images: dict[str, wp.array] = {}
        """Pictures of the observation by key: pixels, depth, segmentation; shape (world_count, height, width, ...)."""
        self.final_images: dict[str, wp.array] = {}
        if self.obs_type != "state":
            edge = self.config.image_size
            camera = scene.cameras[edge, edge]
            self.images["pixels"] = camera.images("pixels")
            for name in self.config.image_outputs:
                self.images[name] = camera.images("pixels", name)
            if self.autoreset_mode == AutoresetMode.SAME_STEP:
                self.final_images = {name: wp.zeros_like(image) for name, image in self.images.items()}

    # -- what a task adds ---------------------------------------------------------------------------------------------

    def scene_config(self) -> TableSceneConfig:
        """Return what the scene is built from: the configured one, and what a task adds to it.

        Where Poisson's ratio is drawn, the functions of every object are made for several.
        """
        scene, given = self.config.scene, self.config.object_set
        if given is not None:
            scene = replace(scene, objects=given.resolved(scene.object))
        if self.config.poissons_ratio_range is None:
            return scene
        if given is not None:
            scene = replace(scene, objects=given.resolved(scene.object).for_varied_ratio())
        first, *others = (thing.for_varied_ratio() for thing in (scene.object, *scene.others))
        return replace(scene, object=first, others=tuple(others))

    def _check_objects(self) -> None:
        """Refuse objects of a set that the gripper is to take and cannot.

        Raises:
            GraspError: If there is one; it names the object.
        """
        if self.object_set is None or not self.grasps:
            return
        scene, jaw = self.scene, ParallelJaw.of(self.config.scene.arm)
        for name, thing, material in zip(self.member_names, scene.members, scene.materials, strict=True):
            friction = max(math.sqrt(material.friction * jaw.friction), 1.0e-3)
            try:
                rest_grasps(thing.body, jaw, friction=friction)
            except GraspError as error:
                hint = "give it another size, or leave it out of the set"
                raise GraspError(f"{name} does not fit the gripper: {error.message}", hint=hint) from error

    def _kept(self, material: Material) -> dict[str, float]:
        """Return the properties of a material that are not drawn."""
        names = MATERIAL[: MATERIAL.index("scale")] if self.object_set is not None else ()
        return {name: getattr(material, name) for name in names if getattr(self.config, f"{name}_range") is None}

    def other_arcs(self) -> Arcs:
        """Return in which directions from object 0 others of a set may lie; all around by default."""
        return Arcs()

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
            ranged("poissons_ratio", -0.9, 0.49),
            ranged("density", 10.0, 2.0e4, log=True),
            ranged("friction", 0.0, 10.0),
            ranged("scale", 0.5, 2.0),
            *self._clutter_parameters(),
        )

    def _clutter_parameters(self) -> tuple[Parameter, ...]:
        """Return where objects beside object 0 lie."""
        if self.slots == 1:
            return ()
        return clutter_parameters(self.config, self.slots - 1, self.scene.members, self.other_arcs())

    def goal_segments(self) -> tuple[Segment, ...]:
        """Return the segments of the observation that say what to reach."""
        return ()

    def object_segments(self) -> tuple[Segment, ...]:
        """Return more segments that see the object; the last ones of the observation."""
        return ()

    def place(self) -> None:
        """Write `place_position` and `place_yaw` of all objects of the worlds in `scene.world_mask`."""
        self.place_object(0, "position", "yaw")
        self.place_others()

    def clear(self) -> None:
        """Reset `held`, and counters of the subclass, in the worlds of `scene.world_mask`."""
        self.launch(kernels.forget, [self.scene.world_mask, 0], [self.held])

    def before_step(self) -> None:
        """Change the worlds before each control step; part of the captured step."""

    def observe(self) -> None:
        """Write the goal segments of `observation` and the `metrics`, functions of the state alone."""
        if self.kernels is not None:
            self.launch(self.kernels.observe, [self.state, self.plan], [self.result])

    def evaluate(self) -> None:
        """Write `terms`, `success` and, for failures of the task's own, `failure` (an `EndReason`); once per step."""
        if self.kernels is not None:
            self.launch(self.kernels.evaluate, [self.state, self.plan], [self.result])

    def state_arrays(self) -> dict[str, wp.array]:
        """Return what episodes go on from beside the physics, by name, worlds first.

        Whoever keeps something from step to step that is no function of the physical state adds it.
        """
        names = ("seed", "episode", "elapsed", "end", "failure", "held", "terminated", "truncated", "success", "done")
        written = ("finite", "observation", "reward", "terms", "metrics")
        return {"parameters": self.table.values, **{name: getattr(self, name) for name in (*names, *written)}}

    def marker(self) -> Splats | Sequence[Splats] | None:
        """Return the splats that mark the goal in pictures, a list for worlds that differ.

        `observe` writes `scene.marker_place`.
        """
        return None

    def marker_per_object(self, draw: Callable[[SoftObject], Splats]) -> Splats | list[Splats]:
        """Return a marker that depends on object 0; a list where the worlds differ, see `TableScene`.

        Args:
            draw: Makes the splats of an object.
        """
        scene = self.scene_config()
        given = scene.objects
        if given is None:
            return draw(load(scene.object, material=scene.material))
        chosen = np.arange(given.count) if given.resample else given.chosen(self.world_count)
        drawn = {
            k: draw(load(given.config(k), material=given.material(k, scene.material)))
            for k in np.unique(chosen).tolist()
        }
        return drawn[chosen[0]] if len(drawn) == 1 and not given.resample else [drawn[k] for k in chosen.tolist()]

    def front_camera(self, name: str, edge: int) -> PinholeCamera:
        """Return the camera that looks at the object from the front, with pictures of `edge` x `edge` pixels."""
        return square_camera(name, edge, (0.86, 0.34, 0.25), (0.44, 0.0, 0.11), 0.60)

    def observation_camera(self) -> PinholeCamera:
        """Return the camera of pixel observations, named "pixels"."""
        edge = self.config.image_size
        if self.config.camera == "front":
            return self.front_camera("pixels", edge)
        return wrist_camera("pixels", edge, self.config.scene.arm)

    def render_cameras(self) -> list[PinholeCamera]:
        """Return the cameras whose pictures stand side by side in a rendered frame."""
        edge = self.config.render_size
        return [self.front_camera("front", edge), overview("overview", edge)]

    # -- helpers for subclasses ---------------------------------------------------------------------------------------

    def launch(
        self,
        kernel: wp.Kernel | Callable[..., None],
        inputs: Sequence[object],
        outputs: Sequence[object] = (),
        dim: int | tuple[int, ...] | None = None,
    ) -> None:
        """Launch a kernel over the worlds.

        Args:
            kernel: The kernel.
            inputs: Its first arguments.
            outputs: Its last arguments.
            dim: Number of threads; None for one per world.
        """
        dim = self.world_count if dim is None else dim
        wp.launch(kernel, dim=dim, inputs=list(inputs), outputs=list(outputs), device=self.device)

    def place_object(
        self,
        index: int,
        position: str,
        yaw: str,
        *,
        ground: float = 0.0,
        turn: float = 0.0,
        shift: wp.array | None = None,
    ) -> None:
        """Put an object down.

        Args:
            index: Which object of a world.
            position: The parameter that says where its centre is [m].
            yaw: The one that says its rotation about the vertical [rad].
            ground: Height over the table of what it stands on [m].
            turn: What is added to the yaw [rad].
            shift: From the centre of the unscaled object to what lies at the position, along the yaw [m], shape
                (world_count,); None for the centre itself.
        """
        scene, names = self.scene, {"position": position, "yaw": yaw, "scale": "scale"}
        columns = {field: self.table.column(name) for field, name in names.items()}
        given = {
            "turn": turn,
            "shift": self._no_shift if shift is None else shift,
            "gap": GAP + ground,
            "object_index": index,
        }
        place = filled(kernels.Placement, **columns, **given, height=self._heights)
        outputs = [scene.place_position, scene.place_yaw]
        self.launch(kernels.place_object, [scene.world_mask, self.state, place], outputs)

    def place_others(self) -> None:
        """Put the objects of a set beside object 0 down, about it."""
        scene, others = self.scene, self.slots - 1
        if not others:
            return
        names = {"turn": "others_turn", "place": "other_place_1", "yaw": "other_yaw_1", "scale": "scale"}
        columns = {field: self.table.column(name) for field, name in names.items()}
        stride = self.table.column("other_place_2") - columns["place"] if others > 1 else 0
        clutter = filled(kernels.Clutter, **columns, stride=stride, height=self._heights, gap=GAP)
        inputs, outputs = [scene.world_mask, self.state, clutter], [scene.place_position, scene.place_yaw]
        self.launch(kernels.place_beside, inputs, outputs, (self.world_count, others))

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
        options = dict(options or {})
        wanted = options.pop("object", None)
        if wanted is not None:
            asked = np.where(mask[:, None], np.rint(wanted), int(kernels.UNASKED)).astype(np.int32)
            self._wanted.assign(asked.reshape(-1))
        self._draw()
        self._wanted.fill_(int(kernels.UNASKED))
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
        self.write_observation()
        self.draw_pictures()

    def begin(self, mask: NDArray[np.bool_] | None = None) -> None:
        """Let episodes begin in the masked worlds, all if None, from where they are: time counts from zero."""
        chosen = np.ones(self.world_count, bool) if mask is None else mask
        for array in (self.elapsed, self.terminated, self.truncated, self.done, self.end, self.terms):
            values = array.numpy().copy()
            values[chosen] = 0
            array.assign(values)

    def _draw(self) -> None:
        """Draw the parameters of the worlds in `scene.world_mask`."""
        table = self.table
        if self.scene.resampled:
            least = 1 if self.object_set is None else self.object_set.number_range[0]
            inputs = [self.scene.world_mask, self.seed, self.episode, self._ends, least, self.slots, self._wanted]
            self.launch(kernels.draw_objects, inputs, [self._choice, table.kind])
        inputs = [self.scene.world_mask, self.seed, table.kind, table.low, table.high, table.log]
        self.launch(kernels.draw_parameters, inputs, [self.episode, table.values])

    def _start(self) -> None:
        """Set those worlds up from their parameters."""
        scene = self.scene
        mask = scene.world_mask
        if scene.resampled:
            self.use_objects()
        self.apply_materials()
        self.place()
        scene.reset_worlds()
        for camera in scene.cameras.values():
            camera.randomize(mask)
        self.launch(kernels.clear_worlds, [mask], [self._episode, self.result])
        self.clear()

    def use_objects(self) -> None:
        """Let the worlds in `scene.world_mask` have the objects that `object_index` says, with what is theirs."""
        self.scene.use_objects()
        for table, array, every_slot in self._rows:
            self.scene.copy_rows(table, array, every_slot=every_slot)

    def apply_materials(self) -> None:
        """Give the bodies of the worlds in `scene.world_mask` the materials and sizes of their parameters."""
        values = self._material
        inputs = [self.state, self._material_columns, self._own_materials, self._choice, self.slots]
        self.launch(kernels.spread_materials, inputs, [values], values.shape[1])
        wp.copy(self._solver_mask, self.scene.world_mask, count=self.world_count)
        set_parameters(self.scene.solver, self._solver_mask, **self.materials)

    def write_observation(self) -> None:
        """Write the observation and the metrics of all worlds."""
        columns = self.layout.columns_in(kernels.Columns)
        self.launch(kernels.observe, [self.state, self._arm, columns], [self.observation])
        if self.object_set is not None and self.config.objects_one_hot:
            count = self.object_set.count
            inputs = [self._choice, self.slots, count, self.column("object_one_hot")]
            self.launch(kernels.observe_kind, inputs, [self.observation], (self.world_count, self.slots * count))
        if self.slots > 1:
            inputs = [self.state, self.column("other_offsets"), self.column("other_present")]
            self.launch(kernels.observe_others, inputs, [self.observation], (self.world_count, self.slots - 1))
        self.observe()
        self.launch(kernels.bound_observation, [self._low, self._high], [self.observation, self.finite])

    def draw_pictures(self) -> None:
        """Draw the picture of a pixel observation."""
        if self.obs_type != "state":
            edge = self.config.image_size
            self.scene.draw(self.scene.cameras[edge, edge])

    def draw_film(self) -> NDArray[np.uint8]:
        """Return the pictures of the film cameras side by side, uint8 (world_count, edge, cameras * edge, 3)."""
        scene, film = self.scene, self.scene.film
        if film is not None:
            time = self.elapsed.numpy() / self.config.scene.control_hz
            film.aim(film.cameras[0].name, self._follow.matrices(self.in_focus(), time))
        pictures = scene.draw_film().numpy()
        cameras = pictures.reshape(-1, self.world_count, *pictures.shape[1:])
        return np.concatenate(list(cameras), axis=2)

    def forget_film(self, mask: NDArray[np.bool_]) -> None:
        """Let the following camera jump to its place in the masked worlds, shape (world_count,)."""
        self._follow.forget(mask)

    def in_focus(self) -> NDArray[np.float64]:
        """Return balls (x, y, z, radius) [m] that the following camera shows, shape (world_count, K, 4).

        They are object 0, the hand, and the goal if a marker shows it.
        """
        scene = self.scene
        scale = self.table.values.numpy()[:, self.table.column("scale")]
        radius = np.array([thing.radius for thing in scene.members])[scene.member] * scale
        balls = [(scene.object_position.numpy()[:, 0], radius), (scene.controller.tool_pose.numpy()[:, :3], HAND)]
        if scene.marker is not None:
            balls.append((scene.marker_place.numpy()[:, :3], MARKER))
        return np.stack([np.column_stack([x, np.broadcast_to(r, len(x))]) for x, r in balls], axis=1)

    # -- the step -----------------------------------------------------------------------------------------------------

    def step(self) -> None:
        """Advance all worlds by one control step with the actions in `scene.actions`."""
        self.graph.launch()

    def _step(self) -> None:
        """Simulate, judge, start the episodes that are due, observe."""
        scene = self.scene
        self.before_step()
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            wp.copy(self._fresh, self.done)
            scene.control_step()
            self.restart(self._fresh)
            self.write_observation()
            self.finish(self._fresh)
            self.clear()  # what `evaluate` counted in worlds that only started
        else:
            scene.control_step()
            self.write_observation()
            self.finish(self.never)
            if self.autoreset_mode == AutoresetMode.SAME_STEP:
                if self.images:
                    wp.capture_if(self.any_done, on_true=self._keep_pictures)
                for name, now in self.outcome.items():
                    wp.copy(self.final_outcome[name], now)
                wp.copy(self._fresh, self.done)
                self.restart(self._fresh)
                self.write_observation()
        self.draw_pictures()

    def _launches(self) -> None:
        """Launch what a step launches beside the scene's, whose kernels the scene began to compile itself."""
        self.before_step()
        self.write_observation()
        self.finish(self.never)
        self.clear()

    def restart(self, mask: wp.array) -> None:
        """Start new episodes in the worlds of the mask."""
        wp.copy(self.scene.world_mask, mask)
        self._draw()
        self._start()

    def finish(self, fresh: wp.array) -> None:
        """Judge the step."""
        scene = self.scene
        self.failure.zero_()
        self.any_done.zero_()
        self.evaluate()
        status, lowest = scene.solver.status, self._lowest
        not_finite = bits.WORLD_NOT_FINITE | bits.WORLD_RIGID_NOT_FINITE
        sparse = int(self.config.reward_mode == "sparse" and not self.config.terms_follow_mode)
        inputs = [fresh, self.limit, sparse, not_finite, status, self.finite, self.state, lowest]
        self.launch(kernels.finish_step, inputs, [self.result, self._episode])

    def _keep_pictures(self) -> None:
        """Draw the last picture of the episodes that end."""
        self.draw_pictures()
        for name, image in self.images.items():
            wp.copy(self.final_images[name], image)

    # -- spaces -------------------------------------------------------------------------------------------------------

    @property
    def action_space(self) -> gym.spaces.Box:
        """Actions of one world, in [-1, 1]."""
        return gym.spaces.Box(-1.0, 1.0, (self.scene.controller.action_size,), np.float32)

    def state_keys(self) -> dict[str, slice]:
        """Return the columns of each key of a state observation that is a dict; empty for one that is a vector."""
        return {}

    def observation_space(self) -> gym.Space:
        """Return the space of one world's observation; every bound is finite."""
        if self.obs_type == "state":
            keys = self.state_keys()
            if keys:
                return gym.spaces.Dict({name: self.layout.space(columns) for name, columns in keys.items()})
            return self.layout.space(slice(0, len(self.low)))
        edge = self.config.image_size
        spaces: dict[str, gym.Space] = {"pixels": gym.spaces.Box(0, 255, (edge, edge, 3), np.uint8)}
        if "depth" in self.images:
            spaces["depth"] = gym.spaces.Box(0.0, 10.0, (edge, edge), np.float32)
        if "segmentation" in self.images:
            count = len(self.scene.cameras[edge, edge].labels)
            spaces["segmentation"] = gym.spaces.Box(-1, count, (edge, edge), np.int32)
        if self.obs_type == "pixels_agent_pos":
            spaces["agent_pos"] = self.layout.space(slice(0, self.agent_size))
        return spaces["pixels"] if list(spaces) == ["pixels"] else gym.spaces.Dict(spaces)
