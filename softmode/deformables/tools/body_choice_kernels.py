"""Device side of bodies that take each other's place: where an instance finds its data, and rows without a history.

An instance without a body keeps its room and its parameters, and has no functions, points and samples: what runs over
these passes it by.
"""

import warp as wp

from softmode.deformables.model.declare import struct
from softmode.deformables.model.parameter_kernels import RestQuantities
from softmode.deformables.model.struct_kernels import Instances

wp.set_module_options({"enable_backward": False})


@struct
class BodyRows:
    """What an instance has of its body, at scale 1, and of its material, a row per choice."""

    asset: wp.array[int]
    key: wp.array[wp.int64]
    function_count: wp.array[int]
    driven_count: wp.array[int]
    point_start: wp.array[int]
    point_count: wp.array[int]
    row_start: wp.array[int]
    sample_count: wp.array[int]
    volume: wp.array[wp.float64]  # [m^3]
    area: wp.array[float]  # [m^2]
    size: wp.array[float]  # [m], as all that follow
    tolerance: wp.array[float]
    margin: wp.array[float]
    smoothing: wp.array[float]
    spacing: wp.array[float]
    material_model: wp.array[int]
    viscosity: wp.array[float]  # [s]
    mass_damping: wp.array[float]  # [1/s]


@wp.kernel
def choose_bodies(
    rows: BodyRows,
    choice: wp.array[int],  # (instance_count,), -1 for none
    world_mask: wp.array[wp.bool],
    # Out:
    rest: RestQuantities,
    instances: Instances,
    key_out: wp.array[wp.int64],
):
    """Point the instances of masked worlds to the body that is chosen, or to none."""
    i = wp.tid()
    if not world_mask[instances.world[i]]:
        return
    b = choice[i]
    if b < 0:
        instances.function_count[i] = 0
        instances.driven_count[i] = 0
        instances.point_count[i] = 0
        instances.sample_count[i] = 0
        return
    instances.asset[i] = rows.asset[b]
    instances.function_count[i] = rows.function_count[b]
    instances.driven_count[i] = rows.driven_count[b]
    instances.point_start[i] = rows.point_start[b]
    instances.point_count[i] = rows.point_count[b]
    instances.row_start[i] = rows.row_start[b]
    instances.sample_count[i] = rows.sample_count[b]
    instances.material_model[i] = rows.material_model[b]
    instances.viscosity[i] = rows.viscosity[b]
    instances.mass_damping[i] = rows.mass_damping[b]
    rest.volume[i] = rows.volume[b]
    rest.area[i] = rows.area[b]
    rest.size[i] = rows.size[b]
    rest.tolerance[i] = rows.tolerance[b]
    rest.margin[i] = rows.margin[b]
    rest.smoothing[i] = rows.smoothing[b]
    rest.spacing[i] = rows.spacing[b]
    key_out[i] = rows.key[b]
    for s in range(rows.sample_count[b]):
        rest.radius[instances.particle_start[i] + s] = 0.5 * rows.spacing[b]


@wp.kernel
def copy_rows(
    table: wp.array2d[wp.uint32],  # (choices, words)
    choice: wp.array[int],  # (world_count * slots,), -1 for none
    slots: int,  # choices of a world
    slot: int,  # which of them counts
    first: int,  # first word that is copied
    world_mask: wp.array[wp.bool],
    # Out:
    out: wp.array2d[wp.uint32],  # (world_count, words)
):
    """Copy some words from the row of its choice to every masked world, zeros where it has none."""
    w, k = wp.tid()
    if not world_mask[w]:
        return
    chosen = choice[w * slots + slot]
    value = wp.uint32(0)
    if chosen >= 0:
        value = table[chosen, first + k]
    out[w, first + k] = value


@wp.kernel
def clear_rows(
    world: wp.array[int],  # (instance_count,)
    world_mask: wp.array[wp.bool],
    # Out:
    out: wp.array2d[wp.uint32],  # (instance_count, words)
):
    """Set the rows of the instances in masked worlds to zero."""
    i, k = wp.tid()
    if world_mask[world[i]]:
        out[i, k] = wp.uint32(0)


@wp.kernel
def rows_that_chose(
    choice: wp.array[int],  # (world_count * slots,)
    slots: int,  # choices of a world
    slot: int,  # which of them counts
    wanted: int,
    # Out:
    row_out: wp.array[int],  # (world_count,)
):
    """Write the worlds that chose something, -1 for the others."""
    w = wp.tid()
    row_out[w] = wp.where(choice[w * slots + slot] == wanted, w, -1)
