"""Device side of PressSoft: contact force, reward, success."""

from enum import IntEnum

import warp as wp

from softmode.envs.reward_kernels import StepResult, WorldState, count_held, tool_position

wp.set_module_options({"enable_backward": False})

Term = IntEnum("Term", "reach force hold overshoot", start=0)
Metric = IntEnum("Metric", "contact_force force_error indentation centre_distance", start=0)
GAUGE = wp.constant(0.01)
"""Height of the marker over the pad per newton that is missing [m/N]."""


@wp.struct
class Plan:
    """Columns, what is pressed, with what, and when the goal is met."""

    drawn_goal_force: int  # [N]
    drawn_scale: int
    column_goal_force: int
    column_contact_force: int
    column_missing_force: int
    top: wp.array[float]  # height of every unscaled pad [m]
    tip_length: float  # from the tool point down to the finger tips [m]
    force_tolerance: float  # as a share of the goal
    least_tolerance: float  # [N]
    centre_tolerance: float  # [m]
    hold_steps: int


@wp.kernel
def observe(state: WorldState, plan: Plan, result: StepResult):
    """Write goal force, contact force and their difference; the metrics; and the marker over the plan."""
    w = wp.tid()
    goal = state.parameters[w, plan.drawn_goal_force]
    surface = plan.top[w] * state.parameters[w, plan.drawn_scale]
    p = tool_position(state, w)
    x = state.object_position[w, 0]
    # vertical: what the fingers squeeze each other with adds nothing
    force = state.finger_force[w, 0][2] + state.finger_force[w, 1][2]
    result.observation[w, plan.column_goal_force] = goal
    result.observation[w, plan.column_contact_force] = force
    result.observation[w, plan.column_missing_force] = goal - force
    aside = wp.sqrt((x[0] - p[0]) * (x[0] - p[0]) + (x[1] - p[1]) * (x[1] - p[1]))
    result.metrics[w, Metric.contact_force] = force
    result.metrics[w, Metric.force_error] = force - goal
    result.metrics[w, Metric.indentation] = surface - (p[2] - plan.tip_length)
    result.metrics[w, Metric.centre_distance] = aside
    missing = wp.clamp(goal - force, 0.0, goal)
    place = wp.vec3(x[0] + 0.05, x[1] + 0.05, surface + GAUGE * missing)
    result.marker_place[w] = wp.transform(place, wp.quat_identity())


@wp.kernel
def evaluate(state: WorldState, plan: Plan, result: StepResult):
    """Reward reaching the middle of the pad, the right force, and keeping it; punish far too much."""
    w = wp.tid()
    goal = state.parameters[w, plan.drawn_goal_force]
    force = result.metrics[w, Metric.contact_force]
    error = wp.abs(result.metrics[w, Metric.force_error])
    distance = result.metrics[w, Metric.centre_distance]
    gap = wp.max(-result.metrics[w, Metric.indentation], 0.0)
    aside = wp.max(distance - 0.5 * plan.centre_tolerance, 0.0)
    there = distance <= plan.centre_tolerance and error <= wp.max(plan.force_tolerance * goal, plan.least_tolerance)
    reach = 1.0 - wp.tanh(25.0 * wp.sqrt(gap * gap + aside * aside))
    # from no force on there is a slope towards the goal, steepest at the goal
    match = wp.max(1.0 - wp.tanh(1.5 * error / goal) / wp.tanh(1.5), 0.0)
    result.terms[w, Term.reach] = reach
    result.terms[w, Term.force] = 1.5 * reach * match
    result.terms[w, Term.hold] = wp.where(there, 2.0, 0.0)
    result.terms[w, Term.overshoot] = -wp.clamp((force - 1.3 * goal) / goal, 0.0, 1.0)
    count_held(there, plan.hold_steps, result, w)
