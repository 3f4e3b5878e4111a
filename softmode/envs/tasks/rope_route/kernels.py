"""Device side of RopeRoute: the rope's axis, its winding about the pegs, reward and success."""

import warp as wp

from softmode.envs.grasp_kernels import grasped

wp.set_module_options({"enable_backward": False})


@wp.func
def peg_side(route: float, peg: int):
    """Return the side on which the rope is to pass a peg: +1 away from the robot, -1 towards it, alternating."""
    side = wp.where(route < 0.0, -1.0, 1.0)
    return wp.where(peg % 2 == 0, side, -side)


@wp.func
def rope_goal(parameters: wp.array2d[float], route: int, goal: int, peg_position: wp.array[wp.vec2], world: int):
    """Return where the rope's end is to lie [m]: aside of the last peg, on the rope's side, and beyond it along y."""
    last = peg_position.shape[0] - 1
    side = peg_side(parameters[world, route], last)
    aside = side * parameters[world, goal]
    return peg_position[last] + wp.vec2(aside, parameters[world, goal + 1])


@wp.func
def turn(a: wp.vec2, b: wp.vec2):
    """Return the signed angle from a to b [rad]."""
    return wp.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])


@wp.kernel
def place_rope(
    world_mask: wp.array[wp.bool],
    parameters: wp.array2d[float],
    position_parameter: int,  # of the rope's end [m]
    yaw_parameter: int,  # from the y axis [rad]
    scale_parameter: int,
    half_length: float,  # of the unscaled rope [m]
    height: float,  # of the unscaled rope's axis [m]
    gap: float,  # [m]
    # Out:
    position_out: wp.array[wp.vec3d],
    yaw_out: wp.array[wp.float64],
):
    """Put the rope down along y, its end where the position says."""
    w = wp.tid()
    if not world_mask[w]:
        return
    scale = parameters[w, scale_parameter]
    yaw = 0.5 * wp.pi + parameters[w, yaw_parameter]
    x = parameters[w, position_parameter] - scale * half_length * wp.cos(yaw)
    y = parameters[w, position_parameter + 1] - scale * half_length * wp.sin(yaw)
    position_out[w] = wp.vec3d(wp.float64(x), wp.float64(y), wp.float64(height * scale + gap))
    yaw_out[w] = wp.float64(yaw)


@wp.kernel
def trace_axis(
    function_start: wp.array[int],
    rest: wp.array[wp.vec3d],
    basis: wp.array2d[wp.float64],  # at the points of the axis, (points, functions)
    q: wp.array[wp.vec3d],
    # Out:
    axis: wp.array2d[wp.vec3],
):
    """Deform the points of the axis: x = X + sum_k b_k(X) q_k."""
    w, i = wp.tid()
    start = function_start[w]
    x = rest[i]
    for k in range(basis.shape[1]):
        x += basis[i, k] * q[start + k]
    axis[w, i] = wp.vec3(x)


@wp.kernel
def observe(
    parameters: wp.array2d[float],
    route_parameter: int,
    goal_parameter: int,
    peg_position: wp.array[wp.vec2],
    axis: wp.array2d[wp.vec3],
    grasp_point: int,
    tool_pose: wp.array[wp.transform],
    goal_column: int,
    rope_column: int,
    marker_height: float,  # [m]
    # Out:
    observation: wp.array2d[float],
    metrics: wp.array2d[float],
    marker_place: wp.array[wp.transform],
):
    """Write goal and sides; the rope's end, what there is to grasp, and the winding; the metrics and the marker."""
    w = wp.tid()
    tool = wp.transform_get_translation(tool_pose[w])
    goal = rope_goal(parameters, route_parameter, goal_parameter, peg_position, w)
    pegs = peg_position.shape[0]
    points = axis.shape[1]
    end = axis[w, points - 1]
    grasp = axis[w, grasp_point]
    along = end - grasp
    for k in range(2):
        observation[w, goal_column + k] = goal[k]
        observation[w, goal_column + 2 + k] = goal[k] - tool[k]
        observation[w, rope_column + 6 + k] = goal[k] - end[k]
    for k in range(3):
        observation[w, rope_column + k] = grasp[k] - tool[k]
        observation[w, rope_column + 3 + k] = along[k]
    least = float(1.0e9)
    for p in range(pegs):
        angle = float(0.0)
        before = wp.vec2(axis[w, 0][0], axis[w, 0][1]) - peg_position[p]
        for i in range(1, points):
            after = wp.vec2(axis[w, i][0], axis[w, i][1]) - peg_position[p]
            angle += turn(before, after)
            before = after
        side = peg_side(parameters[w, route_parameter], p)
        observation[w, goal_column + 4 + p] = side
        observation[w, rope_column + 8 + p] = side * angle
        least = wp.min(least, side * angle)
    top = float(0.0)
    for i in range(points):
        top = wp.max(top, axis[w, i][2])
    metrics[w, 0] = wp.length(wp.vec2(end[0], end[1]) - goal)
    metrics[w, 1] = least
    metrics[w, 2] = top
    metrics[w, 3] = wp.length(grasp - tool)
    marker_place[w] = wp.transform(wp.vec3(goal[0], goal[1], marker_height), wp.quat_identity())


@wp.kernel
def evaluate(
    observation: wp.array2d[float],
    winding_column: int,
    pegs: int,
    metrics: wp.array2d[float],  # distance to the goal [m], least winding [rad], highest point, distance to grasp [m]
    finger_force: wp.array2d[wp.vec3],
    winding: float,  # that counts as passing a peg [rad]
    tolerance: float,  # [m]
    peg_height: float,  # [m]
    hold_steps: int,
    # In, out:
    held: wp.array[int],
    # Out:
    terms: wp.array2d[float],
    success: wp.array[wp.bool],
):
    """Reward reaching, grasping, passing every peg on its side, nearing the goal, and being there."""
    w = wp.tid()
    near = metrics[w, 3]
    passed = float(0.0)
    for p in range(pegs):
        passed += wp.clamp(observation[w, winding_column + p] / winding, -1.0, 1.0) / float(pegs)
    low = metrics[w, 2] < peg_height
    routed = low and metrics[w, 1] >= winding
    there = routed and metrics[w, 0] <= tolerance
    steps = int(0)
    if there:
        steps = held[w] + 1
    held[w] = steps
    terms[w, 0] = 1.0 - wp.tanh(10.0 * near)
    terms[w, 1] = wp.where(grasped(finger_force, w) and near < 0.03, 0.5, 0.0)
    terms[w, 2] = 2.0 * passed
    terms[w, 3] = (1.0 + wp.max(passed, 0.0)) * (1.0 - wp.tanh(5.0 * metrics[w, 0]))
    terms[w, 4] = wp.where(there, 2.0, 0.0)
    success[w] = steps >= hold_steps
