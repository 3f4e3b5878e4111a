"""SolverReduced: the implicit reduced step as a Newton solver, for several bodies and worlds, captured as a graph."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase

from softmode.deformables import assembly_kernels as assembly
from softmode.deformables import contact, kernels, status
from softmode.deformables import search_kernels as search
from softmode.deformables.authoring import (
    NAMESPACE,
    add_pins,
    add_reduced_body,
    body_key,
    contact_stiffness,
    register_custom_attributes,
)
from softmode.deformables.body import ReducedBody
from softmode.deformables.factor import LANES, BlockCholesky, pad, vec8
from softmode.deformables.rigid_dofs import RigidDofs
from softmode.deformables.shape_queries import SUPPORTED_SHAPES
from softmode.errors import ConfigError

__all__ = [
    "SolverReduced",
    "SolverReducedOptions",
    "add_pins",
    "add_reduced_body",
    "contact_stiffness",
    "register_custom_attributes",
]


@dataclass(frozen=True, kw_only=True)
class SolverReducedOptions:
    """How a step is solved."""

    iteration_max: int = 20
    """Newton iterations at most."""
    stiffness_renewal: int = 5
    """The elastic Hessian is assembled every so many iterations at least (contact always is), and"""
    renewal_distance: float = 1.0e-3
    """after an iteration that moved a body by more than this fraction of its size (rms). 0 is Newton's own method."""
    tolerance: float = 1.0e-5
    """Newton stops when every body moved less than this fraction of its size (rms) in an iteration, and"""
    force_tolerance: float = 1.0e-5
    """when the residual force on every body near a contact is below this fraction of the forces on it."""
    step_length_min: float = 2.0**-10
    """Shortest step the line search tries."""
    contact_max: int = 256
    """Contacts per instance at most; more raise the overflow flag and drop those that do not touch yet."""
    contact_margin: float = 0.01
    """Detection distance as a fraction of the body size, on top of twice the motion of the step."""
    contact_smoothing: float = 1.0e-3
    """Range of the C2 onset of the contact penalty as a fraction of the body size."""
    stick_velocity: float = 1.0e-4
    """Slip velocity [m/s] below which friction counts as sticking."""

    def __post_init__(self) -> None:
        """Check every range."""
        for name, low in (("iteration_max", 1), ("stiffness_renewal", 1), ("contact_max", 1)):
            if getattr(self, name) < low:
                raise ConfigError(f"{name} must be at least {low}, got {getattr(self, name)}")
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
    """Implicit Euler on the reduced coordinates of every soft body of a model.

    Rigid shapes are obstacles that move as their bodies do in ``state_in``; for two-way contact with MuJoCo use
    :class:`softmode.deformables.coupling.SolverCoupledReduced`.

    A step costs no host read-back and may be captured with ``wp.ScopedCapture`` on CPU and CUDA.

    Args:
        model: Finalised model that holds bodies added by :func:`add_reduced_body`.
        bodies: The reduced bodies used in the model, in any order.
        options: How the step is solved.

    Raises:
        ConfigError: If a body of the model is not among ``bodies``, or a shape type cannot be touched.
    """

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
        self.options = options or SolverReducedOptions()
        if not hasattr(model, NAMESPACE):
            raise ConfigError("model holds no reduced body", hint="call add_reduced_body before finalize")
        self._build_tables(list(bodies))
        self._build_buffers()
        self.attach_rigid(
            RigidDofs(model, self.world_count, np.zeros(self.world_count, int), np.zeros(self.world_count, int))
        )
        self.refresh()

    # -- host side tables ---------------------------------------------------------------------------------------------

    def _build_tables(self, bodies: list[ReducedBody]) -> None:
        """Concatenate the bases of all assets and lay out the instances."""
        data = getattr(self.model, NAMESPACE)
        keys = {body_key(body): a for a, body in enumerate(bodies)}
        wanted = data.body_key.numpy()
        missing = [int(k) for k in wanted if int(k) not in keys]
        if missing:
            raise ConfigError(
                f"{len(missing)} instance(s) of the model use a body that is not in bodies",
                hint="pass every ReducedBody given to add_reduced_body",
            )
        self.bodies = bodies
        self.asset = np.array([keys[int(k)] for k in wanted])
        world = data.instance_world.numpy()
        if (world < 0).any() and self.model.world_count > 1:
            raise ConfigError("a reduced body lies outside all worlds", hint="add it to the builder that is replicated")
        self.instance_world = np.maximum(world, 0)
        if (np.diff(self.instance_world) < 0).any():
            raise ConfigError("instances are not ordered by world", hint="add bodies to one world before the next")
        self.instance_count, self.world_count = len(wanted), max(self.model.world_count, 1)
        counts = np.bincount(self.instance_world, minlength=self.world_count)
        self.instance_start = np.concatenate([[0], np.cumsum(counts)])

        self.stride = pad(max(body.function_count for body in bodies))
        point_start, row_start = [], []
        gradients, rows, means = [], [], []
        points = samples = 0
        for body in bodies:
            point_start.append(points)
            row_start.append(samples)
            points += body.point_count
            samples += body.surface_count
            gradients.append(self._padded(body.grad_basis))
            rows.append(self._padded(body.surface_basis))
            means.append(self._padded(body.mean_basis[None]))
        pin_rows, pin_points = self._pin_rows(data)
        grad = np.concatenate(gradients)
        device = self.model.device

        def table(values: Any, dtype: Any) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        def joined(name: str) -> np.ndarray:
            return np.concatenate([getattr(body, name) for body in bodies])

        self.grad_basis = table(grad.astype(np.float32), wp.vec3)
        blocks = grad.reshape(len(grad), -1, LANES, 3).transpose(1, 0, 3, 2)
        self.grad_basis8 = table(blocks.astype(np.float32), vec8)
        self.point_weight = table(joined("weights"), wp.float64)
        self.stiffness_scale = table(joined("stiffness_scale").astype(np.float32), float)
        basis_rows = np.concatenate([*rows, pin_rows]).astype(np.float32)
        self.row_basis = table(basis_rows, float)
        self.row_basis8 = table(basis_rows.reshape(len(basis_rows), -1, LANES), vec8)
        self.row_point = table(np.concatenate([joined("surface_points"), pin_points]), wp.vec3d)
        self.row_area = table(np.append(joined("surface_areas"), np.zeros(len(pin_points))).astype(np.float32), float)
        self.mean_basis = table(np.concatenate(means), wp.float64)

        def per_instance(values: Sequence[int]) -> wp.array:
            return table(np.asarray(values)[self.asset], int)

        self.world = table(self.instance_world, int)
        self.world_instances = table(self.instance_start, int)
        self.instance_asset = table(self.asset, int)
        self.function_count = per_instance([body.function_count for body in bodies])
        self.point_start, self.point_count = per_instance(point_start), per_instance([b.point_count for b in bodies])
        self.row_start, self.sample_count = per_instance(row_start), per_instance([b.surface_count for b in bodies])
        self.point_max = max(body.point_count for body in bodies)
        self.sample_max = max(body.surface_count for body in bodies)
        self.size = np.array([np.linalg.norm(np.ptp(body.bounds, axis=0)) for body in bodies])[self.asset]
        self.parameters = data
        self.mass = wp.zeros(self.instance_count, dtype=wp.float64, device=device)
        self.tolerance = table((self.options.tolerance * self.size).astype(np.float32), float)
        self.margin = table((self.options.contact_margin * self.size).astype(np.float32), float)
        self.smoothing = table((self.options.contact_smoothing * self.size).astype(np.float32), float)
        self.rigid_tolerance = float(self.options.tolerance * self.size.min())
        self.candidate = table(self._candidates(), int)

    def _padded(self, values: np.ndarray) -> np.ndarray:
        """Pad the function axis (the second) of basis values with zeros to the stride."""
        widths = [(0, 0)] * values.ndim
        widths[1] = (0, self.stride - values.shape[1])
        return np.pad(np.asarray(values, float), widths)

    def _pin_rows(self, data: Any) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the basis at the pins and sort them by instance."""
        device = self.model.device
        owner = data.pin_instance.numpy() if hasattr(data, "pin_instance") else np.zeros(0, int)
        points = data.pin_point.numpy().reshape(-1, 3) if len(owner) else np.zeros((0, 3))
        counts = np.bincount(owner, minlength=self.instance_count) if len(owner) else np.zeros(self.instance_count, int)
        if (np.diff(owner) < 0).any():
            raise ConfigError("pins are not ordered by instance", hint="add the pins of one body before the next")
        rows = np.zeros((len(owner), self.stride))
        known: dict[tuple[int, bytes], np.ndarray] = {}
        for i in range(self.instance_count):
            mine = owner == i
            key = (int(self.asset[i]), points[mine].tobytes())
            if mine.any() and key not in known:
                known[key] = self._padded(self.bodies[self.asset[i]].evaluate(points[mine])[0])
            if mine.any():
                rows[mine] = known[key]
        first_row = sum(body.surface_count for body in self.bodies)
        self.pin_max = int(counts.max(initial=0))
        self.pin_count = wp.array(counts, dtype=int, device=device)
        self.pin_start = wp.array(np.concatenate([[0], np.cumsum(counts)[:-1]]), dtype=int, device=device)
        self.pin_row = wp.array(first_row + np.arange(max(len(owner), 1)), dtype=int, device=device)
        return rows, points

    def _candidates(self) -> np.ndarray:
        """List, per instance, the shapes of its world that collide with particles."""
        model = self.model
        if model.shape_count == 0:
            return np.full((self.instance_count, 1), -1)
        flags, kinds, worlds = model.shape_flags.numpy(), model.shape_type.numpy(), model.shape_world.numpy()
        solid = (flags & int(newton.ShapeFlags.COLLIDE_PARTICLES)) != 0
        supported = [int(kind) for kind in SUPPORTED_SHAPES]
        for shape in np.flatnonzero(solid & ~np.isin(kinds, supported)):
            raise ConfigError(
                f"shape {shape} ({model.shape_label[shape]!r}) is a {newton.GeoType(int(kinds[shape])).name.lower()}, "
                "which a soft body cannot touch",
                hint="use a plane, box, sphere, capsule, cylinder or mesh, or clear its COLLIDE_PARTICLES flag",
            )
        scale = model.shape_scale.numpy()
        meshes = np.isin(kinds, [int(newton.GeoType.MESH), int(newton.GeoType.CONVEX_MESH)])
        uneven = np.ptp(np.abs(scale), axis=1) > 1e-5 * np.abs(scale).max(axis=1)
        for shape in np.flatnonzero(solid & meshes & uneven):
            raise ConfigError(
                f"shape {shape} ({model.shape_label[shape]!r}) is a mesh scaled by {scale[shape]}, whose distances "
                "a soft body cannot query",
                hint="scale the vertices of the mesh instead",
            )
        moving = solid & (model.shape_body.numpy() >= 0) & (worlds == -1)
        if self.world_count > 1 and moving.any():
            raise ConfigError(
                f"shape {np.flatnonzero(moving)[0]} belongs to a body outside all worlds; every world would push it",
                hint="add the body to the builder that is replicated",
            )
        lists = [np.flatnonzero(solid & ((worlds == -1) | (worlds == w))) for w in self.instance_world]
        out = np.full((self.instance_count, max(max(map(len, lists)), 1)), -1)
        for i, shapes in enumerate(lists):
            out[i, : len(shapes)] = shapes
        return out

    def _build_buffers(self) -> None:
        """Allocate everything a step writes."""
        device = self.model.device
        instances, worlds = self.instance_count, self.world_count
        entries = self.options.contact_max + self.pin_max
        self.entry_max = entries

        def zeros(shape: tuple[int, ...], dtype: Any) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        functions = (instances, self.stride)
        self.q_start, self.q_inertial = zeros(functions, wp.vec3d), zeros(functions, wp.vec3d)
        self.q, self.q_trial = zeros(functions, wp.vec3d), zeros(functions, wp.vec3d)
        self.force, self.gradient = zeros(functions, wp.vec3d), zeros(functions, wp.vec3d)
        self.point_energy = zeros((instances, self.point_max), wp.float64)
        self.point_stress = zeros((instances, self.point_max), wp.mat33d)
        self.point_hessian = zeros((instances, 6, self.point_max), wp.mat33)
        unknowns = 3 * self.stride
        self.stiffness = zeros((instances, unknowns, unknowns // LANES), vec8)
        samples = (instances, self.sample_max)
        self.sample_position, self.sample_drift = zeros(samples, wp.vec3d), zeros(samples, wp.vec3)
        self.lower, self.upper = zeros((instances,), wp.vec3), zeros((instances,), wp.vec3)
        self.near = zeros(self.candidate.shape, int)
        slots = (instances, self.sample_max, contact.SLOTS)
        self.slot_shape, self.slot_gap = zeros(slots, int), zeros(slots, wp.float64)
        self.slot_normal = zeros(slots, wp.vec3)
        self.entry_count = zeros((instances,), int)
        self.entry_row, self.entry_shape = zeros((instances, entries), int), zeros((instances, entries), int)
        self.entry_arm = zeros((instances, entries), wp.vec3)
        self.entry_normal, self.entry_offset = (
            zeros((instances, entries), wp.vec3d),
            zeros((instances, entries), wp.vec3d),
        )
        self.entry_stiffness = zeros((instances, entries), wp.float64)
        self.entry_friction = zeros((instances, entries), wp.float64)
        self.entry_normal_force = zeros((instances, entries), wp.float64)
        self.entry_energy = zeros((instances, entries), wp.float64)
        self.entry_force = zeros((instances, entries), wp.vec3d)
        self.entry_hessian = zeros((instances, entries), wp.mat33)
        self.instance_force = zeros((instances,), wp.vec3d)
        self.body_wrench = zeros((max(self.model.body_count, 1),), wp.spatial_vector)
        self.active, self.searching, self.last = (zeros((worlds,), int) for _ in range(3))
        self.renew, self.exact = zeros((worlds,), int), zeros((worlds,), int)
        self.any_active, self.any_searching = zeros((1,), int), zeros((1,), int)
        self.potential, self.potential_trial = zeros((worlds,), wp.float64), zeros((worlds,), wp.float64)
        self.slope, self.step_length = zeros((worlds,), wp.float64), zeros((worlds,), wp.float64)
        self.iteration = zeros((worlds,), int)
        self.status = zeros((worlds,), int)
        """Status bits per world (see ``status``), gathered over steps until cleared with ``status.zero_()``."""

    def attach_rigid(self, rigid: RigidDofs) -> None:
        """Let the joint dofs of ``rigid`` take part in the solve."""
        self.rigid = rigid
        device = self.model.device
        shape = (self.instance_count, self.entry_max, max(rigid.count_max, 1))
        self.entry_jacobian = wp.zeros(shape, dtype=wp.vec3, device=device)
        self.entry_coupling = wp.zeros(shape, dtype=wp.vec3, device=device)
        self.system = BlockCholesky(self.world, 3 * self.stride, rigid.count_max + 1, device)

    def refresh(self) -> None:
        """Read back what the model's parameters decide on the host: masses from densities."""
        volumes = np.array([body.volume for body in self.bodies])[self.asset]
        self.mass.assign(self.parameters.density.numpy() * volumes)

    def notify_model_changed(self, flags: int) -> None:
        """Follow changes of the model; material arrays are read live, masses are recomputed."""
        self.refresh()

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

        ``contacts`` is not read: contacts between soft bodies and shapes are found by the solver itself.
        """
        self.validate_observables(observables, contacts)
        self.begin(state_in, dt)
        self.detect(state_in, control, dt, prescribed=True)
        self.minimise(dt)
        self.finish(state_out, dt)

    def begin(self, state: newton.State, dt: float) -> None:
        """Read the state and predict."""
        data = getattr(state, NAMESPACE)
        self._launch(
            kernels.begin_step,
            (self.instance_count, self.stride),
            [
                self.parameters.function_start,
                self.function_count,
                self.instance_asset,
                self.world,
                self.mass,
                self.row_start,
                self.sample_count,
                self.parameters.particle_start,
                self.mean_basis,
                self.row_basis,
                self.model.gravity,
                data.q,
                data.qd,
                state.particle_f,
                wp.float64(dt),
            ],
            [self.q_start, self.q_inertial, self.q, self.force],
        )

    def detect(self, state: newton.State, control: newton.Control | None, dt: float, *, prescribed: bool) -> None:
        """Find the contacts of the step and write them behind the pins as entries."""
        model, data = self.model, self.parameters
        instances = self.instance_count
        samples = (instances, self.sample_max)
        self._launch(
            contact.place_samples,
            samples,
            [
                self.function_count,
                self.row_start,
                self.sample_count,
                self.row_point,
                self.row_basis,
                self.q_start,
                self.q_inertial,
            ],
            [self.sample_position, self.sample_drift],
        )
        if self.pin_max:
            targets = getattr(control if control is not None else model, NAMESPACE).pin_target
            self._launch(
                contact.gather_pins,
                (instances, self.pin_max),
                [
                    self.function_count,
                    self.pin_count,
                    self.pin_start,
                    self.pin_row,
                    data.pin_stiffness,
                    targets,
                    self.row_point,
                    self.row_basis,
                    self.q_start,
                ],
                [self.entry_row, self.entry_shape, self.entry_offset, self.entry_stiffness],
            )
        if model.shape_count == 0:
            wp.copy(self.entry_count, self.pin_count)
            return
        bounds = (model.shape_collision_aabb_lower, model.shape_collision_aabb_upper)
        self._launch(
            contact.bound_samples,
            instances,
            [self.sample_count, self.sample_position, self.sample_drift, self.margin],
            [self.lower, self.upper],
        )
        self._launch(
            contact.cull_shapes,
            self.candidate.shape,
            [
                self.candidate,
                model.shape_type,
                model.shape_body,
                model.shape_transform,
                *bounds,
                model.shape_margin,
                state.body_q,
                state.body_qd,
                model.body_com,
                self.lower,
                self.upper,
                float(dt),
            ],
            [self.near],
        )
        self._launch(
            contact.find_contacts,
            samples,
            [
                self.sample_count,
                self.margin,
                self.candidate,
                self.near,
                model.shape_type,
                model.shape_scale,
                model.shape_source_ptr,
                model.shape_margin,
                *bounds,
                model.shape_body,
                model.shape_transform,
                state.body_q,
                state.body_qd,
                model.body_com,
                self.sample_position,
                self.sample_drift,
                float(dt),
            ],
            [self.slot_shape, self.slot_gap, self.slot_normal],
        )
        self._launch(
            contact.gather_entries,
            instances,
            [
                self.world,
                self.row_start,
                self.sample_count,
                data.contact_stiffness,
                data.friction,
                self.pin_count,
                self.entry_max,
                self.row_area,
                model.shape_body,
                model.shape_material_mu,
                state.body_q,
                state.body_qd,
                model.body_com,
                int(prescribed),
                self.sample_position,
                self.slot_shape,
                self.slot_gap,
                self.slot_normal,
                float(dt),
                status.WORLD_CONTACT_OVERFLOW,
            ],
            [
                self.entry_count,
                self.entry_row,
                self.entry_shape,
                self.entry_arm,
                self.entry_normal,
                self.entry_offset,
                self.entry_stiffness,
                self.entry_friction,
                self.status,
            ],
        )
        rigid = self.rigid
        if rigid.count_max:
            self._launch(
                contact.entry_jacobians,
                (instances, self.entry_max, rigid.count_max),
                [
                    self.world,
                    self.entry_count,
                    rigid.count,
                    rigid.dof_start,
                    model.shape_body,
                    rigid.body_articulation,
                    rigid.body_link,
                    rigid.articulation_dof_start,
                    rigid.articulation_dof_count,
                    rigid.jacobian,
                    self.entry_shape,
                    self.entry_arm,
                ],
                [self.entry_jacobian],
            )

    def minimise(self, dt: float) -> None:
        """Minimise the incremental potential of every world by Newton with a line search."""
        self.active.fill_(1)
        self.renew.fill_(1)
        self.exact.zero_()
        self.iteration.zero_()
        self.any_active.fill_(1)
        wp.capture_while(self.any_active, self._newton_iteration, dt=dt)

    def _newton_iteration(self, dt: float) -> None:
        """Take one Newton step in every world that is not done."""
        self._evaluate(self.active, self.q, self.rigid.r, dt, derivatives=True)
        self._gather_gradient(dt)
        self._check_convergence(dt)
        self._sum_potential(self.active, self.q, self.rigid.r, dt, self.potential)
        self._assemble(dt)
        self._solve()
        self._begin_search(dt)
        wp.capture_while(self.any_searching, self._try_step, dt=dt)
        self._finish_iteration()

    def _evaluate(self, selected: wp.array, q: wp.array, r: wp.array, dt: float, *, derivatives: bool) -> None:
        """Evaluate elastic points and point constraints at q, r in the selected worlds."""
        data = self.parameters
        self._launch(
            kernels.evaluate_points,
            (self.instance_count, self.point_max),
            [
                self.world,
                self.function_count,
                self.point_start,
                self.point_count,
                data.material_model,
                data.youngs_modulus,
                data.poissons_ratio,
                data.viscosity,
                self.grad_basis,
                self.point_weight,
                self.stiffness_scale,
                selected,
                self.q_start,
                q,
                wp.float64(dt),
                int(derivatives),
                self.renew,
            ],
            [self.point_energy, self.point_stress, self.point_hessian],
        )
        self._launch(
            contact.evaluate_entries,
            (self.instance_count, self.entry_max),
            [
                self.world,
                self.function_count,
                self.pin_count,
                self.smoothing,
                wp.float64(self.options.stick_velocity * dt),
                self.row_basis,
                selected,
                self.q_start,
                q,
                r,
                self.rigid.count,
                self.entry_count,
                self.entry_row,
                self.entry_normal,
                self.entry_offset,
                self.entry_stiffness,
                self.entry_friction,
                self.entry_jacobian,
                int(derivatives),
                self.iteration,
                self.exact,
            ],
            [self.entry_normal_force, self.entry_energy, self.entry_force, self.entry_hessian, self.entry_coupling],
        )

    def _sum_potential(self, selected: wp.array, q: wp.array, r: wp.array, dt: float, out: wp.array) -> None:
        """Sum the potential of the selected worlds."""
        self._launch(
            search.sum_potential,
            self.world_count,
            [
                self.function_count,
                self.point_count,
                self.mass,
                self.parameters.mass_damping,
                self.world_instances,
                self.rigid.count,
                selected,
                self.q_start,
                self.q_inertial,
                q,
                self.force,
                self.point_energy,
                self.entry_count,
                self.entry_energy,
                self.rigid.inertia,
                self.rigid.predicted,
                r,
                wp.float64(dt),
            ],
            [out],
        )

    def _gather_gradient(self, dt: float) -> None:
        """Gather the gradient of the potential with respect to q."""
        self._launch(
            kernels.gather_gradient,
            (self.instance_count, self.stride),
            [
                self.world,
                self.function_count,
                self.point_start,
                self.point_count,
                self.mass,
                self.parameters.mass_damping,
                self.grad_basis,
                self.row_basis,
                self.active,
                self.q_start,
                self.q_inertial,
                self.q,
                self.force,
                self.point_stress,
                self.entry_count,
                self.entry_row,
                self.entry_force,
                wp.float64(dt),
            ],
            [self.gradient],
        )

    def _check_convergence(self, dt: float) -> None:
        """Stop the worlds that have converged or used up their iterations."""
        options = self.options
        self._launch(
            search.check_convergence,
            self.world_count,
            [
                self.function_count,
                self.mass,
                self.tolerance,
                self.world_instances,
                options.iteration_max,
                wp.float64(options.force_tolerance),
                wp.float64(dt),
                self.gradient,
                self.force,
                self.pin_count,
                self.entry_count,
                self.entry_force,
                self.last,
                self.iteration,
            ],
            [self.active, self.status],
        )

    def _assemble(self, dt: float) -> None:
        """Assemble the Hessian into the block systems [K | C | -g] and the rigid part."""
        instances, blocks = self.instance_count, self.stride // LANES
        self._launch(
            assembly.assemble_stiffness,
            (instances, 6, blocks, blocks),
            [
                self.world,
                self.function_count,
                self.point_start,
                self.point_count,
                self.mass,
                self.parameters.mass_damping,
                self.grad_basis8,
                self.active,
                self.renew,
                self.point_hessian,
                float(dt),
            ],
            [self.stiffness],
        )
        self._launch(
            assembly.assemble_matrix,
            (instances, 6, blocks, blocks),
            [
                self.world,
                self.stride,
                self.row_basis8,
                self.active,
                self.stiffness,
                self.entry_count,
                self.entry_row,
                self.entry_hessian,
            ],
            [self.system.matrix],
        )
        self._launch(
            assembly.assemble_columns,
            (instances, 3 * self.stride, self.system.column_block_count),
            [
                self.world,
                self.function_count,
                self.stride,
                self.row_basis,
                self.active,
                self.gradient,
                self.entry_count,
                self.entry_row,
                self.entry_coupling,
                self.rigid.count_max,
            ],
            [self.system.matrix],
        )
        rigid = self.rigid
        if rigid.count_max:
            self._launch(
                assembly.assemble_rigid,
                (self.world_count, rigid.count_max),
                [
                    self.world_instances,
                    rigid.count,
                    self.active,
                    rigid.inertia,
                    rigid.predicted,
                    rigid.r,
                    self.entry_count,
                    self.entry_force,
                    self.entry_jacobian,
                    self.entry_coupling,
                ],
                [rigid.gradient, rigid.matrix],
            )

    def _solve(self) -> None:
        """Factor every body, condense onto the rigid dofs, solve those, substitute back."""
        rigid, system = self.rigid, self.system
        system.factor(self.active)
        if rigid.count_max:
            self._launch(
                assembly.condense,
                (self.world_count, rigid.count_max),
                [
                    self.world_instances,
                    rigid.count,
                    rigid.count_max,
                    self.active,
                    rigid.gradient,
                    system.matrix,
                    system.size,
                    rigid.matrix,
                ],
                [rigid.direction],
            )
            self._launch(
                assembly.solve_rigid, self.world_count, [rigid.count, self.active, rigid.matrix, rigid.direction]
            )
        self.direction = system.solve(self.active, rigid.count_max, rigid.direction, rigid.count_max)

    def _begin_search(self, dt: float) -> None:
        """Start the line search of every active world."""
        self.any_searching.zero_()
        self._launch(
            search.begin_search,
            self.world_count,
            [
                self.function_count,
                self.stride,
                self.tolerance,
                self.world_instances,
                self.rigid.count,
                self.rigid_tolerance,
                wp.float64(self.options.stick_velocity * dt),
                self.active,
                self.pin_count,
                self.entry_count,
                self.gradient,
                self.direction,
                self.rigid.gradient,
                self.rigid.direction,
            ],
            [self.slope, self.step_length, self.last, self.searching, self.any_searching],
        )

    def _try_step(self, dt: float) -> None:
        """Evaluate one trial step in every searching world and accept or halve it."""
        rigid = self.rigid
        self._launch(
            search.trial_functions,
            (self.instance_count, self.stride),
            [self.world, self.function_count, self.stride, self.searching, self.step_length, self.q, self.direction],
            [self.q_trial],
        )
        if rigid.count_max:
            self._launch(
                search.trial_rigid,
                (self.world_count, rigid.count_max),
                [rigid.count, self.searching, self.step_length, rigid.r, rigid.direction],
                [rigid.trial],
            )
        self._evaluate(self.searching, self.q_trial, rigid.trial, dt, derivatives=False)
        self._sum_potential(self.searching, self.q_trial, rigid.trial, dt, self.potential_trial)
        self.any_searching.zero_()
        self._launch(
            search.judge_trial,
            self.world_count,
            [self.potential, self.potential_trial, self.slope, wp.float64(self.options.step_length_min)],
            [self.step_length, self.searching, self.any_searching],
        )

    def _finish_iteration(self) -> None:
        """Take the accepted steps."""
        options = self.options
        self.any_active.zero_()
        self._launch(
            search.finish_iteration,
            self.world_count,
            [
                self.function_count,
                self.stride,
                self.world_instances,
                self.rigid.count,
                options.stiffness_renewal,
                wp.float64(options.renewal_distance / options.tolerance),
                self.tolerance,
                self.step_length,
                self.direction,
                self.rigid.direction,
                self.last,
            ],
            [self.active, self.q, self.rigid.r, self.iteration, self.renew, self.exact, self.status, self.any_active],
        )

    def finish(self, state: newton.State, dt: float) -> None:
        """Write coordinates, velocities and particles, and sum the contact reactions."""
        data, instances = self.parameters, self.instance_count
        self._launch(
            kernels.check_finite,
            self.world_count,
            [self.function_count, self.world_instances, self.rigid.count, self.q, self.rigid.r],
            [self.status],
        )
        out = getattr(state, NAMESPACE)
        self._launch(
            kernels.end_step,
            (instances, self.stride),
            [data.function_start, self.function_count, self.world, self.status, self.q_start, self.q, wp.float64(dt)],
            [out.q, out.qd],
        )
        self.body_wrench.zero_()
        self._launch(
            contact.sum_reactions,
            self.world_count,
            [
                self.world_instances,
                self.model.shape_body,
                self.pin_count,
                self.entry_count,
                self.entry_shape,
                self.entry_arm,
                self.entry_force,
            ],
            [self.body_wrench, self.instance_force],
        )
        self.update_particles(state)

    def update_particles(self, state: newton.State) -> None:
        """Move the surface particles of ``state`` to where its reduced coordinates put them."""
        data, out = self.parameters, getattr(state, NAMESPACE)
        self._launch(
            kernels.skin_samples,
            (self.instance_count, self.sample_max),
            [
                data.function_start,
                self.function_count,
                self.row_start,
                self.sample_count,
                data.particle_start,
                self.row_point,
                self.row_basis,
                out.q,
                out.qd,
            ],
            [state.particle_q, state.particle_qd],
        )

    def reset(self, state: newton.State, world_mask: wp.array | None = None, flags: Any = None) -> None:
        """Put the bodies of the chosen worlds back to the model's initial state and clear what those worlds report.

        Args:
            state: State to reset in place.
            world_mask: Boolean mask of shape (world_count + 1,), the last entry for entities outside worlds; or None
                for all.
            flags: Accepted for the contract; reduced coordinates are always reset.
        """
        if world_mask is None:
            world_mask = wp.full(self.world_count + 1, True, dtype=bool, device=self.model.device)
        initial, out = self.parameters, getattr(state, NAMESPACE)
        self._launch(
            kernels.reset_functions,
            (self.instance_count, self.stride),
            [initial.function_start, self.function_count, self.world, world_mask, initial.q, initial.qd],
            [out.q, out.qd],
        )
        self._launch(
            kernels.reset_worlds,
            max(self.world_count, self.instance_count, self.model.body_count),
            [self.world, self.model.body_world, world_mask],
            [self.status, self.instance_force, self.body_wrench],
        )
        self.update_particles(state)

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any], outputs: Sequence[Any] = ()) -> None:
        """Launch on the model's device."""
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=list(outputs), device=self.model.device)
