"""Device side of attachments: pins are held, released or moved per world."""

import warp as wp

from softmode.deformables.model.struct_kernels import Instances, in_mask

wp.set_module_options({"enable_backward": False})


@wp.kernel
def hold_pins(
    instances: Instances,
    instance_start: wp.array[int],  # (world_count + 1,)
    instance_world: wp.array[int],
    world_mask: wp.array[wp.bool],
    local: int,
    first: int,
    sign: float,
    # In and out:
    pin_stiffness: wp.array[float],  # [N/m], negative while released
):
    """Hold (sign 1) or release (sign -1) pins of one body in the masked worlds."""
    w, p = wp.tid()
    i = instance_start[w] + local
    if i >= instance_start[w + 1]:
        return
    if in_mask(instance_world[i], world_mask):
        pin = instances.pin_start[i] + first + p
        pin_stiffness[pin] = sign * wp.abs(pin_stiffness[pin])


@wp.kernel
def move_pins(
    instances: Instances,
    instance_start: wp.array[int],  # (world_count + 1,)
    local: int,
    first: int,
    pose: wp.array[wp.transform],  # (world_count,)
    target: wp.array[wp.vec3d],  # (pin_total,), as the model has it [m]
    # Out:
    target_out: wp.array[wp.vec3d],
):
    """Move the targets of an attachment from where the model has them."""
    w, p = wp.tid()
    i = instance_start[w] + local
    if i >= instance_start[w + 1]:
        return
    pin = instances.pin_start[i] + first + p
    x = wp.vec3(target[pin])
    target_out[pin] = target[pin] + wp.vec3d(wp.transform_point(pose[w], x) - x)


@wp.kernel
def hold_all_pins(
    instances: Instances,
    instance_world: wp.array[int],
    world_mask: wp.array[wp.bool],
    # In and out:
    pin_stiffness: wp.array[float],
):
    """Hold every pin of the masked worlds."""
    i, p = wp.tid()
    if p < instances.pin_count[i] and in_mask(instance_world[i], world_mask):
        pin = instances.pin_start[i] + p
        pin_stiffness[pin] = wp.abs(pin_stiffness[pin])
