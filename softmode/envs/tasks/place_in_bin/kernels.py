"""Device side of PlaceInBin: the bin as seen from tool and objects, reward, success, spills."""

from enum import IntEnum

import warp as wp

from softmode.envs.reward_kernels import (
    NEAR,
    EndReason,
    StepResult,
    WorldState,
    count_held,
    grasped,
    is_there,
    tool_position,
    touched,
    write,
)

wp.set_module_options({"enable_backward": False})

Term = IntEnum("Term", "reach grasp carry release rest gentle", start=0)
Metric = IntEnum("Metric", "object_height bin_distance others_inside", start=0)


LONGEST = wp.constant(0.5)
"""Way of a toy from which its potential is 0 [m]."""


@wp.struct
class Plan:
    """Columns, the bin and the toys that are to lie in it, and when the goal is met."""

    drawn_scale: int
    column_goal: int
    column_goal_offset: int
    column_object_goal: int
    column_other_offsets: int  # column of the observation; zero where there are no others
    rim: wp.vec3  # centre of the bin's opening [m]
    half: wp.vec2  # half of its inner edges [m]
    margin: float  # of the part of the bin over which to lower the object, from its walls [m]
    wall: float  # thickness of the walls [m]
    floor: float  # height of the bin's floor [m]
    highest: float  # height of the centre of what counts as inside [m]
    heights: wp.array2d[float]  # of the unscaled toys' centres at rest [m], (world_count, objects)
    radius: wp.array2d[float]  # from there to their farthest points [m], (world_count, slots)
    dropped: float  # height under which another toy than the first is lost [m]
    clearance: float  # over the rim while carrying [m]
    rest_speed: float  # [m/s]
    light: float  # force of a finger that counts half in letting go [N]
    hold_steps: int


@wp.func
def beyond(x: wp.vec3, centre: wp.vec3, half: wp.vec2):
    """Return the horizontal distance of a point from a rectangle, 0 inside [m]."""
    dx = wp.max(wp.abs(x[0] - centre[0]) - half[0], 0.0)
    dy = wp.max(wp.abs(x[1] - centre[1]) - half[1], 0.0)
    return wp.sqrt(dx * dx + dy * dy)


@wp.func
def inside_bin(plan: Plan, x: wp.vec3):
    """Return whether an object with this centre is in the bin."""
    return beyond(x, plan.rim, plan.half) == 0.0 and x[2] <= plan.highest


@wp.func
def over_bin(plan: Plan, x: wp.vec3):
    """Return whether nothing is lost by letting an object go: it is in the bin, or what falls, falls into it."""
    return inside_bin(plan, x) or beyond(x, plan.rim, plan.half - wp.vec2(plan.margin, plan.margin)) == 0.0


@wp.func
def toy_at_hand(state: WorldState, plan: Plan, w: int):
    """Return the toy whose turn it is: the first that is not in the bin, else the first."""
    for o in range(state.slots):
        if is_there(state, w, o) and not inside_bin(plan, state.object_position[w, o]):
            return o
    return int(0)


@wp.kernel
def observe(state: WorldState, plan: Plan, result: StepResult):
    """Write the ways to the bin and to the other objects, the distance, and how many of these are inside."""
    w = wp.tid()
    rim = plan.rim
    x = state.object_position[w, 0]
    write(result.observation, w, plan.column_goal, rim)
    write(result.observation, w, plan.column_goal_offset, rim - tool_position(state, w))
    write(result.observation, w, plan.column_object_goal, rim - x)
    toy = toy_at_hand(state, plan, w)
    inside = float(0.0)
    for o in range(state.stride):
        other = state.object_position[w, o]
        if o != toy and is_there(state, w, o) and inside_bin(plan, other):
            inside += 1.0
        if o >= state.slots:
            write(result.observation, w, plan.column_other_offsets + 3 * (o - state.slots), other - x)
    now = state.object_position[w, toy]
    result.metrics[w, Metric.object_height] = now[2]
    result.metrics[w, Metric.bin_distance] = beyond(now, rim, plan.half)
    result.metrics[w, Metric.others_inside] = inside


@wp.func
def way_to_go(plan: Plan, x: wp.vec3, low: float):
    """Return how far a held toy still has to be moved: up to where it clears the rim, across, and down [m].

    Near the middle of the bin it need not be so high; the way is continuous, and longer for a toy that is too high.

    Args:
        plan: The bin.
        x: Centre of the toy [m].
        low: Height of its centre at rest on the table [m].
    """
    aside = beyond(x, plan.rim, plan.half - wp.vec2(plan.margin, plan.margin))
    bottom = plan.floor + low
    clear = bottom + (plan.rim[2] + plan.clearance - plan.floor) * wp.clamp(aside / plan.margin, 0.0, 1.0)
    return 2.0 * wp.max(clear, x[2]) - x[2] - bottom + aside


@wp.func
def add_toy(state: WorldState, plan: Plan, w: int, o: int, at_hand: bool, share: float, result: StepResult):
    """Add a toy's share of the reward for reaching, grasping, carrying and letting go; each rises along the task."""
    x = state.object_position[w, o]
    size = state.parameters[w, plan.drawn_scale]
    distance = wp.length(x - tool_position(state, w))
    reach = 1.0 - wp.tanh(5.0 * distance)
    grasp = float(0.0)
    free = float(0.0)
    inside = inside_bin(plan, x)
    over = over_bin(plan, x)
    # fingers may feel another object: only near this one they hold it
    if over or (grasped(state, w) and distance < size * plan.radius[w, o] + NEAR):
        grasp = 1.0
    carry = grasp * wp.max(1.0 - way_to_go(plan, x, plan.heights[w, o] * size) / LONGEST, 0.0)
    if over:
        reach = 1.0
        free = 1.0
        if at_hand:  # the less the fingers squeeze, the better
            force = 0.5 * (wp.length(state.finger_force[w, 0]) + wp.length(state.finger_force[w, 1]))
            free = 1.0 / (1.0 + force / plan.light)
    if inside:
        carry = 1.0
    result.terms[w, Term.reach] += share * reach
    result.terms[w, Term.grasp] += 0.5 * share * grasp
    result.terms[w, Term.carry] += 3.0 * share * carry
    result.terms[w, Term.release] += 2.0 * share * free


@wp.kernel
def evaluate(state: WorldState, plan: Plan, result: StepResult):
    """Reward reaching, grasping, carrying, letting go and leaving the toys at rest, one after another."""
    w = wp.tid()
    toy = toy_at_hand(state, plan, w)
    count = int(0)
    at_goal = int(0)
    resting = not touched(state, w)
    for o in range(state.stride):
        if is_there(state, w, o):
            resting = resting and inside_bin(plan, state.object_position[w, o])
            if over_bin(plan, state.object_position[w, o]):
                at_goal = at_goal | (1 << o)
            if o < state.slots:
                count += 1
                resting = resting and wp.length(state.object_velocity[w, o]) <= plan.rest_speed
    for term in range(result.terms.shape[1]):
        result.terms[w, term] = 0.0
    for o in range(state.slots):
        # what is in the bin has earned its share, what has to wait none
        if is_there(state, w, o) and (o == toy or inside_bin(plan, state.object_position[w, o])):
            add_toy(state, plan, w, o, o == toy, 1.0 / float(count), result)
    result.terms[w, Term.rest] = wp.where(resting, 2.0, 0.0)
    result.at_goal[w] = at_goal
    count_held(resting, plan.hold_steps, result, w)
    walls = plan.half + wp.vec2(plan.wall, plan.wall)
    for o in range(1, state.stride):
        x = state.object_position[w, o]
        if o >= state.slots:
            if not (beyond(x, plan.rim, walls) == 0.0):
                result.failure[w] = EndReason.SPILLED
        elif is_there(state, w, o) and not (x[2] >= plan.dropped):
            result.failure[w] = EndReason.DROPPED
