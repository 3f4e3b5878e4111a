"""What the kernels of all tasks read and write, and what a touch, a grasp and a held goal are."""

from enum import IntEnum
from typing import Any

import warp as wp

TOUCH_FORCE = wp.constant(0.02)
"""Force from which a finger counts as touching [N]."""

NEAR = wp.constant(0.02)
"""How far the tool may be beyond an object's farthest point where fingers that feel something hold that object [m]."""


class EndReason(IntEnum):
    """Why an episode ended, ``info["end_reason"]``; what comes after TIME_LIMIT is a failure and terminates.

    The limit of a single environment is that of Gymnasium's ``TimeLimit`` around it, which info does not tell.
    """

    RUNNING = 0
    TIME_LIMIT = 1
    DIVERGED = 2
    """A number of the world's state was not finite."""
    DROPPED = 3
    """The object fell off the table."""
    SPILLED = 4
    """Another object left the container that it belongs in."""
    FAILED = 5
    """A rule of the task itself was broken: its `evaluate` wrote so."""
    ROUGH = 6
    """Force or strain was beyond its limit (`TaskConfig.terminate_when_rough`)."""


@wp.struct
class WorldState:
    """What goals, observations and rewards are functions of, world first."""

    parameters: wp.array2d[float]  # drawn at reset
    object_position: wp.array2d[wp.vec3]  # centres of mass [m]
    object_velocity: wp.array2d[wp.vec3]  # [m/s]
    tool_pose: wp.array[wp.transform]
    finger_force: wp.array2d[wp.vec3]  # [N]
    function_start: wp.array[int]
    q: wp.array[wp.vec3d]  # reduced coordinates [m]
    particle_start: wp.array[int]
    particle_q: wp.array[wp.vec3]  # surface samples [m]
    points: wp.array2d[int]  # those of object 0 that are observed, (world_count, points)
    stride: int  # soft objects per world
    slots: int  # of them those of a set, the first ones
    choice: wp.array[int]  # (world_count * slots,) which object of the set that is, -1 for none


@wp.struct
class StepResult:
    """What the kernels of a task write, world first."""

    observation: wp.array2d[float]
    metrics: wp.array2d[float]
    terms: wp.array2d[float]  # of the reward
    success: wp.array[wp.bool]
    failure: wp.array[int]  # an EndReason
    held: wp.array[int]  # control steps in a row in which the goal was met
    at_goal: wp.array[int]  # bit o: object o may be let go where it is, which is no drop
    marker_place: wp.array[wp.transform]


@wp.func
def write(table: wp.array2d[float], world: int, column: int, values: Any):
    """Write a vector into columns that follow each other."""
    for k in range(len(values)):
        table[world, column + k] = values[k]


@wp.func
def tool_position(state: WorldState, world: int):
    """Return where the tool is [m]."""
    return wp.transform_get_translation(state.tool_pose[world])


@wp.func
def surface_point(state: WorldState, world: int, point: int):
    """Return where an observed surface point of object 0 is [m]."""
    return state.particle_q[state.particle_start[world * state.stride] + state.points[world, point]]


@wp.func
def is_there(state: WorldState, world: int, o: int):
    """Return whether a world has its object o."""
    if o >= state.slots:
        return True
    return state.choice[world * state.slots + o] >= 0


@wp.func
def touches(state: WorldState, world: int, finger: int):
    """Return whether a finger feels an object."""
    return wp.length(state.finger_force[world, finger]) > TOUCH_FORCE


@wp.func
def grasped(state: WorldState, world: int):
    """Return whether both fingers feel an object."""
    return touches(state, world, 0) and touches(state, world, 1)


@wp.func
def touched(state: WorldState, world: int):
    """Return whether any finger feels an object."""
    return touches(state, world, 0) or touches(state, world, 1)


@wp.func
def count_held(met: bool, hold_steps: int, result: StepResult, world: int):
    """Count the control steps in a row in which the goal is met; enough of them are a success."""
    steps = int(0)
    if met:
        steps = result.held[world] + 1
    result.held[world] = steps
    result.success[world] = steps >= hold_steps
