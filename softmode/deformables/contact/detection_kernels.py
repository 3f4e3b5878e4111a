"""Detection of contact between surface samples and the rigid shapes of the Newton model, once per step.

Every sample is tested against the shapes near its body; gap, normal and lever arm are frozen for the step and become
*point constraints* of the step (see ``penalty_kernels`` for their energy): first the pins of the instance, then
its contacts in sample order.

The queries are ours because Newton's public ``sdf_*`` functions come without their gradients, and because its soft
contact records are appended by an atomic counter: fixed slots per sample keep the order, and so the bits, reproducible.
"""

import warp as wp

from softmode.deformables.contact.cell_kernels import (
    NEAR,
    Surface,
    cell_at,
    fade_of,
    gradient_of,
    shape_of_cell,
    touched_share,
    write_row,
)
from softmode.deformables.contact.face_kernels import near_rim, part_under_face
from softmode.deformables.contact.penalty_kernels import (
    BULK_FACTOR,
    HARDENING_DEPTH,
    SHEAR_FACTOR,
    beyond_penalty,
    dent_compliance,
    dent_depth,
    shear_yield,
    stiffness_per_area,
)
from softmode.deformables.contact.ridge_kernels import (
    FAR,
    RIDGE,
    Box,
    beside_edge,
    inward_of,
    reach_of,
    ridge_at,
    ridge_in_cell,
)
from softmode.deformables.contact.shape_query_kernels import (
    BOX,
    CAPSULE,
    CYLINDER,
    HEIGHTFIELD,
    PLANE,
    SMOOTH,
    SPHERE,
    Heightfields,
    SurfaceQuery,
    query_heightfield,
    query_shape,
)
from softmode.deformables.model.declare import struct
from softmode.deformables.model.deformation_kernels import displacement_gradient
from softmode.deformables.model.lane_kernels import barrier
from softmode.deformables.model.status import (
    PARAMETER_BITS,
    WORLD_CONTACT_OVERFLOW,
    WORLD_PARAMETER_RANGE,
    WORLD_PENETRATION,
    WORLD_RIGID_NOT_FINITE,
)
from softmode.deformables.model.struct_kernels import (
    OVERLAP,
    SLOTS,
    Basis,
    Instances,
    Motion,
    PointConstraints,
    Rigid,
    Samples,
    interpolate,
    interpolate_change,
    mat23d,
    sample_area,
)

wp.set_module_options({"enable_backward": False})


CULLED = wp.constant(31)
"""Candidate shapes that samples may be culled against, a bit each; further ones are all looked at."""
OPPOSED = wp.constant(0.3)
"""Cosine beyond which a direction counts as against a normal."""


@struct
class Shapes:
    """The rigid shapes of the model and where their bodies are at the start of the step."""

    kind: wp.array[int]
    scale: wp.array[wp.vec3]
    source: wp.array[wp.uint64]
    fields: Heightfields
    margin: wp.array[float]
    lower: wp.array[wp.vec3]  # bounds in the shape's frame [m]
    upper: wp.array[wp.vec3]
    body: wp.array[int]
    transform: wp.array[wp.transform]
    friction: wp.array[float]
    body_q: wp.array[wp.transform]
    body_qd: wp.array[wp.spatial_vector]
    body_com: wp.array[wp.vec3]
    body_mass: wp.array[float]  # [kg]


@wp.kernel
def place_samples(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    # Out:
    samples: Samples,
):
    """Compute where the surface samples are at the start of the step and how far they would drift during it."""
    i, s = wp.tid()
    if s >= instances.sample_count[i]:
        return
    row = instances.row_start[i] + s
    n = instances.function_count[i]
    samples.position[i, s] = basis.row_point[row] + interpolate(basis.row, row, motion.q_start, i, n)
    samples.drift[i, s] = wp.vec3(interpolate_change(basis.row, row, motion.q_inertial, motion.q_start, i, n))


@wp.kernel
def bound_samples(
    instances: Instances,
    team: int,
    # In and out:
    samples: Samples,
):
    """Bound the samples of an instance, grown by margin and drift."""
    i, member = wp.tid()
    lower = wp.vec3(1.0e30)
    upper = wp.vec3(-1.0e30)
    drift_lower = wp.vec3(1.0e30)
    drift_upper = wp.vec3(-1.0e30)
    reach = float(0.0)
    for s in range(member, instances.sample_count[i], team):
        x = wp.vec3(samples.position[i, s])
        drift = samples.drift[i, s]
        lower = wp.min(lower, x)
        upper = wp.max(upper, x)
        drift_lower = wp.min(drift_lower, drift)
        drift_upper = wp.max(drift_upper, drift)
        reach = wp.max(reach, wp.length(drift))
    samples.reach[i, member, 0] = lower - wp.vec3(2.0 * reach)
    samples.reach[i, member, 1] = upper + wp.vec3(2.0 * reach)
    samples.reach[i, member, 2] = drift_lower
    samples.reach[i, member, 3] = drift_upper
    barrier()
    if member != 0:
        return
    lower = samples.reach[i, 0, 0]
    upper = samples.reach[i, 0, 1]
    for k in range(1, team):
        lower = wp.min(lower, samples.reach[i, k, 0])
        upper = wp.max(upper, samples.reach[i, k, 1])
        drift_lower = wp.min(drift_lower, samples.reach[i, k, 2])
        drift_upper = wp.max(drift_upper, samples.reach[i, k, 3])
    samples.drift_lower[i] = drift_lower
    samples.drift_upper[i] = drift_upper
    side = wp.sqrt(instances.area[i] / float(instances.sample_count[i]))
    grow = wp.vec3(wp.max(instances.margin[i], FAR * side) + instances.contact_radius[i])
    samples.lower[i] = lower - grow
    samples.upper[i] = upper + grow


@wp.func
def point_velocity(body_q: wp.transform, body_qd: wp.spatial_vector, com: wp.vec3, point: wp.vec3):
    """Return the velocity [m/s] of a world point that moves with a body."""
    arm = point - wp.transform_point(body_q, com)
    return wp.spatial_top(body_qd) + wp.cross(wp.spatial_bottom(body_qd), arm)


@wp.kernel
def cull_shapes(
    instances: Instances,
    candidate: wp.array2d[int],  # (instance_count, candidate_max), -1 pads
    shapes: Shapes,
    samples: Samples,
    pin_body: wp.array[int],  # (pin_total,)
    pin_stiffness: wp.array[float],  # (pin_total,) [N/m]
    dt: float,
    # Out:
    near_out: wp.array2d[int],  # (instance_count, candidate_max)
    status: wp.array[int],  # (world_count,)
):
    """Mark the candidate shapes whose bounding sphere reaches the bounds of the instance.

    One that is nowhere, or whose friction is no number or negative, is flagged.

    A body does not touch the shapes of a rigid body that it is fixed to, until it is released.
    """
    i, c = wp.tid()
    shape = candidate[i, c]
    near_out[i, c] = 0
    if shape < 0:
        return
    mu = shapes.friction[shape]
    if not (wp.isfinite(mu) and mu >= 0.0):
        bits = WORLD_PARAMETER_RANGE | wp.static(PARAMETER_BITS["shape_material_mu"])
        wp.atomic_or(status, instances.world[i], bits)
    body = shapes.body[shape]
    if body >= 0:
        place = shapes.body_q[body]
        finite = wp.isfinite(wp.transform_get_translation(place)) and wp.isfinite(wp.transform_get_rotation(place))
        if not (finite and wp.isfinite(shapes.body_qd[body])):
            wp.atomic_or(status, instances.world[i], WORLD_RIGID_NOT_FINITE)
    if shapes.kind[shape] == PLANE or shapes.kind[shape] == HEIGHTFIELD:  # solid below without end
        near_out[i, c] = 1
        return
    pose = shapes.transform[shape]
    lower = shapes.lower[shape]
    upper = shapes.upper[shape]
    radius = 0.5 * wp.length(upper - lower)
    if body >= 0:
        pose = shapes.body_q[body] * pose
        if instances.link_pin_count[i] > 0:
            for pin in range(instances.pin_start[i], instances.pin_start[i] + instances.pin_count[i]):
                if pin_body[pin] == body and pin_stiffness[pin] > 0.0:
                    return
    centre = wp.transform_point(pose, 0.5 * (lower + upper))
    reach = radius + shapes.margin[shape]
    if body >= 0:
        twist = shapes.body_qd[body]
        speed = wp.length(point_velocity(shapes.body_q[body], twist, shapes.body_com[body], centre))
        reach += 2.0 * dt * (speed + radius * wp.length(wp.spatial_bottom(twist)))
    nearest = wp.min(wp.max(centre, samples.lower[i]), samples.upper[i])
    if wp.length(centre - nearest) <= reach:
        near_out[i, c] = 1


@wp.func
def march(
    shapes: Shapes,
    shape: int,
    x: wp.vec3,
    nearest: SurfaceQuery,
    along: wp.vec3,
    end: float,
    back: int,
    thick: float,
    onset: float,
    reach: float,
):
    """Return gap and normal of the half-space that stands for a shape along a way from ``x``, in the shape's frame.

    The way is marched by distances to the shape grown by ``thick``. To the body's inside (``back``), for a sample past
    the middle of a thin plate or through it: where the way leaves the shape, else what is ``nearest`` to x. The way of
    a fast sample: where it first meets the shape, or else passes nearest, with no ``onset`` of its contact.
    """
    kind = shapes.kind[shape]
    scale = shapes.scale[shape]
    source = shapes.source[shape]
    query = nearest
    out = query
    at = float(0.0)
    out_at = float(0.0)
    inside = query.distance <= 0.0
    depth = 0.5 * end
    least = 1.0e-3 * end
    for _ in range(64):
        if at >= end:
            break
        at = wp.min(at + wp.max(wp.abs(query.distance), least), end)
        y = x + at * along
        query = query_shape(kind, scale, source, y, reach)
        if kind == HEIGHTFIELD:
            query = query_heightfield(y, shapes.fields, shapes.fields.index[shape], reach)
        query.distance -= thick
        if back == 1:
            if inside and query.distance > 0.0:
                if wp.dot(query.normal, along) > OPPOSED:
                    out = query
                    out_at = at
                break
            if not inside and at > depth:
                break
            inside = query.distance <= 0.0
        else:
            if query.distance < out.distance:
                out = query
                out_at = at
            if query.distance <= least:
                inside = bool(True)
                break
    slope = wp.dot(out.normal, along)
    out.distance -= out_at * slope
    if back == 0 and not inside:
        # a way that misses the shape misses its half-space, and where it begins outside of the onset that too
        clear = wp.where(nearest.distance > onset, onset, 0.0)
        out.distance = wp.max(out.distance, clear - end * slope)
    return out


@wp.func
def shape_frame(shapes: Shapes, shape: int):
    """Return origin and rotation of a shape at the start of the step, in float64."""
    pose = shapes.transform[shape]
    body = shapes.body[shape]
    if body >= 0:
        pose = shapes.body_q[body] * pose
    return wp.vec3d(wp.transform_get_translation(pose)), wp.normalize(wp.quatd(wp.transform_get_rotation(pose)))


@wp.func
def box_at(instances: Instances, basis: Basis, shapes: Shapes, samples: Samples, i: int, row: int, shape: int):
    """Return a box and the cell of a sample, and how vectors are turned into the frame of the box."""
    origin, rotation = shape_frame(shapes, shape)
    side = instances.scale[i] * wp.sqrt(basis.row_area[row])
    R = wp.transpose(wp.quat_to_matrix(rotation))
    box = Box()
    box.half = wp.vec3d(shapes.scale[shape] + wp.vec3(shapes.margin[shape] + instances.contact_radius[i]))
    box.x = R * (samples.position[i, row - instances.row_start[i]] - origin)
    box.normal = wp.vec3d(basis.row_normal[row])
    box.area = wp.float64(side * side)
    return box, R


@wp.func
def box_beside(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    shapes: Shapes,
    samples: Samples,
    i: int,
    row: int,
    shape: int,
    normal: wp.vec3d,
    gap: wp.float64,
    dent: float,
):
    """Return a box and the cell of a sample with a gap beside it, how its frame is turned, and whether an edge is near.

    The normal is where it is nearest; ``dent`` as in ``reach_of`` [m].
    """
    box, R = box_at(instances, basis, shapes, samples, i, row, shape)
    box.front = R * normal
    box.reach = wp.float64(reach_of(instances.scale[i] * wp.sqrt(basis.row_area[row]), dent))
    box.dent = wp.float64(dent)
    beside = beside_edge(box.half, box.x, gap, box.reach)
    if beside:
        box.F = R * gradient_of(instances, basis, motion.q_start, i, row)
    return box, wp.transpose(R), beside


@wp.func
def pressed_by(box: Box, instances: Instances, surface: Surface, i: int, row: int, k: wp.float64, give: wp.float64):
    """Return a cell beside a box with what its edges press by; k is the stiffness of the penalty [N/m]."""
    give_of_face = dent_compliance(instances, i, surface.relative_stiffness[row], surface.dent_length[row])
    box.unit = RIDGE * box.dent / (wp.float64(give_of_face) * k)
    box.give = give
    return box


@wp.func
def face_part(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    shapes: Shapes,
    samples: Samples,
    inset: wp.array[wp.vec3],  # as of ``Surface``
    i: int,
    row: int,
    shape: int,
):
    """Return a box and the cell of a sample at its rim, how its frame is turned, and the face that the cell lies on.

    As ``part_under_face``.
    """
    box, R = box_at(instances, basis, shapes, samples, i, row, shape)
    axis = int(-1)
    part = wp.float64(1.0)
    middle = wp.vec3d()
    if near_rim(box):
        box.F = R * gradient_of(instances, basis, motion.q_start, i, row)
        box.inset = wp.vec3d(inset[row])
        axis, part, middle = part_under_face(box)
    return box, wp.transpose(R), axis, part, middle


@wp.kernel(launch_bounds=(256, 2))
def find_contacts(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    candidate: wp.array2d[int],
    near: wp.array2d[int],
    shapes: Shapes,
    inset: wp.array[wp.vec3],  # as of ``Surface``
    dt: float,
    # State in:
    stick_shape: wp.array[wp.vec2i],  # (particle_count,), see ``remember_slip``
    dt_before: wp.array[wp.float64],  # (instance_count,) [s], 0 where no step led here
    # In and out:
    samples: Samples,
):
    """Keep the deepest contacts of each sample within margin plus twice the relative motion of the step.

    A sample outside of a shape that lies between it and the inside of its body has gone through, unless it did not
    touch that shape in the step before: then the body is bent around an end of the shape.
    """
    i, s = wp.tid()
    if s >= instances.sample_count[i]:
        return
    samples.shape[i, s, 0] = -1
    samples.shape[i, s, 1] = -1
    samples.gap[i, s, 0] = wp.float64(1.0e30)
    samples.gap[i, s, 1] = wp.float64(1.0e30)
    x = samples.position[i, s]
    row = instances.row_start[i] + s
    stuck = stick_shape[instances.particle_start[i] + s]
    side = instances.scale[i] * wp.sqrt(basis.row_area[row])
    for c in range(candidate.shape[1]):
        if near[i, c] == 0 or (c < CULLED and (samples.near[i, s] >> c) & 1 == 0):
            continue
        shape = candidate[i, c]
        pose = shapes.transform[shape]
        body = shapes.body[shape]
        drift = samples.drift[i, s]
        if body >= 0:
            pose = shapes.body_q[body] * pose
            moving = point_velocity(shapes.body_q[body], shapes.body_qd[body], shapes.body_com[body], wp.vec3(x))
            drift -= dt * moving
        reach = instances.margin[i] + 2.0 * wp.length(drift)
        # the difference to the shape's origin in float64: far from the world's origin only the offset is large
        turn = wp.transform_get_rotation(pose)
        local = wp.quat_rotate_inv(turn, wp.vec3(x - wp.vec3d(wp.transform_get_translation(pose))))
        thick = shapes.margin[shape] + instances.contact_radius[i]
        far = reach + thick
        kind = shapes.kind[shape]
        if kind != HEIGHTFIELD:  # inside a mesh the surface may be as far away as the mesh is large
            far = wp.max(far, wp.length(shapes.upper[shape] - shapes.lower[shape]))
        # struct arguments are copied: one of many arrays costs more than the distance to a box
        query = query_shape(kind, shapes.scale[shape], shapes.source[shape], local, far)
        if kind == HEIGHTFIELD:
            query = query_heightfield(local, shapes.fields, shapes.fields.index[shape], far)
        query.distance -= thick
        depth = instances.scale[i] * float(wp.length(basis.inner_point[row]))
        part = float(1.0)
        if kind == BOX and query.distance < wp.max(reach, FAR * side):
            box, _frame, axis, under, _middle = face_part(
                instances, basis, motion, shapes, samples, inset, i, row, shape
            )
            level = float(1.0e30)
            if axis >= 0:
                level = float(wp.abs(box.x[axis]) - box.half[axis])
            # beside a flank no deeper than a step may start, nor than half way to the middle of a thin body
            nearest = wp.abs(query.distance - level) < 1.0e-6
            if level < reach and (nearest or level > -wp.min(OVERLAP * instances.size[i], 0.5 * depth)):
                part = float(under)
                query.distance = level
                query.normal = wp.vec3()
                query.normal[axis] = wp.where(box.x[axis] < wp.float64(0.0), -1.0, 1.0)
        # In general the half-space at the nearest point stands for the shape during the step, but
        along = wp.vec3()
        end = float(0.0)
        back = int(0)
        travel = wp.length(drift)
        touched = stuck[0] == shape or stuck[1] == shape or dt_before[i] == wp.float64(0.0)
        if part == 1.0 and (query.distance <= 0.0 or (touched and query.distance < 2.0 * depth)):
            bent = interpolate(basis.inner_row, row, motion.q_start, i, instances.function_count[i])
            inner = wp.quat_rotate_inv(turn, wp.vec3(basis.inner_point[row] + bent))
            depth = wp.length(inner)
            near_back = query.distance <= 0.0 or (touched and query.distance < depth)
            if near_back and wp.dot(query.normal, inner) < -OPPOSED * depth:
                # the nearest surface faces away from the body's inside: the sample must go back to it
                along = inner / depth
                end = 2.0 * depth
                back = 1
        if end == 0.0 and query.distance > 0.0 and travel > instances.margin[i] and travel > query.distance:
            # a half-space at the start would also stop fast samples that fly past a small shape
            along = wp.quat_rotate_inv(turn, drift) / travel
            if part == 1.0 or wp.dot(query.normal, along) > -OPPOSED:  # else its cell comes down on a face
                end = travel
                part = 1.0
        if end > 0.0:
            query = march(shapes, shape, local, query, along, end, back, thick, instances.smoothing[i], far)
        if kind == BOX and query.distance >= reach and query.distance < FAR * side:
            facing = wp.vec3d(wp.quat_rotate(turn, query.normal))
            from_box = wp.float64(query.distance)
            box, _frame, beside = box_beside(
                instances, basis, motion, shapes, samples, i, row, shape, facing, from_box, 0.0
            )
            if beside:
                inward = inward_of(box)
                length, deep = ridge_in_cell(box.half, box.x, inward, box.area, box.reach, wp.dot(box.front, inward))
                if length > wp.float64(0.0) and deep > -wp.float64(reach):
                    reach = FAR * side
        gap = wp.float64(query.distance)
        if gap < wp.float64(reach) and gap < samples.gap[i, s, 1]:
            normal = wp.quat_rotate(turn, query.normal)
            slot = int(1)
            if gap < samples.gap[i, s, 0]:
                samples.shape[i, s, 1] = samples.shape[i, s, 0]
                samples.gap[i, s, 1] = samples.gap[i, s, 0]
                samples.normal[i, s, 1] = samples.normal[i, s, 0]
                samples.part[i, s, 1] = samples.part[i, s, 0]
                slot = 0
            samples.shape[i, s, slot] = shape
            samples.gap[i, s, slot] = gap
            samples.normal[i, s, slot] = normal
            samples.part[i, s, slot] = part


@wp.func
def turn(rotation: wp.vec3, arm: wp.vec3):
    """Return how far the end of an arm moves in a finite rotation, given as a vector [rad].

    The linear omega dt x arm would move out by (omega dt)^2 / 2 of the arm in every step, and friction with it.
    """
    half = 0.5 * wp.length(rotation)
    sinc = 1.0 - half * half / 6.0
    if half > 1.0e-2:
        sinc = wp.sin(half) / half
    linear = wp.cross(rotation, arm)
    return sinc * wp.cos(half) * linear + 0.5 * sinc * sinc * wp.cross(rotation, linear)


@wp.func
def shape_area(shapes: Shapes, shape: int):
    """Return the surface area of a shape's bounds [m^2]."""
    if shapes.kind[shape] == PLANE:
        return float(1.0e30)
    edge = shapes.upper[shape] - shapes.lower[shape]
    return 2.0 * (edge[0] * edge[1] + edge[1] * edge[2] + edge[2] * edge[0])


@wp.func
def curvature_of(shapes: Shapes, shape: int, normal: wp.vec3d):
    """Return the mean curvature [1/m] of a shape where its normal is ``normal``."""
    kind = shapes.kind[shape]
    if kind == SPHERE:
        return 1.0 / shapes.scale[shape][0]
    if kind == CAPSULE or kind == CYLINDER:
        _origin, rotation = shape_frame(shapes, shape)
        across = float(wp.quat_rotate_inv(rotation, normal)[2])
        return 0.5 * (1.0 - across * across) / shapes.scale[shape][0]
    return float(0.0)


@wp.func
def motion_of_cell(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    shapes: Shapes,
    samples: Samples,
    i: int,
    row: int,
    shape: int,
    n: wp.vec3d,
    dt: float,
):
    """Return F of a sample, F a step at its velocity ahead, and how far its gap with a shape then grows [m].

    How far a ball rolls in a step is what turns it: a centre of pressure of the start would lag by half a step.
    """
    count = instances.function_count[i]
    start = gradient_of(instances, basis, motion.q_start, i, row)
    rate = displacement_gradient(basis.row_gradient, motion.qd_start, i, row, count)
    velocity = interpolate(basis.row, row, motion.qd_start, i, count)
    body = shapes.body[shape]
    if body >= 0:
        x = wp.vec3(samples.position[i, row - instances.row_start[i]])
        velocity -= wp.vec3d(point_velocity(shapes.body_q[body], shapes.body_qd[body], shapes.body_com[body], x))
    return start, start + wp.float64(dt) * rate, wp.float64(dt) * wp.dot(n, velocity)


@wp.func
def remembered_slip(
    shapes: Shapes,
    shape: int,
    x: wp.vec3d,
    normal: wp.vec3d,
    stick_shape: wp.array[wp.vec2i],
    stick_point: wp.array[mat23d],
    particle: int,
    prescribed: int,
):
    """Return the tangential displacement [m] that a sample carries over from the step before, and its anchor.

    Zero where the sample has not been in contact with this shape.
    """
    origin, rotation = shape_frame(shapes, shape)
    anchor = wp.quat_rotate_inv(rotation, x - origin)
    slip = wp.vec3d()
    for k in range(SLOTS):
        if stick_shape[particle][k] == shape:
            point = stick_point[particle][k]
            slip = wp.quat_rotate(rotation, point)
            if prescribed == 0:
                slip = x - origin - slip
                anchor = point
    return slip - wp.dot(slip, normal) * normal, anchor


@wp.func
def rank_contacts(
    found: wp.array3d[int],  # (instance_count, sample_max, SLOTS), -1 where empty
    gap: wp.array3d[wp.float64],  # likewise [m]
    tally: wp.array3d[int],  # (instance_count, team, 2), scratch
    i: int,
    begin: int,
    end: int,
    member: int,
    team: int,
):
    """Return where a thread writes what touches and what is close of its samples, and how many there are in all.

    What touches stands before what is close, each in sample order. Every thread of the team must call it.
    """
    touching = int(0)
    close = int(0)
    for s in range(begin, end):
        for slot in range(SLOTS):
            if found[i, s, slot] >= 0:
                if gap[i, s, slot] <= wp.float64(0.0):
                    touching += 1
                else:
                    close += 1
    tally[i, member, 0] = touching
    tally[i, member, 1] = close
    barrier()
    at_touching = int(0)
    at_close = int(0)
    total = int(0)
    for k in range(team):
        if k < member:
            at_touching += tally[i, k, 0]
            at_close += tally[i, k, 1]
        at_close += tally[i, k, 0]
        total += tally[i, k, 0] + tally[i, k, 1]
    return at_touching, at_close, total


@wp.kernel
def gather_contacts(
    instances: Instances,
    basis: Basis,
    shapes: Shapes,
    samples: Samples,
    motion: Motion,
    surface: Surface,
    constraint_max: int,
    prescribed: int,
    stick_ratio: wp.float64,
    team: int,
    dt: float,
    # State in:
    stick_shape: wp.array[wp.vec2i],  # (particle_count,), see ``friction_memory_kernels``
    stick_point: wp.array[mat23d],
    # Out:
    constraints: PointConstraints,
    status: wp.array[int],
):
    """Compact the slots of an instance behind its pins, in sample order: touching contacts first, then near ones.

    Each thread of a team counts its own run of samples, then says where the counts before it end. Contacts lie close to
    each other, in few of the runs: so what there is to say of each is written by the threads in turns.
    """
    i, member = wp.tid()
    count = instances.sample_count[i]
    begin = member * count / team
    end = (member + 1) * count / team
    at_touching, at_close, total = rank_contacts(samples.shape, samples.gap, samples.tally, i, begin, end, member, team)
    at_touching += instances.pin_count[i]
    at_close += instances.pin_count[i]
    total += instances.pin_count[i]
    if member == 0:
        constraints.count[i] = wp.min(total, constraint_max)
        if total > constraint_max:
            wp.atomic_or(status, instances.world[i], WORLD_CONTACT_OVERFLOW)
    deepest = -wp.float64(OVERLAP * instances.size[i])
    for s in range(begin, end):
        for slot in range(SLOTS):
            shape = samples.shape[i, s, slot]
            samples.constraint[i, s, slot] = -1
            if shape < 0:
                continue
            if samples.gap[i, s, slot] < deepest:
                wp.atomic_or(status, instances.world[i], WORLD_PENETRATION)
            e = at_close
            if samples.gap[i, s, slot] <= wp.float64(0.0):
                e = at_touching
                at_touching += 1
            else:
                at_close += 1
            if e < constraint_max:
                samples.constraint[i, s, slot] = e
                constraints.row[i, e] = instances.row_start[i] + s
    barrier()
    for e in range(instances.pin_count[i] + member, wp.min(total, constraint_max), team):
        row = constraints.row[i, e]
        s = row - instances.row_start[i]
        slot = int(0)
        for k in range(SLOTS):
            if samples.constraint[i, s, k] == e:
                slot = k
        shape = samples.shape[i, s, slot]
        gap = wp.max(samples.gap[i, s, slot], deepest)
        # of unit length in float64: what is left of the gap in the slip must not count against the stick range
        normal = wp.normalize(wp.vec3d(samples.normal[i, s, slot]))
        cell_shape = shape_of_cell(surface, instances, basis, i, row, curvature_of(shapes, shape, normal))
        part = wp.float64(samples.part[i, s, slot])
        start = wp.mat33d()
        ahead = wp.mat33d()
        closing = wp.float64(0.0)
        touched = wp.float64(0.0)
        middle = wp.vec3d()
        beside = gap <= NEAR * cell_shape.steepest
        if beside or part < wp.float64(1.0):
            start, ahead, closing = motion_of_cell(instances, basis, motion, shapes, samples, i, row, shape, normal, dt)
        if beside:
            fade = fade_of(cell_shape, ahead, normal)
            touched = touched_share(
                surface, samples.shape, samples.gap, samples.part, True, cell_shape, fade, i, row, shape
            )
        if part < wp.float64(1.0):
            _box, _frame, _axis, _part, middle = face_part(
                instances, basis, motion, shapes, samples, surface.inset, i, row, shape
            )
            gap += wp.dot(normal, start * middle)
            closing += wp.dot(normal, (ahead - start) * middle)
        spared = float(wp.float64(1.0) - touched * touched)
        area = wp.max(float(part) * sample_area(instances.scale[i], basis.row_area[row]), 1.0e-30)
        relative = surface.relative_stiffness[row]
        partner_mass = float(0.0)
        if shapes.body[shape] >= 0 and prescribed == 0:
            partner_mass = shapes.body_mass[shapes.body[shape]]
        partner_area = shape_area(shapes, shape)
        firm = relative * surface.slenderness[row]
        kappa = stiffness_per_area(instances, i, BULK_FACTOR, firm, partner_mass, partner_area, dt)
        stiffness = wp.float64(kappa * area)
        dent = dent_compliance(instances, i, relative, surface.dent_length[row])
        compliance = wp.float64(spared * dent / area)
        share = float(1.0)
        if partner_mass > 0.0:  # what is light beside the body turns faster than its cells, which lag by a step
            share = partner_mass / (partner_mass + float(instances.mass[i]))
        compliance = beyond_penalty(stiffness, compliance)
        ratio = stiffness * compliance * wp.float64(share * share)
        cell = cell_at(cell_shape, part, ahead, normal, gap, closing, ratio)
        turned = wp.dot(normal, (ahead - start) * cell.centre)
        cell.centre += middle
        ridge = wp.float64(0.0)
        ridge_lead = wp.float64(0.0)
        if shapes.kind[shape] == BOX and dent > 0.0 and part == wp.float64(1.0):
            found = samples.gap[i, s, slot]
            long = instances.scale[i] * surface.dent_length[row]
            box, frame, beside = box_beside(
                instances, basis, motion, shapes, samples, i, row, shape, normal, found, long
            )
            if beside:
                box = pressed_by(box, instances, surface, i, row, stiffness, stiffness * compliance)
                ridge, ridge_lead, front = ridge_at(box, cell.lead - gap, cell.onset, cell_shape.least)
                normal = wp.normalize(frame * front)
        constraints.ridge[i, e] = ridge
        constraints.ridge_lead[i, e] = ridge_lead  # always: nan from a step before would be felt, as 0 times it is nan
        # both bodies feel the force at one point, not the shape at its own surface: a pair of forces on two
        # points would make angular momentum out of friction times penetration
        point = wp.vec3(samples.position[i, s] + start * cell.centre)
        drift = wp.vec3()
        arm = wp.vec3()
        body = shapes.body[shape]
        if body >= 0:
            arm = point - wp.transform_point(shapes.body_q[body], shapes.body_com[body])
            if prescribed != 0:
                twist = shapes.body_qd[body]
                drift = dt * wp.spatial_top(twist) + turn(dt * wp.spatial_bottom(twist), arm)
        constraints.dof_begin[i, e] = 0
        constraints.dof_end[i, e] = 0
        constraints.shape[i, e] = shape
        constraints.body[i, e] = body
        constraints.arm[i, e] = arm
        constraints.normal[i, e] = normal
        shear = stiffness_per_area(instances, i, SHEAR_FACTOR, relative, partner_mass, partner_area, dt)
        edged = (SMOOTH >> shapes.kind[shape]) & 1 == 0
        slip, anchor = remembered_slip(
            shapes,
            shape,
            samples.position[i, s],
            normal,
            stick_shape,
            stick_point,
            instances.particle_start[i] + s,
            prescribed,
        )
        # d enters as offset + displacement, with the gap along the normal and the shape's own motion taken off
        constraints.offset[i, e] = (gap - turned - cell.lead) * normal + slip - wp.vec3d(drift)
        constraints.lead[i, e] = cell.lead
        constraints.onset[i, e] = cell.onset
        constraints.anchor[i, e] = anchor
        stick = stick_ratio * wp.float64(shear * area)
        constraints.stick_deep[i, e] = stick
        constraints.stick[i, e] = stick / (wp.float64(1.0) + stick * shear_yield(instances, i, compliance, touched))
        constraints.stiffness[i, e] = stiffness
        constraints.dent_compliance[i, e] = compliance
        depth = dent_depth(instances, i, surface.dent_length[row], edged)
        constraints.dent_depth[i, e] = wp.float64(spared * depth) + HARDENING_DEPTH * cell_shape.least
        constraints.partner_row[i, e] = row
        if wp.length_sq(cell.centre) > wp.float64(0.0):
            constraints.row[i, e] = surface.first_row + i * surface.row_max + e
            write_row(basis, constraints.row[i, e], row, cell.centre)
        constraints.friction[i, e] = wp.float64(wp.sqrt(instances.friction[i] * shapes.friction[shape]))


@wp.kernel
def gather_pins(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    shapes: Shapes,
    first_row: int,
    pin_body: wp.array[int],  # (pin_total,), rigid body that holds the target, -1 for the world
    pin_stiffness: wp.array[float],  # (pin_total,) [N/m], negative while released
    pin_target: wp.array[wp.vec3d],  # (pin_total,), in the frame of that body [m]
    prescribed: int,
    dt: float,
    # Out:
    constraints: PointConstraints,
    status: wp.array[int],  # (world_count,)
):
    """Write the pins of an instance as its first constraints: offset = x_n - target; flag what is no number."""
    i, e = wp.tid()
    if e >= instances.pin_count[i]:
        return
    pin = instances.pin_start[i] + e
    row = first_row + pin
    x = basis.row_point[row] + interpolate(basis.row, row, motion.q_start, i, instances.function_count[i])
    constraints.row[i, e] = row
    body = pin_body[pin]
    target = pin_target[pin]
    bits = int(0)
    if not wp.isfinite(pin_stiffness[pin]):
        bits = wp.static(PARAMETER_BITS["pin_stiffness"])
    if pin_stiffness[pin] > 0.0 and not wp.isfinite(target):
        bits |= wp.static(PARAMETER_BITS["pin_target"])
    if bits != 0:
        wp.atomic_or(status, instances.world[i], bits | WORLD_PARAMETER_RANGE)
    if body >= 0:
        pose = shapes.body_q[body]
        rotation = wp.transform_get_rotation(pose)
        arm = wp.quat_rotate(rotation, wp.vec3(target) - shapes.body_com[body])
        # only the offset is large far from the world's origin
        target = wp.vec3d(wp.transform_get_translation(pose)) + wp.vec3d(wp.quat_rotate(rotation, wp.vec3(target)))
        if prescribed != 0:
            twist = shapes.body_qd[body]
            target += wp.vec3d(dt * wp.spatial_top(twist) + turn(dt * wp.spatial_bottom(twist), arm))
        constraints.arm[i, e] = arm
    constraints.dof_begin[i, e] = 0
    constraints.dof_end[i, e] = 0
    constraints.shape[i, e] = -1
    constraints.body[i, e] = body
    constraints.offset[i, e] = x - target
    constraints.stiffness[i, e] = wp.float64(wp.max(pin_stiffness[pin], 0.0))


@wp.kernel
def constraint_jacobians(
    instances: Instances,
    rigid: Rigid,
    # In and out:
    constraints: PointConstraints,
):
    """Compute the motion of the rigid body at each contact or pin per unit joint motion: J_v - arm x J_w."""
    i, e = wp.tid()
    w = instances.world[i]
    if e >= constraints.count[i] or rigid.count[w] == 0:
        return
    body = constraints.body[i, e]
    if body < 0:
        return
    a = rigid.body_articulation[body]
    if a < 0:
        return
    begin = rigid.articulation_dof_start[a] - rigid.dof_start[w]
    constraints.dof_begin[i, e] = begin
    constraints.dof_end[i, e] = begin + rigid.articulation_dof_count[a]
    r = 6 * rigid.body_link[body]
    J = rigid.jacobian
    for local in range(rigid.articulation_dof_count[a]):
        linear = wp.vec3(J[a, r, local], J[a, r + 1, local], J[a, r + 2, local])
        angular = wp.vec3(J[a, r + 3, local], J[a, r + 4, local], J[a, r + 5, local])
        constraints.jacobian[i, e, begin + local] = linear + wp.cross(angular, constraints.arm[i, e])
