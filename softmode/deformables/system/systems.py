"""Which bodies share a linear system, and the systems of a step."""

import numpy as np
import warp as wp

from softmode.deformables.model.lane_kernels import LANES
from softmode.deformables.model.layout import Layout
from softmode.deformables.model.struct_kernels import Instances
from softmode.deformables.system.factor import BlockCholesky


def join_systems(
    layout: Layout, instances: Instances, column_count: int, device: wp.Device
) -> tuple[wp.array, BlockCholesky]:
    """Allocate a linear system per instance or, of several parts, per world; say where instances find theirs.

    Args:
        layout: Layout of the model.
        instances: Its instances, whose ``system`` and ``system_block`` are written.
        column_count: Right-hand columns.
        device: Where the systems lie.

    Returns:
        First system of each world, shape (world_count + 1,), and the systems.
    """
    size, world, part_count = 3 * LANES * layout.block_count, layout.instance_world, layout.part_count
    start, system, part = layout.instance_start, np.arange(layout.instance_count), np.zeros_like(world)
    if part_count > 1:
        start, system, part = np.arange(layout.world_count + 1), world, system - start[world]
    instances.system.assign(system)
    instances.system_block.assign(3 * layout.block_count * part)
    system_world = wp.array(np.repeat(np.arange(layout.world_count), np.diff(start)), dtype=int, device=device)
    systems = BlockCholesky(system_world, part_count * size, column_count, device, part_count)
    return wp.array(start, dtype=int, device=device), systems
