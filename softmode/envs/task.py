"""A task in any number of worlds: scene, draws at reset, observation, reward and ends of episodes, as one graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import warp as wp
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.body.rkpm import sample_farthest
from softmode.deformables.materials.material import Material
from softmode.deformables.model.compile_ahead import compile_launches, compiling_aside
from softmode.deformables.model.structs import filled
from softmode.deformables.reduction.build_body import Progress
from softmode.envs import task_kernels as kernels
from softmode.envs.cameras import overview, square_camera, wrist_camera
from softmode.envs.disturbances import Disturbances, disturbance_parameters, last_actions
from softmode.envs.episodes import FALL, Episodes
from softmode.envs.film import TaskFilm
from softmode.envs.handling import Handling
from softmode.envs.observation import (
    ObservationTable,
    Segment,
    object_part,
    one_hot_part,
    others_part,
    proprioception,
)
from softmode.envs.parameters import Materials, Parameter, ParameterTable
from softmode.envs.pictures import Pictures
from softmode.envs.placement import Arcs, Placement, clutter_parameters
from softmode.envs.reward_kernels import EndReason, StepResult, WorldState
from softmode.envs.task_config import ObservationType, TaskConfig
from softmode.errors import ConfigError, GraspError
from softmode.objects.object_file import stored_bars
from softmode.objects.rest_grasps import rest_grasps
from softmode.objects.soft_object import SoftObject
from softmode.robots.jaws import ParallelJaw
from softmode.scenes.capture import capture_graph
from softmode.scenes.occupancy import Occupancy
from softmode.scenes.table_scene import Marker, TableScene, TableSceneConfig
from softmode.splats.cameras.camera import CameraOptions
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.stages import stage


class Task:
    """A task in `world_count` worlds; subclasses add goals and rewards.

    A subclass names its `step_kernels`, `term_names` and `metric_names`, may extend `parameters` and `goal_segments`,
    and overrides methods of the section "what a task adds", which only launch kernels, because the step is captured as
    one graph.

    Args:
        config: The task's configuration.
        obs_type: What observations are made of; "state" draws no pictures.
        world_count: Number of worlds.
        limit: Control steps per episode, 0 for no limit.
        autoreset_mode: When a world whose episode ended starts the next one; DISABLED leaves that to `reset`.
        render: Whether frames will be asked for.
        device: Warp device.
        progress: Reports the build of the objects.

    Attributes:
        scene: Physics and cameras.
        table: What was drawn at reset.
        materials: Material and scale of every soft object.
        layout: Where the segments of the observation stand.
        segments: Columns of each of them by name.
        episodes: How far each episode is, what it earns, how it ends.
        handling: How gently the objects are handled.
        disturbances: Delays, noise and bias, and drives that differ; None where all are off.
        placement: Puts objects down.
        pictures: What the cameras of an observation draw.
        film: What people watch.
        observation: Bounded observation vector, float32, shape (world_count, D).
        terms: Reward terms, shape (world_count, T), `term_names`.
        metrics: Task-specific figures, shape (world_count, M), `metric_names`.
        success: Whether the task counts as solved now.
        outcome: What a step came to, by name.
        final_outcome: What the last step of the last episode came to, before the reset of SAME_STEP.
        rest_height: Height of the centre of every unscaled object 0 over the table at rest [m], shape (world_count,).
        points: Surface samples of object 0 in the observation: those of world 0, and of all that have its object.
        points_of_choices: The same of every choice of the scene's occupancy, shape (choices, point_count).
        state: What kernels read, a `WorldState`.
        result: What they write, a `StepResult`.
        plan: What the task's own kernels know beside it.
        graph: The step as a captured graph.
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
    filmed_across: ClassVar[bool] = False
    """Whether the film's first camera looks across the direction in which the fingers close."""
    goal_ring: ClassVar[bool] = False
    """Whether films show the goal as a ring about where the object is to be, in place of the marker."""
    any_robot: ClassVar[bool] = False
    """Whether the task has been tried with robots from files, which `robot` names."""
    step_kernels: ClassVar[tuple[Any, Any] | None] = None
    """The kernels that `observe` and `evaluate` launch; both take (`WorldState`, plan, `StepResult`), where plan is a
    struct of the task's own. Its fields are found by their names: ``drawn_NAME`` and ``column_NAME`` are the first
    columns of a parameter and of a segment of the observation, any other is an attribute of the task, its
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
        self.config, self.obs_type, self.world_count, self.autoreset_mode = (
            config,
            obs_type,
            world_count,
            autoreset_mode,
        )
        _check_set(type(self), config)
        cameras = [self.observation_camera()] if obs_type != "state" else []
        film = self.render_cameras() if render else []  # for recorders, in fixed places
        with stage("making the environment"), compiling_aside(device):
            self.scene = scene = TableScene(
                self.scene_config(),
                world_count=world_count,
                cameras=[*cameras, *film],
                film=film,
                camera_options=CameraOptions(
                    mesh_samples=config.mesh_samples, segmentation="segmentation" in config.image_outputs
                ),
                camera_randomization=config.camera_randomization,
                marker=self.marker() if cameras or film else None,
                device=device,
                progress=progress,
            )
            self.device, held = scene.device, scene.occupancy
            if config.object_set is not None and self.grasps:
                _check_grasps(held, ParallelJaw.of(config.scene.arm))
            kept = [_kept(config, *one) for one in zip(held.choices, held.materials, strict=True)]
            self.table = ParameterTable(self.parameters(), held, kept)
            self.materials = Materials(scene.solver, self.table, len(scene.objects), kept)
            points = [sample_farthest(thing.body.surface.points, self.point_count, first=0) for thing in held.choices]
            self.points_of_choices: NDArray[np.intp] = np.stack(points)
            self.points = self.points_of_choices[held.rows[0]]
            heights = np.array([thing.height for thing in held.choices])
            self.rest_height, lowest = held.follow(heights), held.follow(heights - FALL)
            self.layout = layout_of(self)
            self.segments, self.observation = self.layout.segments, self.layout.values
            on = "action_delay" in self.table.parameters
            self.disturbances = Disturbances(scene, self.table, self.layout, limit) if on else None
            sparse = config.reward_mode == "sparse" and not config.terms_follow_mode
            counts = {"terms": len(self.term_names), "metrics": len(self.metric_names)}
            self.episodes = Episodes(world_count, **counts, limit=limit, sparse=sparse, device=self.device)
            self.terms, self.metrics, self.success = self.episodes.terms, self.episodes.metrics, self.episodes.success
            if config.care and "gentle" not in self.term_names:
                hint = "leave it out, or take LiftSoft or PlaceInBin"
                raise ConfigError(f"care is {config.care}: {type(self).__name__} has no term 'gentle'", hint=hint)
            self.handling = Handling(
                scene,
                self.table.column("friction"),
                strain_limit=config.strain_limit,
                force_limit=config.force_limit,
                care=config.care,
                gentle=self.term_names.index("gentle") if "gentle" in self.term_names else -1,
                terminates=config.terminate_when_rough,
            )
            self.outcome: dict[str, wp.array] = {
                "success": self.success,
                "safe": self.handling.safe,
                "handled": self.handling.handled,
                "metrics": self.metrics,
                "parameters": self.table.values,
                "observation": self.observation,
                "status": scene.solver.status,
                "object": held.by_world,
            }
            self.final_outcome = {name: wp.zeros_like(array) for name, array in self.outcome.items()}
            self.state = filled(
                WorldState,
                scene,
                scene.controller,
                scene.model.softmode,
                scene.state,
                parameters=self.table.values,
                points=held.follow(self.points_of_choices, int),
                q=scene.state.softmode.q,
                stride=len(scene.objects),
                slots=held.slots,
                choice=held.choice,
            )
            written = {"observation": self.observation, "marker_place": scene.marker_place}
            self.result = filled(StepResult, self.episodes, self.handling, **written)
            self._arm = filled(kernels.ArmState, scene.controller, scene.state)
            self._finish = partial(
                self.episodes.finish,
                state=self.state,
                result=self.result,
                status=scene.solver.status,
                finite=self.layout.finite,
                lowest=lowest,
            )
            self.placement = Placement(scene, self.table, self.state)
            edge = config.image_size if cameras else None
            keep_last = autoreset_mode == AutoresetMode.SAME_STEP
            self.pictures = Pictures(scene, edge, config.image_outputs, keep_last=keep_last)
            self.film = TaskFilm(self)
            self.build()
            self.plan = None if self.step_kernels is None else plan_of(self, self.step_kernels[0])
            watch = partial(self.handling.watch, scene, scene.config.substeps - 1)
            judge = partial(self.judge, self.episodes.never)
            for launches in (self.before_step, watch, judge, self.clear):
                compile_launches(launches, self.device)
        self.reset()
        self.graph = capture_graph(self._step, self.device)

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
        varied = any(len(thing.body.cubature.lame_ratio) for thing in self.scene.occupancy.choices)

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
            ranged("poissons_ratio", 0.0 if varied else -0.9, 0.49),  # lambda / mu of a field keeps its proportions
            ranged("density", 10.0, 2.0e4, log=True),
            ranged("friction", 0.0, 10.0),
            ranged("scale", 0.5, 2.0),
            *clutter_parameters(config, self.scene.occupancy, self.other_arcs()),
            *disturbance_parameters(config),
        )

    def goal_segments(self) -> tuple[Segment, ...]:
        """Return the segments of the observation that say what to reach."""
        return ()

    def object_segments(self) -> tuple[Segment, ...]:
        """Return more segments that see the object; the last ones of the observation."""
        return ()

    def place(self) -> None:
        """Write `place_position` and `place_yaw` of all objects of the worlds in `scene.world_mask`."""
        self.placement.put(0)
        self.placement.put_others()

    def clear(self) -> None:
        """Reset `held`, and counters of the subclass, in the worlds of `scene.world_mask`."""
        self.launch(kernels.forget, [self.scene.world_mask, 0], [self.episodes.held])

    def before_step(self) -> None:
        """Change the worlds before each control step; part of the captured step."""

    def observe(self) -> None:
        """Write the goal segments of `observation` and the `metrics`, functions of the state alone."""
        if self.step_kernels is not None:
            self.launch(self.step_kernels[0], [self.state, self.plan], [self.result])

    def evaluate(self) -> None:
        """Write `terms`, `success` and, for failures of the task's own, `failure` (an `EndReason`); once per step."""
        if self.step_kernels is not None:
            self.launch(self.step_kernels[1], [self.state, self.plan], [self.result])

    def state_arrays(self) -> dict[str, wp.array]:
        """Return what episodes go on from beside the physics, by name, worlds first.

        Whoever keeps something from step to step that is no function of the physical state adds it.
        """
        table, layout = self.table, self.layout
        drawn = {"parameters": table.values, "seed": table.seed, "episode": table.episode}
        names = ("elapsed", "end", "failure", "held", "terminated", "truncated", "success", "done")
        judged = {name: getattr(self.episodes, name) for name in (*names, "reward", "terms", "metrics")}
        kept = self.handling.state_arrays()
        if self.disturbances is not None:
            kept |= self.disturbances.state_arrays()
        return {**drawn, **judged, **kept, "finite": layout.finite, "observation": layout.values}

    def marker(self) -> Marker | None:
        """Return the splats that mark the goal in pictures, or what draws them for an object.

        `observe` writes `scene.marker_place`.
        """
        return None

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

    # -- the step -----------------------------------------------------------------------------------------------------

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
            chosen = self.table.use_seeds(seeds, mask)
            for camera in self.scene.cameras.values():
                camera.variation.seed(chosen, mask)
        self.episodes.fresh.assign(mask)
        self.restart(self.episodes.fresh, options)
        self.episodes.forget(mask)
        self.write_observation()
        self.pictures.draw()

    def restart(self, mask: wp.array, options: dict[str, NDArray[np.float32]] | None = None) -> None:
        """Start new episodes in the worlds of the mask; capturable without options."""
        scene = self.scene
        wp.copy(scene.world_mask, mask)
        if options:
            self.table.draw_with(scene.world_mask, options)
        else:
            self.table.draw(scene.world_mask)
        if scene.occupancy.resampled:
            scene.use_objects()
        self.materials.apply(scene.world_mask)
        self.place()
        scene.reset_worlds()
        for camera in scene.cameras.values():
            camera.randomize(scene.world_mask)
        self.episodes.clear(scene.world_mask, self.result)
        self.handling.forget(scene.world_mask)
        if self.disturbances is not None:
            self.disturbances.begin(scene.world_mask)
        self.clear()

    def write_observation(self) -> None:
        """Write the observation and the metrics of all worlds."""
        self.layout.write(self.state, self._arm)
        self.observe()
        if self.disturbances is not None:
            self.disturbances.disturb()
        self.layout.bound()

    def judge(self, fresh: wp.array) -> None:
        """Observe and judge the step; worlds of the mask only started."""
        self.write_observation()
        self.episodes.failure.zero_()
        self.episodes.any_done.zero_()
        self.evaluate()
        self.handling.judge(fresh, self.state, self.result)
        self._finish(fresh)

    def step(self) -> None:
        """Advance all worlds by one control step with the actions in `scene.actions`."""
        self.graph.launch()

    def _step(self) -> None:
        """Simulate, judge, start the episodes that are due, observe."""
        scene, episodes = self.scene, self.episodes
        if self.disturbances is not None:
            self.disturbances.delay_actions()
        self.before_step()
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            wp.copy(episodes.fresh, episodes.done)
            scene.control_step()
            self.restart(episodes.fresh)
            self.judge(episodes.fresh)
            self.clear()  # what `evaluate` counted in worlds that only started
        else:
            scene.control_step()
            self.judge(episodes.never)
            if self.autoreset_mode == AutoresetMode.SAME_STEP:
                if self.pictures.images:
                    wp.capture_if(episodes.any_done, on_true=self.pictures.keep_last)
                for name, now in self.outcome.items():
                    wp.copy(self.final_outcome[name], now)
                wp.copy(episodes.fresh, episodes.done)
                self.restart(episodes.fresh)
                self.write_observation()
        self.pictures.draw()


def layout_of(task: Task) -> ObservationTable:
    """Return the observation of a task, laid out in its segments."""
    held, given = task.scene.occupancy, task.config.object_set
    code = one_hot_part(given.count, held.slots) if given is not None and task.config.objects_one_hot else ()
    last = last_actions(task.config, task.scene.controller.action_size)
    goals = hasattr(task, "goal_size")  # whose observation is what lies between object and goal
    agent = (*proprioception(task.scene.controller.joint_count), *(() if goals else last), *task.goal_segments())
    seen = (*object_part(task.point_count), *(last if goals else ()), *task.object_segments())
    seen = (*seen, *others_part(held.slots - 1), *code)
    return ObservationTable(agent, seen, task.world_count, task.device)


def plan_of(task: Task, kernel: Any) -> Any:
    """Return the second argument of a task's kernel, its fields found by their names.

    Raises:
        ConfigError: If a field is nothing that the task has.
    """
    columns = {f"drawn_{name}": task.table.column(name) for name in task.table.parameters}
    columns |= {f"column_{name}": task.layout.column(name) for name in task.segments}
    sources = (task, task.config, task.config.scene.control, task.scene.soft)
    try:
        return filled(kernel.adj.args[1].type, *sources, **columns)
    except AttributeError as error:
        what = f"{type(task).__name__}: the plan of its kernels has a field {error.name!r}, which nothing has"
        raise ConfigError(what, hint="name it as `Task.step_kernels` says, or set it in `build`") from error


def _check_set(task: type[Task], config: TaskConfig) -> None:
    """Refuse a set of objects that a task cannot have.

    Raises:
        ConfigError: If it cannot.
    """
    given = config.object_set
    if given is None:
        return
    if not task.takes_sets:
        raise ConfigError(
            f"{task.__name__} cannot have another object in every world, objects is a set of {given.count}",
            hint="give config.scene.object one object; a task of yours may set takes_sets",
        )
    slots = given.number_range[1]
    if slots > 1 and not task.takes_several:
        raise ConfigError(
            f"{task.__name__} has one object per world, objects.per_world asks for {slots}",
            hint="leave per_world out, or take LiftSoft, PushSoft or PlaceInBin",
        )


def _check_grasps(held: Occupancy, jaw: ParallelJaw) -> None:
    """Refuse objects of a set that the gripper is to take and cannot.

    Raises:
        GraspError: If there is one; it names the object.
    """
    for name, thing, material in zip(held.names, held.choices, held.materials, strict=True):
        friction = max(math.sqrt(material.friction * jaw.friction), 1.0e-3)
        try:
            rest_grasps(thing.body, jaw, friction=friction)
        except GraspError as error:
            hint = "give it another size, or leave it out of the set"
            raise GraspError(f"{name} does not fit the gripper: {error.message}", hint=hint) from error


def _kept(config: TaskConfig, thing: SoftObject, material: Material) -> dict[str, tuple[float, float]]:
    """Return the ranges of the properties of an object of a set that have none: as it is, or as a fit says, E.

    Of one object alone only the density: a field of material says it of the solid, not of its points.
    """
    names = [name for name in Materials.NAMES if name != "scale"] if config.object_set is not None else ["density"]
    own = {name: getattr(material, name) for name in names if getattr(config, f"{name}_range") is None}
    ranges = {name: (value, value) for name, value in own.items()}
    low, value, high = stored_bars(thing.body).get("youngs_modulus", (0.0, 0.0, 0.0))
    if own.get("youngs_modulus") == value:  # another one is that of `ObjectSet.materials`
        ranges["youngs_modulus"] = (low, high)
    return ranges
