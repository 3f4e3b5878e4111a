"""Energy of pins and of contact between surface samples and rigid shapes; the reactions.

With the displacement d of the sample relative to the shape during the step, a contact adds

    E(d) = A [ kappa psi_n(g0 + n . d) ] + mu f_n psi_t(|d_t|),

psi_n the C2 penalty p^3/(6 eps) for p < eps, p^2/2 - eps p/2 + eps^2/6 beyond (p the penetration), psi_t the smoothed
Coulomb potential of Li et al. 2020 (IPC, doi:10.1145/3386569.3392425, eq. 13) with the normal force f_n of the last
Newton iterate.
"""

import warp as wp

from softmode.deformables.lanes import vec8d
from softmode.deformables.tables import (
    Basis,
    Entries,
    Instances,
    Motion,
    Progress,
    Rigid,
    first_coupled,
    interpolate_change,
)

wp.set_module_options({"enable_backward": False})

LAG_ITERATIONS = wp.constant(8)
"""Newton iterations during which the normal force of friction follows the contact; then it is frozen, and what is left
is the minimisation of one potential."""


@wp.func
def normal_potential(penetration: wp.float64, eps: wp.float64):
    """Return the C2 penalty of a penetration [m] per unit stiffness, and its first two derivatives."""
    p = wp.max(penetration, wp.float64(0.0))
    half = wp.float64(0.5)
    six = wp.float64(6.0)
    if p < eps:
        return p * p * p / (six * eps), half * p * p / eps, p / eps
    return half * p * p - half * eps * p + eps * eps / six, p - half * eps, wp.float64(1.0)


@wp.func
def friction_potential(y: wp.float64, eps: wp.float64):
    """Return f0(y), f1(y) / y and f1'(y), f1 = f0', of the smoothed Coulomb potential with stick range ``eps`` [m]."""
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    three = wp.float64(3.0)
    if y < eps:
        return (
            y * y / eps - y * y * y / (three * eps * eps) + eps / three,
            two / eps - y / (eps * eps),
            two / eps - two * y / (eps * eps),
        )
    return y, one / y, wp.float64(0.0)


@wp.kernel
def evaluate_entries(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    progress: Progress,
    rigid: Rigid,
    stick_range: wp.float64,  # eps of the friction potential for this step [m]
    # State in:
    selected: wp.array[int],
    q: wp.array2d[vec8d],
    r: wp.array2d[wp.float64],
    derivatives: int,
    # In and out:
    entries: Entries,
):
    """Evaluate pins and contacts at displacement d = sum_k b_k (q_k - q_nk) - J r, less that of a soft partner.

    A contact of two soft bodies is an entry of each, which has one half of its energy and all of its force.
    """
    i, e = wp.tid()
    w = instances.world[i]
    if selected[w] == 0 or e >= entries.count[i]:
        return
    d = interpolate_change(basis.row, entries.row[i, e], q, motion.q_start, i, instances.function_count[i])
    smoothing = instances.smoothing[i]
    share = wp.float64(1.0)
    if e >= entries.count[i] - entries.pair_count[i]:
        j = entries.partner[i, e]
        if j >= 0:
            d -= interpolate_change(
                basis.row, entries.partner_row[i, e], q, motion.q_start, j, instances.function_count[j]
            )
            smoothing = wp.min(smoothing, instances.smoothing[j])
            share = wp.float64(0.5)
    else:
        for j in range(rigid.count[w]):
            d -= r[w, j] * wp.vec3d(entries.jacobian[i, e, j])
    stiffness = entries.stiffness[i, e]
    identity = wp.identity(n=3, dtype=wp.float64)
    H = stiffness * identity
    if e < instances.pin_count[i]:
        x = entries.offset[i, e] + d
        entries.energy[i, e] = wp.float64(0.5) * stiffness * wp.length_sq(x)
        entries.force[i, e] = -stiffness * x
    else:
        n = entries.normal[i, e]
        total = entries.offset[i, e] + d
        psi, slope, curvature = normal_potential(-wp.dot(n, total), wp.float64(smoothing))
        if derivatives != 0 and progress.iteration[w] <= LAG_ITERATIONS:
            held = slope
            if progress.iteration[w] == 0:
                # in an impact the first guess lies far too deep: friction of such a force would be too stiff to solve
                most = wp.float64(smoothing) - wp.float64(2.0) * wp.min(
                    wp.dot(n, entries.offset[i, e]), wp.float64(0.0)
                )
                held = wp.min(slope, most)
            entries.normal_force[i, e] = stiffness * held
        normal_force = entries.normal_force[i, e]
        # offset = gap n - drift of the shape: the tangential part is the slip of the step
        t = total - wp.dot(n, total) * n
        y = wp.length(t)
        f0, f1_over_y, f1_slope = friction_potential(y, stick_range)
        limit = entries.friction[i, e] * normal_force
        entries.energy[i, e] = share * (stiffness * psi + limit * f0)
        entries.force[i, e] = stiffness * slope * n - limit * f1_over_y * t
        # f0 is concave in y^2, so the quadratic of curvature f1 / y lies above it and its steps cannot overshoot, from
        # however far away; the potential's own curvature f1' along the slip converges faster once the state is close
        N = wp.outer(n, n)
        H = stiffness * curvature * N + limit * f1_over_y * (identity - N)
        if progress.exact[w] != 0 and y > wp.float64(1.0e-9) * stick_range:
            H += limit * (f1_slope - f1_over_y) / (y * y) * wp.outer(t, t)
    if derivatives != 0:
        entries.hessian[i, e] = wp.mat33(H)
        for j in range(rigid.count[w]):
            entries.coupling[i, e, j] = wp.mat33(H) * entries.jacobian[i, e, j]


@wp.kernel
def sum_reactions(
    instances: Instances,
    progress: Progress,
    entries: Entries,
    # Out:
    body_wrench_out: wp.array[wp.spatial_vector],  # (body_count,) on the rigid bodies, about their COM [N, N m]
    instance_force_out: wp.array[wp.vec3d],  # (instance_count,) total contact force on the body [N]
):
    """Sum the forces of contacts and links per rigid body (equal and opposite), of contacts per instance, in order."""
    w = wp.tid()
    for i in range(progress.instance_start[w], progress.instance_start[w + 1]):
        total = wp.vec3d()
        for e in range(first_coupled(instances, i), entries.count[i]):
            f = entries.force[i, e]
            # what a body does to itself is no force on it
            within = e >= entries.count[i] - entries.pair_count[i] and entries.partner[i, e] < 0
            if e >= instances.pin_count[i] and not within:
                total += f
            body = entries.body[i, e]
            if body >= 0:
                reaction = -wp.vec3(f)
                body_wrench_out[body] = body_wrench_out[body] + wp.spatial_vector(
                    reaction, wp.cross(entries.arm[i, e], reaction)
                )
        instance_force_out[i] = total
