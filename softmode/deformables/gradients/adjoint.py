"""Gradients of a trajectory: the adjoint of the reduced step by the implicit function theorem.

A step is the root of r(q_t; q_(t-1), v_(t-1), theta) = 0, the gradient of the incremental potential of ``kernels``.
With H_t = dr/dq_t at the converged q_t, as it is and not projected, a loss L of the trajectory has

    H_t^T lambda_t = dL/dq_t,        t = T .. 1,   dL/dq_t total: what later steps pass back is in it,
    dL/dtheta     -= lambda_t^T dr/dtheta,
    dL/dq_(t-1)   -= (dr/dq_(t-1))^T lambda_t,     dL/dv_(t-1) likewise.

No Newton iteration is taped: a step leaves q, v, the generalised force and its point constraints. The products with H_t
are matrix-free in float64; GMRES (Saad and Schultz 1986, doi:10.1137/0907058) solves them, preconditioned by the
solver's own float32 Cholesky factor at q_t. Both integrators are covered, and driven functions.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_fields, require_number
from softmode.deformables.contact.detection_kernels import place_samples
from softmode.deformables.gradients import adjoint_kernels as kernels
from softmode.deformables.gradients import cell_adjoint_kernels as cell_kernels
from softmode.deformables.gradients import spin_adjoint_kernels as spin_kernels
from softmode.deformables.gradients.krylov import Gmres
from softmode.deformables.gradients.turning_kernels import find_turning
from softmode.deformables.model.declare import WRENCH
from softmode.deformables.model.lane_kernels import vec8d
from softmode.deformables.model.namespaces import soft
from softmode.deformables.model.newton_step_kernels import NewtonStep
from softmode.deformables.model.status import WORLD_NOT_FINITE
from softmode.deformables.model.struct_kernels import OVERLAP, PointConstraints, Points
from softmode.deformables.model.tables import allocate
from softmode.deformables.potential.evaluate_kernels import sum_forces
from softmode.deformables.potential.spin_kernels import end_spin
from softmode.deformables.solver.detect import adapt
from softmode.deformables.solver.evaluate import assemble, evaluate, gather_gradient
from softmode.deformables.solver.solver_reduced import SolverReduced
from softmode.errors import ConfigError, SolverDiverged

Array = NDArray[np.float64]

_CONSTRAINT = ("row", "partner_row", "shape", "normal", "offset", "stiffness", "dent_compliance", "dent_depth", "onset")
_CONSTRAINT += ("lead", "ridge", "ridge_lead", "friction", "stick", "stick_deep")
"""What a step's point constraints are made of, besides their count: members of the solver's ``PointConstraints``."""
FLAT = 0.02
"""Turn of a normal [rad] over the size of a body up to which a shape counts as flat: what float32 leaves of a plane."""
_TOTALS = ("youngs_modulus", "poissons_ratio", "viscosity", "friction", "density", "mass_damping", "gravity", "scale")


@dataclass(frozen=True, kw_only=True)
class AdjointOptions:
    """How the linear systems are solved and which steps are trusted."""

    tolerance: float = 1.0e-12
    """GMRES stops at this residual relative to the right-hand side."""
    cycle_length: int = 40
    """Krylov vectors kept before a restart."""
    cycle_max: int = 5
    """Restarts at most."""
    residual_warning: float = 1.0e-4
    """|r| / |f| of a step above which a warning is given: away from the root the theorem does not hold."""
    residual_max: float = 1.0e-2
    """|r| / |f| of a step above which it is refused."""

    fixed_normals: bool = False
    """Whether contacts with curved shapes, across edges and with what a fast sample flies past keep their normals, as
    far as gradients know. They are then wrong, to the sign; without friction by more than their size."""

    def __post_init__(self) -> None:
        """Check every range."""
        require_fields(self, ("cycle_length", "cycle_max"), at_least=1)
        require_number("tolerance", self.tolerance, above=0.0)
        for name in ("residual_warning", "residual_max"):  # infinite ones are never reached
            require_number(name, min(getattr(self, name), 1.0), above=0.0)


@dataclass(frozen=True, kw_only=True)
class ReducedGradients:
    """Derivatives of the loss, on the solver's device; T steps, I instances, N functions of all instances."""

    q: wp.array
    """By the initial coordinates, vec3d (N,)."""
    qd: wp.array
    """By the initial velocities, vec3d (N,)."""
    force: wp.array
    """By the generalised force of each step (lambda_t), vec3d (T, N); see ``Markers.interpolate`` for point forces."""
    q_driven: wp.array
    """By where the driven functions are put in each step, vec3d (T, N); zero for the others."""
    pin_target: wp.array
    """By the pin targets of each step, vec3d (T, pin_count)."""
    pin_stiffness: wp.array
    """By the stiffness of each pin, (pin_count,)."""
    youngs_modulus: wp.array
    """By E of each instance, (I,)."""
    log_modulus: wp.array
    """By ln E at each cubature point, (I, point_max): the gradient by a field of moduli."""
    poissons_ratio: wp.array
    """By nu, (I,)."""
    density: wp.array
    """By rho, (I,): inertia, weight and mass damping."""
    viscosity: wp.array
    """By tau, (I,)."""
    mass_damping: wp.array
    """By alpha, (I,)."""
    friction: wp.array
    """By the body's friction coefficient, (I,)."""
    gravity: wp.array
    """By the gravity that each instance feels, vec3d (I,)."""
    scale: wp.array
    """By the size of the rest shape over that of the asset, (I,), at the same initial state. ``reset`` gives a body of
    another size another initial state, linear in its scale: add the sum of ``q`` times its derivative."""
    grad_residual: wp.array
    """|r| / |f| of each step and instance, (T, I): how far from its root the solver stopped."""

    def numpy(self) -> dict[str, Array]:
        """Return copies on the host."""
        return {f.name: getattr(self, f.name).numpy() for f in fields(self)}


class AdjointReduced:
    """Records the steps of a solver and differentiates a loss of them.

    ``start(state)``, then ``step`` (or ``solver.step`` and ``record``) up to ``step_max`` times, then ``backward``.

    Differentiated: elasticity, viscosity, inertia and mass damping, gravity, external forces, pins and driven functions
    (exactly); contact with flat faces: its stiffness, which follows E, nu, mass and size, its friction with the normal
    force, what friction remembers, and what the cells of its samples and what touches around them take from the start
    of the step. Not differentiated: the turning of contact normals with the point of contact
    (refused unless ``fixed_normals`` is set), contacts appearing or vanishing at the end of their detection range
    (where they carry no force), the motion of rigid shapes, and what BDF2 remembers from before the record. Parameters
    must not change between recording and ``backward``.

    Args:
        solver: The solver; rigid dofs must not take part in its solve.
        step_max: Steps that can be recorded. A step keeps four vec3d per function, and 112 bytes per pin and, with
            shapes in the model, per contact slot; ``backward`` takes as much again.
        options: Tolerances.

    Raises:
        ConfigError: If rigid joints are unknowns of the solver, soft bodies may touch each other, a pin follows a rigid
            body, or ``friction_lag`` is 0 where there are shapes.
    """

    def __init__(self, solver: SolverReduced, step_max: int, *, options: AdjointOptions | None = None) -> None:
        """Allocate the record and the work space."""
        t = self.tables = solver.tables
        if t.rigid.count_max:
            raise ConfigError(
                "the step solves for joint dofs, whose solver has no derivative",
                hint="use SolverReduced with prescribed rigid bodies",
            )
        if t.pairs is not None:
            raise ConfigError(
                "contact between soft bodies has no derivative",
                hint="use SolverReducedOptions(soft_contact=False), or one body per world",
            )
        if t.instances.link_pin_count.numpy().any():
            raise ConfigError("pins that follow a rigid body have no derivative", hint="pin to the world (link=-1)")
        if solver.model.shape_count and solver.options.friction_lag == 0:
            raise ConfigError(
                "friction_lag=0: the normal force of friction never follows the contact",
                hint="use SolverReducedOptions(friction_lag=...) as large as iteration_max",
            )
        self.solver, self.options, self.step_max = solver, options or AdjointOptions(), step_max
        self.device, layout = solver.model.device, t.layout
        self.instances, self.total = layout.instance_count, int(solver.parameters.q.shape[0])
        self.pin_total = int(solver.parameters.pin_target.shape[0]) if layout.pin_max else 0
        self.constraint_max = solver.view.constraint_max if solver.model.shape_count else layout.pin_max
        self.generation = 0
        """Number of records begun."""
        self.dt: list[float] = []

        # row 0 of the states is the one before the record, which BDF2 remembers; row t + 1 is time t
        states, constraints = (step_max + 2, self.total), (self.instances, max(self.constraint_max, 1))
        self._q, self._qd = self._zeros(states, wp.vec3d), self._zeros(states, wp.vec3d)
        self._dt_before = self._zeros((step_max + 1, self.instances), wp.float64)
        self._force, self._costate = (self._zeros((step_max, *t.unknowns), vec8d) for _ in range(2))
        self._iteration = self._zeros((step_max, layout.world_count), int)
        bodies = (step_max, max(solver.model.body_count, 1))
        self._pose, self._twist = self._zeros(bodies, wp.transform), self._zeros(bodies, WRENCH)
        self._turning = self._zeros((step_max, self.instances), wp.float32)
        self._constraint_count = self._zeros((step_max, self.instances), int)
        kinds = {name: getattr(t.constraints, name).dtype for name in _CONSTRAINT}
        self._constraint = {name: self._zeros((step_max, *constraints), kind) for name, kind in kinds.items()}

        samples, touched = (step_max, *t.samples.shape.shape), self.solver.model.shape_count > 0
        kinds = {"shape": int, "gap": wp.float64, "normal": wp.vec3, "part": wp.float32} if touched else {}
        self._sample = {name: self._zeros(samples, kind) for name, kind in kinds.items()}

        self._sizes = {
            "instance": self.instances,
            "point": layout.point_max,
            "sample": layout.sample_max,
            "constraint": self.constraint_max,
            "pin": self.pin_total,
            "unknown": 3 * layout.block_count,
        }
        of_constraints = (
            "constraint_slip constraint_normal constraint_gain constraint_hessian constraint memory memory_start "
            "contact_bar normal_bar cell_gradient cell_place cell_spared cell_fade edge_gradient edge_place "
            "part_bar middle_bar"
        )
        axes = {"": "instance point", of_constraints: "instance constraint", "sample_place": "instance sample"}
        self._step = allocate(kernels.Linearised, axes, self._sizes, self.device)
        points, constraints = Points(), PointConstraints()
        points.stress, constraints.force = self._step.point, self._step.constraint
        constraints.row, constraints.acting_count = t.constraints.row, t.constraints.count  # all of them act
        every = np.tile(np.arange(t.constraints.row.shape[1], dtype=np.int32), (self.instances, 1))
        constraints.acting = wp.array(every, dtype=int, device=self.device)
        given = {"instances": t.instances, "basis": t.basis, "arrays": t.arrays}
        given |= {"points": points, "constraints": constraints}
        self._sums = allocate(NewtonStep, "", {}, self.device, given=given)
        self._spin = allocate(spin_kernels.SpinLoss, "instance", self._sizes, self.device)
        self._gmres = Gmres(solver, cycle_length=self.options.cycle_length, cycle_max=self.options.cycle_max)
        self._driven = self._zeros(t.unknowns, vec8d)
        self._state = solver.model.state()
        self._resolution = wp.array(
            1.0e-9 * layout.size * t.instances.scale.numpy(), dtype=wp.float64, device=self.device
        )

    @property
    def step_count(self) -> int:
        """Number of recorded steps T."""
        return len(self.dt)

    @property
    def q(self) -> Any:
        """Recorded coordinates [m], vec3d (T + 1, N)."""
        return self._q[1 : self.step_count + 2]

    @property
    def qd(self) -> Any:
        """Recorded velocities [m/s], vec3d (T + 1, N)."""
        return self._qd[1 : self.step_count + 2]

    # -- forward ------------------------------------------------------------------------------------------------------

    def start(self, state: newton.State) -> None:
        """Forget the record and begin a new one at ``state``."""
        self.dt = []
        self.generation += 1
        data = soft(state)
        wp.copy(self._q[0], data.q_before)
        wp.copy(self._qd[0], data.qd_before)
        self._copy_state(state, 0)

    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        dt: float,
        *,
        force: wp.array | None = None,
    ) -> None:
        """Advance by ``dt`` [s] as the solver does, with an extra generalised force [N], vec3d (N,), and record it."""
        solver = self.solver
        solver.begin(state_in, control, dt)
        if force is not None:
            t = self.tables
            t.launch(kernels.add_force, self._blocks, t.instances, force.reshape((1, -1)), t.motion)
        solver.detect(state_in, control, dt, prescribed=True)
        solver.minimise(dt)
        solver.finish(state_out, dt)
        self.record(state_out, dt)

    def record(self, state: newton.State, dt: float) -> None:
        """Record the step of ``dt`` [s] that ``solver`` has just taken to ``state``.

        Raises:
            ConfigError: If ``step_max`` steps are recorded already.
        """
        t = self.step_count
        if t == self.step_max:
            raise ConfigError(f"{t} steps are recorded, the most there is room for", hint="raise step_max")
        self._copy_state(state, t + 1)
        wp.copy(self._force[t], self.tables.motion.force)
        wp.copy(self._iteration[t], self.tables.newton.iteration)
        if self.solver.model.body_count:
            wp.copy(self._pose[t], self.tables.shapes.body_q)
            wp.copy(self._twist[t], self.tables.shapes.body_qd)
        for stored, values in self._constraints(t):
            wp.copy(stored, values)
        if self.solver.model.shape_count:
            self._turning[t].zero_()
            found = (self.tables.instances, self.tables.samples, self.tables.shapes, self.tables.constraints)
            self.tables.launch(find_turning, self._dims[1], *found, self._turning[t])
        self.dt.append(float(dt))

    def _copy_state(self, state: newton.State, t: int) -> None:
        """Keep the state of time t."""
        data = soft(state)
        wp.copy(self._q[t + 1], data.q)
        wp.copy(self._qd[t + 1], data.qd)
        wp.copy(self._dt_before[t], data.dt_before)

    def _constraints(self, t: int) -> list[tuple[Any, Any]]:
        """Return pairs of what is stored of the point constraints of step t and where the solver has it."""
        constraints, width = self.tables.constraints, self.constraint_max
        pairs = [(self._constraint_count[t], constraints.count)]
        if self.solver.model.shape_count:
            pairs += [(stored[t], getattr(self.tables.samples, name)) for name, stored in self._sample.items()]
        if width:
            pairs += [(stored[t], getattr(constraints, name)[:, :width]) for name, stored in self._constraint.items()]
        return pairs

    # -- backward -----------------------------------------------------------------------------------------------------

    def backward(
        self, *, loss_q: wp.array | ArrayLike | None = None, loss_qd: wp.array | ArrayLike | None = None
    ) -> ReducedGradients:
        """Differentiate a loss of the recorded steps.

        Args:
            loss_q: dL/dq_t at fixed q_s and v_s elsewhere, t = 0 .. T, shape (T + 1, N, 3), an array of NumPy or Warp
                (vec3d); None for zero.
            loss_qd: dL/dv_t, likewise; that v_t depends on q_t is accounted for.

        Returns:
            The gradients; arrays are new with each call.

        Raises:
            ConfigError: If nothing is recorded, a shape does not fit, or the normal of a contact turns as its point
                moves and ``fixed_normals`` is not set.
            SolverDiverged: If a step is further from its root than ``residual_max``, its linear system is singular, or
                it starts with a contact so deep that a bound decides how far it is pushed out.

        Warns:
            RuntimeWarning: If a step is further from its root than ``residual_warning``.
        """
        steps, t = self.step_count, self.tables
        if steps == 0:
            raise ConfigError("no step is recorded", hint="call start and step first")
        self._check_normals()
        q_bar, qd_bar = self._cotangent("loss_q", loss_q), self._cotangent("loss_qd", loss_qd)
        axes = {
            "": "instance unknown",
            "log_modulus poissons_ratio viscosity point_scale": "instance point",
            "friction contact": "instance constraint",
            "pin_stiffness": "pin",
        }
        sums = allocate(kernels.Sums, axes, self._sizes, self.device)
        totals = allocate(kernels.Totals, "instance", self._sizes, self.device)
        pin_target = self._zeros((steps, max(self.pin_total, 1)), wp.vec3d)
        residual, error, overlap = (self._zeros((steps, self.instances), wp.float64) for _ in range(3))
        bodies, (points, constraints) = (t.instances, t.basis), self._dims

        for k in reversed(range(steps)):
            costate, dt = self._costate[k], wp.float64(self.dt[k])
            self._restore(k)
            self._measure(k, residual[k], overlap[k])
            t.launch(kernels.add_velocity, t.unknowns, t.motion, qd_bar[k + 2], dt, q_bar[k + 2])
            velocity = (t.motion, t.spin, t.arrays.q, qd_bar[k + 2], q_bar[k + 2], self._spin)
            t.launch(spin_kernels.pull_velocity, self.instances, *bodies, *velocity)
            if self.solver.model.shape_count and k + 1 < steps:
                self._pull_memory(k, q_bar[k + 2])
            self._solve(k, q_bar[k + 2], costate)
            wp.copy(error[k], self._gmres.error)
            t.launch(kernels.accumulate_points, points, *bodies, costate, dt, sums, self._step)
            if self.constraint_max:
                contacts = (t.shapes, t.constraints, t.surface, costate, self.dt[k])
                found = (sums, pin_target[k], self._step)
                t.launch(kernels.accumulate_constraints, constraints, *bodies, *contacts, *found)
            self._sum_points(t.newton.active)
            given = (t.motion, t.arrays, t.model.gravity, costate, self._driven, t.spin, dt, k)
            t.launch(kernels.propagate, t.unknowns, *bodies, *given, q_bar, qd_bar, sums)
            start = (t.motion, self._spin, t.spin, t.arrays.q, costate, dt, k)
            t.launch(spin_kernels.propagate_spin, self.instances, *bodies, *start, q_bar, qd_bar)
            if self.solver.model.shape_count:
                self._pull_cells(k, costate, sums, q_bar[k + 1], qd_bar[k + 1])

        self._check(residual.numpy(), error.numpy(), overlap.numpy())
        density = self.solver.parameters.density
        t.launch(kernels.sum_gradients, self.instances, t.instances, density, sums, totals)
        return ReducedGradients(
            q=self._unpack(q_bar[1:2])[0],
            qd=self._unpack(qd_bar[1:2])[0],
            force=self._unpack(self._costate[:steps]),
            q_driven=self._unpack(q_bar[2:]),
            pin_target=pin_target[:, : self.pin_total],
            pin_stiffness=sums.pin_stiffness[: self.pin_total],
            log_modulus=sums.log_modulus,
            grad_residual=residual,
            **{name: getattr(totals, name) for name in _TOTALS},
        )

    def _check_normals(self) -> None:
        """Refuse contacts whose normals turn, unless an option takes them for fixed."""
        turning = self._turning[: self.step_count].numpy()
        if self.options.fixed_normals or not turning.max() > FLAT:
            return
        t, i = np.unravel_index((turning > FLAT).argmax(), turning.shape)
        raise ConfigError(
            f"step {t}: instance {i} presses on a curved shape, on an edge or on what a fast sample flies past, and the"
            " turning of the contact's normal has no derivative",
            hint="touch planes and flat faces, for fast samples with a larger contact_margin or shorter steps; or pass"
            " AdjointOptions(fixed_normals=True), whose gradients may have the wrong sign",
        )

    def _cotangent(self, name: str, values: wp.array | ArrayLike | None) -> Any:
        """Return dL/dq or dL/dv in blocks, with a row of zeros for the state before the record."""
        shape = (self.step_count + 1, self.total)
        out = self._zeros((self.step_count + 2, *self.tables.unknowns), vec8d)
        if values is None:
            return out
        if not isinstance(values, wp.array):
            host = np.asarray(values, dtype=np.float64)
            if host.shape != (*shape, 3) or not np.isfinite(host).all():
                raise ConfigError(f"{name}: expected finite numbers of shape {(*shape, 3)}, got shape {host.shape}")
            values = wp.array(host, dtype=wp.vec3d, device=self.device)
        if values.shape != shape or values.dtype != wp.vec3d:
            raise ConfigError(f"{name}: expected vec3d {shape}, got {values.dtype} {values.shape}")
        self.tables.launch(kernels.pack, (shape[0], *self._blocks), self.tables.instances, values, out[1:])
        return out

    def _unpack(self, blocks: Any) -> Any:
        """Return blocks (T, ...) as vec3d (T, N)."""
        out = self._zeros((blocks.shape[0], self.total), wp.vec3d)
        dim = (blocks.shape[0], self.instances, self.tables.layout.stride)
        self.tables.launch(kernels.unpack, dim, self.tables.instances, blocks, out)
        return out

    def _restore(self, k: int) -> None:
        """Put recorded step k back into the solver, evaluate it at its root and factor the solver's matrix there."""
        t, dt = self.tables, self.dt[k]
        data = soft(self._state)
        for name, rows in (("q", self._q), ("qd", self._qd)):
            wp.copy(getattr(data, name), rows[k + 1])
            wp.copy(getattr(data, f"{name}_before"), rows[k])
        wp.copy(data.dt_before, self._dt_before[k])
        self.solver.begin(self._state, None, dt)
        wp.copy(t.motion.force, self._force[k])
        end = t.arrays.q.reshape((1, *t.unknowns))
        t.launch(kernels.pack, (1, *self._blocks), t.instances, self._q[k + 2 : k + 3], end)
        for stored, values in self._constraints(k):
            wp.copy(values, stored)
        t.shapes.body_q, t.shapes.body_qd = self._pose[k], self._twist[k]
        if self.solver.model.shape_count:
            t.launch(place_samples, t.samples.position.shape, t.instances, t.basis, t.motion, t.samples)
            t.launch(cell_kernels.restore_rows, self._dims[1], *self._cells, t.constraints, dt)
        adapt(t, dt)
        t.launch_teams(end_spin, self.instances, t.newton_step(dt), t.team, t.spin)
        progress = t.newton
        for flag in (progress.active, progress.refresh, progress.exact):
            flag.fill_(1)
        progress.project.zero_()
        progress.iteration.fill_(1)  # at 0 the normal force of friction is bounded
        evaluate(t, dt, derivatives=True)
        gather_gradient(t, dt)
        assemble(t, dt)
        t.system.factor(progress.active)

    def _measure(self, k: int, residual: wp.array, overlap: wp.array) -> None:
        """Measure the residual of the restored step and linearise it."""
        t, dt, (points, constraints) = self.tables, self.dt[k], self._dims
        step = (t.motion, t.constraints, self._resolution, t.arrays, wp.float64(dt))
        t.launch(kernels.measure_residual, self.instances, t.instances, *step, residual, overlap)
        bodies = (t.instances, t.basis, t.motion)
        t.launch(kernels.place_points, points, *bodies, t.arrays.q, self._step)
        if self.constraint_max:
            stick_range = wp.float64(self.solver.options.stick_velocity * dt)
            t.launch(
                kernels.place_constraints, constraints, *bodies, t.constraints, stick_range, t.arrays.q, self._step
            )

    def _pull_memory(self, k: int, q_bar: wp.array) -> None:
        """Add what the step after k feels of where its contacts stick to dL/dq_t."""
        t, constraints = self.tables, self._dims[1]
        after = (self._constraint_count[k + 1], *(self._constraint[name][k + 1] for name in ("partner_row", "shape")))
        t.launch(kernels.pull_memory, constraints, t.instances, t.shapes, t.constraints, *after, self._step)
        t.launch(kernels.add_memory, t.unknowns, t.instances, t.basis, t.constraints, self._step, q_bar)

    def _pull_cells(self, k: int, costate: wp.array, sums: Any, q_bar: wp.array, qd_bar: wp.array) -> None:
        """Add what the cells of step k's contacts, and what touches around them, feel of its start."""
        t, dt, constraints = self.tables, self.dt[k], self._dims[1]
        given = (*self._cells, t.constraints, t.arrays.q, costate, dt)
        t.launch(cell_kernels.accumulate_cells, constraints, *given, sums, self._step)
        touched = (t.instances, t.samples, t.surface, t.constraints, self._step)
        t.launch(cell_kernels.accumulate_parts, constraints, *self._cells, t.constraints, sums, self._step)
        t.launch(cell_kernels.spread_over_neighbours, self.instances, *touched)
        found = (t.instances, t.basis, t.constraints, self._step, wp.float64(dt))
        t.launch(cell_kernels.propagate_cells, t.unknowns, *found, q_bar, qd_bar)

    @property
    def _cells(self) -> tuple[Any, ...]:
        """What contact takes cells from."""
        t = self.tables
        return t.instances, t.basis, t.motion, t.shapes, t.samples, t.surface

    def _solve(self, k: int, right: wp.array, solution: wp.array) -> None:
        """Solve H_t^T solution = right at the free functions; leave H_t^T solution at the driven ones."""

        def apply(active: wp.array, direction: wp.array, product: wp.array) -> None:
            self._apply(k, active, direction, product)

        self._gmres.solve(apply, right, solution, tolerance=self.options.tolerance)

    def _apply(self, k: int, active: wp.array, direction: wp.array, product: wp.array) -> None:
        """Write H_t^T direction in active worlds to ``product`` and, for the driven functions, to ``_driven``."""
        t, dt, (points, constraints) = self.tables, wp.float64(self.dt[k]), self._dims
        bodies = (t.instances, t.basis)
        t.launch(kernels.apply_points, points, *bodies, active, direction, dt, self._step)
        if self.constraint_max:
            t.launch(kernels.apply_constraints, constraints, *bodies, t.constraints, active, direction, self._step)
        self._sum_points(active)
        given = (t.motion, active, t.arrays, direction, dt)
        t.launch(kernels.sum_product, t.unknowns, *bodies, *given, product, self._driven)

    def _sum_points(self, active: wp.array) -> None:
        """Sum what stands at the points, less what stands at the constraints, into the solver's chunks."""
        t = self.tables
        dim = (self.instances, t.arrays.gradient_chunk.shape[1], t.layout.block_count)
        t.launch(sum_forces, dim, self._sums, active)

    def _check(self, residual: Array, error: Array, overlap: Array) -> None:
        """Refuse steps that are no roots and systems that were not solved."""
        status = self.solver.status.numpy()
        if (status & WORLD_NOT_FINITE).any() or not np.isfinite(residual).all():
            raise SolverDiverged("a recorded step produced no finite state", hint="shorten dt or soften the load")
        if overlap.max() > 1.0 - 1.0e-6:
            t, i = np.unravel_index(overlap.argmax(), overlap.shape)
            raise SolverDiverged(
                f"step {t} of instance {i} starts with a contact deeper than {OVERLAP:g} of the body's size, which is"
                " pushed out by a rule that has no derivative",
                hint="place bodies apart, or shorten dt",
            )
        if residual.max() > self.options.residual_warning:
            t, i = np.unravel_index(residual.argmax(), residual.shape)
            message = f"step {t} of instance {i} stopped at a residual of {residual[t, i]:.1e} of the forces"
            hint = self._why_inexact(int(t), int(i))
            if residual[t, i] > self.options.residual_max:
                raise SolverDiverged(f"{message}, above residual_max = {self.options.residual_max:.1e}", hint=hint)
            warnings.warn(f"{message}: its gradient is as inexact; {hint}", RuntimeWarning, stacklevel=3)
        if error.max() > 1.0e3 * self.options.tolerance:
            t, i = np.unravel_index(error.argmax(), error.shape)
            raise SolverDiverged(
                f"the linear system of step {t}, instance {i}, was solved to {error[t, i]:.1e} only",
                hint="raise AdjointOptions.cycle_length or cycle_max; at a bifurcation there is no gradient",
            )

    def _why_inexact(self, t: int, i: int) -> str:
        """Return what to change so that step t of instance i comes closer to its root."""
        instances, options = self.tables.instances, self.solver.options
        iterations = self._iteration[t].numpy()[instances.world.numpy()[i]]
        contacts = slice(instances.pin_count.numpy()[i], self._constraint_count[t].numpy()[i])
        rubs = self.constraint_max and self._constraint["friction"][t].numpy()[i, contacts].any()
        if rubs and iterations > options.friction_lag:
            return (
                f"the normal force of friction was frozen after SolverReducedOptions.friction_lag ="
                f" {options.friction_lag} of {iterations} iterations: raise it to iteration_max"
            )
        if iterations >= options.iteration_max:
            return f"raise SolverReducedOptions.iteration_max, which all {iterations} were taken of, or shorten dt"
        return "lower SolverReducedOptions.tolerance (and force_tolerance)"

    @property
    def _blocks(self) -> tuple[int, int]:
        return self.instances, self.tables.layout.block_count

    @property
    def _dims(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Threads over the cubature points, and over the point constraints."""
        return (self.instances, self.tables.layout.point_max), (self.instances, self.constraint_max)

    def _zeros(self, shape: Sequence[int], dtype: type) -> Any:
        return wp.zeros(tuple(shape), dtype=dtype, device=self.device)
