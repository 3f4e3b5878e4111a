"""Device side of Newton's iteration: the sum of the potential, convergence, trial steps, acceptance."""

import warp as wp

from softmode.deformables.model.declare import kernel_over
from softmode.deformables.model.lane_kernels import barrier, team_sum, vec8, vec8d
from softmode.deformables.model.status import WORLD_ITERATION_LIMIT, WORLD_NO_DESCENT, WORLD_NOT_FINITE
from softmode.deformables.model.struct_kernels import (
    Basis,
    Instances,
    Motion,
    NewtonState,
    PointConstraints,
    Points,
    Rigid,
    has_contacts,
    hessian_key,
    pushes,
)

wp.set_module_options({"enable_backward": False})


INERTIA_SHARE = wp.constant(0.01)
"""A Hessian serves further iterations while strains have changed it by less than this fraction of the inertia, which
is all that resists the rotation of a stiff body: beyond, small steps would pass for convergence."""
PROJECTED_DISTANCE = wp.constant(0.01)
"""A projected Hessian is kept while steps are larger than this fraction of the size: far from the minimum Newton's own
is likely to be indefinite again."""
FAILURES = wp.constant(2)
"""Indefinite Hessians after which a step keeps to the projected one."""
PROJECTED_ITERATIONS = wp.constant(8)
"""Iterations before which a small step with the projected Hessian does not count as convergence."""
SUFFICIENT_DECREASE = wp.constant(wp.float64(0.25))
"""Least decrease of the potential over that of its tangent. A quadratic has 0.5; with little less than that asked for,
friction between sticking and slipping is crossed back and forth for many iterations."""
EXTENDED_DECREASE = wp.constant(wp.float64(0.54))
"""Decrease beyond which twice the full step is tried. In the onset of contact the potential is cubic (0.58): there
Newton's steps halve the penetration, and double ones end it."""


@wp.func
def potential_share(
    state: NewtonState,
    instances: Instances,
    motion: Motion,
    points: Points,
    constraints: PointConstraints,
    rigid: Rigid,
    q: wp.array2d[vec8d],
    r: wp.array2d[wp.float64],
    dt: wp.float64,
    w: int,
    member: int,
    team: int,
):
    """Return one thread's share of the incremental potential of a world [J], in a fixed order."""
    half = wp.float64(0.5)
    total = wp.float64(0.0)
    for i in range(state.instance_start[w], state.instance_start[w + 1]):
        c = motion.rate[i]
        inertial = half * instances.mass[i] * c * c / (dt * dt)
        damping = half * instances.mass[i] * wp.float64(instances.mass_damping[i]) * c / dt
        for e in range(member, q.shape[1], team):
            x = q[i, e]
            away = x - motion.q_inertial[i, e]
            moved = x - motion.q_rate[i, e]
            step = x - motion.q_start[i, e]
            total += inertial * wp.dot(away, away) + damping * wp.dot(moved, moved) - wp.dot(motion.force[i, e], step)
        for p in range(member, instances.point_count[i], team):
            total += points.energy[i, p]
        for e in range(member, constraints.count[i], team):
            total += constraints.energy[i, e]
    for j in range(member, rigid.count[w], team):
        for l in range(rigid.count[w]):
            total += (
                half * (r[w, j] - rigid.predicted[w, j]) * rigid.inertia[w, j, l] * (r[w, l] - rigid.predicted[w, l])
            )
    for k in range(member, rigid.row_count[w], team):
        total += rigid.row_energy[w, k]
    return total


@wp.func
def check_convergence(
    instances: Instances,
    motion: Motion,
    points: Points,
    constraints: PointConstraints,
    rigid: Rigid,
    team: int,
    iteration_max: int,
    force_tolerance: wp.float64,
    # State in:
    gradient: wp.array2d[vec8d],
    q: wp.array2d[vec8d],
    dt: wp.float64,
    # In and out:
    state: NewtonState,
    w: int,
    member: int,
):
    """Sum the potential; stop a world whose last step was small and whose residual is small near its contacts.

    The second condition matters in contact: within a step's tolerance friction goes from one side of its cone to the
    other, and a residual is momentum that the other body receives and this one does not.
    """
    if state.active[w] == 0:
        return
    share = potential_share(state, instances, motion, points, constraints, rigid, q, rigid.r, dt, w, member, team)
    potential = team_sum(share)
    done = state.last[w]
    for i in range(state.instance_start[w], state.instance_start[w + 1]):
        if done == 1 and state.iteration[w] > 0 and pushes(instances, constraints, i):
            residual = wp.float64(0.0)
            external = wp.float64(0.0)
            scale = wp.float64(0.0)
            for e in range(member, q.shape[1], team):
                residual += wp.dot(gradient[i, e], gradient[i, e])
                external += wp.dot(motion.force[i, e], motion.force[i, e])
            for e in range(member, constraints.count[i], team):
                scale += wp.length(constraints.force[i, e])
            residual = team_sum(residual)
            scale = wp.sqrt(team_sum(external)) + team_sum(scale)
            floor = wp.float64(1.0e-5) * instances.mass[i] * wp.float64(instances.tolerance[i]) / (dt * dt)
            if not (wp.sqrt(residual) <= force_tolerance * scale + floor):
                done = 0
    if member != 0:
        return
    state.potential[w] = potential
    if wp.isnan(potential):
        state.active[w] = 0
        state.status[w] = state.status[w] | WORLD_NOT_FINITE
        return
    if state.iteration[w] == 0:
        return
    if done == 1:
        state.active[w] = 0
    elif state.iteration[w] >= iteration_max:
        state.active[w] = 0
        state.status[w] = state.status[w] | WORLD_ITERATION_LIMIT


check_iterates = kernel_over(check_convergence, "check_iterates", "w", "member")


@wp.func
def start_line_search(
    instances: Instances,
    constraints: PointConstraints,
    rigid: Rigid,
    rigid_tolerance: wp.array[float],  # (world_count,) [m or rad]
    stick_range: wp.float64,  # [m]
    team: int,
    # State in:
    gradient: wp.array2d[vec8d],
    direction: wp.array2d[vec8],
    indefinite: wp.array[int],  # (system_count,)
    # In and out:
    state: NewtonState,
    w: int,
    member: int,
):
    """Compute the slope g . d of each active world and start its line search at alpha = 1.

    Where Newton's own Hessian turns out to be indefinite the world stays put and takes the projected one next.

    A step below the tolerance (in contact, far below the stick range too) is taken in full: there the change of the
    potential drowns in rounding. If the residual is still too large after it, the next small step is searched for:
    between sticking and slipping, full steps may go round in circles.
    """
    if state.active[w] == 0:
        if member == 0:
            state.searching[w] = 0
        return
    slope = wp.float64(0.0)
    last = int(1)
    unsound = int(0)
    for i in range(state.instance_start[w], state.instance_start[w + 1]):
        if state.project[w] == 0 and indefinite[instances.system[i]] != 0:
            unsound = 1
        moved = wp.float64(0.0)
        for e in range(member, gradient.shape[1], team):
            d = vec8d(direction[i, e])
            slope += wp.dot(gradient[i, e], d)
            moved += wp.dot(d, d)
        moved = team_sum(moved)
        limit = wp.float64(instances.tolerance[i])
        if has_contacts(instances, constraints, i):
            limit = wp.min(limit, wp.float64(0.1) * stick_range)
        if not (wp.sqrt(moved) <= limit):
            last = 0
    slope = team_sum(slope)
    if member != 0:
        return
    state.searching[w] = 0
    for j in range(rigid.count[w]):
        slope += rigid.gradient[w, j] * rigid.direction[w, j]
        # dofs that take part are in contact: a light body moves where the soft one stays
        limit = wp.min(wp.float64(rigid_tolerance[w]), wp.float64(0.01) * stick_range)
        if not (wp.abs(rigid.direction[w, j]) <= limit):
            last = 0
    state.slope[w] = slope
    state.step_length[w] = wp.float64(1.0)
    small_again = wp.where(state.iteration[w] > 0, state.last[w], 0)
    state.last[w] = last
    if unsound == 1:
        state.step_length[w] = wp.float64(0.0)
        state.last[w] = 0
        state.failures[w] = state.failures[w] + 1
    elif last == 1 and state.project[w] != 0 and state.iteration[w] < PROJECTED_ITERATIONS:
        # too stiff a matrix takes small steps: that says nothing of the distance to the minimum
        state.last[w] = 0
    elif last == 0 or small_again == 1:
        state.searching[w] = 1
        wp.atomic_max(state.any_searching, 0, 1)


start_line_searches = kernel_over(start_line_search, "start_line_searches", "w", "member")


@wp.kernel
def trial_functions(
    instances: Instances,
    state: NewtonState,
    q: wp.array2d[vec8d],
    direction: wp.array2d[vec8],
    # Out:
    q_out: wp.array2d[vec8d],
):
    """Set q_trial = q + alpha dq."""
    i, e = wp.tid()
    w = instances.world[i]
    if state.searching[w] == 0:
        return
    q_out[i, e] = q[i, e] + state.step_length[w] * vec8d(direction[i, e])


@wp.kernel
def trial_rigid(
    state: NewtonState,
    # In and out:
    rigid: Rigid,
):
    """Set r_trial = r + alpha dr."""
    w, j = wp.tid()
    if state.searching[w] == 0 or j >= rigid.count[w]:
        return
    rigid.trial[w, j] = rigid.r[w, j] + state.step_length[w] * rigid.direction[w, j]


@wp.func
def check_trial(
    instances: Instances,
    motion: Motion,
    points: Points,
    constraints: PointConstraints,
    rigid: Rigid,
    team: int,
    step_length_min: wp.float64,
    # State in:
    q: wp.array2d[vec8d],
    dt: wp.float64,
    # In and out:
    state: NewtonState,
    w: int,
    member: int,
):
    """Accept a trial that lowers the potential enough (Armijo, up to rounding) or halve the step; give up if short.

    Where a full step has lowered it by more than a quadratic would have, take the better of that and twice the step.
    """
    if state.searching[w] == 0:
        return
    share = potential_share(state, instances, motion, points, constraints, rigid, q, rigid.trial, dt, w, member, team)
    trial = team_sum(share)
    if member != 0:
        return
    potential = state.potential[w]
    rounding = wp.float64(1.0e-12) * wp.abs(potential)
    alpha = state.step_length[w]
    if alpha > wp.float64(1.0):
        state.searching[w] = 0
        if not (trial < state.reached[w]):
            state.step_length[w] = wp.float64(1.0)
        return
    if alpha == wp.float64(1.0) and trial < potential + EXTENDED_DECREASE * state.slope[w] - rounding:
        state.reached[w] = trial
        state.step_length[w] = wp.float64(2.0)
        wp.atomic_max(state.any_searching, 0, 1)
        return
    if trial <= potential + SUFFICIENT_DECREASE * alpha * state.slope[w] + rounding:
        state.searching[w] = 0
        return
    alpha *= wp.float64(0.5)
    if alpha < step_length_min:
        alpha = wp.float64(0.0)
        state.searching[w] = 0
    else:
        wp.atomic_max(state.any_searching, 0, 1)
    state.step_length[w] = alpha


check_trials = kernel_over(check_trial, "check_trials", "w", "member")


@wp.func
def refresh_limit(instances: Instances, i: int, refresh_distance: float, dt: float):
    """Return how far a body may move, in strain and rotation, before its elastic Hessian is refreshed [m], rms."""
    inertia = instances.inertia[i] / (dt * dt * instances.youngs_modulus[i])
    return wp.float64(wp.min(refresh_distance, INERTIA_SHARE * inertia) * instances.size[i])


@wp.kernel
def reuse_hessians(
    instances: Instances,
    basis: Basis,
    refresh_distance: float,  # in sizes
    dt: float,
    team: int,
    q: wp.array2d[vec8d],
    # In and out:
    state: NewtonState,
):
    """Start with the elastic Hessian of the step before where no body has bent or turned since.

    The distance leaves out the translation: the basis is mass-orthonormal, so that its coordinates are the basis' mean.
    """
    w, member = wp.tid()
    keep = state.cached[w]
    for i in range(state.instance_start[w], state.instance_start[w + 1]):
        stride = q.shape[1] / 3
        moved = wp.float64(0.0)
        mean = wp.vec3d()
        for e in range(member, q.shape[1], team):
            d = q[i, e] - state.cached_q[i, e]
            moved += wp.dot(d, d)
            mean[e / stride] = mean[e / stride] + wp.dot(d, basis.mean[instances.asset[i], e % stride])
        for axis in range(3):
            part = team_sum(mean[axis])
            mean[axis] = part
        moved = team_sum(moved) - wp.length_sq(mean)
        limit = refresh_limit(instances, i, refresh_distance, dt)
        if not (moved <= limit * limit) or not (state.cached_key[i] == hessian_key(instances, i, dt)):
            keep = 0
    if member == 0:
        state.refresh[w] = 1 - keep


@wp.func
def accept_step(
    instances: Instances,
    rigid: Rigid,
    team: int,
    refresh_interval: int,
    refresh_distance: float,  # in sizes
    dt: float,
    # State in:
    direction: wp.array2d[vec8],
    # In and out:
    q: wp.array2d[vec8d],
    state: NewtonState,
    w: int,
    member: int,
):
    """Take the accepted step; say whether the stiffness is to be refreshed and how friction is to be linearised.

    A world that touches nothing is done with a step below the tolerance; near contacts the residual decides.
    """
    if state.active[w] == 0:
        return
    alpha = state.step_length[w]
    refreshed = state.refresh[w]
    far = int(0)
    away = int(0)
    for i in range(state.instance_start[w], state.instance_start[w + 1]):
        moved = wp.float64(0.0)
        for e in range(member, q.shape[1], team):
            d = vec8d(direction[i, e])
            moved += wp.dot(d, d)
            if refreshed != 0:
                state.cached_q[i, e] = q[i, e]
            if alpha > wp.float64(0.0):
                q[i, e] = q[i, e] + alpha * d
        moved = team_sum(moved)
        if alpha * wp.sqrt(moved) > refresh_limit(instances, i, refresh_distance, dt):
            far = 1
        if refreshed != 0 and member == 0:
            state.cached_key[i] = hessian_key(instances, i, dt)
        if alpha * wp.sqrt(moved) > wp.float64(PROJECTED_DISTANCE * instances.size[i]):
            away = 1
    for j in range(member, rigid.count[w], team):
        if alpha > wp.float64(0.0):
            rigid.r[w, j] = rigid.r[w, j] + alpha * rigid.direction[w, j]
    barrier()
    if member != 0:
        return
    state.iteration[w] = state.iteration[w] + 1
    if refreshed != 0:
        state.cached[w] = 1 - state.project[w]
    stale = state.refresh[w] == 0 or state.project[w] == 0
    state.refresh[w] = far
    slow = state.iteration[w] >= 2 * refresh_interval
    if slow or state.iteration[w] % refresh_interval == 0 or alpha == wp.float64(0.0):
        state.refresh[w] = 1
    if alpha == wp.float64(0.0) or (slow and away == 1):
        state.project[w] = 1
    elif state.project[w] != 0 and away == 0 and state.failures[w] < FAILURES:
        state.project[w] = 0
        state.refresh[w] = 1
    state.exact[w] = 0
    if alpha >= wp.float64(1.0):
        state.exact[w] = 1
    if alpha == wp.float64(0.0) and state.last[w] == 0 and not stale:
        state.active[w] = 0
        state.status[w] = state.status[w] | WORLD_NO_DESCENT
    elif state.last[w] == 1 and state.in_contact[w] == 0:
        state.active[w] = 0
    else:
        wp.atomic_max(state.any_active, 0, 1)


accept_steps = kernel_over(accept_step, "accept_steps", "w", "member")
