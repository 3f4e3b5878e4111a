"""A robot arm at a table with one soft object, in any number of worlds: model, solver, controller, cameras, graphs."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from softmode.deformables.coupling import SolverCoupledReduced
from softmode.deformables.materials import Material
from softmode.deformables.skinning import SkinSplats
from softmode.deformables.solver_reduced import (
    SolverReducedOptions,
    add_reduced_body,
    register_custom_attributes,
)
from softmode.deformables.status import status_reasons
from softmode.envs import table_kernels as kernels
from softmode.envs.objects import ObjectConfig, SoftObject, load_object
from softmode.errors import ConfigError
from softmode.robots import ArmDescription, add_arm
from softmode.robots.control import ArmController, ArmControlOptions
from softmode.splats.camera import CameraOptions, PinholeCamera, SplatCamera
from softmode.splats.rasterizer import RasterizerOptions, SplatArrays


@dataclass(frozen=True, kw_only=True)
class TableSceneConfig:
    """What stands on the table and how time runs."""

    object: ObjectConfig = field(default_factory=ObjectConfig)
    """The soft object."""
    material: Material = field(default_factory=lambda: Material(youngs_modulus=2.0e5, density=250.0))
    """Its material; Young's modulus may be changed per world at reset."""
    arm: ArmDescription = field(default_factory=ArmDescription)
    """The robot."""
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
    object_position: tuple[float, float] = (0.45, 0.0)
    """Where the object stands by default [m]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.substeps < 2 or self.substeps % 2:
            raise ConfigError(f"substeps must be even and at least 2, got {self.substeps}")
        if not 1.0 <= self.control_hz <= 1000.0:
            raise ConfigError(f"control_hz must lie in 1..1000, got {self.control_hz}")
        if not self.table_friction >= 0.0:
            raise ConfigError(f"table_friction must be >= 0, got {self.table_friction}")


class TableScene:
    """Physics and pictures of a table scene; tasks add rewards and randomisation.

    Args:
        config: What to build.
        world_count: Number of replicas.
        cameras: Cameras to draw, grouped by image size; none draws nothing.
        device: Warp device; the default one if None.
        progress: Reports the build of the object, see :func:`softmode.deformables.body.build_body`.
    """

    def __init__(
        self,
        config: TableSceneConfig,
        *,
        world_count: int = 1,
        cameras: Sequence[PinholeCamera] = (),
        camera_options: CameraOptions | None = None,
        device: Any = None,
        progress: Any = None,
    ) -> None:
        """Build model, solvers and controller, and capture the control step."""
        if world_count < 1:
            raise ConfigError(f"world_count must be at least 1, got {world_count}")
        self.config = config
        self.world_count = world_count
        self.device = wp.get_device(device)
        self.dt = 1.0 / (config.control_hz * config.substeps)
        self.soft: SoftObject = load_object(config.object, progress)
        self._build_model()
        self._build_solver()
        self._build_cameras(cameras, camera_options)
        self._graph: Any = None
        self._camera_graphs: dict[tuple[int, int], Any] = {}
        self.reset()

    # -- construction -------------------------------------------------------------------------------------------------

    def _build_model(self) -> None:
        """Add arm, table and object to a world and replicate it."""
        config = self.config
        world = newton.ModelBuilder()
        self.arm = add_arm(world, config.arm)
        shape = newton.ModelBuilder.ShapeConfig(mu=config.table_friction, has_shape_collision=True)
        world.add_shape_box(
            -1,
            xform=wp.transform((0.35, 0.0, -0.03), wp.quat_identity()),
            hx=0.5,
            hy=0.6,
            hz=0.03,
            cfg=shape,
            color=(0.42, 0.48, 0.54),
            label="table",
        )
        add_reduced_body(
            world,
            self.soft.body,
            material=config.material,
            position=(*config.object_position, self.soft.height),
        )
        builder = newton.ModelBuilder()
        register_custom_attributes(builder)
        SolverMuJoCo.register_custom_attributes(builder)
        builder.replicate(world, self.world_count)
        self.model: Any = builder.finalize(device=self.device)  # Any: it carries the attributes of soft bodies

    def _build_solver(self) -> None:
        """Make the coupled solver, the controller and the buffers of a control step."""
        config, model, worlds = self.config, self.model, self.world_count
        rigid = SolverMuJoCo(model, njmax=64, nconmax=32)
        self.solver = SolverCoupledReduced(model, [self.soft.body], options=config.solver, rigid=rigid)
        self.state: Any = model.state()
        self._scratch: Any = model.state()
        self.control = model.control()
        for state in (self.state, self._scratch):
            newton.eval_fk(model, model.joint_q, model.joint_qd, state)
        self.controller = ArmController(model, self.arm, config.control)
        device = self.device
        self.actions = wp.zeros((worlds, config.control.action_size), dtype=float, device=device)
        self.object_position = wp.zeros(worlds, dtype=wp.vec3, device=device)
        self.object_velocity = wp.zeros(worlds, dtype=wp.vec3, device=device)
        self.finger_force = wp.zeros((worlds, 2), dtype=wp.vec3, device=device)
        starts = model.body_world_start.numpy()[:worlds]
        fingers = starts[:, None] + np.asarray(self.arm.finger_bodies)[None]
        self._finger_body = wp.array(fingers, dtype=int, device=device)
        body = self.soft.body
        self._linear = wp.array(body.linear_coordinates, dtype=wp.float64, device=device)
        self._mean_basis = wp.array(body.mean_basis, dtype=wp.float64, device=device)
        self._world_mask = wp.ones(worlds, dtype=wp.bool, device=device)
        self._reset_mask = wp.ones(worlds + 1, dtype=wp.bool, device=device)
        self._place_position = wp.zeros(worlds, dtype=wp.vec3d, device=device)
        self._place_yaw = wp.zeros(worlds, dtype=wp.float64, device=device)
        splats = self.soft.splats
        self.skin = SkinSplats(splats.means, splats.covariances(), self.soft.basis, self.soft.grad_basis, device=device)

    def _build_cameras(self, cameras: Sequence[PinholeCamera], options: CameraOptions | None) -> None:
        """Make one SplatCamera per image size; they share the splats."""
        self.cameras: dict[tuple[int, int], SplatCamera] = {}
        if not cameras:
            return
        self.splat_arrays = SplatArrays.from_splats(
            [self.soft.splats], world_count=self.world_count, device=self.device
        )
        for size in sorted({(camera.width, camera.height) for camera in cameras}):
            mine = [camera for camera in cameras if (camera.width, camera.height) == size]
            self.cameras[size] = SplatCamera(
                self.model, self.splat_arrays, mine, options=options, rasterizer_options=RasterizerOptions()
            )

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
        worlds = self.world_count
        mask = np.ones(worlds, bool) if world_mask is None else np.asarray(world_mask, bool)
        place = np.empty((worlds, 3))
        place[:, :2] = self.config.object_position if position is None else position
        place[:, 2] = self.soft.height + 2.0e-4
        self._world_mask.assign(mask)
        self._reset_mask.assign(np.append(mask, False))
        self._place_position.assign(place)
        self._place_yaw.assign(np.zeros(worlds) if yaw is None else np.asarray(yaw, float))
        if youngs_modulus is not None:
            self._set_stiffness(mask, np.asarray(youngs_modulus, float))
        self.solver.reset(self.state, self._reset_mask)
        data = self.model.softmode
        wp.launch(
            kernels.place_objects,
            dim=(worlds, self.soft.body.function_count),
            inputs=[
                data.function_start,
                self.solver.reduced.instances.world,
                self._linear,
                self._world_mask,
                self._place_position,
                self._place_yaw,
            ],
            outputs=[self.state.softmode.q, self.state.softmode.qd],
            device=self.device,
        )
        self.solver.reduced.update_particles(self.state)
        self.controller.reset(self.state, self._world_mask)
        self.controller.write_targets(self.control)
        self._observe()

    def _set_stiffness(self, mask: np.ndarray, youngs_modulus: np.ndarray) -> None:
        """Change E in the masked worlds."""
        array = self.model.softmode.youngs_modulus
        modulus = array.numpy()
        for w in np.flatnonzero(mask):
            modulus[w] = replace(self.config.material, youngs_modulus=float(youngs_modulus[w])).youngs_modulus
        array.assign(modulus)

    def step(self, actions: np.ndarray) -> None:
        """Advance one control step.

        Args:
            actions: Actions in [-1, 1], shape (world_count, action_size).
        """
        self.actions.assign(np.asarray(actions, np.float32).reshape(self.actions.shape))
        if self._graph is None:
            self._graph = self._capture_control_step()
        wp.capture_launch(self._graph)

    def _capture_control_step(self) -> Any:
        """Compile what a control step needs, then record it; leaves the state as it was."""
        saved = self.model.state()
        saved.assign(self.state)
        self._control_step()
        with wp.ScopedCapture(device=self.device) as capture:
            self._control_step()
        self.state.assign(saved)
        self.controller.reset(self.state)
        return capture.graph

    def _control_step(self) -> None:
        """Move the command, run the substeps, observe."""
        config = self.config
        self.solver.reduced.status.zero_()
        self.controller.command(self.actions, self.state)
        for substep in range(config.substeps):
            self.controller.write_targets(self.control, (substep + 1) / config.substeps)
            first, second = (self.state, self._scratch) if substep % 2 == 0 else (self._scratch, self.state)
            self.solver.step(first, second, self.control, None, self.dt)
        self._observe()

    def _observe(self) -> None:
        """Refresh what observations are made of."""
        data, state, worlds = self.model.softmode, self.state, self.world_count
        self.controller.measure(state)
        wp.launch(
            kernels.observe_objects,
            dim=worlds,
            inputs=[data.function_start, self._mean_basis, state.softmode.q, state.softmode.qd],
            outputs=[self.object_position, self.object_velocity],
            device=self.device,
        )
        wp.launch(
            kernels.observe_fingers,
            dim=(worlds, 2),
            inputs=[self._finger_body, self.solver.body_wrench],
            outputs=[self.finger_force],
            device=self.device,
        )

    def render(self, size: tuple[int, int]) -> SplatCamera:
        """Draw every camera of one image size and return it; its arrays are overwritten by the next frame."""
        camera = self.cameras[size]
        if size not in self._camera_graphs:
            self._draw(camera)
            with wp.ScopedCapture(device=self.device) as capture:
                self._draw(camera)
            self._camera_graphs[size] = capture.graph
        wp.capture_launch(self._camera_graphs[size])
        return camera

    def _draw(self, camera: SplatCamera) -> None:
        """Deform the splats and draw one frame."""
        data, state, arrays = self.model.softmode, self.state, self.splat_arrays
        self.skin.launch(
            state.softmode.q, data.function_start, arrays.means, arrays.covariances, rotations=arrays.rotations
        )
        camera.render(state)

    # -- reading ------------------------------------------------------------------------------------------------------

    @property
    def status(self) -> np.ndarray:
        """Status bits of the last control step per world, see :mod:`softmode.deformables.status`."""
        return self.solver.reduced.status.numpy()

    @property
    def status_reasons(self) -> tuple[tuple[str, ...], ...]:
        """Names of those bits per world."""
        return tuple(status_reasons(int(bits)) for bits in self.status)
