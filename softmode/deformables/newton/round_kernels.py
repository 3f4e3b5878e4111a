"""Device side of Newton's iteration in rounds of five launches, for many worlds of one small body each on CUDA.

A round takes every world through an iteration, where its trial step is accepted:

1. ``evaluate_trials``: a thread for each point, contact and row: energies and stress at the trial;
2. ``check_worlds``: a team for each world accepts the trial or shortens it; where it is accepted, contact forces,
   gradient and convergence;
3. ``differentiate_points`` and 4. ``assemble_stiffness``: where the elastic Hessian is renewed;
5. ``direct_worlds``: a team for each world: its system in shared memory, the direction, the next trial.

Within a round one world may try a shorter step while another takes the next. The functions are those of the one launch
of ``one_launch_kernels``. That launch has several times more code than the instruction cache holds, and as many
registers as its hungriest phase; a launch of a round has its own. A round with few worlds left is slow, though: so
rounds go on while more worlds are left than the one launch holds at a time, and it takes each of those to its end.

The slowest world is what all wait for, and worlds that were slow will mostly be slow again. So those of which most
iterations are expected go their whole way in the one launch, beside the rounds of the others.
"""

from functools import cache

import warp as wp

from softmode.deformables.materials.hessian_kernels import hessian
from softmode.deformables.model.declare import Kernel
from softmode.deformables.model.deformation_kernels import elastic_gradient
from softmode.deformables.model.lane_kernels import LANES, WARP, barrier, copy_blocks, rolled, team_sum
from softmode.deformables.model.newton_step_kernels import TRIAL, NewtonStep
from softmode.deformables.newton.search_kernels import (
    accept_step,
    check_convergence,
    check_trial,
    move_functions,
    start_line_search,
    world_potential,
)
from softmode.deformables.potential.evaluate_kernels import (
    evaluate_constraint,
    evaluate_point,
    gradient_number,
    list_acting,
    material_of,
    store_hessian,
)
from softmode.deformables.potential.rigid_row_kernels import evaluate_row
from softmode.deformables.system.assembly_kernels import inertia_of, stiffness_block
from softmode.deformables.system.shared_system_kernels import dynamic_floats, shared_direction_of, sum_forces_of

wp.set_module_options({"enable_backward": False})

BLOCK = 128
"""Threads of a block where threads do not work as a team."""


TEAMS = 672
"""Threads of teams that a multiprocessor takes at a time: what registers are given out for. All measured, see
``benchmarks/JOURNAL.md``."""
ALWAYS = 5
"""Rounds that are taken however few worlds are left."""
BESIDE = 2
"""Most worlds for each multiprocessor that go their whole way beside the rounds.

Without them 4,096 worlds of random actions lose 12 % (plush) and 16 % (beam) on one H200, and grasps gain 2 to 4 %."""
LEVELS = 16
"""Numbers of iterations that are told apart where worlds are ordered by what is expected of them."""
FEWEST = wp.constant(2)
"""Fewest expected iterations with which a world goes beside the rounds."""
FADE = wp.constant(0.5)
"""Iterations by which fewer are expected after a step that took fewer."""


@wp.func
def level_of(expected: float):
    """Return among which worlds one is counted of which so many iterations are expected."""
    return wp.min(int(expected), LEVELS - 1)


@wp.kernel
def expect_iterations(step: NewtonStep):
    """Expect of each world the iterations of its last step, or little fewer than were expected then; count worlds."""
    w = wp.tid()
    expected = wp.max(float(step.state.iteration[w]), step.state.expected[w] - FADE)
    step.state.expected[w] = expected
    wp.atomic_add(step.state.level_count, level_of(expected), 1)


@wp.func
def least_aside(level_count: wp.array[int], room: int):
    """Return the least level, FEWEST at the least, of which, with all above it, there are at most ``room`` worlds."""
    least = int(LEVELS)
    count = int(0)
    while least > FEWEST:
        count += level_count[least - 1]
        if count > room:
            break
        least -= 1
    return least


@wp.kernel
def start_trials(step: NewtonStep, more: int, room: int):
    """Let the first trial of every world be where Newton starts, and choose which worlds go beside the rounds.

    Args:
        step: Newton's tables.
        more: Rounds that there may be besides those which are always taken.
        room: Most worlds that go beside them.
    """
    w, e = wp.tid()
    if w == 0 and e == 0:
        step.state.rounds_left[0] = more
    if e == 0:
        least = least_aside(step.state.level_count, room)
        step.state.aside[w] = wp.where(level_of(step.state.expected[w]) >= least, 1, 0)
        step.state.solving[w] = 0
    i = step.state.instance_start[w]
    if e < step.arrays.q.shape[1]:
        step.arrays.q_trial[i, e] = step.arrays.q[i, e]
    if e < step.rigid.count[w]:
        step.rigid.trial[w, e] = step.rigid.r[w, e]


@wp.kernel(launch_bounds=(BLOCK, 4))
def evaluate_trials(step: NewtonStep, points: int, constraints: int):
    """Evaluate points and rows at the trials, contacts where a step is searched for; see ``tasks`` for the threads."""
    w, t = wp.tid()
    if step.state.active[w] == 0 or step.state.aside[w] != 0:
        return
    i = step.state.instance_start[w]
    q = step.arrays.q_trial
    r = step.rigid.trial
    if t < points:
        evaluate_point(step, step.state.active, q, int(TRIAL), i, t)
    elif t < points + constraints:
        if step.state.searching[w] != 0:
            evaluate_constraint(step, step.state.active, q, r, 0, i, t - points)
    else:
        evaluate_row(step, step.state.active, r, int(TRIAL), w, t - points - constraints)


@wp.kernel(launch_bounds=(BLOCK, 3))
def differentiate_points(step: NewtonStep):
    """Evaluate the Hessian at the points of the worlds that renew it."""
    w, p = wp.tid()
    i = step.state.instance_start[w]
    if step.state.solving[w] == 0 or step.state.refresh[w] == 0 or p >= step.instances.point_count[i]:
        return
    dt = step.options.dt
    point = step.instances.point_start[i] + p
    parameters = material_of(step.instances, step.basis, i, point)
    s = wp.float64(step.instances.scale[i])
    G = elastic_gradient(step.basis.gradient, step.arrays.q_trial, i, point, step.instances.function_count[i], s)
    G_start = G
    if step.instances.viscosity[i] > 0.0:
        G_start = step.points.start[i, p]
    weight = s * step.basis.point_weight[point]
    C = float(weight) * hessian(parameters, G, G_start, dt, step.state.project[w])
    store_hessian(C, i, p, step.points.hessian)


@wp.kernel
def assemble_stiffness(step: NewtonStep):
    """Assemble the stiffness of these worlds."""
    w, chunk, task = wp.tid()
    if step.state.solving[w] != 0:
        stiffness_block(step, step.state.instance_start[w], chunk, task)


@cache
def check_kernel(team: int) -> Kernel:
    """Return the kernel that checks the trials of the worlds, a team of so many threads for each."""

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(team, TEAMS // team))
    def check_worlds(step: NewtonStep, team: int):
        """Accept the trial of each world or shorten it; where it is accepted find the gradient, and whether it is done.

        Says in ``solving`` which worlds need a direction.
        """
        w, member = wp.tid()
        if step.state.active[w] == 0 or step.state.aside[w] != 0:
            return
        i = step.state.instance_start[w]
        q = step.arrays.q_trial
        r = step.rigid.trial
        n = step.rigid.count[w]
        width = step.arrays.q.shape[1]
        found = int(1)
        # a second round for the potential with the normal force that friction goes by
        rounds = int(1) + step.state.searching[w]
        potential = wp.float64(0.0)
        for k in range(2 - rounds, 2):
            rolled()
            if k == 1:
                for e in range(member, step.constraints.count[i], team):
                    rolled()
                    evaluate_constraint(step, step.state.active, q, r, 1, i, e)
                barrier()
            potential = world_potential(step, q, r, w, member, team)
            if k == 0:
                check_trial(step, potential, w, member)
                barrier()
                searching = step.state.searching[w]
                alpha = step.state.step_length[w]
                found = step.state.evaluated[w]
                if searching == 0:
                    accept_step(step, team, w, member)
                    barrier()
                if found == 0:
                    if alpha > wp.float64(0.0):
                        move_functions(step.instances, step.basis, step.arrays, alpha, i, member, team, q)
                    else:
                        copy_blocks(step.arrays.q, q, i, member, team)
                    for j in range(member, n, team):
                        rolled()
                        r[w, j] = step.rigid.r[w, j] + alpha * step.rigid.direction[w, j]
                    barrier()
                if searching == 0:
                    copy_blocks(q, step.arrays.q, i, member, team)
                    for j in range(member, n, team):
                        rolled()
                        step.rigid.r[w, j] = r[w, j]
                if found == 0 or step.state.active[w] == 0:
                    if member == 0:
                        step.state.solving[w] = 0
                    return
        list_acting(step, team, i, member)
        barrier()
        sum_forces_of(step.instances, step.basis, step.points, step.constraints, step.arrays, i, member, team)
        barrier()
        for k in range(member, LANES * width, team):
            rolled()
            gradient_number(step, wp.max(team / WARP, 1), i, k)
        barrier()
        check_convergence(step, potential, team, w, member)
        if member == 0:
            step.state.solving[w] = step.state.active[w]

    return check_worlds


@cache
def direct_kernel(size: int, width: int, team: int) -> Kernel:
    """Return the kernel that finds the directions of the worlds and their next trials, a team of threads for each.

    Args:
        size: Unknowns of the systems.
        width: Their columns.
        team: Threads that share a world.
    """
    dynamic = dynamic_floats(size, width)
    shared_direction = shared_direction_of(size, width)

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(team, TEAMS // team))
    def direct_worlds(step: NewtonStep, team: int):
        """Assemble and solve the system of each world, and start its line search."""
        w, member = wp.tid()
        if wp.static(dynamic > 0):
            _room = wp.tile_empty(shape=wp.static(dynamic), dtype=float, storage="shared")
        if step.state.solving[w] != 0:
            i = step.state.instance_start[w]
            q = step.arrays.q_trial
            r = step.rigid.trial
            # the padding behind the functions carries inertia alone
            inertia = inertia_of(step.instances, step.motion, step.options.dt, i)
            shared_direction(
                inertia,
                step.options.rigid_max,
                step.basis,
                step.constraints,
                step.rigid,
                step.arrays,
                i,
                w,
                member,
                team,
            )
            barrier()
            start_line_search(step, team, w, member)
            barrier()
            searching = step.state.searching[w]
            alpha = step.state.step_length[w]
            if searching == 0:
                accept_step(step, team, w, member)
                if member == 0:
                    step.state.solving[w] = step.state.active[w]
            if alpha > wp.float64(0.0):
                move_functions(step.instances, step.basis, step.arrays, alpha, i, member, team, q)
                for j in range(member, step.rigid.count[w], team):
                    rolled()
                    r[w, j] = step.rigid.r[w, j] + alpha * step.rigid.direction[w, j]
                barrier()
                if searching == 0:
                    copy_blocks(q, step.arrays.q, i, member, team)
                    for j in range(member, step.rigid.count[w], team):
                        rolled()
                        step.rigid.r[w, j] = r[w, j]

    return direct_worlds


@wp.kernel
def count_left(step: NewtonStep, worlds: int, held: int, team: int):
    """Say after a round whether another one is worth it: whether more than ``held`` worlds are left."""
    _all, member = wp.tid()
    count = wp.float64(0.0)
    for w in range(member, worlds, team):
        count += wp.float64(step.state.active[w])
    count = team_sum(count)
    if member == 0:
        rounds = step.state.rounds_left[0]
        step.state.rounds_left[0] = rounds - 1
        step.state.any_left[0] = wp.where(count > wp.float64(held) and rounds > 0, 1, 0)


def tasks(point_max: int, constraint_max: int, row_max: int) -> tuple[int, int, int]:
    """Return the threads of a world in ``evaluate_trials``: for points, for constraints, all, in warps of their own."""
    points, constraints, rows = (-(-count // WARP) * WARP for count in (point_max, constraint_max, row_max))
    return points, constraints, points + constraints + rows
