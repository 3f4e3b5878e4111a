"""SolverReduced: the implicit reduced step as a Newton solver, for several bodies and worlds, captured as a graph."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.contact import detection_kernels as detection
from softmode.deformables.contact import friction_memory_kernels as stick_kernels
from softmode.deformables.contact import penalty_kernels as contact
from softmode.deformables.contact.pairs import SoftPairs
from softmode.deformables.contact.shape_tables import candidate_shapes, heightfields, mesh_sources, solid_shapes
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.model.authoring import (
    NAMESPACE,
    add_pins,
    add_reduced_body,
    drive_regions,
    register_custom_attributes,
)
from softmode.deformables.model.buffers import make_entries, make_motion, make_points, make_progress, make_samples
from softmode.deformables.model.lane_kernels import LANES, team_size, vec8, vec8d
from softmode.deformables.model.layout import lay_out
from softmode.deformables.model.rigid_dofs import RigidDofs
from softmode.deformables.model.sizes import Sizes
from softmode.deformables.solver import assembly_kernels as assembly
from softmode.deformables.solver import attachment_kernels
from softmode.deformables.solver import fused_newton_kernels as newton_kernels
from softmode.deformables.solver import rigid_row_kernels as constraints
from softmode.deformables.solver import search_kernels as search
from softmode.deformables.solver import step_kernels as kernels
from softmode.deformables.solver.attachments import Attachment
from softmode.deformables.solver.fused_system_kernels import SHARED_SIZE, SHARED_WIDTH
from softmode.deformables.solver.observables import REDUCED_KINDS, ReducedObservableKind, ReducedObservables
from softmode.deformables.solver.step_checks import check_step
from softmode.deformables.solver.systems import join_systems
from softmode.errors import ConfigError

__all__ = [
    "SolverReduced",
    "SolverReducedOptions",
    "add_pins",
    "add_reduced_body",
    "drive_regions",
    "register_custom_attributes",
]

Integrator = Literal["euler", "bdf2"]

CUDA_THREADS = 2**16
"""Threads that keep a GPU busy: sums over points are split until there are about so many."""
ONE_LAUNCH_BLOCKS = 5
"""Blocks of eight functions up to which a body is small enough for a team of threads on CUDA."""


@dataclass(frozen=True, kw_only=True)
class SolverReducedOptions:
    """How a step is solved."""

    integrator: Integrator = "euler"
    """"euler": implicit Euler, first order, damps what a step cannot resolve (half of a 10 rad/s spin in a second at
    60 Hz). "bdf2": keeps 97 % of it; second order for a body without viscosity (whose stress is differenced
    backwards). It needs equal steps, and takes an Euler step where there is none before, as after a reset, and where
    a body has contacts or is attached to a rigid body. Who writes q or qd must set ``state.softmode.dt_before`` of the
    instance to 0."""
    iteration_max: int = 40
    """Newton iterations at most."""
    stiffness_renewal: int = 5
    """The elastic Hessian is assembled every so many iterations at least (contact always is), and"""
    renewal_distance: float = 1.0e-3
    """after an iteration that moved a body by more than this fraction of its size (rms). 0 is Newton's own method."""
    carry_stiffness: bool = False
    """Whether a step may start with the elastic Hessian of the step before, where no body has bent or turned by more
    than that since: half of the time of a body at rest. It changes results within the tolerances; what a step starts
    with is then no longer in its state alone, so that a replayed step agrees within the tolerances, not to the bit."""
    tolerance: float = 1.0e-5
    """Newton stops when every body moved less than this fraction of its size (rms) in an iteration, and"""
    force_tolerance: float = 1.0e-5
    """when the residual force on every body near a contact is below this fraction of the forces on it."""
    friction_lag: int = 8
    """Iterations during which the normal force that limits friction follows the contact; then it is frozen, and what is
    left is the minimisation of one potential. Newton converges linearly until then where bodies slide: fewer make a
    step cheaper, and friction of the last iterate but a few."""
    step_length_min: float = 2.0**-16
    """Shortest step the line search tries."""
    contact_max: int = 256
    """Contacts per instance at most; more raise the overflow flag and drop those that do not touch yet."""
    contact_margin: float = 0.01
    """Detection distance as a fraction of the body size, on top of twice the motion of the step."""
    soft_contact: bool = True
    """Whether soft bodies touch each other, and themselves where ``self_contact`` says so."""
    contact_smoothing: float = 1.0e-3
    """Range of the C2 onset of the contact penalty as a fraction of the body size."""
    stick_ratio: float = 1.0
    """Tangential over normal stiffness of a contact that sticks to a shape; friction remembers where, so that nothing
    creeps. 0 forgets: friction is Coulomb's smoothed over ``stick_velocity``, and what it holds creeps at up to it."""
    stick_velocity: float = 1.0e-4
    """Slip velocity [m/s] below which friction without memory counts as sticking."""

    def __post_init__(self) -> None:
        """Check every range."""
        if self.integrator not in ("euler", "bdf2"):
            raise ConfigError(f"integrator must be 'euler' or 'bdf2', got {self.integrator!r}")
        for name, low in (("iteration_max", 1), ("stiffness_renewal", 1), ("contact_max", 1), ("friction_lag", 0)):
            if getattr(self, name) < low:
                raise ConfigError(f"{name} must be at least {low}, got {getattr(self, name)}")
        for name in ("renewal_distance", "stick_ratio"):
            if not 0.0 <= getattr(self, name) < float("inf"):
                raise ConfigError(f"{name} must be a finite number >= 0, got {getattr(self, name)!r}")
        for name in (
            "tolerance",
            "force_tolerance",
            "step_length_min",
            "contact_margin",
            "contact_smoothing",
            "stick_velocity",
        ):
            if not 0.0 < getattr(self, name) < float("inf"):
                raise ConfigError(f"{name} must be a finite number > 0, got {getattr(self, name)!r}")


class SolverReduced(SolverBase):
    """Implicit Euler or BDF2 on the reduced coordinates of every soft body of a model.

    Rigid shapes are obstacles that move as their bodies do in ``state_in``; for two-way contact with MuJoCo use
    :class:`softmode.deformables.coupling.solver_coupled.SolverCoupledReduced`.

    A step costs no host read-back and may be captured with ``wp.ScopedCapture`` on CPU and CUDA.

    Args:
        model: Finalised model that holds bodies added by :func:`add_reduced_body`.
        bodies: The reduced bodies used in the model, in any order.
        options: How the step is solved.

    Raises:
        ConfigError: If a body of the model is not among ``bodies``, or a shape cannot be touched.
    """

    ObservableKind = ReducedObservableKind
    Observables = ReducedObservables
    SUPPORTED_OBSERVABLES = REDUCED_KINDS

    @classmethod
    def register_custom_attributes(cls, builder: newton.ModelBuilder) -> None:
        """Declare the attributes of reduced bodies on a builder."""
        register_custom_attributes(builder)

    def __init__(
        self, model: newton.Model, bodies: Sequence[ReducedBody], *, options: SolverReducedOptions | None = None
    ) -> None:
        """Lay out tables and buffers; see the class."""
        super().__init__(model)
        self.model: Any = model
        self.options = options = options or SolverReducedOptions()
        if not hasattr(model, NAMESPACE):
            raise ConfigError("model holds no reduced body", hint="call add_reduced_body before finalize")
        self.parameters = getattr(model, NAMESPACE)
        device = model.device
        self.layout = layout = lay_out(model, bodies)
        self.instance_count, self.world_count = layout.instance_count, layout.world_count
        self.stride = LANES * layout.block_count
        self.basis, self.instances = layout.basis, layout.instances
        fractions = {
            "tolerance": options.tolerance,
            "margin": options.contact_margin,
            "smoothing": options.contact_smoothing,
        }
        self.sizes = Sizes(model, layout, self.parameters, **fractions)
        self.rigid_tolerance = self.sizes.rigid_tolerance
        self.parameter_flags = wp.zeros(self.instance_count, dtype=int, device=device)
        """What :func:`softmode.deformables.solver.parameters.set_parameters` had to clamp, per instance."""
        self.candidate = wp.array(candidate_shapes(model, layout), dtype=int, device=device)
        self.near = wp.zeros_like(self.candidate)
        self.shapes = self._shapes()
        self.prescribed = True
        """Whether the rigid bodies of the step move as prescribed."""

        self.team = team_size(device)
        functions = (self.instance_count, 3 * layout.block_count)
        self.functions = functions
        self.motion = make_motion(functions, device)
        self.points = make_points(self.instance_count, layout.point_max, device)
        self.samples = make_samples(self.instance_count, layout.sample_max, self.team, device)
        crowded = bool((np.diff(layout.instance_start) > 1).any()) or bool(self.parameters.self_contact.numpy().any())
        self.pairs = None
        if options.soft_contact and crowded:
            self.pairs = SoftPairs(model, layout, options.contact_max // 2, options.stick_ratio, self.sizes.spacing)
        """Contact between soft bodies, None where there is never any."""
        self.progress = make_progress(layout.instance_start, functions, device)
        self.progress.friction_lag = options.friction_lag
        self.q, self.q_trial = (wp.zeros(functions, dtype=vec8d, device=device) for _ in range(2))
        self.gradient = wp.zeros(functions, dtype=vec8d, device=device)
        self.reaction = wp.zeros(functions, dtype=vec8d, device=device)
        """Generalised forces that held the driven functions at the last iterate but one [N], in blocks: their error is
        Newton's tolerance times the stiffness, so tighten it where forces of 1 % matter."""
        self.one_launch = device.is_cuda and self.part_count == 1 and layout.block_count <= ONE_LAUNCH_BLOCKS
        """Whether a team of threads takes a world through all of its Newton iterations in one launch."""
        self.newton_team = newton_kernels.TEAM if device.is_cuda else 1
        one_each = self.instance_count == self.world_count and layout.pin_max == 0
        driven = bool(self.instances.driven_count.numpy().any())
        self.shared = self.one_launch and one_each and not driven and 3 * self.stride <= SHARED_SIZE
        """Whether the systems of that launch are assembled and solved in shared memory."""
        self.newton_options: Any = newton_kernels.NewtonOptions()
        blocks = layout.block_count
        chunks = 1 if self.shared else self._chunks(functions[0] * blocks, blocks)
        self.gradient_chunk = wp.zeros((functions[0], chunks, functions[1]), dtype=vec8d, device=device)
        chunks = self._chunks(functions[0] * 3 * blocks**2, 3 * blocks**2 + 3 * (blocks**2 + blocks) // 2)
        self.stiffness = wp.zeros((functions[0], chunks, 3 * self.stride, functions[1]), dtype=vec8, device=device)
        shape = (functions[0], self.stride, layout.block_count) if layout.pin_max else (1, 1, 1)
        self.pins = wp.zeros(shape, dtype=vec8, device=device)
        self.instance_force = wp.zeros(self.instance_count, dtype=wp.vec3d, device=device)
        vector: Any = wp.spatial_vector
        self.body_wrench = wp.zeros(max(model.body_count, 1), dtype=vector, device=device)
        """Contact wrench on every rigid body about its centre of mass [N, N m]."""
        none = np.zeros(self.world_count, int)
        self.attach_rigid(RigidDofs(model, self.world_count, none, none))
        self.every_world = wp.full(self.world_count + 1, True, dtype=bool, device=device)
        self._check_materials()
        self.refresh()

    def _chunks(self, threads: int, tasks: int) -> int:
        """Return into how many parts sums over points are split where a kernel has so many threads.

        ``tasks`` is how many of them belong to one body.
        """
        if self.one_launch:
            return int(np.clip(self.newton_team // tasks, 1, 16))
        return int(np.clip(CUDA_THREADS // threads, 1, 16)) if self.model.device.is_cuda else 1

    def _shapes(self) -> Any:
        """Gather what contact reads of the model's shapes."""
        model, shapes = self.model, detection.Shapes()
        if model.shape_count:
            shapes.kind, shapes.scale = model.shape_type, model.shape_scale
            shapes.source, self._hulls = mesh_sources(model, solid_shapes(model))
            shapes.margin, shapes.friction = model.shape_margin, model.shape_material_mu
            shapes.lower, shapes.upper = model.shape_collision_aabb_lower, model.shape_collision_aabb_upper
            shapes.body, shapes.transform = model.shape_body, model.shape_transform
            shapes.fields = heightfields(model)
        shapes.body_com, shapes.body_mass = model.body_com, model.body_mass
        return shapes

    def attach_rigid(self, rigid: RigidDofs) -> None:
        """Let the joint dofs of ``rigid`` take part in the solve."""
        self.rigid = rigid
        device = self.model.device
        self.entry_max = self.options.contact_max + self.layout.pin_max
        self.entries = make_entries(self.instance_count, self.entry_max, rigid.count_max, device)
        columns = rigid.count_max + 1
        self.system_start, self.system = join_systems(self.layout, self.part_count, columns, device)
        self.direction = self.system.solution
        unit = self.system.unit
        self.shared = self.shared and self.system.scalars.shape[2] <= SHARED_WIDTH
        self._minimise_worlds: Any = wp.overload(newton_kernels.minimise_worlds, {"unit": unit})
        if self.part_count > 1:
            self.direction = wp.zeros(self.functions, dtype=vec8, device=device)

    @property
    def part_count(self) -> int:
        """Bodies that share a linear system: all of a world where soft bodies may touch each other, else one."""
        return 1 if self.pairs is None else int(np.diff(self.layout.instance_start).max())

    @property
    def bodies(self) -> tuple[ReducedBody, ...]:
        """The distinct bodies."""
        return self.layout.bodies

    @property
    def status(self) -> wp.array:
        """Status bits per world (see ``status``), gathered over steps until cleared with ``status.zero_()``."""
        return self.progress.status

    @property
    def iteration(self) -> wp.array:
        """Newton iterations of the last step per world."""
        return self.progress.iteration

    def refresh(self, world_mask: wp.array | None = None) -> None:
        """Compute what follows from the model's densities and scales in the masked worlds; see :class:`Sizes`.

        Args:
            world_mask: Boolean mask of shape (world_count + 1,) as for :meth:`reset`; None for all worlds.
        """
        self.sizes.derive(self.checked_mask(world_mask))

    def _check_materials(self) -> None:
        """Refuse materials that the bodies cannot have."""
        models = self.parameters.material_model.numpy()
        if (self.instances.driven_count.numpy()[models == int(MaterialModel.NEO_HOOKEAN)] > 0).any():
            raise ConfigError(
                "a body with exact regions has the material NEO_HOOKEAN, which a driven region may invert in one step",
                hint="use STABLE_NEO_HOOKEAN_LOG, or a soft region",
            )

    def notify_model_changed(self, flags: int) -> None:
        """Follow changes of the model: call it, with any flags, after a change of density, scale or material model.

        Everything else (Young's modulus, Poisson's ratio, viscosity, damping, friction, contact stiffness, pins,
        gravity, shapes' poses and friction) is read in every step. May be captured, and then checks nothing.
        """
        self.refresh()
        if not self.model.device.is_capturing:
            self._check_materials()

    # -- the step -----------------------------------------------------------------------------------------------------

    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        *,
        observables: Any = None,
    ) -> None:
        """Advance every soft body by ``dt`` [s]; rigid bodies move as prescribed by ``state_in``.

        ``contacts`` is not read: contacts between soft bodies and shapes are found by the solver itself. Without
        ``control`` driven regions and pins stay where the model has them.

        Raises:
            ConfigError: If ``dt`` is not finite and positive, or a state or the control belongs to another model.
        """
        self.validate_observables(observables, contacts)
        check_step(self.model, state_in, state_out, control, dt)
        self.begin(state_in, control, dt)
        self.detect(state_in, control, dt, prescribed=True)
        self.minimise(dt)
        self.finish(state_out, dt)
        self.report(observables)

    def begin(self, state: newton.State, control: newton.Control | None, dt: float) -> None:
        """Read the state and predict."""
        data, chunk = getattr(state, NAMESPACE), self.gradient_chunk
        dim = (self.instance_count, chunk.shape[1], self.layout.block_count)
        self._launch(kernels.sum_external, dim, [self.instances, self.basis, state.particle_f, chunk.shape[1]], [chunk])
        self._launch(
            kernels.begin_step,
            (self.instance_count, self.layout.block_count),
            [
                self.instances,
                self.basis,
                self.model.gravity,
                data.q,
                data.qd,
                data.q_before,
                data.qd_before,
                data.dt_before,
                self._control(control).q_driven,
                chunk,
                wp.float64(dt),
                int(self.options.integrator == "bdf2"),
            ],
            [self.motion, self.q],
        )

    def detect(self, state: newton.State, control: newton.Control | None, dt: float, *, prescribed: bool) -> None:
        """Find the contacts of the step and write them behind the pins as entries."""
        self.shapes.body_q, self.shapes.body_qd = state.body_q, state.body_qd
        self.prescribed = prescribed
        if self.layout.pin_max:
            self._gather_pins(control, dt, prescribed=prescribed)
        if self.model.shape_count or self.pairs is not None:
            self._place_samples()
        if self.model.shape_count:
            self._find_contacts(state, dt, prescribed=prescribed)
        else:
            wp.copy(self.entries.count, self.instances.pin_count)
        if self.pairs is not None:
            memory = getattr(state, NAMESPACE)
            tables = [self.samples, self.progress, memory, self.entries]
            self.pairs.detect(self.motion, *tables, entry_max=self.entry_max, dt=float(dt))
        if self.part_count > 1:
            dim = (self.world_count, self.part_count)
            tables = [self.instances, self.progress, self.entries]
            self._launch(assembly.relate_pairs, dim, tables, [self.system.relation])
            self.system.order_parts()
            place = [self.instances, self.progress, self.system.place, 3 * self.layout.block_count]
            self._launch(assembly.place_parts, self.instance_count, place)
        self.adapt(dt)

    def differentiate_entries(self) -> None:
        """Compute how the entries move with the joint dofs, from the Jacobians of the articulations."""
        dim = (self.instance_count, self.entry_max)
        self._launch(detection.entry_jacobians, dim, [self.instances, self.rigid.table], [self.entries])

    def bound_pivots(self) -> None:
        """Compute the pivots of the inertia, below which those of the condensed rigid system cannot be."""
        self._launch_team(assembly.bound_pivots, self.world_count, [self.team], [self.rigid.table])

    def _place_samples(self) -> None:
        """Compute where the surface samples are and what bounds them."""
        every = (self.instance_count, self.layout.sample_max)
        self._launch(detection.place_samples, every, [self.instances, self.basis, self.motion], [self.samples])
        self._launch_team(detection.bound_samples, self.instance_count, [self.instances, self.team], [self.samples])

    def _find_contacts(self, state: newton.State, dt: float, *, prescribed: bool) -> None:
        """Find the contacts of the surface samples with the rigid shapes."""
        instances, samples, shapes, team = self.instances, self.samples, self.shapes, self.team
        memory, every = getattr(state, NAMESPACE), (self.instance_count, self.layout.sample_max)
        self._launch(
            detection.cull_shapes,
            self.candidate.shape,
            [instances, self.candidate, shapes, samples, *self._link_pins(), float(dt)],
            [self.near],
        )
        self._launch(
            detection.find_contacts,
            every,
            [instances, self.basis, self.motion, self.candidate, self.near, shapes, float(dt)],
            [samples],
        )
        self._launch_team(
            detection.gather_contacts,
            self.instance_count,
            [
                instances,
                self.basis,
                shapes,
                samples,
                self.entry_max,
                int(prescribed),
                wp.float64(self.options.stick_ratio),
                team,
                float(dt),
                memory.stick_shape,
                memory.stick_point,
            ],
            [self.entries, self.status],
        )

    def _gather_pins(self, control: newton.Control | None, dt: float, *, prescribed: bool) -> None:
        """Write the pins as the first entries of the step and assemble their stiffness."""
        layout, tables, row = self.layout, [self.instances, self.basis], self.layout.first_pin_row
        targets = [self._control(control).pin_target, int(prescribed), float(dt)]
        self._launch(
            detection.gather_pins,
            (self.instance_count, layout.pin_max),
            [*tables, self.motion, self.shapes, row, *self._link_pins(), *targets],
            [self.entries],
        )
        dim = (self.instance_count, layout.block_count, layout.block_count)
        self._launch(assembly.assemble_pins, dim, [*tables, row, self.parameters.pin_stiffness], [self.pins])

    def _link_pins(self) -> list[Any]:
        """Return which rigid bodies the pins follow and how stiffly, empty where there are no pins."""
        return [getattr(self.parameters, name, None) for name in ("pin_body", "pin_stiffness")]

    def adapt(self, dt: float) -> None:
        """Let bodies in contact or attached to a rigid body take an Euler step, whatever the integrator."""
        if self.options.integrator == "bdf2":
            self._launch(kernels.touch, self.functions, [self.instances, self.entries, wp.float64(dt)], [self.motion])

    def minimise(self, dt: float) -> None:
        """Minimise the incremental potential of every world by Newton with a line search."""
        self._launch(kernels.begin_newton, self.world_count, [self.progress, self.instances, self.entries])
        tables = [self.instances, self.motion, self.entries]
        self._launch(kernels.extrapolate, self.functions, [*tables, wp.float64(dt)], [self.q])
        if self.options.carry_stiffness:
            given = [self.instances, self.basis, self.options.renewal_distance, float(dt), self.team, self.q]
            self._launch_team(search.keep_hessians, self.world_count, given, [self.progress])
        if self.one_launch:
            self._minimise_at_once(dt)
        else:
            wp.capture_while(self.progress.any_active, self._newton_iteration, dt=dt)

    def _minimise_at_once(self, dt: float) -> None:
        """Take every world through its iterations in one launch, a team of threads per world."""
        options, system, given = self.options, self.system, self.newton_options
        given.iteration_max, given.force_tolerance = options.iteration_max, wp.float64(options.force_tolerance)
        given.stick_range = wp.float64(options.stick_velocity * dt)
        given.step_length_min = wp.float64(options.step_length_min)
        given.renewal, given.renewal_distance = options.stiffness_renewal, options.renewal_distance
        given.rigid_max, given.dt = self.rigid.count_max, wp.float64(dt)
        given.gradient_chunks, given.stiffness_chunks = self.gradient_chunk.shape[1], self.stiffness.shape[1]
        given.factor_width = system.width
        given.shared = int(self.shared)
        arrays = newton_kernels.NewtonArrays()
        arrays.q, arrays.q_trial, arrays.gradient, arrays.reaction = self.q, self.q_trial, self.gradient, self.reaction
        arrays.gradient_chunk, arrays.stiffness, arrays.pins = self.gradient_chunk, self.stiffness, self.pins
        arrays.rigid_tolerance, arrays.system_start = self.rigid_tolerance, self.system_start
        arrays.system_world, arrays.matrix, arrays.scalars = system.system_world, system.matrix, system.scalars
        arrays.pattern, arrays.diagonal, arrays.indefinite = system.pattern, system.diagonal, system.indefinite
        arrays.right, arrays.direction = system.right, self.direction
        tables = [self.instances, self.basis, self.motion, self.points, self.entries, self.rigid.table, self.progress]
        wp.launch(
            self._minimise_worlds,
            dim=(self.world_count, self.newton_team),
            inputs=[*tables, given, arrays, system.unit, self.newton_team],
            block_dim=self.newton_team,
            device=self.model.device,
        )

    def _newton_iteration(self, dt: float) -> None:
        """Take one Newton step in every world that is not done."""
        self._evaluate(self.progress.active, self.q, self.rigid.r, dt, derivatives=True)
        self._gather_gradient(dt)
        self._judge_iterate(dt)
        self._assemble(dt)
        self._solve()
        self._begin_search(dt)
        wp.capture_while(self.progress.any_searching, self._try_step, dt=dt)
        self._finish_iteration(dt)

    def _evaluate(self, selected: wp.array, q: wp.array, r: wp.array, dt: float, *, derivatives: bool) -> None:
        """Evaluate elastic points and point constraints at q, r in the selected worlds."""
        step = [selected, q, wp.float64(dt), int(derivatives), self.progress]
        self._launch(
            kernels.evaluate_points,
            self.points.energy.shape,
            [self.instances, self.basis, self.motion, *step],
            [self.points],
        )
        stick_range = wp.float64(self.options.stick_velocity * dt)
        tables = [self.instances, self.basis, self.motion, self.progress, self.rigid.table]
        self._launch(
            contact.evaluate_entries,
            self.entries.row.shape,
            [*tables, stick_range, selected, q, r, int(derivatives)],
            [self.entries],
        )
        if self.rigid.row_max:
            rows = [selected, r, wp.float64(dt), int(derivatives)]
            dim = (self.world_count, self.rigid.row_max)
            self._launch(constraints.evaluate_rows, dim, rows, [self.rigid.table])

    def _gather_gradient(self, dt: float) -> None:
        """Gather the gradient of the potential with respect to q."""
        active, chunk = self.progress.active, self.gradient_chunk
        self._launch(
            kernels.sum_forces,
            (self.instance_count, chunk.shape[1], self.layout.block_count),
            [self.instances, self.basis, self.points, self.entries, active, chunk.shape[1]],
            [chunk],
        )
        self._launch(
            kernels.sum_gradient,
            self.functions,
            [self.instances, self.basis, self.motion, active, chunk, self.q, wp.float64(dt)],
            [self.gradient, self.reaction],
        )

    def _judge_iterate(self, dt: float) -> None:
        """Sum the potential and stop the worlds that have converged or used up their iterations."""
        options = self.options
        limits = [options.iteration_max, wp.float64(options.force_tolerance)]
        self.progress.any_active.zero_()
        self._launch_team(
            search.judge_iterate,
            self.world_count,
            [*self._potential_tables(), *limits, self.gradient, self.q, wp.float64(dt)],
            [self.progress],
        )

    def _potential_tables(self) -> list[Any]:
        """Return what the sum of the potential reads."""
        return [self.instances, self.motion, self.points, self.entries, self.rigid.table, self.team]

    def _assemble(self, dt: float) -> None:
        """Assemble the Hessian into the block systems [K | C | -g] and the rigid part."""
        instances, basis, entries = self.instances, self.basis, self.entries
        active, blocks, rigid = self.progress.active, self.layout.block_count, self.rigid
        chunks = self.stiffness.shape[1]
        tasks = 3 * blocks * blocks + 3 * (blocks * blocks + blocks) // 2  # 8x8 blocks of the upper triangle
        columns = 3 * blocks if self.model.device.is_cuda else 1  # threads that share a row of the matrix
        self._launch(
            assembly.assemble_stiffness,
            (self.instance_count, chunks, tasks),
            [instances, basis, self.points, active, self.progress.renew, chunks],
            [self.stiffness],
            block_dim=128,  # more than 100 registers per thread: larger blocks leave half of a multiprocessor idle
        )
        self._launch(
            assembly.assemble_matrix,
            (self.instance_count, 3 * self.stride, columns),
            [instances, basis, self.motion, active, self.stiffness, self.pins, wp.float64(dt), columns],
            [self.system.matrix],
        )
        self._launch(
            assembly.add_contacts,
            (self.instance_count, tasks),
            [instances, basis, entries, active],
            [self.system.matrix],
            block_dim=128,
        )
        self._launch(
            assembly.assemble_columns,
            (self.instance_count, 3 * blocks, rigid.count_max + 1),
            [instances, basis, entries, active, self.gradient, rigid.table, rigid.count_max, self.system.size],
            [self.system.scalars],
        )
        if self.part_count > 1:
            self._launch(
                assembly.assemble_pairs,
                (self.world_count, self.part_count**2, 9 * blocks * blocks),
                [instances, basis, entries, self.progress, self.system.relation],
                [self.system.matrix],
                block_dim=128,
            )
        if rigid.count_max:
            dim = (self.world_count, rigid.count_max, rigid.count_max)
            self._launch(assembly.assemble_rigid, dim, [instances, entries, self.progress], [rigid.table])

    def _solve(self) -> None:
        """Factor every body, condense onto the rigid dofs, solve those, substitute back."""
        rigid, system, active = self.rigid, self.system, self.progress.active
        system.factor(active)
        if rigid.count_max:
            dim = (self.world_count, rigid.count_max, rigid.count_max + 1)
            tables = [self.progress, self.system_start, rigid.count_max, system.matrix]
            self._launch(assembly.condense, dim, tables, [rigid.table])
            self._launch_team(assembly.solve_rigid, self.world_count, [active, self.team], [rigid.table])
        solution = system.solve(active, rigid.count_max, rigid.direction, rigid.count_max)
        if self.part_count > 1:
            self._launch(assembly.read_direction, self.functions, [self.instances, solution], [self.direction])

    def _begin_search(self, dt: float) -> None:
        """Start the line search of every active world."""
        self.progress.any_searching.zero_()
        limits = [self.rigid_tolerance, wp.float64(self.options.stick_velocity * dt), self.team]
        linear = [self.gradient, self.direction, self.system.indefinite]
        self._launch_team(
            search.begin_search,
            self.world_count,
            [self.instances, self.entries, self.rigid.table, *limits, *linear],
            [self.progress],
        )

    def _try_step(self, dt: float) -> None:
        """Evaluate one trial step in every searching world and accept or halve it."""
        rigid, progress = self.rigid, self.progress
        self._launch(
            search.trial_functions, self.functions, [self.instances, progress, self.q, self.direction], [self.q_trial]
        )
        if rigid.count_max:
            self._launch(search.trial_rigid, (self.world_count, rigid.count_max), [progress], [rigid.table])
        self._evaluate(progress.searching, self.q_trial, rigid.trial, dt, derivatives=False)
        progress.any_searching.zero_()
        step_length_min = wp.float64(self.options.step_length_min)
        self._launch_team(
            search.judge_trial,
            self.world_count,
            [*self._potential_tables(), step_length_min, self.q_trial, wp.float64(dt)],
            [progress],
        )

    def _finish_iteration(self, dt: float) -> None:
        """Take the accepted steps."""
        options = self.options
        renewal = [options.stiffness_renewal, options.renewal_distance, float(dt)]
        self._launch_team(
            search.finish_iteration,
            self.world_count,
            [self.instances, self.rigid.table, self.team, *renewal, self.direction],
            [self.q, self.progress],
        )

    def finish(self, state: newton.State, dt: float) -> None:
        """Write coordinates, velocities and particles, and sum the contact reactions."""
        out = getattr(state, NAMESPACE)
        self._launch_team(
            kernels.check_state,
            self.world_count,
            [self.instances, self.points, self.rigid.table, self.team, self.layout.block_count, self.q],
            [self.progress],
        )
        self._launch(
            kernels.end_step,
            (self.instance_count, self.stride),
            [self.instances, self.motion, self.entries, self.status, self.q, self.layout.block_count, wp.float64(dt)],
            [out.q, out.qd, out.q_before, out.qd_before, out.dt_before],
        )
        if self.model.shape_count:
            self._launch(
                stick_kernels.remember_slip,
                (self.instance_count, self.layout.sample_max),
                [self.instances, self.shapes, self.samples, self.entries, int(self.prescribed)],
                [out.stick_shape, out.stick_point],
            )
        if self.pairs is not None:
            self.pairs.remember(self.motion, self.progress, self.entries, out)
        self.body_wrench.zero_()
        self._launch(
            contact.sum_reactions,
            self.world_count,
            [self.instances, self.progress, self.entries],
            [self.body_wrench, self.instance_force],
        )
        self.update_particles(state)

    def report(self, observables: Any) -> None:
        """Write the contact forces of the step into the arrays that ``observables`` asks for."""
        if observables is None:
            return
        if observables.is_requested(ReducedObservableKind.BODY_SOFT_CONTACT_F):
            wp.copy(observables.body_soft_contact_f, self.body_wrench, count=self.model.body_count)
        if observables.is_requested(ReducedObservableKind.INSTANCE_CONTACT_F):
            wp.copy(observables.instance_contact_f, self.instance_force)

    def update_particles(self, state: newton.State) -> None:
        """Move the surface particles of ``state`` to where its reduced coordinates put them."""
        out = getattr(state, NAMESPACE)
        dim = (self.instance_count, self.layout.sample_max)
        particles = [state.particle_q, state.particle_qd]
        self._launch(kernels.skin_samples, dim, [self.instances, self.basis, out.q, out.qd], particles)

    def reset(self, state: newton.State, world_mask: wp.array | None = None, flags: Any = None) -> None:
        """Put the bodies of the chosen worlds back to the model's initial state and clear what those worlds report.

        A body whose scale has changed since it was added is placed at its new size about its centre of mass.

        Args:
            state: State to reset in place.
            world_mask: Boolean mask of shape (world_count + 1,), the last entry for entities outside worlds; or None
                for all.
            flags: ``newton.StateFlags``; coordinates are reset with PARTICLE_Q, velocities with PARTICLE_QD. None
                resets all.

        Raises:
            ConfigError: If the mask has another shape or type.
        """
        mask = self.checked_mask(world_mask)
        flags = int(newton.StateFlags.ALL if flags is None else flags)
        initial, out = self.parameters, getattr(state, NAMESPACE)
        chosen = [flags & int(newton.StateFlags.PARTICLE_Q), flags & int(newton.StateFlags.PARTICLE_QD)]
        self._launch(
            kernels.reset_functions,
            (self.instance_count, self.stride),
            [
                self.instances,
                self.basis,
                initial.placed_scale,
                initial.instance_world,
                mask,
                *chosen,
                initial.q,
                initial.qd,
            ],
            [out.q, out.qd, out.dt_before],
        )
        dim = (self.instance_count, self.layout.sample_max)
        memory = [out.stick_shape, out.stick_partner]
        self._launch(stick_kernels.forget_slip, dim, [self.instances, initial.instance_world, mask], memory)
        self._launch(
            kernels.reset_worlds,
            max(self.instance_count, self.model.body_count),
            [self.instances, initial.instance_world, self.model.body_world, mask],
            [
                self.status,
                self.instance_force,
                self.body_wrench,
                self.entries.count,
                self.entries.pair_count,
                self.progress.kept,
            ],
        )
        if self.layout.pin_max:
            dim = (self.instance_count, self.layout.pin_max)
            pins = [self.parameters.pin_stiffness]
            self._launch(attachment_kernels.hold_all_pins, dim, [self.instances, initial.instance_world, mask], pins)
        self.update_particles(state)

    def release(self, attachment: Attachment, world_mask: wp.array | None = None) -> None:
        """Let go of an attachment in the masked worlds; may be captured, then give a mask.

        Args:
            attachment: What :func:`softmode.deformables.solver.attachments.attach` returned.
            world_mask: Boolean mask of shape (world_count + 1,) as for :meth:`reset`; None for all worlds.

        Raises:
            ConfigError: If the mask has another shape or type.
        """
        self._hold(attachment, world_mask, -1.0)

    def hold(self, attachment: Attachment, world_mask: wp.array | None = None) -> None:
        """Take a released attachment up again; arguments as for :meth:`release`."""
        self._hold(attachment, world_mask, 1.0)

    def _hold(self, attachment: Attachment, world_mask: wp.array | None, sign: float) -> None:
        mask = self.checked_mask(world_mask)
        where = [attachment.instance, attachment.first, sign]
        self._launch(
            attachment_kernels.hold_pins,
            (self.world_count, attachment.count),
            [self.instances, self.progress.instance_start, self.parameters.instance_world, mask, *where],
            [self.parameters.pin_stiffness],
        )

    def checked_mask(self, world_mask: wp.array | None) -> wp.array:
        """Return the mask, all worlds if there is none; refuse what a kernel would misread.

        Raises:
            ConfigError: If the mask has another shape or type.
        """
        if world_mask is None:
            return self.every_world
        mask: Any = world_mask
        shape, dtype = self.every_world.shape, self.every_world.dtype
        if not isinstance(mask, wp.array) or mask.dtype != dtype or mask.shape != shape:
            given = f"{mask.dtype.__name__} {mask.shape}" if isinstance(mask, wp.array) else type(mask).__name__
            raise ConfigError(
                f"world_mask must be a wp.array of wp.bool, shape (world_count + 1,) = {shape}, got {given}",
                hint="give the entities outside all worlds the last entry",
            )
        return mask

    def _control(self, control: newton.Control | None) -> Any:
        """Return the control attributes, the model's where there is no control."""
        return getattr(control if control is not None else self.model, NAMESPACE)

    def _launch(
        self, kernel: Any, dim: Any, inputs: list[Any], outputs: Sequence[Any] = (), block_dim: int = 256
    ) -> None:
        """Launch on the model's device."""
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=list(outputs), block_dim=block_dim, device=self.model.device)

    def _launch_team(self, kernel: Any, count: int, inputs: list[Any], outputs: Sequence[Any] = ()) -> None:
        """Launch one team of threads per world or instance, each in a block of its own."""
        wp.launch(
            kernel,
            dim=(count, self.team),
            inputs=inputs,
            outputs=list(outputs),
            block_dim=self.team,
            device=self.model.device,
        )
