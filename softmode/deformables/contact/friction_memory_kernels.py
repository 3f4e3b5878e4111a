"""Memory of friction: where every surface sample sticks, carried from step to step in the state.

A contact that sticks is a spring, so a body at rest stays where it is; what exceeds the cone slides and is lost. The
memory of a sample is, per slot, the shape it sticks to and a point in that shape's frame (see ``remember_slip``).
"""

import warp as wp

from softmode.deformables.contact.detection_kernels import Shapes, shape_frame
from softmode.deformables.contact.penalty_kernels import elastic_slip
from softmode.deformables.model.struct_kernels import SLOTS, Instances, PointConstraints, Samples, in_mask, mat23d

wp.set_module_options({"enable_backward": False})


@wp.kernel
def remember_slip(
    instances: Instances,
    shapes: Shapes,
    samples: Samples,
    constraints: PointConstraints,
    prescribed: int,
    # State out:
    stick_shape_out: wp.array[wp.vec2i],
    stick_point_out: wp.array[mat23d],
):
    """Write what every sample touches at the end of the step, and where: what of its slip is elastic stays there.

    The rest is slid; without friction, or friction that remembers, all of it. A contact that has opened has no friction
    to hold a displacement, and is forgotten. Shapes with dofs in the solve keep the anchor, to the bit while the
    contact sticks, so that errors of the solve do not add up; shapes that move as prescribed keep the displacement
    itself, in their frame, because a belt moves without its pose.
    """
    i, s = wp.tid()
    if s >= instances.sample_count[i]:
        return
    stuck = wp.vec2i(-1, -1)
    points = mat23d()
    for slot in range(SLOTS):
        e = samples.constraint[i, s, slot]
        if e < 0:
            continue
        if not (constraints.normal_force[i, e] > wp.float64(0.0)):
            continue
        limit = constraints.friction[i, e] * constraints.normal_force[i, e]
        origin, rotation = shape_frame(shapes, constraints.shape[i, e])
        total = constraints.slip[i, e]
        slid = wp.length(total)
        most = elastic_slip(limit, constraints.stick[i, e], constraints.stick_deep[i, e], constraints.dent_depth[i, e])
        if not wp.isfinite(slid + most):
            continue
        elastic = total
        if slid > most:
            elastic = most / slid * total
        point = constraints.anchor[i, e]
        if prescribed != 0:
            point = wp.quat_rotate_inv(rotation, elastic)
        elif slid > most:
            n = constraints.normal[i, e]
            before = constraints.offset[i, e] - wp.dot(n, constraints.offset[i, e]) * n
            held = samples.position[i, s] - before + total - elastic
            point = wp.quat_rotate_inv(rotation, held - origin)
        stuck[slot] = constraints.shape[i, e]
        points[slot] = point
    particle = instances.particle_start[i] + s
    stick_shape_out[particle] = stuck
    stick_point_out[particle] = points


@wp.kernel
def forget_slip(
    instances: Instances,
    instance_world: wp.array[int],
    world_mask: wp.array[wp.bool],
    # State out:
    stick_shape_out: wp.array[wp.vec2i],
    stick_partner_out: wp.array[wp.vec2i],
    dent_out: wp.array[wp.vec3],
):
    """Let the samples in masked worlds stick to nothing, and have no dent."""
    i, s = wp.tid()
    if s < instances.sample_count[i] and in_mask(instance_world[i], world_mask):
        stick_shape_out[instances.particle_start[i] + s] = wp.vec2i(-1, -1)
        stick_partner_out[instances.particle_start[i] + s] = wp.vec2i(-1, -1)
        dent_out[instances.particle_start[i] + s] = wp.vec3()
