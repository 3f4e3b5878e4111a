"""Device side of the sensors: fixed-order sums over the point constraints of the last step."""

import warp as wp

from softmode.deformables.model.declare import struct
from softmode.deformables.model.lane_kernels import sum8d
from softmode.deformables.model.struct_kernels import (
    Basis,
    Instances,
    Motion,
    PointConstraints,
    blocks_of,
    interpolate,
    sample_area,
)

wp.set_module_options({"enable_backward": False})


@struct
class Readings:
    """What a sensor of contact reads, shape (world_count, link_count, soft_count); world frame.

    Of a link with soft bodies; or, in shape (world_count, 1, 1), of a soft body with everything.
    """

    force: wp.array3d[wp.vec3]  # on the link, or the soft body [N]
    friction: wp.array3d[wp.vec3]  # its tangential part [N]
    torque: wp.array3d[wp.vec3]  # about the centre of mass [N m]
    position: wp.array3d[wp.vec3]  # centre of pressure [m]
    normal: wp.array3d[wp.vec3]  # mean normal, out of the link or into the soft body
    area: wp.array3d[float]  # [m^2]


@struct
class Touch:
    """Contact as it is summed up: what `Readings` become."""

    force: wp.vec3d  # [N]
    friction: wp.vec3d  # [N]
    torque: wp.vec3d  # [N m]
    position: wp.vec3d  # sum over the contacts, weighted by normal force [N m]
    normal: wp.vec3d  # likewise [N]
    weight: wp.float64  # [N]
    area: wp.float64  # [m^2]


@wp.func
def point_of(instances: Instances, basis: Basis, motion: Motion, constraints: PointConstraints, i: int, e: int):
    """Return where a constraint was at the start of the step [m]: both bodies feel the force there.

    On a shape it is the centre of pressure of the sample's cell. Where a sample of another soft body touches this one,
    the row is a mean of rows and its place that of the sample.
    """
    row = constraints.row[i, e]
    k = i
    if row >= basis.row_point.shape[0]:
        row = constraints.partner_row[i, e]
        k = constraints.partner[i, e]
    return basis.row_point[row] + interpolate(basis.row, row, motion.q_start, k, instances.function_count[k])


@wp.func
def is_internal(constraints: PointConstraints, i: int, e: int):
    """Return whether a constraint is a contact of a body with itself, which puts no force on it."""
    return e >= constraints.count[i] - constraints.pair_count[i] and constraints.partner[i, e] < 0


@wp.func
def normal_part(constraints: PointConstraints, i: int, e: int):
    """Return n . f [N], or 0 where the step failed."""
    value = wp.dot(constraints.normal[i, e], constraints.force[i, e])
    return wp.where(wp.isfinite(value), value, wp.float64(0.0))


@wp.func
def first_of_sample(constraints: PointConstraints, first: int, i: int, e: int):
    """Return whether no earlier constraint is the same sample pressed by the same body: its area counts once."""
    for k in range(first, e):
        same = constraints.partner_row[i, k] == constraints.partner_row[i, e]
        same = same and constraints.body[i, k] == constraints.body[i, e]
        if same and constraints.shape[i, k] >= 0 and normal_part(constraints, i, k) > wp.float64(0.0):
            return False
    return True


@wp.func
def mean_of(total: wp.vec3d, weight: wp.float64):
    """Return a weighted mean, zero where nothing weighs."""
    return wp.where(weight > wp.float64(0.0), total / wp.max(weight, wp.float64(1.0e-300)), wp.vec3d())


@wp.func
def add_force(touch: Touch, f: wp.vec3d, friction: wp.vec3d, arm: wp.vec3d):
    """Return the sums with a force on the body that is read."""
    touch.force += f
    touch.friction += friction
    touch.torque += wp.cross(arm, f)
    return touch


@wp.func
def add_pressure(touch: Touch, pressing: wp.float64, x: wp.vec3d, n: wp.vec3d):
    """Return the sums with a normal force at a place."""
    touch.weight += pressing
    touch.position += pressing * x
    touch.normal += pressing * n
    return touch


@wp.func
def write_readings(out: Readings, w: int, l: int, column: int, touch: Touch):
    """Write the sums and means of a contact."""
    out.force[w, l, column] = wp.vec3(touch.force)
    out.friction[w, l, column] = wp.vec3(touch.friction)
    out.torque[w, l, column] = wp.vec3(touch.torque)
    out.position[w, l, column] = wp.vec3(mean_of(touch.position, touch.weight))
    out.normal[w, l, column] = wp.vec3(wp.normalize(touch.normal))
    out.area[w, l, column] = float(touch.area)


@wp.kernel
def read_contacts(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    constraints: PointConstraints,
    instance_start: wp.array[int],  # (world_count + 1,)
    link_body: wp.array2d[int],  # (world_count, link_count), -1 for all fixed shapes
    soft: wp.array[int],  # (soft_count,), body within its world
    # Out:
    matrix_out: Readings,
    total_out: Readings,  # soft_count = 1: of all soft bodies of the world
):
    """Sum the contacts of a link with one soft body, in the last column with all of them."""
    w, l, column = wp.tid()
    begin = instance_start[w]
    end = instance_start[w + 1]
    if column < soft.shape[0]:
        begin = begin + soft[column]
        end = begin + 1
    body = link_body[w, l]
    touch = Touch()
    for i in range(begin, end):
        first = instances.pin_count[i]
        for e in range(first, constraints.count[i]):
            # constraints without a shape are contacts of soft bodies with each other
            if constraints.body[i, e] != body or constraints.shape[i, e] < 0:
                continue
            f = constraints.force[i, e]
            if not wp.isfinite(wp.length_sq(f)):
                continue
            n = constraints.normal[i, e]
            pressing = normal_part(constraints, i, e)
            x = point_of(instances, basis, motion, constraints, i, e)
            arm = wp.vec3d(constraints.arm[i, e])
            if body < 0:
                arm = x
            touch = add_force(touch, -f, -(f - pressing * n), arm)
            if pressing > wp.float64(0.0):
                touch = add_pressure(touch, pressing, x, n)
                if first_of_sample(constraints, first, i, e):
                    area = basis.row_area[constraints.partner_row[i, e]]
                    touch.area += wp.float64(sample_area(instances.scale[i], area))
    if column < soft.shape[0]:
        write_readings(matrix_out, w, l, column, touch)
    else:
        write_readings(total_out, w, l, 0, touch)


@wp.kernel
def read_attachments(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    constraints: PointConstraints,
    instance_start: wp.array[int],
    soft: wp.array[int],  # (attachment_count,)
    first_pin: wp.array[int],
    pin_count: wp.array[int],
    # Out:
    force_out: wp.array2d[wp.vec3],  # (world_count, attachment_count) [N]
    torque_out: wp.array2d[wp.vec3],  # [N m]
):
    """Sum what the pins of an attachment pull at their other end."""
    w, a = wp.tid()
    i = instance_start[w] + soft[a]
    force = wp.vec3d()
    torque = wp.vec3d()
    for e in range(first_pin[a], wp.min(first_pin[a] + pin_count[a], constraints.count[i])):
        f = constraints.force[i, e]
        if not wp.isfinite(wp.length_sq(f)):
            continue
        arm = wp.vec3d(constraints.arm[i, e])
        if constraints.body[i, e] < 0:
            # the offset of a pin is its soft end less its target
            arm = point_of(instances, basis, motion, constraints, i, e) - constraints.offset[i, e]
        force -= f
        torque -= wp.cross(arm, f)
    force_out[w, a] = wp.vec3(force)
    torque_out[w, a] = wp.vec3(torque)


@wp.kernel
def find_samples(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    constraints: PointConstraints,
    instance_start: wp.array[int],
    soft: int,
    position: wp.array2d[wp.vec3d],  # (instance_count, sample_max), samples at the start of the step [m]
    surface_normal: wp.array2d[wp.vec3],  # and their normals, outward
    # Out:
    sample_out: wp.array2d[int],  # (world_count, constraint_max)
):
    """Find the sample of each contact: its own, or the nearest that faces the sample of another soft body."""
    w, e = wp.tid()
    i = instance_start[w] + soft
    if e < instances.pin_count[i] or e >= constraints.count[i] or is_internal(constraints, i, e):
        return
    found = constraints.row[i, e] - instances.row_start[i]
    if constraints.shape[i, e] >= 0:
        found = constraints.partner_row[i, e] - instances.row_start[i]
    if constraints.row[i, e] >= basis.row_point.shape[0]:
        x = point_of(instances, basis, motion, constraints, i, e)
        nearest = wp.float64(1.0e30)
        for s in range(instances.sample_count[i]):
            distance = wp.length_sq(position[i, s] - x)
            if wp.dot(surface_normal[i, s], wp.vec3(constraints.normal[i, e])) > -0.5:
                distance += wp.float64(1.0e10)  # only where none faces it
            if distance < nearest:
                nearest = distance
                found = s
    sample_out[w, e] = found


@wp.kernel
def gather_pressure(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    constraints: PointConstraints,
    instance_start: wp.array[int],
    soft: int,
    sample: wp.array2d[int],  # (world_count, constraint_max)
    # In and out, zero before:
    normal_force: wp.array2d[wp.vec3d],  # (world_count, sample_count) [N]
    friction: wp.array2d[wp.vec3d],  # (world_count, sample_count) [N]
    # Out:
    patch_out: Readings,  # shape (world_count, 1, 1)
):
    """Sum the contact forces on each surface sample, and on the body."""
    w = wp.tid()
    i = instance_start[w] + soft
    centre = wp.vec3d()
    stride = basis.row.shape[1]
    for b in range(blocks_of(instances.function_count[i])):
        mean = basis.mean[instances.asset[i], b]
        for axis in range(3):
            centre[axis] += sum8d(wp.cw_mul(mean, motion.q_start[i, axis * stride + b]))
    touch = Touch()
    for e in range(instances.pin_count[i], constraints.count[i]):
        f = constraints.force[i, e]
        if is_internal(constraints, i, e) or not wp.isfinite(wp.length_sq(f)):
            continue
        n = constraints.normal[i, e]
        pressing = normal_part(constraints, i, e)
        x = point_of(instances, basis, motion, constraints, i, e)
        touch = add_force(touch, f, f - pressing * n, x - centre)
        if pressing > wp.float64(0.0):
            touch = add_pressure(touch, pressing, x, n)
        s = sample[w, e]
        before = wp.length_sq(normal_force[w, s])
        normal_force[w, s] = normal_force[w, s] + pressing * n
        friction[w, s] = friction[w, s] + (f - pressing * n)
        if before == wp.float64(0.0) and pressing > wp.float64(0.0):
            touch.area += wp.float64(sample_area(instances.scale[i], basis.row_area[instances.row_start[i] + s]))
    write_readings(patch_out, w, 0, 0, touch)


@wp.kernel
def spread_pressure(
    instances: Instances,
    basis: Basis,
    instance_start: wp.array[int],
    soft: int,
    normal_force: wp.array2d[wp.vec3d],
    friction: wp.array2d[wp.vec3d],
    # Out, shape (world_count, sample_count):
    pressure_out: wp.array2d[float],  # [Pa]
    traction_out: wp.array2d[wp.vec3],  # [Pa]
    normal_out: wp.array2d[wp.vec3],
):
    """Divide the forces on the samples by their areas."""
    w, s = wp.tid()
    i = instance_start[w] + soft
    area = wp.max(
        wp.float64(sample_area(instances.scale[i], basis.row_area[instances.row_start[i] + s])), wp.float64(1.0e-30)
    )
    pressure_out[w, s] = float(wp.length(normal_force[w, s]) / area)
    traction_out[w, s] = wp.vec3(friction[w, s] / area)
    normal_out[w, s] = wp.vec3(wp.normalize(normal_force[w, s]))
