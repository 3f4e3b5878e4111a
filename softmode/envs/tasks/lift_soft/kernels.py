"""Device side of LiftSoft: goal, reward, success."""

from enum import IntEnum

import warp as wp

from softmode.envs.reward_kernels import NEAR, StepResult, WorldState, count_held, grasped, tool_position, write

wp.set_module_options({"enable_backward": False})

Term = IntEnum("Term", "reach grasp lift goal hold gentle", start=0)
Metric = IntEnum("Metric", "object_height goal_distance", start=0)


@wp.struct
class Plan:
    """Columns, what is lifted, and when the goal is met."""

    drawn_goal: int  # x, y [m] and how far to rise [m]
    drawn_scale: int
    column_goal: int
    rest_height: wp.array[float]  # of the unscaled object's centre [m]
    radius: wp.array[float]  # from there to its farthest point [m]
    goal_tolerance: float  # [m]
    hold_steps: int


@wp.kernel
def observe(state: WorldState, plan: Plan, result: StepResult):
    """Write the goal, relative to the object and as a position, the rise and the distance."""
    w = wp.tid()
    rest_height = plan.rest_height[w] * state.parameters[w, plan.drawn_scale]
    goal = wp.vec3(
        state.parameters[w, plan.drawn_goal],
        state.parameters[w, plan.drawn_goal + 1],
        rest_height + state.parameters[w, plan.drawn_goal + 2],
    )
    x = state.object_position[w, 0]
    write(result.observation, w, plan.column_goal, goal)
    result.metrics[w, Metric.object_height] = x[2] - rest_height
    result.metrics[w, Metric.goal_distance] = wp.length(goal - x)
    result.marker_place[w] = wp.transform(goal, wp.quat_identity())


@wp.kernel
def evaluate(state: WorldState, plan: Plan, result: StepResult):
    """Reward reaching, grasping, lifting, nearing the goal, and staying there."""
    w = wp.tid()
    offset = state.object_position[w, 0] - tool_position(state, w)
    held_by_both = grasped(state, w)
    if state.stride > 1:
        # fingers may feel another object: only near the first one they hold that one
        near = plan.radius[w] * state.parameters[w, plan.drawn_scale] + NEAR
        held_by_both = held_by_both and wp.length(offset) < near
    grasp = wp.where(held_by_both, 1.0, 0.0)
    rise = result.metrics[w, Metric.object_height]
    distance = result.metrics[w, Metric.goal_distance]
    there = held_by_both and distance <= plan.goal_tolerance
    lifted = wp.clamp(rise / wp.max(state.parameters[w, plan.drawn_goal + 2], 1.0e-3), 0.0, 1.0)
    result.terms[w, Term.reach] = 1.0 - wp.tanh(6.0 * wp.length(offset))
    result.terms[w, Term.grasp] = 0.5 * grasp
    result.terms[w, Term.lift] = 1.0 * lifted * grasp
    result.terms[w, Term.goal] = 2.0 * lifted * grasp * (1.0 - wp.tanh(10.0 * distance))
    result.terms[w, Term.hold] = wp.where(there, 2.0, 0.0)
    count_held(there, plan.hold_steps, result, w)
