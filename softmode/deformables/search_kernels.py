"""Device side of Newton's iteration: convergence, trial steps, the sum of the potential, acceptance."""

import warp as wp

from softmode.deformables.factor import LANES, vec8
from softmode.deformables.status import WORLD_ITERATION_LIMIT, WORLD_NO_DESCENT

wp.set_module_options({"enable_backward": False})


@wp.kernel
def check_convergence(
    # Instances:
    function_count: wp.array[int],
    mass: wp.array[wp.float64],
    tolerance: wp.array[float],  # (instance_count,) [m]
    # Worlds:
    instance_start: wp.array[int],
    iteration_max: int,
    force_tolerance: wp.float64,
    dt: wp.float64,
    # State in:
    gradient: wp.array2d[wp.vec3d],
    force: wp.array2d[wp.vec3d],
    pin_count: wp.array[int],
    entry_count: wp.array[int],
    entry_force: wp.array2d[wp.vec3d],
    last: wp.array[int],
    iteration: wp.array[int],
    # In and out:
    active: wp.array[int],
    status: wp.array[int],
):
    """Stop a world whose last step was small and whose residual is small against the forces on each of its bodies.

    The second condition matters in contact: within a step's tolerance friction goes from one side of its cone to the
    other, and a residual is momentum that the other body receives and this one does not.
    """
    w = wp.tid()
    if active[w] == 0 or iteration[w] == 0:
        return
    done = last[w]
    for i in range(instance_start[w], instance_start[w + 1]):
        residual = wp.float64(0.0)
        external = wp.float64(0.0)
        for k in range(function_count[i]):
            residual += wp.length_sq(gradient[i, k])
            external += wp.length_sq(force[i, k])
        scale = wp.sqrt(external)
        for e in range(entry_count[i]):
            scale += wp.length(entry_force[i, e])
        floor = wp.float64(1.0e-3) * mass[i] * wp.float64(tolerance[i]) / (dt * dt)
        if entry_count[i] > pin_count[i] and not (wp.sqrt(residual) <= force_tolerance * scale + floor):
            done = 0
    if done == 1:
        active[w] = 0
    elif iteration[w] >= iteration_max:
        active[w] = 0
        status[w] = status[w] | WORLD_ITERATION_LIMIT


@wp.func
def unknown(direction: wp.array2d[vec8], instance: int, blocks: int, function: int):
    """Return the vec3 of one function out of a component-major solution."""
    lane = function % LANES
    block = function / LANES
    return wp.vec3d(
        wp.float64(direction[instance, block][lane]),
        wp.float64(direction[instance, blocks + block][lane]),
        wp.float64(direction[instance, 2 * blocks + block][lane]),
    )


@wp.kernel
def trial_functions(
    # Instances:
    world: wp.array[int],
    function_count: wp.array[int],
    stride: int,
    # State in:
    searching: wp.array[int],
    step_length: wp.array[wp.float64],
    q: wp.array2d[wp.vec3d],
    direction: wp.array2d[vec8],  # (instance_count, 3 stride / 8)
    # Out:
    q_out: wp.array2d[wp.vec3d],
):
    """Set q_trial = q + alpha dq."""
    i, k = wp.tid()
    w = world[i]
    if searching[w] == 0 or k >= function_count[i]:
        return
    q_out[i, k] = q[i, k] + step_length[w] * unknown(direction, i, stride / LANES, k)


@wp.kernel
def trial_rigid(
    rigid_count: wp.array[int],
    searching: wp.array[int],
    step_length: wp.array[wp.float64],
    r: wp.array2d[wp.float64],
    direction: wp.array2d[wp.float64],
    # Out:
    r_out: wp.array2d[wp.float64],
):
    """Set r_trial = r + alpha dr."""
    w, j = wp.tid()
    if searching[w] == 0 or j >= rigid_count[w]:
        return
    r_out[w, j] = r[w, j] + step_length[w] * direction[w, j]


@wp.kernel
def sum_potential(
    # Instances:
    function_count: wp.array[int],
    point_count: wp.array[int],
    mass: wp.array[wp.float64],
    mass_damping: wp.array[float],
    # Worlds:
    instance_start: wp.array[int],
    rigid_count: wp.array[int],
    # State in:
    selected: wp.array[int],
    q_start: wp.array2d[wp.vec3d],
    q_inertial: wp.array2d[wp.vec3d],
    q: wp.array2d[wp.vec3d],
    force: wp.array2d[wp.vec3d],
    point_energy: wp.array2d[wp.float64],
    entry_count: wp.array[int],
    entry_energy: wp.array2d[wp.float64],
    inertia: wp.array3d[wp.float64],
    r_predicted: wp.array2d[wp.float64],
    r: wp.array2d[wp.float64],
    dt: wp.float64,
    # Out:
    potential_out: wp.array[wp.float64],  # (world_count,) [J]
):
    """Sum the incremental potential of a world, in a fixed order."""
    w = wp.tid()
    if selected[w] == 0:
        return
    half = wp.float64(0.5)
    total = wp.float64(0.0)
    for i in range(instance_start[w], instance_start[w + 1]):
        inertial = half * mass[i] / (dt * dt)
        damping = half * mass[i] * wp.float64(mass_damping[i]) / dt
        for k in range(function_count[i]):
            inertial_step = q[i, k] - q_inertial[i, k]
            step = q[i, k] - q_start[i, k]
            total += inertial * wp.length_sq(inertial_step) + damping * wp.length_sq(step) - wp.dot(force[i, k], step)
        for p in range(point_count[i]):
            total += point_energy[i, p]
        for e in range(entry_count[i]):
            total += entry_energy[i, e]
    for j in range(rigid_count[w]):
        for l in range(rigid_count[w]):
            total += half * (r[w, j] - r_predicted[w, j]) * inertia[w, j, l] * (r[w, l] - r_predicted[w, l])
    potential_out[w] = total


@wp.kernel
def begin_search(
    # Instances:
    function_count: wp.array[int],
    stride: int,
    tolerance: wp.array[float],  # (instance_count,) [m], root mean square
    # Worlds:
    instance_start: wp.array[int],
    rigid_count: wp.array[int],
    rigid_tolerance: float,  # [m or rad]
    stick_range: wp.float64,  # [m]
    # State in:
    active: wp.array[int],
    pin_count: wp.array[int],
    entry_count: wp.array[int],
    gradient: wp.array2d[wp.vec3d],
    direction: wp.array2d[vec8],
    rigid_gradient: wp.array2d[wp.float64],
    rigid_direction: wp.array2d[wp.float64],
    # Out:
    slope_out: wp.array[wp.float64],
    step_length_out: wp.array[wp.float64],
    last_out: wp.array[int],  # (world_count,), 1 where every body moves less than its tolerance
    searching_out: wp.array[int],
    any_searching_out: wp.array[int],
):
    """Compute the slope g . d of each active world and start its line search at alpha = 1.

    A step below the tolerance (in contact, far below the stick range too) is taken in full: there the change of the
    potential drowns in rounding.
    """
    w = wp.tid()
    searching_out[w] = 0
    if active[w] == 0:
        return
    slope = wp.float64(0.0)
    last = int(1)
    blocks = stride / LANES
    for i in range(instance_start[w], instance_start[w + 1]):
        moved = wp.float64(0.0)
        for k in range(function_count[i]):
            dq = unknown(direction, i, blocks, k)
            slope += wp.dot(gradient[i, k], dq)
            moved += wp.length_sq(dq)
        limit = wp.float64(tolerance[i])
        if entry_count[i] > pin_count[i]:
            limit = wp.min(limit, wp.float64(0.1) * stick_range)
        if not (wp.sqrt(moved) <= limit):
            last = 0
    for j in range(rigid_count[w]):
        slope += rigid_gradient[w, j] * rigid_direction[w, j]
        if not (wp.abs(rigid_direction[w, j]) <= wp.float64(rigid_tolerance)):
            last = 0
    slope_out[w] = slope
    step_length_out[w] = wp.float64(1.0)
    last_out[w] = last
    if last == 0:
        searching_out[w] = 1
        wp.atomic_max(any_searching_out, 0, 1)


@wp.kernel
def judge_trial(
    # State in:
    potential: wp.array[wp.float64],
    potential_trial: wp.array[wp.float64],
    slope: wp.array[wp.float64],
    step_length_min: wp.float64,
    # In and out:
    step_length: wp.array[wp.float64],
    searching: wp.array[int],
    # Out:
    any_searching_out: wp.array[int],
):
    """Accept a trial that lowers the potential (Armijo, up to rounding) or halve the step; give up at the minimum."""
    w = wp.tid()
    if searching[w] == 0:
        return
    rounding = wp.float64(1.0e-12) * wp.abs(potential[w])
    alpha = step_length[w]
    if potential_trial[w] <= potential[w] + wp.float64(1.0e-4) * alpha * slope[w] + rounding:
        searching[w] = 0
        return
    alpha *= wp.float64(0.5)
    if alpha < step_length_min:
        alpha = wp.float64(0.0)
        searching[w] = 0
    else:
        wp.atomic_max(any_searching_out, 0, 1)
    step_length[w] = alpha


@wp.kernel
def finish_iteration(
    # Instances:
    function_count: wp.array[int],
    stride: int,
    # Worlds:
    instance_start: wp.array[int],
    rigid_count: wp.array[int],
    renewal: int,
    renewal_distance: wp.float64,  # in tolerances
    tolerance: wp.array[float],  # (instance_count,) [m]
    # State in:
    step_length: wp.array[wp.float64],
    direction: wp.array2d[vec8],
    rigid_direction: wp.array2d[wp.float64],
    last: wp.array[int],
    # In and out:
    active: wp.array[int],
    q: wp.array2d[wp.vec3d],
    r: wp.array2d[wp.float64],
    iteration: wp.array[int],
    renew: wp.array[int],
    exact: wp.array[int],
    status: wp.array[int],
    # Out:
    any_active_out: wp.array[int],
):
    """Take the accepted step; say whether the stiffness is to be renewed and how friction is to be linearised."""
    w = wp.tid()
    if active[w] == 0:
        return
    iteration[w] = iteration[w] + 1
    alpha = step_length[w]
    stale = renew[w] == 0
    renew[w] = 0
    if iteration[w] % renewal == 0 or alpha == wp.float64(0.0):
        renew[w] = 1
    for i in range(instance_start[w], instance_start[w + 1]):
        moved = wp.float64(0.0)
        for k in range(function_count[i]):
            step = alpha * unknown(direction, i, stride / LANES, k)
            moved += wp.length_sq(step)
            q[i, k] = q[i, k] + step
        if wp.sqrt(moved) > renewal_distance * wp.float64(tolerance[i]):
            renew[w] = 1
    for j in range(rigid_count[w]):
        r[w, j] = r[w, j] + alpha * rigid_direction[w, j]
    exact[w] = 0
    if iteration[w] >= 1 and alpha == wp.float64(1.0):
        exact[w] = 1
    if alpha == wp.float64(0.0) and last[w] == 0 and not stale:
        active[w] = 0
        status[w] = status[w] | WORLD_NO_DESCENT
    else:
        wp.atomic_max(any_active_out, 0, 1)
