"""Device side of pins and contacts on CPU: eight of an instance at a time, one in each lane.

The formulas are those of ``penalty_kernels`` and ``step_kernels.evaluate_constraint``, which say why they are written
as they are and which this code is tested against. A constraint's numbers do not depend on the other seven: where one
would branch, the lanes select. Contacts of two soft bodies are evaluated one by one.
"""

import warp as wp

from softmode.deformables.contact.penalty_kernels import HARDENING, HARDENING_DEPTH
from softmode.deformables.model.declare import kernel_over
from softmode.deformables.model.interpolation_cpu_kernels import SUMS
from softmode.deformables.model.lane_kernels import LANES, vec8, vec8d
from softmode.deformables.model.struct_kernels import PointConstraints
from softmode.deformables.solver.iteration_kernels import NewtonStep
from softmode.deformables.solver.step_kernels import RELAXED_AFTER, evaluate_constraint

wp.set_module_options({"enable_backward": False})

_KEEP, _SET, _FIRST, _RELAX = range(4)
"""What becomes of the normal force that friction goes by: as it is, that of the iterate, that with the bound of a
step's first guess, the mean of the two."""

_LAW = """
    typedef __typeof__((lanes)0.0 < (lanes)0.0) words;  // 64-bit integers
    struct Potential { lanes psi, slope, curvature; };
    struct Law {
        static lanes most(lanes a, lanes b) { return a < b ? b : a; }
        static lanes least(lanes a, lanes b) { return b < a ? b : a; }
        static Potential penalty(lanes penetration, lanes eps) {
            #pragma clang fp contract(fast)
            const lanes p = most(penetration, 0.0), square = p * p, part = p / eps;
            const words near = p < eps;
            Potential found;
            found.psi = near ? square * part / 6.0 : 0.5 * square - 0.5 * eps * p + eps * eps / 6.0;
            found.slope = near ? 0.5 * p * part : p - 0.5 * eps;
            found.curvature = near ? part : (lanes)1.0;
            return found;
        }
        static Potential dented(lanes penetration, lanes eps, lanes ratio) {
            #pragma clang fp contract(fast)
            const lanes p = most(penetration, 0.0);
            const lanes root = __builtin_elementwise_sqrt(1.0 + 2.0 * ratio * p / eps);
            const lanes given = p < eps * (1.0 + 0.5 * ratio) ? 2.0 * p / (1.0 + root)
                                                              : (p + 0.5 * ratio * eps) / (1.0 + ratio);
            Potential found = penalty(ratio > 0.0 ? given : p, eps);
            found.psi += 0.5 * ratio * found.slope * found.slope;
            found.curvature /= 1.0 + ratio * found.curvature;
            return found;
        }
        static Potential normal(lanes penetration, lanes eps, lanes ratio, lanes depth) {
            #pragma clang fp contract(fast)
            const lanes onset = HARDENING_DEPTH * eps;
            const Potential deep = penalty(penetration - depth - onset, onset);
            Potential found = dented(penetration, eps, ratio);
            found.psi += HARDENING * deep.psi;
            found.slope += HARDENING * deep.slope;
            found.curvature += HARDENING * deep.curvature;
            return found;
        }
        static Potential friction(lanes y, lanes limit, lanes stick, lanes range) {  // psi, force over slip, curvature
            #pragma clang fp contract(fast)
            const lanes zero = 0.0;
            const words sticks = stick * y <= limit, none = limit <= 0.0, memory = stick > 0.0;
            Potential found;
            found.psi = none ? zero : sticks ? 0.5 * stick * y * y : limit * (y - 0.5 * limit / stick);
            found.slope = none ? zero : sticks ? stick : limit / y;
            found.curvature = none ? zero : sticks ? stick : zero;
            if (!__builtin_reduce_or(~memory)) return found;
            const words near = y < range;
            const lanes square = range * range;
            lanes f0 = near ? y * y / range - y * y * y / (3.0 * square) + range / 3.0 : y;
            lanes secant = near ? 2.0 / range - y / square : 1.0 / y;
            lanes tangent = near ? 2.0 / range - 2.0 * y / square : zero;
            found.psi = memory ? found.psi : limit * f0;
            found.slope = memory ? found.slope : limit * secant;
            found.curvature = memory ? found.curvature : limit * tangent;
            return found;
        }
    };
"""

_EVALUATE = """
    const size_t own = (size_t)i * constraints.row.shape[1] + e;
    const int stride = rows.shape[1], blocks = (function_count + 7) / 8;
    int at[8];
    for (int k = 0; k < 8; ++k) at[k] = k < count ? k : count - 1;

    // the displacement relative to the other side
    double* const displacement = (double*)constraints.displacement.data + 3 * own;
    lanes d[3];
    if (known) {
        for (int k = 0; k < 8; ++k)
            for (int axis = 0; axis < 3; ++axis) d[axis][k] = displacement[3 * at[k] + axis];
    } else {
        const lanes* const Q = (const lanes*)((const char*)q.data + (size_t)i * q.strides[0]);
        const lanes* const from = (const lanes*)((const char*)q_from.data + (size_t)i * q_from.strides[0]);
        const int* const row = (const int*)constraints.row.data + own;
        const char* where[8];
        for (int k = 0; k < 8; ++k) where[k] = (const char*)rows.data + (size_t)row[at[k]] * rows.strides[0];
        lanes sum[3][8] = {};
        for (int b = 0; b < blocks; ++b) {
            lanes x[3], before;
            for (int axis = 0; axis < 3; ++axis) {
                __builtin_memcpy(x + axis, Q + axis * stride + b, sizeof(lanes));
                __builtin_memcpy(&before, from + axis * stride + b, sizeof(lanes));
                x[axis] -= before;
            }
            #pragma unroll
            for (int k = 0; k < 8; ++k) {
                const lanes value = Sums::row(where[k] + 32 * b);
                for (int axis = 0; axis < 3; ++axis) sum[axis][k] += value * x[axis];
            }
        }
        for (int axis = 0; axis < 3; ++axis) d[axis] = Sums::of(sum[axis]);
        const int* const begin = (const int*)constraints.dof_begin.data + own;
        const int* const end = (const int*)constraints.dof_end.data + own;
        const size_t width = constraints.jacobian.shape[2];
        const float* const jacobian = (const float*)constraints.jacobian.data + 3 * own * width;
        const double* const unknown = (const double*)((const char*)r.data + (size_t)w * r.strides[0]);
        for (int k = 0; k < count; ++k) {
            double change[3] = {d[0][k], d[1][k], d[2][k]};
            for (int j = begin[k]; j < end[k]; ++j) {
                const float* const J = jacobian + 3 * (k * width + j);
                for (int axis = 0; axis < 3; ++axis) change[axis] -= unknown[j] * (double)J[axis];
            }
            for (int axis = 0; axis < 3; ++axis) {
                d[axis][k] = change[axis];
                displacement[3 * k + axis] = change[axis];
            }
        }
    }

    const double* const normals = (const double*)constraints.normal.data + 3 * own;
    const double* const offsets = (const double*)constraints.offset.data + 3 * own;
    lanes n[3], offset[3], stiffness, compliance, depth, friction, stick, held;
    words pinned;
    for (int k = 0; k < 8; ++k) {
        const size_t one = own + at[k];
        pinned[k] = e + at[k] < pins ? -1 : 0;
        stiffness[k] = constraints.stiffness.data[one];
        compliance[k] = constraints.dent_compliance.data[one];
        depth[k] = constraints.dent_depth.data[one];
        friction[k] = constraints.friction.data[one];
        stick[k] = constraints.stick.data[one];
        held[k] = constraints.normal_force.data[one];
        for (int axis = 0; axis < 3; ++axis) {
            n[axis][k] = normals[3 * at[k] + axis];
            offset[axis][k] = offsets[3 * at[k] + axis];
        }
    }
    lanes total[3], t[3], force[3], H[6];
    for (int axis = 0; axis < 3; ++axis) total[axis] = offset[axis] + d[axis];
    const lanes gap = n[0] * total[0] + n[1] * total[1] + n[2] * total[2], eps = smoothing;
    const lanes ratio = stiffness * compliance;
    const Potential across = Law::normal(-gap, eps, ratio, depth);
    if (normal_force != KEEP) {
        lanes slope = across.slope;
        if (normal_force == FIRST) {
            const lanes start = n[0] * offset[0] + n[1] * offset[1] + n[2] * offset[2];
            slope = Law::least(slope, Law::normal(eps - 2.0 * Law::least(start, 0.0), eps, ratio, depth).slope);
        }
        const lanes pressed = stiffness * slope;
        held = normal_force == RELAX ? 0.5 * (pressed + held) : pressed;
    }
    for (int axis = 0; axis < 3; ++axis) t[axis] = total[axis] - gap * n[axis];
    const lanes y = __builtin_elementwise_sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]);
    const Potential along = Law::friction(y, friction * held, stick, stick_range);
    const lanes length = total[0] * total[0] + total[1] * total[1] + total[2] * total[2];
    const lanes energy = pinned ? 0.5 * stiffness * length : stiffness * across.psi + along.psi;
    for (int axis = 0; axis < 3; ++axis) {
        force[axis] = stiffness * across.slope * n[axis] - along.slope * t[axis];
        force[axis] = pinned ? -stiffness * total[axis] : force[axis];
    }
    double* const slips = (double*)constraints.slip.data + 3 * own;
    double* const forces = (double*)constraints.force.data + 3 * own;
    for (int k = 0; k < count; ++k) {
        constraints.energy.data[own + k] = energy[k];
        for (int axis = 0; axis < 3; ++axis) forces[3 * k + axis] = force[axis][k];
        if (pinned[k]) continue;
        if (normal_force != KEEP) constraints.normal_force.data[own + k] = held[k];
        for (int axis = 0; axis < 3; ++axis) slips[3 * k + axis] = t[axis][k];
    }
    if (!derivatives) return;

    const words turns = y > 1.0e-9 * stick_range;
    const lanes beyond = exact ? (turns ? (along.curvature - along.slope) / (y * y) : (lanes)0.0) : (lanes)0.0;
    const lanes stiff = stiffness * across.curvature;
    for (int a = 0, m = 0; a < 3; ++a)
        for (int b = a; b < 3; ++b, ++m) {
            const lanes one = a == b ? 1.0 : 0.0, N = n[a] * n[b];
            H[m] = stiff * N + along.slope * (one - N) + beyond * t[a] * t[b];
            H[m] = pinned ? stiffness * one : H[m];
        }
    float* const hessians = (float*)constraints.hessian.data + 9 * own;
    const int* const begin = (const int*)constraints.dof_begin.data + own;
    const int* const end = (const int*)constraints.dof_end.data + own;
    const size_t width = constraints.jacobian.shape[2];
    const float* const jacobian = (const float*)constraints.jacobian.data + 3 * own * width;
    float* const coupling = (float*)constraints.coupling.data + 3 * own * width;
    for (int k = 0; k < count; ++k) {
        float h[6];
        for (int m = 0; m < 6; ++m) h[m] = (float)H[m][k];
        const float full[9] = {h[0], h[1], h[2], h[1], h[3], h[4], h[2], h[4], h[5]};
        for (int m = 0; m < 9; ++m) hessians[9 * k + m] = full[m];
        for (int j = begin[k]; j < end[k]; ++j) {
            const float* const J = jacobian + 3 * (k * width + j);
            float* const out = coupling + 3 * (k * width + j);
            for (int a = 0; a < 3; ++a) out[a] = full[3 * a] * J[0] + full[3 * a + 1] * J[1] + full[3 * a + 2] * J[2];
        }
    }
"""


def _native(text: str) -> str:
    """Return native code with the numbers of this module in the place of their names."""
    numbers = {"HARDENING_DEPTH": float(HARDENING_DEPTH), "HARDENING": float(HARDENING)}
    numbers |= {"KEEP": _KEEP, "FIRST": _FIRST, "RELAX": _RELAX}
    for name, number in numbers.items():
        text = text.replace(name, str(number))
    return text


@wp.func_native(snippet=f"{{{SUMS}{_native(_LAW + _EVALUATE)}}}")
def evaluate_eight_constraints(
    constraints: PointConstraints,
    rows: wp.array2d[vec8],
    q: wp.array2d[vec8d],
    q_from: wp.array2d[vec8d],
    r: wp.array2d[wp.float64],
    smoothing: wp.float64,
    stick_range: wp.float64,
    w: int,
    i: int,
    e: int,
    count: int,
    pins: int,
    function_count: int,
    known: int,
    derivatives: int,
    normal_force: int,
    exact: int,
) -> None:
    """Evaluate ``count`` constraints of an instance from ``e`` on; see ``step_kernels.evaluate_constraint``.

    Args:
        constraints: The constraints.
        rows: Functions of the basis at samples.
        q: Where the body is.
        q_from: Where it was at the start of the step.
        r: Motion of the joints.
        smoothing: Range of the onset of contact [m].
        stick_range: That of the smoothed friction [m].
        w: World.
        i: Instance.
        e: First constraint.
        count: Constraints, at most eight.
        pins: How many constraints of the instance are pins.
        function_count: Functions of the instance.
        known: Whether displacements are known.
        derivatives: Whether Hessians are wanted.
        normal_force: What becomes of the normal force that friction goes by.
        exact: Whether the curvature of friction along the slip is that of its potential.
    """


@wp.func
def evaluate_constraints_of(
    step: NewtonStep,
    # State in:
    selected: wp.array[int],  # (world_count,)
    q: wp.array2d[vec8d],
    r: wp.array2d[wp.float64],
    derivatives: int,
    i: int,
):
    """Evaluate pins and contacts of an instance; see ``step_kernels.evaluate_constraint``."""
    w = step.instances.world[i]
    if selected[w] == 0:
        return
    count = step.constraints.count[i]
    alone = count - step.constraints.pair_count[i]
    iteration = step.state.iteration[w]
    known = int(0)
    normal_force = int(wp.static(_KEEP))
    if derivatives != 0:
        if step.state.evaluated[w] != 0:
            known = 1
        if iteration <= step.state.friction_lag:
            normal_force = wp.static(_SET)
            if iteration == 0:
                normal_force = wp.static(_FIRST)
            if iteration > RELAXED_AFTER:
                normal_force = wp.static(_RELAX)
    for e in range(0, alone, LANES):
        evaluate_eight_constraints(
            step.constraints,
            step.basis.row,
            q,
            step.motion.q_start,
            r,
            wp.float64(step.instances.smoothing[i]),
            step.options.stick_range,
            w,
            i,
            e,
            wp.min(LANES, alone - e),
            step.instances.pin_count[i],
            step.instances.function_count[i],
            known,
            derivatives,
            normal_force,
            step.state.exact[w],
        )
    for e in range(alone, count):
        evaluate_constraint(step, selected, q, r, derivatives, i, e)


evaluate_constraints = kernel_over(evaluate_constraints_of, "evaluate_constraints", "i")
