"""Device side of tasks made of terms: weights, held goals, failures, levels of a curriculum."""

import warp as wp

from softmode.envs.reward_kernels import StepResult, count_held

wp.set_module_options({"enable_backward": False})


@wp.kernel
def weigh(
    values: wp.array2d[float],  # (terms, worlds)
    weight: wp.array[float],
    # Out:
    terms: wp.array2d[float],
):
    """Write the terms of the reward, each its value times its weight."""
    w = wp.tid()
    for k in range(weight.shape[0]):
        terms[w, k] = weight[k] * values[k, w]


@wp.kernel
def write_metric(values: wp.array[float], column: int, result: StepResult):
    """Write a figure of every world."""
    w = wp.tid()
    result.metrics[w, column] = values[w]


@wp.kernel
def hold(met: wp.array[wp.bool], hold_steps: int, result: StepResult):
    """Count the steps in a row in which the goal is met."""
    w = wp.tid()
    count_held(met[w], hold_steps, result, w)


@wp.kernel
def fail(broken: wp.array[wp.bool], reason: int, result: StepResult):
    """End the episodes in which a rule is broken."""
    w = wp.tid()
    if broken[w]:
        result.failure[w] = reason


@wp.kernel
def advance_level(
    world_mask: wp.array[wp.bool],
    episode: wp.array[int],
    next_level: wp.array[float],
    column: int,  # of the parameter
    size: int,
    low: wp.array2d[float],  # (kinds, columns)
    high: wp.array2d[float],
    kind: wp.array[int],  # of worlds
    easy_low: wp.array[float],
    easy_high: wp.array[float],
    # In, out:
    level: wp.array[float],
    parameters: wp.array2d[float],
):
    """Set the level of worlds that start, 0 after a seed, and take what was drawn from the range to the level's."""
    w = wp.tid()
    if not world_mask[w]:
        return
    now = wp.clamp(next_level[w], 0.0, 1.0)
    if episode[w] == 0:
        now = 0.0
    level[w] = now
    for k in range(size):
        a = low[kind[w], column + k]
        b = high[kind[w], column + k]
        share = float(0.0)
        if b > a:
            share = (parameters[w, column + k] - a) / (b - a)
        least = easy_low[k] + now * (a - easy_low[k])
        most = easy_high[k] + now * (b - easy_high[k])
        parameters[w, column + k] = least + share * (most - least)
