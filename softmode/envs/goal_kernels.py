"""Device side of tasks whose goal is a place of the object: goals in the observation, the reward of two goals."""

import warp as wp

from softmode.envs.reward_kernels import StepResult, count_held

wp.set_module_options({"enable_backward": False})


@wp.struct
class GoalColumns:
    """First columns of the observation."""

    object_position: int
    goal: int  # as the task writes it
    achieved_goal: int
    desired_goal: int


@wp.struct
class GoalRules:
    """What the reward depends on beside the goals."""

    goal_size: int
    sparse: int
    goal_tolerance: float  # [m]
    hold_steps: int


@wp.func
def goal_distance(
    achieved: wp.array2d[float],
    achieved_column: int,
    desired: wp.array2d[float],
    desired_column: int,
    size: int,
    w: int,
):
    """Return how far two places are apart [m]."""
    total = float(0.0)
    for k in range(size):
        d = achieved[w, achieved_column + k] - desired[w, desired_column + k]
        total += d * d
    return wp.sqrt(total)


@wp.func
def goal_reward(distance: float, rules: GoalRules):
    """Return 0 at the goal and -1 elsewhere, or the distance with a minus sign [m]."""
    reward = -distance
    if rules.sparse != 0:
        reward = -1.0
        if distance <= rules.goal_tolerance:
            reward = 0.0
    return reward


@wp.kernel
def observe_goals(columns: GoalColumns, rules: GoalRules, result: StepResult):
    """Write both goals."""
    w = wp.tid()
    for k in range(rules.goal_size):
        result.observation[w, columns.achieved_goal + k] = result.observation[w, columns.object_position + k]
        result.observation[w, columns.desired_goal + k] = result.observation[w, columns.goal + k]


@wp.kernel
def evaluate_goals(columns: GoalColumns, rules: GoalRules, result: StepResult):
    """Reward nearness to the goal or being there; the goal is met within the tolerance."""
    w = wp.tid()
    seen = result.observation  # bounded by now, as the goals are that learners compute rewards from
    distance = goal_distance(seen, columns.achieved_goal, seen, columns.desired_goal, rules.goal_size, w)
    result.terms[w, 0] = goal_reward(distance, rules)
    count_held(distance <= rules.goal_tolerance, rules.hold_steps, result, w)


@wp.kernel
def compute_goal_reward(
    achieved: wp.array2d[float],
    desired: wp.array2d[float],
    rules: GoalRules,
    # Out:
    reward: wp.array[float],
):
    """Compute the reward of any pairs of goals as `evaluate_goals` does."""
    n = wp.tid()
    reward[n] = goal_reward(goal_distance(achieved, 0, desired, 0, rules.goal_size, n), rules)
