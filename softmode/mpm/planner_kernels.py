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
    left: wp.array[int]
    """Gradients that the segment has left, (1,)."""
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


@wp.struct
class Record:
    """What segments leave behind, row by row until it is read."""

    count: wp.array[int]
    """Rows that are full, (1,)."""
    row: wp.array[int]
    """Row of the segment that ended just now, -1 if it failed, (1,)."""
    settles: wp.array[int]
    """Whether that segment ends without stress and with half of its velocity, (1,)."""
    settling: wp.array[int]
    """Whether all segments do, (1,)."""
    goal: wp.array[wp.float64]
    """Or the losses at which the first does; (W,)."""
    status: wp.array2d[wp.float64]
    """Loss at the end of the segment, and 1 if the world failed, (W, 2)."""


@wp.func
def begins_pass(search: Search, iterations: int):
    """Return whether the gradient at hand is the first of a pass."""
    return search.left[0] % iterations == 0


@wp.kernel(enable_backward=False, module="unique")
def judge_start(search: Search, failure: wp.array2d[int], gradients: int):
    """Take the loss of the state at hand as that of the accepted control."""
    world = wp.tid()
    loss = search.trial_loss[world]
    if failure[world, 0] > 0 or not wp.isfinite(loss):
        loss = wp.float64(wp.inf)
    search.loss[world] = loss
    search.adam_count[world] = 0
    search.left[0] = gradients


@wp.kernel(enable_backward=False, module="unique")
def begin_gradient(search: Search, step: float, iterations: int):
    """Start a pass, if it is time: all worlds, the first length of step again."""
    world = wp.tid()
    if begins_pass(search, iterations):
        search.step[world] = step
        search.active[world] = 1
    search.norm[world] = wp.float64(0.0)
    search.any_searching[0] = 0
    # Without a trial, and after one that was rejected for good, the states are not those of the accepted control.
    search.stale[0] = 1


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
def begin_search(search: Search, tolerance: wp.float64, iterations: int):
    """Begin a line search, unless the world's pass is over or its gradient has all but vanished."""
    world = wp.tid()
    if begins_pass(search, iterations):
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


@wp.kernel(enable_backward=False, module="unique")
def end_gradient(search: Search):
    """Count a gradient."""
    search.left[0] = search.left[0] - 1


@wp.kernel(enable_backward=False, module="unique")
def end_segment(search: Search, failure: wp.array2d[int], record: Record):
    """Judge a segment, whose losses are those of the trial: in which row it is kept, if any, and whether it settles."""
    failed = int(0)
    reached = int(1)
    for world in range(search.trial_loss.shape[0]):
        loss = search.trial_loss[world]
        record.status[world, 0] = loss
        record.status[world, 1] = wp.where(failure[world, 0] > 0, wp.float64(1.0), wp.float64(0.0))
        if failure[world, 0] > 0:
            failed = 1
        if not loss <= record.goal[world]:
            reached = 0
    record.settles[0] = wp.max(record.settling[0], reached)
    record.row[0] = -1
    if failed == 0:
        record.row[0] = record.count[0]
        record.count[0] = record.count[0] + 1


@wp.kernel(enable_backward=False, module="unique")
def hand_over(
    record: Record,
    # State that the segment ends with, and its controls:
    x_in: wp.array2d[Any],
    v_in: wp.array2d[Any],
    C_in: wp.array2d[Any],
    F_in: wp.array2d[Any],
    control: wp.array3d[Any],
    # State that the next begins with:
    x_out: wp.array2d[Any],
    v_out: wp.array2d[Any],
    C_out: wp.array2d[Any],
    F_out: wp.array2d[Any],
    # What is kept of it:
    kept_x: wp.array3d[Any],
    kept_v: wp.array3d[Any],
    kept_F: wp.array3d[Any],
    kept_control: wp.array4d[Any],
):
    """Begin the next segment where one ended, and keep that; what failed is left alone."""
    world, p = wp.tid()
    row = record.row[0]
    if row < 0:
        return
    v = v_in[world, p]
    C = C_in[world, p]
    F = F_in[world, p]
    if record.settles[0] != 0:
        half = type(v[0])(0.5)
        v = half * v
        C = half * C
        F = wp.identity(n=3, dtype=type(half))
    x_out[world, p] = x_in[world, p]
    v_out[world, p] = v
    C_out[world, p] = C
    F_out[world, p] = F
    kept_x[row, world, p] = x_in[world, p]
    kept_v[row, world, p] = v
    kept_F[row, world, p] = F
    for layer in range(control.shape[0]):
        kept_control[row, layer, world, p] = control[layer, world, p]
