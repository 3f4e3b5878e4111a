"""What Newton's iteration goes by and what its phases hand on, and sums of outer products in blocks of eight."""

from typing import Any

import warp as wp

from softmode.deformables.model.declare import struct
from softmode.deformables.model.lane_kernels import LANES, mat88, vec8, vec8d
from softmode.deformables.model.struct_kernels import (
    Basis,
    Instances,
    Motion,
    NewtonState,
    PointConstraints,
    Points,
    Rigid,
)

wp.set_module_options({"enable_backward": False})


@struct
class Systems:
    """Systems of one size, N unknowns in parts, with M right-hand columns, a multiple of eight."""

    world: wp.array[int]  # (system_count,)
    matrix: wp.array3d[vec8]  # (system_count, N, (N + M) / 8), of the first N columns the upper triangle
    scalars: wp.array3d[float]  # (system_count, N, N + M), the same memory number by number
    pattern: wp.array3d[int]  # (system_count, part_count, part_count), related parts, upper triangle; which ones exist
    diagonal: wp.array2d[vec8]  # (system_count, N): diagonal blocks of U with inverse pivots
    bounds: wp.array2d[wp.vec2]  # (system_count, N / 8): least pivots of eight rows, and what rounding may take of them
    indefinite: wp.array[int]  # (system_count,), 1 where a pivot had to be raised by more than rounding
    right: wp.array2d[float]  # (system_count, N), scratch of the solution
    solution: wp.array2d[vec8]  # (system_count, N / 8)


ENERGIES = wp.constant(0)
"""What an evaluation at points and rows finds: energies alone;"""
ALL = wp.constant(1)
"""those with stress and Hessian, less what the trial that became the iterate has found already;"""
TRIAL = wp.constant(2)
"""those of a trial step with the stress, which serve if it is accepted. Contacts have their energies alone then: their
forces wait for the normal force that friction goes by next."""

mat38d: Any = wp.types.matrix(shape=(3, LANES), dtype=wp.float64)


@struct
class NewtonOptions:
    """How the iteration goes, see ``SolverReducedOptions``."""

    iteration_max: int
    force_tolerance: wp.float64
    stick_range: wp.float64  # eps of the friction potential for this step [m]
    step_length_min: wp.float64
    refresh_interval: int
    refresh_distance: float  # in sizes
    rigid_max: int  # joint dofs that there is room for
    factor_width: int  # columns that a thread of the factorisation takes at a time
    stiffness_slabs: int  # parts of the points that one thread assembles one after another
    dt: wp.float64


@struct
class NewtonArrays:
    """What the phases hand on, shape (instance_count, 3 block_count) where not said."""

    q: wp.array2d[vec8d]
    q_trial: wp.array2d[vec8d]
    gradient: wp.array2d[vec8d]  # [N]; zero for driven functions
    reaction: wp.array2d[vec8d]  # [N]; what holds the driven functions, zero for the others
    gradient_chunk: wp.array3d[vec8d]  # (instance_count, chunk_count, 3 block_count) [N]
    stiffness: wp.array4d[vec8]  # (instance_count, chunk_count, 3 stride, 3 block_count), upper triangle
    pins: wp.array3d[vec8]  # (instance_count, stride, block_count), upper triangle
    rigid_tolerance: wp.array[float]  # (world_count,) [m or rad]
    system_start: wp.array[int]  # (world_count + 1,)
    systems: Systems
    direction: wp.array2d[vec8]
    turn: wp.array[wp.vec3d]  # (instance_count,), rotation that is in the direction [rad], 0 where it is small
    turn_centre: wp.array[wp.vec3d]  # (instance_count,), centre of mass of the iterate [m]
    turn_shift: wp.array[wp.vec3d]  # (instance_count,), its motion in the direction [m]


@struct
class NewtonStep:
    """All that Newton's iteration reads and writes in a step.

    It is larger than 8 kB: hand its members, not all of it, to a function that a function of a kernel calls and to
    native code. The CUDA compiler copies a struct of that size there for every thread.
    """

    instances: Instances
    basis: Basis
    motion: Motion
    points: Points
    constraints: PointConstraints
    rigid: Rigid
    state: NewtonState
    options: NewtonOptions
    arrays: NewtonArrays


@wp.func
def add_outer(block: mat88, left: vec8, right: vec8):
    """Return block + left right^T, in one update per row: see ``lane_kernels``."""
    for a in range(LANES):
        block[a] = block[a] + left[a] * right
    return block


@wp.func
def add_outer_3d(block: mat38d, left: wp.vec3d, right: vec8d):
    """Return block + left right^T, likewise, for three components."""
    for a in range(3):
        block[a] = block[a] + left[a] * right
    return block
