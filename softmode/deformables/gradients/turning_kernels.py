"""Whether the normal of a contact turns as its point moves along the shape, which the adjoint takes for fixed."""

import warp as wp

from softmode.deformables.contact.detection_kernels import Shapes, shape_frame
from softmode.deformables.contact.shape_query_kernels import HEIGHTFIELD, PLANE, query_heightfield, query_shape
from softmode.deformables.model.struct_kernels import SLOTS, Instances, PointConstraints, Samples

wp.set_module_options({"enable_backward": False})

STEP = wp.constant(1.0e-3)
"""How far a sample is moved along the shape, in sizes of its body."""


@wp.kernel
def find_turning(
    instances: Instances,
    samples: Samples,
    shapes: Shapes,
    constraints: PointConstraints,
    # Out:
    turning_out: wp.array[float],  # (instance_count,), set before to 0
):
    """Find the most that the normal of a pressing contact turns over a size of the body [rad]."""
    i, e = wp.tid()
    if e >= constraints.count[i] or e < instances.pin_count[i]:
        return
    shape = constraints.shape[i, e]
    kind = shapes.kind[shape]
    if kind == PLANE or wp.length_sq(constraints.force[i, e]) == wp.float64(0.0):
        return
    if constraints.ridge[i, e] > wp.float64(0.0):  # edges of a box in the cell have its normal
        wp.atomic_max(turning_out, i, 1.0)
        return
    origin, rotation = shape_frame(shapes, shape)
    s = constraints.partner_row[i, e] - instances.row_start[i]
    for slot in range(SLOTS):
        if samples.constraint[i, s, slot] == e and samples.part[i, s, slot] < 1.0:
            return  # the normal is that of a face, beside it too
    x = wp.vec3(wp.quat_rotate_inv(rotation, samples.position[i, s] - origin))
    n = wp.vec3(wp.quat_rotate_inv(rotation, constraints.normal[i, e]))
    across = wp.vec3()
    across[wp.argmin(wp.abs(n))] = 1.0
    across = wp.normalize(wp.cross(n, across))
    far = instances.size[i] + wp.length(shapes.upper[shape] - shapes.lower[shape])
    for direction in range(4):
        if direction == 2:
            across = wp.cross(n, across)
        y = x + wp.where(direction % 2 == 0, STEP, -STEP) * instances.size[i] * across
        query = query_shape(kind, shapes.scale[shape], shapes.source[shape], y, far)
        if kind == HEIGHTFIELD:
            query = query_heightfield(y, shapes.fields, shapes.fields.index[shape], far)
        wp.atomic_max(turning_out, i, wp.length(query.normal - n) / STEP)
