"""Device side of pins and contacts on CPU: eight of an instance at a time, one in each lane.

Their law is written from ``response_kernels``; ``test_cpu_kernels.py`` compares all with
``evaluate_kernels.evaluate_constraint``. Contacts of two soft bodies are evaluated one by one.
"""

import warp as wp

from softmode.deformables.contact.response_kernels import KEEP, contact_response
from softmode.deformables.model.declare import kernel_over
from softmode.deformables.model.interpolation_cpu_kernels import SUMS
from softmode.deformables.model.lane_kernels import LANES, vec8, vec8d
from softmode.deformables.model.newton_step_kernels import NewtonStep
from softmode.deformables.model.struct_kernels import PointConstraints
from softmode.deformables.potential.evaluate_kernels import evaluate_constraint, normal_force_mode
from softmode.lanes import lanes_code

wp.set_module_options({"enable_backward": False})

_EVALUATE = """
    const size_t own = (size_t)i * constraints.row.shape[1] + e, width = constraints.jacobian.shape[2];
    const int* const begin = (const int*)constraints.dof_begin.data + own;
    const int* const end = (const int*)constraints.dof_end.data + own;
    const float* const jacobian = (const float*)constraints.jacobian.data + 3 * own * width;
    double* const displacement = (double*)constraints.displacement.data + 3 * own;
    int at[8];
    for (int k = 0; k < 8; ++k) at[k] = k < count ? k : count - 1;

    lanes moved[3];  // relative to the other side
    if (known) {
        for (int k = 0; k < 8; ++k)
            for (int axis = 0; axis < 3; ++axis) moved[axis][k] = displacement[3 * at[k] + axis];
    } else {
        const char *where[8], *q_own = (const char*)q.data + (size_t)i * q.strides[0];
        const char* const before = (const char*)q_from.data + (size_t)i * q_from.strides[0];
        const int* const row = (const int*)constraints.row.data + own;
        for (int k = 0; k < 8; ++k) where[k] = (const char*)rows.data + (size_t)row[at[k]] * rows.strides[0];
        Sums::rows(where, sizeof(floats), q_own, before, rows.shape[1], function_count, moved);
        const double* const unknown = (const double*)((const char*)r.data + (size_t)w * r.strides[0]);
        for (int k = 0; k < count; ++k) {
            double change[3] = {moved[0][k], moved[1][k], moved[2][k]};
            for (int j = begin[k]; j < end[k]; ++j)
                for (int axis = 0; axis < 3; ++axis)
                    change[axis] -= unknown[j] * (double)jacobian[3 * (k * width + j) + axis];
            for (int axis = 0; axis < 3; ++axis) {
                moved[axis][k] = change[axis];
                displacement[3 * k + axis] = change[axis];
            }
        }
    }

    const double* const normals = (const double*)constraints.normal.data + 3 * own;
    const double* const offsets = (const double*)constraints.offset.data + 3 * own;
    wp::vec_t<3, lanes> n, offset, d;
    lanes stiffness, compliance, depth, ridge, ridge_lead, friction, stick, deep, held, onset;
    words pinned;
    for (int k = 0; k < 8; ++k) {
        const size_t one = own + at[k];
        pinned[k] = e + at[k] < pins ? -1 : 0;
        stiffness[k] = constraints.stiffness.data[one];
        compliance[k] = constraints.dent_compliance.data[one];
        depth[k] = constraints.dent_depth.data[one];
        onset[k] = constraints.onset.data[one];
        ridge[k] = constraints.ridge.data[one];
        ridge_lead[k] = constraints.ridge_lead.data[one];
        friction[k] = constraints.friction.data[one];
        stick[k] = constraints.stick.data[one];
        deep[k] = constraints.stick_deep.data[one];
        held[k] = constraints.normal_force.data[one];
        for (int axis = 0; axis < 3; ++axis) {
            n.c[axis][k] = normals[3 * at[k] + axis];
            offset.c[axis][k] = offsets[3 * at[k] + axis];
            d.c[axis][k] = moved[axis][k];
        }
    }
    const Law::contact_response_results found = Law::contact_response(
        pinned, offset, n, d, stiffness, compliance, depth, ridge, ridge_lead, friction, stick, deep, held, onset,
        stick_range, mode, exact);
    double* const slips = (double*)constraints.slip.data + 3 * own;
    double* const forces = (double*)constraints.force.data + 3 * own;
    for (int k = 0; k < count; ++k) {
        constraints.energy.data[own + k] = found._0[k];
        for (int axis = 0; axis < 3; ++axis) forces[3 * k + axis] = found._1.c[axis][k];
        if (pinned[k]) continue;
        if (mode != KEEP) constraints.normal_force.data[own + k] = found._3[k];
        for (int axis = 0; axis < 3; ++axis) slips[3 * k + axis] = found._4.c[axis][k];
    }
    if (!derivatives) return;

    float* const coupling = (float*)constraints.coupling.data + 3 * own * width;
    for (int k = 0; k < count; ++k) {
        float* const H = (float*)constraints.hessian.data + 9 * (own + k);
        for (int m = 0; m < 9; ++m) H[m] = (float)found._2.data[m / 3][m % 3][k];
        for (int j = begin[k]; j < end[k]; ++j) {
            const float* const J = jacobian + 3 * (k * width + j);
            float* const out = coupling + 3 * (k * width + j);
            for (int a = 0; a < 3; ++a) out[a] = H[3 * a] * J[0] + H[3 * a + 1] * J[1] + H[3 * a + 2] * J[2];
        }
    }
"""


@wp.func_native(
    snippet=f"{{{SUMS}{lanes_code(contact_response, uniform=('stick_range',))}{_EVALUATE}}}".replace("KEEP", str(KEEP))
)
def evaluate_eight_constraints(
    constraints: PointConstraints,
    rows: wp.array2d[vec8],
    q: wp.array2d[vec8d],
    q_from: wp.array2d[vec8d],
    r: wp.array2d[wp.float64],
    stick_range: wp.float64,
    w: int,
    i: int,
    e: int,
    count: int,
    pins: int,
    function_count: int,
    known: int,
    derivatives: int,
    mode: int,
    exact: int,
) -> None:
    """Evaluate ``count`` constraints of an instance from ``e`` on; see ``evaluate_kernels.evaluate_constraint``.

    Args:
        constraints: The constraints.
        rows: Functions of the basis at samples.
        q: Where the body is.
        q_from: Where it was at the start of the step.
        r: Motion of the joints.
        stick_range: Range of the smoothed friction [m].
        w: World.
        i: Instance.
        e: First constraint.
        count: Constraints, at most eight.
        pins: How many constraints of the instance are pins.
        function_count: Functions of the instance.
        known: Whether displacements are known.
        derivatives: Whether Hessians are wanted.
        mode: What becomes of the normal force that friction goes by.
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
    """Evaluate pins and contacts of an instance; see ``evaluate_kernels.evaluate_constraint``."""
    w = step.instances.world[i]
    if selected[w] == 0:
        return
    count = step.constraints.count[i]
    alone = count - step.constraints.pair_count[i]
    mode = normal_force_mode(step.state.iteration[w], step.state.friction_lag, derivatives)
    known = int(0)
    if derivatives != 0 and step.state.evaluated[w] != 0:
        known = 1
    for e in range(0, alone, LANES):
        evaluate_eight_constraints(
            step.constraints,
            step.basis.row,
            q,
            step.motion.q_start,
            r,
            step.options.stick_range,
            w,
            i,
            e,
            wp.min(LANES, alone - e),
            step.instances.pin_count[i],
            step.instances.function_count[i],
            known,
            derivatives,
            mode,
            step.state.exact[w],
        )
    for e in range(alone, count):
        evaluate_constraint(step, selected, q, r, derivatives, i, e)


evaluate_constraints = kernel_over(evaluate_constraints_of, "evaluate_constraints", "i")
