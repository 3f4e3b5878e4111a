"""A robot arm at a table with soft objects, in any number of worlds: model, solver, controller, cameras, graphs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from softmode.checks import require_number
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.coupling.rigid_solver import RigidSolver, mujoco_warnings
from softmode.deformables.coupling.solver_coupled import SolverCoupledReduced
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import register_custom_attributes, reserve_room
from softmode.deformables.model.compile_ahead import begin_compiling, compile_for_building, compiling_aside
from softmode.deformables.model.declare import launch
from softmode.deformables.model.status import status_reasons
from softmode.deformables.solver.solver_reduced import SolverReducedOptions
from softmode.deformables.tools.body_choice import BodyChoice
from softmode.deformables.tools.grips import GripOptions, Grips, add_grip_slots
from softmode.errors import ConfigError
from softmode.objects.config import ObjectConfig
from softmode.objects.loader import Progress
from softmode.objects.object_set import ObjectSet
from softmode.objects.placed import Placed
from softmode.objects.soft_object import SoftObject
from softmode.pause import cut_circles
from softmode.radiance.march import RadianceMarch
from softmode.robots import control_kernels
from softmode.robots.arm import ArmDescription
from softmode.robots.control import ArmControlOptions
from softmode.robots.robot_control import controller_of
from softmode.robots.table_robot import TableRobot, finger_links
from softmode.scenes import table_kernels as kernels
from softmode.scenes.binding import BoundSplats
from softmode.scenes.capture import capture_graph, capture_step, require_even
from softmode.scenes.film_camera import FilmCamera, columns_of
from softmode.scenes.fixture import Fixture, add_fixture
from softmode.scenes.occupancy import Occupancy
from softmode.scenes.recording import Recording
from softmode.scenes.scene import cameras_by_size, marched_fields
from softmode.splats.cameras.camera import CameraOptions, SplatCamera
from softmode.splats.cameras.camera_randomization import CameraRandomization
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.splats import Splats

Marker = Splats | Callable[[SoftObject], Splats]
"""What marks a place in pictures: splats around the origin, or what draws them for the first object of a world."""
GAP = 2.0e-4
"""Height over the table at which objects are put down [m]."""
TABLE_PLACE = (0.35, 0.0, -0.03)
"""Centre of the table [m]."""
TABLE_SIZE = (0.5, 0.6, 0.03)
"""Half of its edges [m]."""
PARKED = (0.0, 0.0, -1.0)
"""Where the surface samples of objects lie that are not there [m]; nothing draws or touches them."""


@dataclass(frozen=True, kw_only=True)
class TableSceneConfig:
    """What stands on the table and how time runs."""

    object: ObjectConfig = field(default_factory=ObjectConfig)
    """The soft object."""
    objects: ObjectSet | None = None
    """Objects of which each world gets one, or several, in place of `object`; those that are named get its build."""
    others: tuple[ObjectConfig, ...] = ()
    """More soft objects, of the same material."""
    fixtures: tuple[Fixture, ...] = ()
    """Rigid shapes on the table."""
    material: Material = field(default_factory=lambda: Material(youngs_modulus=2.0e5, density=250.0))
    """Its material; Young's modulus may be changed per world at reset. In a set, that of objects that say none."""
    arm: ArmDescription | TableRobot = field(default_factory=ArmDescription)
    """The robot: the built-in arm, or a loaded one that :func:`softmode.robots.place_robot` put at the table."""
    control: ArmControlOptions = field(default_factory=ArmControlOptions)
    """What actions mean."""
    solver: SolverReducedOptions = field(default_factory=SolverReducedOptions)
    """How the soft step is solved."""
    control_hz: float = 30.0
    """Control steps per second."""
    substeps: int = 8
    """Physics steps per control step; even."""
    table_friction: float = 0.8
    """Coulomb coefficient of the table."""
    constraint_max: int = 96
    """Rows of MuJoCo's constraints per world."""
    rigid_contact_max: int = 32
    """Contacts between rigid shapes per world."""
    object_position: tuple[float, float] = (0.45, 0.0)
    """Where the object stands by default [m]."""
    grip_slots: int = 0
    """Points of each soft object that may be gripped while the scene runs; see :attr:`TableScene.grips`."""
    grip_options: GripOptions = field(default_factory=GripOptions)
    """How stiff such grips are."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_even("substeps", self.substeps)
        require_number("control_hz", self.control_hz, at_least=1.0, at_most=1000.0)
        require_number("table_friction", self.table_friction, at_least=0.0)
        require_number("grip_slots", self.grip_slots, at_least=0, at_most=4096)
        if self.objects is not None and not isinstance(self.objects, ObjectSet):
            raise ConfigError(f"objects is a {type(self.objects).__name__}", hint="give an ObjectSet([...])")


class TableScene:
    """Physics and pictures of a table scene; tasks add rewards and randomisation.

    Args:
        config: What to build.
        world_count: Number of replicas.
        cameras: Cameras to draw, grouped by image size; none draws nothing.
        film: Cameras of one image size whose pictures people look at; see :meth:`draw_film`.
        camera_options: Light and background.
        camera_randomization: What `randomize` of the cameras draws.
        marker: Splats around the origin that mark a place, such as a goal, in pictures, or what draws them for the
            first object of a world; they touch nothing.
        device: Warp device; the default one if None.
        progress: Reports the build of the object, see :func:`softmode.deformables.reduction.build_body.build_body`.
    """

    def __init__(
        self,
        config: TableSceneConfig,
        *,
        world_count: int = 1,
        cameras: Sequence[PinholeCamera] = (),
        film: Sequence[PinholeCamera] = (),
        camera_options: CameraOptions | None = None,
        camera_randomization: CameraRandomization | None = None,
        marker: Marker | None = None,
        device: wp.DeviceLike = None,
        progress: Progress = None,
    ) -> None:
        """Build model, solvers and controller, and capture the control step."""
        require_number("world_count", world_count, at_least=1)
        self.config = config
        self.world_count = world_count
        self.device = wp.get_device(device)
        self.dt = 1.0 / (config.control_hz * config.substeps)
        self.after_substep: Callable[[TableScene, int], None] | None = None
        """Launches after each substep; is given the scene and the number of the substep."""
        given = config.objects
        if given is not None and given.resample and (config.others or config.grip_slots):
            what = "others" if config.others else "grip_slots"
            raise ConfigError(f"objects.resample and {what} exclude each other", hint=f"leave {what} out")
        self.occupancy = Occupancy(
            config.object,
            given,
            config.others,
            material=config.material,
            world_count=world_count,
            device=self.device,
            progress=progress,
        )
        """Which object each slot of each world holds."""
        self.objects = self.occupancy.bodies
        """The soft objects of a world, of world 0 where worlds differ (see `objects_of`); their instances follow each
        other, world by world."""
        with compiling_aside(self.device):
            compile_for_building(self.device, control_kernels, kernels)
            self._build_model()
            self._build_solver()
            begin_compiling(self.control_step, self.device)
        self.marker_place = wp.zeros(world_count, dtype=wp.transform, device=self.device)
        """Where the marker is drawn, transform, shape (world_count,)."""
        self.marker_place.fill_(wp.transform_identity())
        self.marker = self.occupancy.drawn(marker) if callable(marker) else marker
        """Splats that mark a place in pictures, the last ones of `splats`: one for all, or one per world, or per choice
        of `occupancy` where a reset may change the object."""
        self.splats: BoundSplats | None = None
        """The splats of the objects, then those of the marker, as cameras see them; None without cameras."""
        self.cameras: dict[tuple[int, int], SplatCamera] = {}
        """The cameras by the width and height of their pictures [px]."""
        self.fields: RadianceMarch | None = None
        """Radiance fields that cameras march through (`ObjectConfig.march`); None if there are none."""
        self.film: FilmCamera | None = None
        """The cameras that people look through; None without any."""
        if cameras or film:
            held = self.occupancy
            choices = {"choices": held.choices, "choice": held.choice} if held.resampled else {}
            marked = () if self.marker is None else (self.marker,)
            self.fields = marched_fields(self.solver, held.shown)
            self.splats = BoundSplats(self.model, held.shown, others=marked, **choices)
            if self.marker is not None:
                rest, one = self.splats.table.means.numpy()[:, self.splats.columns[-1]], isinstance(self.marker, Splats)
                if held.resampled and not one:
                    self.marker_points = held.follow(rest, wp.vec3)
                else:
                    self.marker_points = wp.array(rest[:1] if one else rest, dtype=wp.vec3, device=self.device)
                """Centres of the marker's splats from `marker_place` [m], shape (1 or world_count, splats); a task may
                put an array of its own here before the first picture, to change the marker's shape."""
        if cameras and self.splats is not None:
            self.cameras = cameras_by_size(
                self.model,
                self.splats,
                cameras,
                options=camera_options,
                randomization=camera_randomization,
                overlay=self.fields,
            )
        if film and self.splats is not None:
            seen, columns = self.splats.arrays, self.splats.columns
            things = slice(0, columns[len(self.splats.indices) - 1].stop)
            goal = None if self.marker is None else columns_of(seen, columns[-1])
            given = (columns_of(seen, things), goal, film)
            self.film = FilmCamera(self.model, self.state, *given, room=True, overlay=self.fields)
        self._graph: Recording | None = None
        self._camera_graphs: dict[tuple[int, int], Recording] = {}
        if self.occupancy.slots > 1:
            self.use_objects()
        self.reset()

    @property
    def soft(self) -> SoftObject:
        """The first soft object, of world 0 where worlds differ."""
        return self.objects[0]

    def objects_of(self, world: int) -> tuple[SoftObject, ...]:
        """Return the soft objects of a world, those that are there."""
        return self.occupancy.objects_of(world)

    def marker_of(self, world: int) -> Splats | None:
        """Return the splats that mark a place in a world, as they were given; None without any."""
        if self.marker is None or isinstance(self.marker, Splats):
            return self.marker
        return self.marker[self.occupancy.rows[world] if self.occupancy.resampled else world]

    # -- construction -------------------------------------------------------------------------------------------------

    def _build_model(self) -> None:
        """Make a world for each object that object 0 may be, and a model of as many copies of each as are wanted."""
        held = self.occupancy
        worlds = [self._world(thing, made_of) for thing, made_of in zip(held.choices, held.materials, strict=True)]
        builder = newton.ModelBuilder()
        register_custom_attributes(builder)
        SolverMuJoCo.register_custom_attributes(builder)
        if len(worlds) == 1:
            builder.replicate(worlds[0], self.world_count)
        else:
            for row in held.rows:
                builder.add_world(worlds[row])
        self.model: Any = builder.finalize(device=self.device)  # Any: it carries the attributes of soft bodies
        cut_circles(self.model, builder, *worlds)

    def _world(self, first: SoftObject, material: Material) -> newton.ModelBuilder:
        """Return a world with arm, table, fixtures and objects; the first of these and its material are given."""
        config = self.config
        world = newton.ModelBuilder()
        self.arm = config.arm.add_to(world)
        slate, friction = (0.42, 0.48, 0.54), config.table_friction
        table = Fixture(label="table", position=TABLE_PLACE, size=TABLE_SIZE, color=slate, friction=friction)
        for fixture in (table, *config.fixtures):
            add_fixture(world, fixture)
        for thing in (*[first] * self.occupancy.slots, *self.occupancy.others):
            placed = Placed(object=thing, position=(*config.object_position, thing.height))
            instance = placed.add_to(world, material=material if thing is first else config.material)
            if config.grip_slots:
                add_grip_slots(world, instance, config.grip_slots)
            if self.occupancy.resampled:
                bodies = [one.body for one in self.occupancy.choices]
                functions = max(body.function_count for body in bodies) - thing.body.function_count
                reserve_room(world, functions, max(body.surface_count for body in bodies) - thing.body.surface_count)
        return world

    def _build_solver(self) -> None:
        """Make the coupled solver, the controller and the buffers of a control step."""
        config, model, worlds = self.config, self.model, self.world_count
        with mujoco_warnings():
            rigid = RigidSolver(model, njmax=config.constraint_max, nconmax=config.rigid_contact_max)
        found = {id(thing.body): thing.body for thing in (*self.occupancy.choices, *self.objects)}
        distinct = list(found.values())
        self.solver = SolverCoupledReduced(model, distinct, options=config.solver, rigid=rigid)
        self.state: Any = model.state()
        self._scratch: Any = model.state()
        self.control: Any = model.control()
        for state in (self.state, self._scratch):
            newton.eval_fk(model, model.joint_q, model.joint_qd, state)
        self.controller = controller_of(model, config.arm, self.arm, config.control)
        slots, instances = config.grip_slots, worlds * len(self.objects)
        self.grips = tuple(
            Grips(self.solver, i, slot_count=slots, options=config.grip_options)
            for i in range(instances if slots else 0)
        )
        """Grips of each instance, world by world, that pull and hold it while the scene runs; none without slots."""
        device = self.device
        self.actions = wp.zeros((worlds, self.controller.action_size), dtype=float, device=device)
        self.object_position = wp.zeros((worlds, len(self.objects)), dtype=wp.vec3, device=device)
        """Centre of mass of each soft object [m], shape (world_count, objects)."""
        self.object_velocity = wp.zeros_like(self.object_position)
        """Its velocity [m/s]."""
        self.finger_force = wp.zeros((worlds, 2), dtype=wp.vec3, device=device)
        starts, fingers = model.body_world_start.numpy()[:worlds], finger_links(config.arm, self.arm)
        fingers = np.where(fingers < 0, -1, starts[:, None, None] + fingers)
        self.finger_body = wp.array(fingers, dtype=int, device=device)
        self._bases = self._object_bases(found)
        self._choice: BodyChoice | None = None
        if self.occupancy.resampled:
            bodies = [thing.body for thing in self.occupancy.choices]
            self._choice = BodyChoice(self.solver, bodies, self.occupancy.materials)
        self.world_mask = wp.ones(worlds, dtype=wp.bool, device=device)
        """Which worlds `reset_worlds` resets, shape (world_count,)."""
        self._solver_mask = wp.zeros(worlds + 1, dtype=wp.bool, device=device)
        self.place_position = wp.zeros(instances, dtype=wp.vec3d, device=device)
        """Where `reset_worlds` puts the centre of mass of each object [m], shape (world_count * objects,)."""
        self.place_yaw = wp.zeros(instances, dtype=wp.float64, device=device)
        """Its rotation about the vertical [rad]."""

    def _object_bases(self, found: dict[int, ReducedBody]) -> Any:
        """Return what places and centres of the objects follow from, on the device; bodies are told by identity."""
        device, held, bodies = self.device, self.occupancy, found.values()
        most = max(body.function_count for body in bodies)
        linear, mean = np.zeros((len(bodies), most, 4)), np.zeros((len(bodies), most))
        for b, body in enumerate(bodies):
            linear[b, : body.function_count], mean[b, : body.function_count] = body.linear_coordinates, body.mean_basis
        place = {key: row for row, key in enumerate(found)}
        rows = [[place[id(o.body)] for o in (*[first] * held.slots, *held.others)] for first in held.choices]
        bases = kernels.ObjectBases()
        bases.body = held.follow(rows, int, every_slot=True).flatten()  # the same memory
        bases.function_start = self.model.softmode.function_start
        bases.function_count = self.solver.tables.instances.function_count
        bases.linear = wp.array(linear, dtype=wp.float64, device=device)
        bases.mean = wp.array(mean, dtype=wp.float64, device=device)
        bases.stride = len(self.objects)
        return bases

    # -- time ---------------------------------------------------------------------------------------------------------

    def reset(
        self,
        *,
        world_mask: np.ndarray | None = None,
        position: np.ndarray | None = None,
        yaw: np.ndarray | None = None,
        youngs_modulus: np.ndarray | None = None,
    ) -> None:
        """Put arm and object of the chosen worlds back.

        Args:
            world_mask: Which worlds, shape (world_count,); all if None.
            position: Where the object stands [m], shape (world_count, 2); the configured place if None.
            yaw: Its rotation about the vertical [rad], shape (world_count,); zero if None.
            youngs_modulus: E [Pa] of the object, shape (world_count,); unchanged if None.
        """
        worlds, count = self.world_count, len(self.objects)
        mask = np.ones(worlds, bool) if world_mask is None else np.asarray(world_mask, bool)
        place = np.empty((worlds, count, 3))
        place[:, :, :2] = self.config.object_position
        place[:, :, 2] = self.occupancy.heights + GAP
        turn = np.zeros((worlds, count))
        if position is not None:
            place[:, 0, :2] = position
        if yaw is not None:
            turn[:, 0] = yaw
        self.world_mask.assign(mask)
        self.place_position.assign(place.reshape(-1, 3))
        self.place_yaw.assign(turn.reshape(-1))
        if youngs_modulus is not None:
            self._set_stiffness(mask, np.asarray(youngs_modulus, float))
        self.reset_worlds()

    def reset_worlds(self) -> None:
        """Put arm and objects of the worlds in `world_mask` back, objects where `place_position` says; capturable."""
        worlds, data, state = self.world_count, self.model.softmode, self.state
        wp.copy(self._solver_mask, self.world_mask, count=worlds)
        self.solver.reset(state, self._solver_mask)
        place = (self.world_mask, self.place_position, self.place_yaw, data.scale)
        outputs = (state.softmode.q, state.softmode.qd, self.control.softmode.q_driven)
        dim = (worlds * len(self.objects), self._bases.mean.shape[1])
        launch(self.device, kernels.place_objects, dim, self._bases, *place, *outputs)
        self.solver.update_particles(state)
        if self.occupancy.slots > 1:
            room = (wp.vec3(*PARKED), data.particle_start, self.solver.tables.layout.sample_max)
            parked = (state.softmode.q, state.softmode.qd, state.particle_q, state.particle_qd)
            launch(self.device, kernels.park_objects, dim[0], self._bases, self.world_mask, *room, *parked)
        self.controller.reset(state, self.world_mask)
        self.controller.write_targets(self.control)
        self.observe()

    def use_objects(self) -> None:
        """Put the objects that `occupancy` has chosen into the worlds of `world_mask`; capturable.

        Materials, places and the state come after it: set the parameters and call `reset_worlds`.

        Raises:
            ConfigError: If worlds keep their objects.
        """
        if self._choice is None:
            raise ConfigError("the worlds keep their objects", hint="give objects=ObjectSet([...], resample=True)")
        self._choice.set(self.occupancy.choice, self.world_mask)
        self.occupancy.put(self.world_mask)
        if self.splats is not None:
            self.splats.choose(self.world_mask)

    def _set_stiffness(self, mask: np.ndarray, youngs_modulus: np.ndarray) -> None:
        """Change E in the masked worlds."""
        array = self.model.softmode.youngs_modulus
        modulus = array.numpy()
        for w in np.flatnonzero(mask):
            checked = replace(self.config.material, youngs_modulus=float(youngs_modulus[w])).youngs_modulus
            modulus[w * len(self.objects) : (w + 1) * len(self.objects)] = checked
        array.assign(modulus)

    def step(self, actions: np.ndarray | None = None) -> None:
        """Advance one control step.

        Args:
            actions: Actions in [-1, 1], shape (world_count, action_size); None for those of the step before.
        """
        if actions is not None:
            self.actions.assign(np.asarray(actions, np.float32).reshape(self.actions.shape))
        if self._graph is None:
            self._graph = capture_step(self, self.control_step)
            self.controller.reset(self.state)
        self._graph.launch()

    def control_step(self) -> None:
        """Move the command by `actions`, run the substeps, observe; capturable."""
        config = self.config
        self.solver.status.zero_()
        self.controller.command(self.actions, self.state)
        for substep in range(config.substeps):
            self.controller.write_targets(self.control, (substep + 1) / config.substeps)
            first, second = (self.state, self._scratch) if substep % 2 == 0 else (self._scratch, self.state)
            for grips in self.grips:
                grips.apply(first, self.control, self.dt)
            self.solver.step(first, second, self.control, None, self.dt)
            if self.after_substep is not None:
                self.after_substep(self, substep)
        self.observe()

    def observe(self) -> None:
        """Refresh what observations are made of; capturable."""
        state, worlds = self.state, self.world_count
        self.controller.measure(state)
        arrays = (state.softmode.q, state.softmode.qd, self.object_position, self.object_velocity)
        launch(self.device, kernels.observe_objects, worlds * len(self.objects), self._bases, *arrays)
        fingers = (self.finger_body, self.solver.body_wrench, self.finger_force)
        launch(self.device, kernels.observe_fingers, (worlds, 2), *fingers)

    def render(self, size: tuple[int, int]) -> SplatCamera:
        """Draw every camera of one image size and return it; its arrays are overwritten by the next frame."""
        camera = self.cameras[size]
        if size not in self._camera_graphs:
            self._camera_graphs[size] = capture_graph(lambda: self.draw(camera), self.device)
        self._camera_graphs[size].launch()
        return camera

    def draw(self, camera: SplatCamera) -> None:
        """Move the splats and draw one frame; capturable after a first frame."""
        self.move_splats()
        camera.render(self.state)

    def draw_film(self) -> wp.array:
        """Draw the cameras of the film; return uint8, shape (cameras * world_count, height, width, 3), by camera.

        Raises:
            ConfigError: If there are none.
        """
        if self.film is None:
            raise ConfigError("the scene has no film cameras", hint="pass TableScene(film=...) at least one")
        self.move_splats()
        return self.film.render(self.state)

    def move_splats(self) -> None:
        """Move the splats of objects and marker to where they are now; capturable after a first time."""
        if self.splats is not None:
            self.splats.update(self.state)
            if self.fields is not None:
                self.fields.update(self.state)
            if self.marker is not None:
                dim, first = (self.world_count, self.marker_points.shape[1]), self.splats.columns[-1].start
                arrays = (self.marker_points, self.marker_place, first, self.splats.arrays.means)
                launch(self.device, kernels.place_marker, dim, *arrays)

    # -- reading ------------------------------------------------------------------------------------------------------

    @property
    def status(self) -> np.ndarray:
        """Status bits of the last control step per world, see :mod:`softmode.deformables.model.status`."""
        return self.solver.status.numpy()

    @property
    def status_reasons(self) -> tuple[tuple[str, ...], ...]:
        """Names of those bits per world."""
        return tuple(status_reasons(int(bits)) for bits in self.status)
