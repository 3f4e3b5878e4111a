"""Device side of the planner: Adam's direction, a trial step, and whether it is accepted; world by world."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Search:
    """Line search of every world."""

    loss: wp.array[wp.float64]
    """Loss of the accepted control, (W,)."""
    trial_loss: wp.array[wp.float64]
    """Loss of the trial, (W,)."""
    norm: wp.array[wp.float64]
    """Squared norm of the gradient, (W,)."""
    first_norm: wp.array[wp.float64]
    """That of the first gradient of a layer, (W,)."""
    step: wp.array[float]
    """Length of the trial step, (W,)."""
    adam_count: wp.array[int]
    """Accepted steps of Adam in this segment, t, (W,)."""
    halvings: wp.array[int]
    """Halvings in this search, (W,)."""
    searching: wp.array[int]
    """Whether the world seeks a smaller loss, (W,)."""
    active: wp.array[int]
    """Whether the world's pass goes on, (W,)."""
    any_searching: wp.array[int]
    """Whether any world searches, (1,)."""
    stale: wp.array[int]
    """Whether any world's states are those of a control that was not accepted, (1,)."""
    gradient_count: wp.array[int]
    """Gradients taken, (W,)."""
    trial_count: wp.array[int]
    """Trials taken, (W,)."""


@wp.kernel(enable_backward=False, module="unique")
def begin_pass(search: Search, step: float):
    """Start a pass over a control layer: all worlds, the first length of step again."""
    world = wp.tid()
    search.step[world] = step
    search.active[world] = 1


@wp.kernel(enable_backward=False, module="unique")
def judge_start(search: Search, failure: wp.array2d[int]):
    """Take the loss of the state at hand as that of the accepted control."""
    world = wp.tid()
    loss = search.trial_loss[world]
    if failure[world, 0] > 0 or not wp.isfinite(loss):
        loss = wp.float64(wp.inf)
    search.loss[world] = loss
    search.adam_count[world] = 0


@wp.kernel(enable_backward=False, module="unique")
def gradient_norm(bar: wp.array2d[Any], norm: wp.array[wp.float64], threads: int):
    """Add the squares of a gradient; each of the ``threads`` of a world sums its share."""
    world, thread = wp.tid()
    total = wp.float64(0.0)
    for p in range(thread, bar.shape[1], threads):
        b = bar[world, p]
        total += wp.float64(wp.ddot(b, b))
    wp.atomic_add(norm, world, total)


@wp.kernel(enable_backward=False, module="unique")
def begin_search(search: Search, tolerance: wp.float64, first: int):
    """Begin a line search, unless the world's pass is over or its gradient has all but vanished."""
    world = wp.tid()
    if first != 0:
        search.first_norm[world] = search.norm[world]
    small = search.norm[world] <= tolerance * tolerance * search.first_norm[world]
    if small or not wp.isfinite(search.norm[world]) or not wp.isfinite(search.loss[world]):
        search.active[world] = 0
    search.searching[world] = search.active[world]
    search.halvings[world] = 0
    if search.active[world] != 0:
        search.gradient_count[world] = search.gradient_count[world] + 1
        wp.atomic_max(search.any_searching, 0, 1)
        search.stale[0] = 0


@wp.kernel(enable_backward=False, module="unique")
def adam_direction(
    search: Search,
    bar: wp.array2d[Any],
    # Moments that the last accepted step left:
    first_moment: wp.array2d[Any],
    second_moment: wp.array2d[Any],
    # Moments with this gradient, and the direction:
    first_trial: wp.array2d[Any],
    second_trial: wp.array2d[Any],
    direction: wp.array2d[Any],
):
    """Follow Adam (Kingma and Ba 2015) with the gradient at unit norm; eps 1e-5 stands outside of the root."""
    world, p = wp.tid()
    if search.searching[world] != 0:
        g = bar[world, p]
        length = type(g[0, 0])(wp.sqrt(search.norm[world]))
        t = float(search.adam_count[world] + 1)
        scale_m = type(length)(1.0 - wp.pow(0.9, t))
        scale_s = type(length)(1.0 - wp.pow(0.999, t))
        g = g / length
        m = type(length)(0.9) * first_moment[world, p] + type(length)(0.1) * g
        s = type(length)(0.999) * second_moment[world, p] + type(length)(0.001) * wp.cw_mul(g, g)
        d = m / scale_m
        for a in range(3):
            for b in range(3):
                d[a, b] = d[a, b] / (wp.sqrt(s[a, b] / scale_s) + type(length)(1.0e-5))
        first_trial[world, p] = m
        second_trial[world, p] = s
        direction[world, p] = d


@wp.kernel(enable_backward=False, module="unique")
def try_control(search: Search, accepted: wp.array2d[Any], direction: wp.array2d[Any], control: wp.array2d[Any]):
    """Set the control of the trial: A - a d; the accepted one where the world does not search."""
    world, p = wp.tid()
    A = accepted[world, p]
    if search.searching[world] != 0:
        A = A - type(A[0, 0])(search.step[world]) * direction[world, p]
    control[world, p] = A


@wp.kernel(enable_backward=False, module="unique")
def judge_trial(search: Search, failure: wp.array2d[int], most_halvings: int, accepted_now: wp.array[int]):
    """Accept a trial that lowers the loss; else halve the step, and after too many leave the pass."""
    world = wp.tid()
    accepted_now[world] = 0
    if search.searching[world] != 0:
        search.trial_count[world] = search.trial_count[world] + 1
        loss = search.trial_loss[world]
        if failure[world, 0] == 0 and wp.isfinite(loss) and loss < search.loss[world]:
            search.loss[world] = loss
            search.adam_count[world] = search.adam_count[world] + 1
            search.searching[world] = 0
            accepted_now[world] = 1
        else:
            search.step[world] = 0.5 * search.step[world]
            search.halvings[world] = search.halvings[world] + 1
            if search.halvings[world] > most_halvings:
                search.searching[world] = 0
                search.active[world] = 0
                wp.atomic_max(search.stale, 0, 1)
        if search.searching[world] != 0:
            wp.atomic_max(search.any_searching, 0, 1)


@wp.kernel(enable_backward=False, module="unique")
def keep_trial(
    accepted_now: wp.array[int],
    control: wp.array2d[Any],
    first_trial: wp.array2d[Any],
    second_trial: wp.array2d[Any],
    accepted: wp.array2d[Any],
    first_moment: wp.array2d[Any],
    second_moment: wp.array2d[Any],
):
    """Keep control and moments of the worlds whose trial was accepted just now."""
    world, p = wp.tid()
    if accepted_now[world] != 0:
        accepted[world, p] = control[world, p]
        first_moment[world, p] = first_trial[world, p]
        second_moment[world, p] = second_trial[world, p]
