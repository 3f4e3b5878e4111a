"""Device side of grips: where gripped points shall be at the end of the next step, and how stiffly they are held."""

import warp as wp

from softmode.deformables.model.declare import struct
from softmode.deformables.model.lane_kernels import LANES
from softmode.deformables.model.struct_kernels import Basis, Instances, blocks_of

wp.set_module_options({"enable_backward": False})

PULL = wp.constant(1)
"""Kind of a grip that is a damped spring, as of a hand that pulls; the other kind holds."""
HOLD = wp.constant(2)


@struct
class GripTable:
    """The grips of one body and their points; a point is a pin whose rest point changes at run time."""

    kind: wp.array[int]  # (grip_max,)
    position: wp.array[wp.vec3d]  # (grip_max,), where the grip is [m]
    rotation: wp.array[wp.quatd]  # and how it is turned
    goal_position: wp.array[wp.vec3d]  # where it shall be after `remaining` steps
    goal_rotation: wp.array[wp.quatd]
    remaining: wp.array[int]  # (1,)
    grip: wp.array[int]  # (slot_max,), grip of each point
    offset: wp.array[wp.vec3d]  # (slot_max,), from the grip's position, before it turns [m]
    share: wp.array[float]  # (slot_max,), part of the grip's stiffness


@struct
class GripStrength:
    """How stiff grips are, in terms of the body that they hold; see ``GripOptions``."""

    pull_stiffness: float
    pull_rate: float
    pull_force: float
    pull_sag: float
    hold_stiffness: float
    hold_sag: float


@wp.func
def slerp(a: wp.quatd, b: wp.quatd, t: wp.float64):
    """Return the rotation at t between two, along the shorter way."""
    near = b
    cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    if cosine < wp.float64(0.0):
        near = -b
        cosine = -cosine
    one = wp.float64(1.0)
    if cosine > wp.float64(0.9999):
        return wp.normalize((one - t) * a + t * near)
    angle = wp.acos(cosine)
    return wp.normalize((wp.sin((one - t) * angle) * a + wp.sin(t * angle) * near) / wp.sin(angle))


@wp.kernel
def move_grips(
    # In and out:
    table: GripTable,
):
    """Move every grip by its part of the way to its goal, so that it gets there with the last step of the frame."""
    g = wp.tid()
    if table.kind[g] == 0:
        return
    part = wp.float64(1.0) / wp.float64(wp.max(table.remaining[0], 1))
    table.position[g] = table.position[g] + part * (table.goal_position[g] - table.position[g])
    table.rotation[g] = slerp(table.rotation[g], table.goal_rotation[g], part)


@wp.kernel
def write_pins(
    instances: Instances,
    basis: Basis,
    gravity: wp.array[wp.vec3],  # (world_count,) [m/s^2]
    strength: GripStrength,
    i: int,  # the instance
    first_slot: int,  # its first pin that is a grip's
    first_row: int,  # row of the first pin in basis.row
    dt: wp.float64,
    # State in:
    q: wp.array[wp.vec3d],
    # In and out:
    table: GripTable,
    # Out:
    pin_stiffness_out: wp.array[float],  # (pin_total,) [N/m]
    pin_target_out: wp.array[wp.vec3d],  # (pin_total,) [m]
):
    """Write targets and stiffness of the pins.

    A spring with a damper, force -k (x - t) - c (x - x_n) / dt at the end of the step, is a spring of k + c / dt to
    (k t + c / dt x_n) / (k + c / dt): what the solver minimises is the potential of both.
    """
    s = wp.tid()
    if s == 0:
        table.remaining[0] = wp.max(table.remaining[0] - 1, 0)
    if first_slot + s >= instances.pin_count[i]:
        return
    pin = instances.pin_start[i] + first_slot + s
    g = table.grip[s]
    target = table.position[g] + wp.quat_rotate(table.rotation[g], table.offset[s])
    weight = float(instances.mass[i]) * wp.length(gravity[wp.max(instances.world[i], 0)])
    size = instances.size[i]
    modulus = instances.youngs_modulus[i]
    if table.kind[g] == HOLD:
        k = wp.max(strength.hold_stiffness * modulus * size, weight / (strength.hold_sag * size))
        pin_stiffness_out[pin] = table.share[s] * k
        pin_target_out[pin] = target
        return
    mass = float(instances.mass[i])
    k = wp.min(strength.pull_stiffness * modulus * size, mass * strength.pull_rate * strength.pull_rate)
    k = wp.max(k, weight / (strength.pull_sag * size))
    c = 2.0 * wp.sqrt(k * mass)
    row = first_row + pin
    x = basis.row_point[row]
    n = instances.function_count[i]
    first = instances.function_start[i]
    for b in range(blocks_of(n)):
        values = basis.row[row, b]
        for lane in range(wp.min(LANES, n - LANES * b)):
            x += wp.float64(values[lane]) * q[first + LANES * b + lane]
    reach = (strength.pull_force * modulus * size * size + weight / strength.pull_sag) / k
    away = target - x
    distance = float(wp.length(away))
    if distance > reach:
        target = x + wp.float64(reach / distance) * away
    damper = wp.float64(c) / dt
    stiffness = wp.float64(k) + damper
    pin_stiffness_out[pin] = table.share[s] * float(stiffness)
    pin_target_out[pin] = (wp.float64(k) * target + damper * x) / stiffness
