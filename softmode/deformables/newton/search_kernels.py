"""Device side of Newton's iteration: the sum of the potential, convergence, trial steps, acceptance."""

import warp as wp

from softmode.deformables.model.declare import kernel_over
from softmode.deformables.model.lane_kernels import (
    LANES,
    WARP,
    barrier,
    by_eights,
    column_of,
    copy_blocks,
    number_of,
    rolled,
    set_number,
    single_of,
    team_sum,
    team_sum3,
    team_sum33,
    vec8,
    vec8d,
    warp_sum2,
)
from softmode.deformables.model.newton_step_kernels import NewtonArrays, NewtonOptions, NewtonStep, mat38d
from softmode.deformables.model.status import WORLD_ITERATION_LIMIT, WORLD_NO_DESCENT, WORLD_NOT_FINITE
from softmode.deformables.model.struct_kernels import (
    VANISHING,
    Basis,
    Instances,
    Motion,
    PointConstraints,
    Points,
    Rigid,
    blocks_of,
    exists,
    first_coupled,
    has_contacts,
    hessian_key,
    instance_end,
    pushes,
)
from softmode.deformables.potential.spin_kernels import (
    axial,
    centre_of_mass,
    rest_block,
    rotation_of,
    tensor_of_inertia,
    unknown_block,
)

wp.set_module_options({"enable_backward": False})

PHASES = wp.get_module(f"{__name__}.phases")
"""What only launches per phase need, see :func:`softmode.deformables.model.declare.kernel_over`."""
INERTIA_SHARE = wp.constant(0.01)
"""A Hessian serves further iterations while strains have changed it by less than this fraction of the inertia, which
is all that resists the rotation of a stiff body: beyond, small steps would pass for convergence."""
PROJECTED_DISTANCE = wp.constant(0.01)
"""A projected Hessian is kept while steps are larger than this fraction of the size: far from the minimum Newton's own
is likely to be indefinite again."""
FAILURES = wp.constant(2)
"""Indefinite Hessians after which a step keeps to the projected one until it is near the minimum:"""
NEAR_DISTANCE = wp.constant(1.0e-3)
"""its steps are smaller than this fraction of the size. There the projected one converges linearly only."""
NEAR_FAILURES = wp.constant(5)
"""Indefinite Hessians after which it keeps to the projected one even there."""
TURN_LEAST = wp.constant(wp.float64(1.0e-4))
"""Size of a Newton step, over that of the body (rms), from which on its rotation is a finite one: below, the strain of
a linear one is far less than the tolerance."""
SHORT_STEP = wp.constant(wp.float64(0.0625))
"""Step length below which Newton's own Hessian is given up for the projected one: such steps lead nowhere."""
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
    instances: Instances,
    motion: Motion,
    points: Points,
    constraints: PointConstraints,
    rigid: Rigid,
    instance_start: wp.array[int],
    dt: wp.float64,
    q: wp.array2d[vec8d],
    r: wp.array2d[wp.float64],
    w: int,
    member: int,
    team: int,
):
    """Return one thread's share of the incremental potential of a world [J], in a fixed order."""
    half = wp.float64(0.5)
    total = wp.float64(0.0)
    for i in range(instance_start[w], instance_end(instances, instance_start, w)):
        rolled()
        c = motion.rate[i]
        inertial = half * instances.mass[i] * c * c / (dt * dt)
        damping = half * instances.mass[i] * wp.float64(instances.mass_damping[i]) * c / dt
        if by_eights() != 0:
            for e in range(member, q.shape[1], team):
                x = q[i, e]
                away = x - motion.q_inertial[i, e]
                moved = x - motion.q_rate[i, e]
                ahead = x - motion.q_start[i, e]
                kinetic = inertial * wp.dot(away, away) + damping * wp.dot(moved, moved)
                total += kinetic - wp.dot(motion.force[i, e], ahead)
        else:
            for k in range(member, LANES * q.shape[1], team):
                rolled()
                at = number_of(q, i, k)
                from_target = at - number_of(motion.q_inertial, i, k)
                from_rate = at - number_of(motion.q_rate, i, k)
                total += inertial * from_target * from_target + damping * from_rate * from_rate
                total -= number_of(motion.force, i, k) * (at - number_of(motion.q_start, i, k))
        for p in range(member, instances.point_count[i], team):
            rolled()
            total += points.energy[i, p]
        for e in range(member, constraints.count[i], team):
            rolled()
            total += constraints.energy[i, e]
    n = rigid.count[w]
    for t in range(member, n * n, team):
        rolled()
        j = t / n
        l = t % n
        total += half * (r[w, j] - rigid.predicted[w, j]) * rigid.inertia[w, j, l] * (r[w, l] - rigid.predicted[w, l])
    for k in range(member, rigid.row_count[w], team):
        rolled()
        total += rigid.row_energy[w, k]
    return total


@wp.func
def world_potential(step: NewtonStep, q: wp.array2d[vec8d], r: wp.array2d[wp.float64], w: int, member: int, team: int):
    """Return the incremental potential of a world at (q, r) [J] to each of its threads; every one must call it."""
    share = potential_share(
        step.instances,
        step.motion,
        step.points,
        step.constraints,
        step.rigid,
        step.state.instance_start,
        step.options.dt,
        q,
        r,
        w,
        member,
        team,
    )
    return team_sum(share)


@wp.func
def square_share(values: wp.array2d[vec8d], i: int, member: int, team: int):
    """Return one thread's share of the squared length of row ``i``."""
    total = wp.float64(0.0)
    if by_eights() != 0:
        for e in range(member, values.shape[1], team):
            total += wp.dot(values[i, e], values[i, e])
    else:
        for k in range(member, LANES * values.shape[1], team):
            rolled()
            value = number_of(values, i, k)
            total += value * value
    return total


@wp.func
def step_shares(arrays: NewtonArrays, i: int, member: int, team: int):
    """Return one thread's shares of gradient . direction of a body [J] and of the direction's squared length [m^2]."""
    slope = wp.float64(0.0)
    squared = wp.float64(0.0)
    if by_eights() != 0:
        for e in range(member, arrays.direction.shape[1], team):
            d = vec8d(arrays.direction[i, e])
            slope += wp.dot(arrays.gradient[i, e], d)
            squared += wp.dot(d, d)
    else:
        for k in range(member, LANES * arrays.direction.shape[1], team):
            rolled()
            value = wp.float64(single_of(arrays.direction, i, k))
            slope += number_of(arrays.gradient, i, k) * value
            squared += value * value
    return slope, squared


@wp.func
def rigid_excess(
    instances: Instances,
    constraints: PointConstraints,
    rigid: Rigid,
    instance_start: wp.array[int],
    force_tolerance: wp.float64,
    rigid_tolerance: wp.array[float],
    w: int,
    member: int,
    team: int,
):
    """Return how many of one thread's joint dofs have a residual above the tolerance of the forces on them.

    A warp adds up the forces on a dof, each thread some of them.
    """
    excess = wp.float64(0.0)
    lanes = wp.min(team, WARP)
    lane = member % lanes
    for j in range(member / lanes, rigid.count[w], team / lanes):
        rolled()
        residual = wp.float64(0.0)
        scale = wp.float64(0.0)
        if lane == 0:
            scale = rigid.inertia[w, j, j] * wp.float64(rigid_tolerance[w])
        for k in range(lane, rigid.count[w], lanes):
            rolled()
            residual += rigid.inertia[w, j, k] * (rigid.r[w, k] - rigid.predicted[w, k])
        for i in range(instance_start[w], instance_end(instances, instance_start, w)):
            rolled()
            for k in range(first_coupled(instances, i) + lane, constraints.acting_count[i], lanes):
                rolled()
                e = constraints.acting[i, k]
                if j >= constraints.dof_begin[i, e] and j < constraints.dof_end[i, e]:
                    force = wp.dot(wp.vec3d(constraints.jacobian[i, e, j]), constraints.force[i, e])
                    residual += force
                    scale += wp.abs(force)
        for k in range(lane, rigid.row_count[w], lanes):
            rolled()
            force = wp.float64(rigid.row_jacobian[w, k, j]) * rigid.row_force[w, k]
            residual += force
            scale += wp.abs(force)
        sums = warp_sum2(wp.vec2d(residual, scale))
        if lane == 0 and not (wp.abs(sums[0]) <= force_tolerance * sums[1]):
            excess += wp.float64(1.0)
    return excess


@wp.func
def moves_freely(row: wp.array2d[vec8], r: int, driven: int, function_count: int):
    """Return 1 if a row of the basis moves with functions after the first ``driven``: they vanish on exact regions."""
    for b in range(driven / LANES, blocks_of(function_count)):
        values = row[r, b]
        for lane in range(LANES):
            if LANES * b + lane >= driven and wp.abs(values[lane]) > VANISHING:
                return 1
    return 0


@wp.func
def check_convergence(step: NewtonStep, potential: wp.float64, team: int, w: int, member: int):
    """Stop a world whose residual is small, and whose last step was where nothing is touched.

    Near contacts the residual decides, of bodies and of joints: it is momentum that the other side receives and this
    one does not. A small step says little there, because within it friction goes from one side of its cone to the
    other; and to wait for one after the residual is small costs an iteration or two more than the forces need. This
    test comes before the Hessian is assembled and factorised.
    """
    if step.state.active[w] == 0:
        return
    dt = step.options.dt
    done = int(1)
    if step.state.iteration[w] == 0:
        done = 0
    for i in range(step.state.instance_start[w], instance_end(step.instances, step.state.instance_start, w)):
        rolled()
        if not exists(step.instances, i):
            continue
        if done == 1 and not pushes(step.instances, step.constraints, i):
            done = step.state.last[w]
        elif done == 1:
            residual = square_share(step.arrays.gradient, i, member, team)
            external = square_share(step.motion.force, i, member, team)
            scale = wp.float64(0.0)
            driven = step.instances.driven_count[i]
            count = step.instances.function_count[i]
            alone = step.constraints.count[i] - step.constraints.pair_count[i]
            for k in range(member, step.constraints.acting_count[i], team):
                rolled()
                at = step.constraints.acting[i, k]
                # what presses on an exact region is no force on the rest: a foot stuck in a pot meets meganewtons
                free = int(1)
                if driven > 0 and at < alone:
                    free = moves_freely(step.basis.row, step.constraints.row[i, at], driven, count)
                if free != 0:
                    scale += wp.length(step.constraints.force[i, at])
            sums = team_sum3(wp.vec3d(residual, external, scale))
            residual = sums[0]
            scale = wp.sqrt(sums[1]) + sums[2]
            floor = wp.float64(1.0e-5) * step.instances.mass[i] * wp.float64(step.instances.tolerance[i]) / (dt * dt)
            if not (wp.sqrt(residual) <= step.options.force_tolerance * scale + floor):
                done = 0
    if done == 1 and step.rigid.count[w] > 0:
        excess = rigid_excess(
            step.instances,
            step.constraints,
            step.rigid,
            step.state.instance_start,
            step.options.force_tolerance,
            step.arrays.rigid_tolerance,
            w,
            member,
            team,
        )
        excess = team_sum(excess)
        if excess > wp.float64(0.0):
            done = 0
    if member != 0:
        return
    step.state.evaluated[w] = 0
    step.state.potential[w] = potential
    if wp.isnan(potential):
        step.state.active[w] = 0
        step.state.status[w] = step.state.status[w] | WORLD_NOT_FINITE
        return
    if step.state.iteration[w] == 0:
        return
    if done == 1:
        step.state.active[w] = 0
    elif step.state.iteration[w] >= step.options.iteration_max:
        step.state.active[w] = 0
        step.state.status[w] = step.state.status[w] | WORLD_ITERATION_LIMIT


@wp.kernel(module=PHASES, enable_backward=False)
def check_iterates(step: NewtonStep, team: int):
    """Sum the potential of the iterate and check its convergence."""
    w, member = wp.tid()
    if step.state.active[w] == 0:
        return
    potential = world_potential(step, step.arrays.q, step.rigid.r, w, member, team)
    check_convergence(step, potential, team, w, member)


@wp.func
def direction_block(arrays: NewtonArrays, i: int, b: int):
    """Return eight coordinates of the direction."""
    stride = arrays.direction.shape[1] / 3
    block = mat38d()
    for axis in range(3):
        block[axis] = vec8d(arrays.direction[i, axis * stride + b])
    return block


@wp.func
def direction_column(arrays: NewtonArrays, i: int, k: int):
    """Return the three coordinates of function ``k`` of the direction."""
    n = LANES * (arrays.direction.shape[1] / 3)
    d = arrays.direction
    return wp.vec3d(wp.vec3(single_of(d, i, k), single_of(d, i, n + k), single_of(d, i, 2 * n + k)))


@wp.func
def find_turn(instances: Instances, basis: Basis, arrays: NewtonArrays, i: int, member: int, team: int):
    """Find the rigid part of the direction: motion of the centre of mass, and the rotation with its angular momentum.

    Along a straight line a rotation stretches, which a stiff body resists long before the rotation is done.
    """
    a = instances.asset[i]
    n = instances.function_count[i]
    X = wp.vec3d()
    shift = wp.vec3d()
    S = wp.mat33d()
    moment = wp.vec3d()
    if by_eights() != 0:
        X = centre_of_mass(basis, arrays.q, a, n, i, member, team)
        for b in range(member, blocks_of(n), team):
            shift += direction_block(arrays, i, b) * basis.mean[a, b]
        shift = team_sum3(shift)
        U = wp.mat33d()
        for b in range(member, blocks_of(n), team):
            rest, one = rest_block(basis, a, b)
            r = unknown_block(arrays.q, i, b) + rest - wp.outer(X, one)
            S += r * wp.transpose(r)
            U += r * wp.transpose(direction_block(arrays, i, b))
        moment = axial(U)
    else:
        for k in range(member, n, team):
            rolled()
            c = basis.linear[a, k]
            mean = number_of(basis.mean, a, k)
            X += mean * (column_of(arrays.q, i, k) + wp.vec3d(c[0], c[1], c[2]))
            shift += mean * direction_column(arrays, i, k)
        X = team_sum3(X)
        shift = team_sum3(shift)
        for k in range(member, n, team):
            rolled()
            c = basis.linear[a, k]
            arm = column_of(arrays.q, i, k) + wp.vec3d(c[0], c[1], c[2]) - c[3] * X
            S += wp.outer(arm, arm)
            moment += wp.cross(arm, direction_column(arrays, i, k))
    S = team_sum33(S)
    moment = team_sum3(moment)
    if member == 0:
        arrays.turn_centre[i] = X
        arrays.turn_shift[i] = shift
        arrays.turn[i] = wp.inverse(tensor_of_inertia(S, instances.size[i])) * moment


@wp.func
def moved_block(instances: Instances, basis: Basis, arrays: NewtonArrays, i: int, b: int, alpha: wp.float64):
    """Return eight coordinates of the iterate moved by alpha times the direction, its rotation a finite one."""
    rest, one = rest_block(basis, instances.asset[i], b)
    shift = arrays.turn_shift[i]
    turn = arrays.turn[i]
    r = unknown_block(arrays.q, i, b) + rest - wp.outer(arrays.turn_centre[i], one)
    bent = direction_block(arrays, i, b) - wp.outer(shift, one) - wp.skew(turn) * r
    centre = arrays.turn_centre[i] + alpha * shift
    return rotation_of(alpha * turn) * (r + alpha * bent) + wp.outer(centre, one) - rest


@wp.func
def moved_column(instances: Instances, basis: Basis, arrays: NewtonArrays, i: int, k: int, alpha: wp.float64):
    """Return the coordinates of one function likewise."""
    c = basis.linear[instances.asset[i], k]
    rest = wp.vec3d(c[0], c[1], c[2])
    shift = arrays.turn_shift[i]
    turn = arrays.turn[i]
    r = column_of(arrays.q, i, k) + rest - c[3] * arrays.turn_centre[i]
    bent = direction_column(arrays, i, k) - c[3] * shift - wp.cross(turn, r)
    centre = arrays.turn_centre[i] + alpha * shift
    return rotation_of(alpha * turn) * (r + alpha * bent) + c[3] * centre - rest


@wp.func
def move_functions(
    instances: Instances,
    basis: Basis,
    arrays: NewtonArrays,
    alpha: wp.float64,
    i: int,
    member: int,
    team: int,
    # Out; it may be ``arrays.q``:
    q_out: wp.array2d[vec8d],
):
    """Move the coordinates of an instance by alpha times the direction."""
    stride = q_out.shape[1] / 3
    turn = arrays.turn[i]
    if by_eights() != 0:
        if wp.dot(turn, turn) == wp.float64(0.0):
            for e in range(member, q_out.shape[1], team):
                q_out[i, e] = arrays.q[i, e] + alpha * vec8d(arrays.direction[i, e])
            return
        for b in range(member, stride, team):
            block = moved_block(instances, basis, arrays, i, b, alpha)
            for axis in range(3):
                q_out[i, axis * stride + b] = block[axis]
        return
    if wp.dot(turn, turn) == wp.float64(0.0):
        for k in range(member, LANES * q_out.shape[1], team):
            rolled()
            set_number(q_out, i, k, number_of(arrays.q, i, k) + alpha * wp.float64(single_of(arrays.direction, i, k)))
        return
    n = LANES * stride
    for k in range(member, instances.function_count[i], team):
        rolled()
        moved = moved_column(instances, basis, arrays, i, k, alpha)
        set_number(q_out, i, k, moved[0])
        set_number(q_out, i, n + k, moved[1])
        set_number(q_out, i, 2 * n + k, moved[2])


@wp.func
def start_line_search(step: NewtonStep, team: int, w: int, member: int):
    """Compute the slope g . d of each active world and start its line search at alpha = 1.

    Where Newton's own Hessian turns out to be indefinite the world stays put and takes the projected one next.

    A step below the tolerance (in contact, far below the stick range too) is taken in full: there the change of the
    potential drowns in rounding. If the residual is still too large after it, the next small step is searched for:
    between sticking and slipping, full steps may go round in circles.
    """
    if step.state.active[w] == 0:
        if member == 0:
            step.state.searching[w] = 0
        return
    slope = wp.float64(0.0)
    last = int(1)
    unsound = int(0)
    for i in range(step.state.instance_start[w], instance_end(step.instances, step.state.instance_start, w)):
        rolled()
        if step.state.project[w] == 0 and step.arrays.systems.indefinite[step.instances.system[i]] != 0:
            unsound = 1
        along, moved = step_shares(step.arrays, i, member, team)
        slope += along
        moved = team_sum(moved)
        limit = wp.float64(step.instances.tolerance[i])
        if has_contacts(step.instances, step.constraints, i):
            limit = wp.min(limit, wp.float64(0.1) * step.options.stick_range)
        if not (wp.sqrt(moved) <= limit):
            last = 0
        if wp.sqrt(moved) > TURN_LEAST * wp.float64(step.instances.size[i]) and step.instances.driven_count[i] == 0:
            find_turn(step.instances, step.basis, step.arrays, i, member, team)
        elif member == 0:
            step.arrays.turn[i] = wp.vec3d()
    far = wp.float64(0.0)
    # dofs that take part are in contact: a light body moves where the soft one stays
    limit = wp.min(wp.float64(step.arrays.rigid_tolerance[w]), wp.float64(0.01) * step.options.stick_range)
    for j in range(member, step.rigid.count[w], team):
        rolled()
        slope += step.rigid.gradient[w, j] * step.rigid.direction[w, j]
        if not (wp.abs(step.rigid.direction[w, j]) <= limit):
            far += wp.float64(1.0)
    sums = team_sum3(wp.vec3d(slope, far, wp.float64(0.0)))
    if member != 0:
        return
    if sums[1] > wp.float64(0.0):
        last = 0
    step.state.searching[w] = 0
    step.state.slope[w] = sums[0]
    step.state.step_length[w] = wp.float64(1.0)
    small_again = wp.where(step.state.iteration[w] > 0, step.state.last[w], 0)
    step.state.last[w] = last
    if unsound == 1:
        step.state.step_length[w] = wp.float64(0.0)
        step.state.last[w] = 0
        step.state.failures[w] = step.state.failures[w] + 1
    elif last == 1 and step.state.project[w] != 0 and step.state.iteration[w] < PROJECTED_ITERATIONS:
        # too stiff a matrix takes small steps: that says nothing of the distance to the minimum
        step.state.last[w] = 0
    elif last == 0 or small_again == 1:
        step.state.searching[w] = 1
        wp.atomic_max(step.state.any_searching, 0, 1)


start_line_searches = kernel_over(start_line_search, "start_line_searches", "w", "member")


@wp.kernel
def trial_functions(step: NewtonStep, team: int):
    """Move q_trial to q + alpha dq."""
    i, member = wp.tid()
    w = step.instances.world[i]
    if step.state.searching[w] == 0:
        return
    alpha = step.state.step_length[w]
    move_functions(step.instances, step.basis, step.arrays, alpha, i, member, team, step.arrays.q_trial)


@wp.kernel
def trial_rigid(step: NewtonStep):
    """Set r_trial = r + alpha dr."""
    w, j = wp.tid()
    if step.state.searching[w] == 0 or j >= step.rigid.count[w]:
        return
    step.rigid.trial[w, j] = step.rigid.r[w, j] + step.state.step_length[w] * step.rigid.direction[w, j]


@wp.func
def check_trial(step: NewtonStep, trial: wp.float64, w: int, member: int):
    """Accept a trial that lowers the potential enough (Armijo, up to rounding) or halve the step; give up if short.

    Where a full step has lowered it by more than a quadratic would have, take the better of that and twice the step.
    That helps in the onset of contact, from the first iterations on until it does not; friction that gives way looks
    the same.
    What has been evaluated of an accepted trial serves the next iteration.
    """
    if member != 0:
        return
    potential = step.state.potential[w]
    rounding = wp.float64(1.0e-12) * wp.abs(potential) + step.state.rounding[w]
    alpha = step.state.step_length[w]
    if alpha > wp.float64(1.0):
        step.state.searching[w] = 0
        step.state.evaluated[w] = 1
        if not (trial < step.state.reached[w]):
            step.state.step_length[w] = wp.float64(1.0)
            step.state.evaluated[w] = 0
            step.state.extends[w] = 0
        return
    longer = trial < potential + EXTENDED_DECREASE * step.state.slope[w] - rounding
    if alpha == wp.float64(1.0) and longer and step.state.extends[w] != 0:
        step.state.reached[w] = trial
        step.state.step_length[w] = wp.float64(2.0)
        wp.atomic_max(step.state.any_searching, 0, 1)
        return
    if step.state.iteration[w] > 0:
        step.state.extends[w] = 0
    if trial <= potential + SUFFICIENT_DECREASE * alpha * step.state.slope[w] + rounding:
        step.state.searching[w] = 0
        step.state.evaluated[w] = 1
        return
    alpha *= wp.float64(0.5)
    if alpha < step.options.step_length_min:
        alpha = wp.float64(0.0)
        step.state.searching[w] = 0
    else:
        wp.atomic_max(step.state.any_searching, 0, 1)
    step.state.step_length[w] = alpha


@wp.kernel(module=PHASES, enable_backward=False)
def check_trials(step: NewtonStep, team: int):
    """Sum the potential of the trial step of a searching world and check it."""
    w, member = wp.tid()
    if step.state.searching[w] == 0:
        return
    trial = world_potential(step, step.arrays.q_trial, step.rigid.trial, w, member, team)
    check_trial(step, trial, w, member)


@wp.func
def refresh_limit(instances: Instances, i: int, options: NewtonOptions):
    """Return how far a body may move, in strain and rotation, before its elastic Hessian is refreshed [m], rms."""
    dt = float(options.dt)
    inertia = instances.inertia[i] / (dt * dt * instances.youngs_modulus[i])
    return wp.float64(wp.min(options.refresh_distance, INERTIA_SHARE * inertia) * instances.size[i])


@wp.kernel
def reuse_hessians(step: NewtonStep, team: int):
    """Start with the elastic Hessian of the step before where no body has bent or turned since.

    The distance leaves out the translation: the basis is mass-orthonormal, so that its coordinates are the basis' mean.
    """
    w, member = wp.tid()
    keep = step.state.cached[w]
    q = step.arrays.q
    for i in range(step.state.instance_start[w], instance_end(step.instances, step.state.instance_start, w)):
        stride = q.shape[1] / 3
        moved = wp.float64(0.0)
        mean = wp.vec3d()
        for e in range(member, q.shape[1], team):
            d = q[i, e] - step.state.cached_q[i, e]
            moved += wp.dot(d, d)
            mean[e / stride] = mean[e / stride] + wp.dot(d, step.basis.mean[step.instances.asset[i], e % stride])
        for axis in range(3):
            part = team_sum(mean[axis])
            mean[axis] = part
        moved = team_sum(moved) - wp.length_sq(mean)
        limit = refresh_limit(step.instances, i, step.options)
        if not (moved <= limit * limit) or not (
            step.state.cached_key[i] == hessian_key(step.instances, i, float(step.options.dt))
        ):
            keep = 0
    if member == 0:
        step.state.refresh[w] = 1 - keep


@wp.func
def accept_step(step: NewtonStep, team: int, w: int, member: int):
    """Say after a step whether the stiffness is to be refreshed and how friction is to be linearised.

    A world that touches nothing is done with a step below the tolerance; near contacts the residual decides. The step
    itself is taken by ``accept_steps``, or by the one launch.
    """
    if step.state.active[w] == 0:
        return
    alpha = step.state.step_length[w]
    refreshed = step.state.refresh[w]
    far = int(0)
    away = int(0)
    allowed = int(NEAR_FAILURES)
    for i in range(step.state.instance_start[w], instance_end(step.instances, step.state.instance_start, w)):
        rolled()
        _slope, moved = step_shares(step.arrays, i, member, team)
        moved = team_sum(moved)
        if refreshed != 0:
            copy_blocks(step.arrays.q, step.state.cached_q, i, member, team)
        if alpha * wp.sqrt(moved) > refresh_limit(step.instances, i, step.options):
            far = 1
        if refreshed != 0 and member == 0:
            step.state.cached_key[i] = hessian_key(step.instances, i, float(step.options.dt))
        if alpha * wp.sqrt(moved) > wp.float64(PROJECTED_DISTANCE * step.instances.size[i]):
            away = 1
        if alpha * wp.sqrt(moved) > wp.float64(NEAR_DISTANCE * step.instances.size[i]):
            allowed = FAILURES
    barrier()
    if member != 0:
        return
    step.state.iteration[w] = step.state.iteration[w] + 1
    if refreshed != 0:
        step.state.cached[w] = 1 - step.state.project[w]
    stale = step.state.refresh[w] == 0 or step.state.project[w] == 0
    step.state.refresh[w] = far
    slow = step.state.iteration[w] >= 2 * step.options.refresh_interval
    if slow or step.state.iteration[w] % step.options.refresh_interval == 0 or alpha == wp.float64(0.0):
        step.state.refresh[w] = 1
    # it is not friction's curvature that throws the step off, so Newton's own Hessian is all but indefinite
    astray = step.state.project[w] == 0 and step.state.exact[w] == 0 and alpha < SHORT_STEP
    if alpha == wp.float64(0.0) or (slow and away == 1):
        step.state.project[w] = 1
    elif astray:
        step.state.project[w] = 1
        step.state.refresh[w] = 1
        step.state.failures[w] = step.state.failures[w] + 1
    elif step.state.project[w] != 0 and away == 0 and step.state.failures[w] < allowed:
        step.state.project[w] = 0
        step.state.refresh[w] = 1
    step.state.exact[w] = 0
    if alpha >= wp.float64(1.0):
        step.state.exact[w] = 1
    if alpha == wp.float64(0.0) and step.state.last[w] == 0 and not stale:
        step.state.active[w] = 0
        step.state.status[w] = step.state.status[w] | WORLD_NO_DESCENT
    elif step.state.last[w] == 1 and step.state.in_contact[w] == 0:
        step.state.active[w] = 0
        step.state.evaluated[w] = 0
    else:
        wp.atomic_max(step.state.any_active, 0, 1)


@wp.kernel(module=PHASES, enable_backward=False)
def accept_steps(step: NewtonStep, team: int):
    """Take the accepted step of an active world."""
    w, member = wp.tid()
    if step.state.active[w] == 0:
        return
    alpha = step.state.step_length[w]
    accept_step(step, team, w, member)
    if alpha > wp.float64(0.0):
        for i in range(step.state.instance_start[w], step.state.instance_start[w + 1]):
            move_functions(step.instances, step.basis, step.arrays, alpha, i, member, team, step.arrays.q)
        for j in range(member, step.rigid.count[w], team):
            step.rigid.r[w, j] = step.rigid.r[w, j] + alpha * step.rigid.direction[w, j]
