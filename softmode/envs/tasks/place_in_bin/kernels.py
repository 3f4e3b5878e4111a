"""Device side of PlaceInBin: the bin as seen from tool and objects, reward, success, spills."""

from enum import IntEnum

import warp as wp

from softmode.envs.end_reason import EndReason
from softmode.envs.reward_kernels import (
    NEAR,
    StepResult,
    WorldState,
    count_held,
    grasped,
    tool_position,
    touched,
    write,
)

wp.set_module_options({"enable_backward": False})

Term = IntEnum("Term", "reach grasp lift carry lower release rest", start=0)
Metric = IntEnum("Metric", "object_height bin_distance others_inside", start=0)


@wp.struct
class Drawn:
    """Columns of the parameters."""

    scale: int


@wp.struct
class Columns:
    """Columns of the observation."""

    goal: int
    goal_offset: int
    object_goal: int


@wp.struct
class Plan:
    """Columns, the bin and the toy that is to lie in it, and when the goal is met."""

    drawn: Drawn
    columns: Columns
    other_offsets: int  # column of the observation; zero where there are no others
    rim: wp.vec3  # centre of the bin's opening [m]
    half: wp.vec2  # half of its inner edges [m]
    margin: float  # of the part of the bin over which to lower the object, from its walls [m]
    wall: float  # thickness of the walls [m]
    floor: float  # height of the bin's floor [m]
    highest: float  # height of the centre of what counts as inside [m]
    rest_height: wp.array[float]  # of the unscaled toy's centre [m], (world_count,)
    radius: wp.array[float]  # from there to its farthest point [m], (world_count,)
    clearance: float  # over the rim while carrying [m]
    rest_speed: float  # [m/s]
    hold_steps: int


@wp.func
def beyond(x: wp.vec3, centre: wp.vec3, half: wp.vec2):
    """Return the horizontal distance of a point from a rectangle, 0 inside [m]."""
    dx = wp.max(wp.abs(x[0] - centre[0]) - half[0], 0.0)
    dy = wp.max(wp.abs(x[1] - centre[1]) - half[1], 0.0)
    return wp.sqrt(dx * dx + dy * dy)


@wp.kernel
def observe(state: WorldState, plan: Plan, result: StepResult):
    """Write the ways to the bin and to the other objects, the distance, and how many of these are inside."""
    w = wp.tid()
    rim = plan.rim
    x = state.object_position[w, 0]
    write(result.observation, w, plan.columns.goal, rim)
    write(result.observation, w, plan.columns.goal_offset, rim - tool_position(state, w))
    write(result.observation, w, plan.columns.object_goal, rim - x)
    inside = float(0.0)
    for o in range(1, state.stride):
        other = state.object_position[w, o]
        if beyond(other, rim, plan.half) == 0.0 and other[2] <= plan.highest:
            inside += 1.0
        write(result.observation, w, plan.other_offsets + 3 * (o - 1), other - x)
    result.metrics[w, Metric.object_height] = x[2]
    result.metrics[w, Metric.bin_distance] = beyond(x, rim, plan.half)
    result.metrics[w, Metric.others_inside] = inside


@wp.kernel
def evaluate(state: WorldState, plan: Plan, result: StepResult):
    """Reward grasping, lifting, carrying, lowering, letting go and leaving the object at rest."""
    w = wp.tid()
    rim = plan.rim
    x = state.object_position[w, 0]
    size = state.parameters[w, plan.drawn.scale]
    distance = wp.length(x - tool_position(state, w))
    inside = result.metrics[w, Metric.bin_distance] == 0.0 and x[2] <= plan.highest
    # fingers may feel another object: only near the first one they hold that one
    grip = grasped(state, w) and distance < size * plan.radius[w] + NEAR
    low = plan.rest_height[w] * size
    carried = rim[2] + low + plan.clearance
    aside = beyond(x, rim, plan.half - wp.vec2(plan.margin, plan.margin))
    held_or_in = wp.where(grip or inside, 1.0, 0.0)
    lift = wp.clamp((x[2] - low) / (carried - low), 0.0, 1.0)
    lowered = float(0.0)
    if aside == 0.0:
        lift = 1.0
        lowered = wp.clamp((carried - x[2]) / (carried - low - plan.floor), 0.0, 1.0)
    near = 1.0 - wp.tanh(6.0 * aside)
    reach = 1.0 - wp.tanh(5.0 * distance)
    if inside:
        reach = 1.0
        lift = 1.0
        near = 1.0
    free = inside and not touched(state, w)
    complete = int(result.metrics[w, Metric.others_inside]) == state.stride - 1
    resting = free and complete and wp.length(state.object_velocity[w, 0]) <= plan.rest_speed
    result.terms[w, Term.reach] = reach
    result.terms[w, Term.grasp] = 0.5 * held_or_in
    result.terms[w, Term.lift] = lift * held_or_in
    result.terms[w, Term.carry] = lift * near * held_or_in
    result.terms[w, Term.lower] = lowered * held_or_in
    result.terms[w, Term.release] = wp.where(free, 1.0, 0.0)
    result.terms[w, Term.rest] = wp.where(resting, 2.0, 0.0)
    count_held(resting, plan.hold_steps, result, w)
    walls = plan.half + wp.vec2(plan.wall, plan.wall)
    for o in range(1, state.stride):
        if not (beyond(state.object_position[w, o], rim, walls) == 0.0):
            result.failure[w] = EndReason.SPILLED
