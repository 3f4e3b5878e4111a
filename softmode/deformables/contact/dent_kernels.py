"""Device code of the dents that a step leaves: how far the skin lies outside of what the functions of a body say.

A sample sinks in by p = x + v: the penalty takes x, the dent v, r / (1 + r) of it, see ``penalty_kernels``. The
functions move a sample by p; the skin that one sees and touches has moved by v less, along the normal of the contact.
"""

import warp as wp

from softmode.deformables.contact.pair_kernels import Pairs
from softmode.deformables.model.struct_kernels import SLOTS, Instances, PointConstraints, Samples

wp.set_module_options({"enable_backward": False})


@wp.func
def with_dent(dent: wp.vec3, normal: wp.vec3, depth: float):
    """Return the least change of a dent that takes the skin out by ``depth`` [m] along a normal.

    Two faces that are one, as those of two boxes side by side, dent a sample once; two that are not, along both.
    """
    return dent + wp.max(depth - wp.dot(normal, dent), 0.0) * normal


@wp.func
def own_dent(constraints: PointConstraints, share: float, i: int, e: int):
    """Return the dent [m] of a body at a contact, of which ``share`` is its part where two give way; 0 if no number."""
    total = constraints.offset[i, e] + constraints.displacement[i, e]
    ratio = constraints.stiffness[i, e] * constraints.dent_compliance[i, e]
    penetration = -wp.dot(constraints.normal[i, e], total)
    sunk = wp.max(penetration - constraints.lead[i, e], wp.float64(0.0))
    depth = share * float(ratio / (wp.float64(1.0) + ratio) * sunk)
    return wp.where(wp.isfinite(depth), depth, 0.0)


@wp.kernel
def leave_dents(
    instances: Instances,
    samples: Samples,
    constraints: PointConstraints,
    # State out:
    dent_out: wp.array[wp.vec3],  # (particle_count,) [m]
):
    """Write the dents at contacts with shapes, and none where a sample touches nothing."""
    i, s = wp.tid()
    if s >= instances.sample_count[i]:
        return
    dent = wp.vec3()
    for slot in range(SLOTS):
        e = samples.constraint[i, s, slot]
        if e >= 0:
            depth = own_dent(constraints, 1.0, i, e)
            dent = with_dent(dent, wp.vec3(constraints.normal[i, e]), depth)
    dent_out[instances.particle_start[i] + s] = dent


@wp.kernel
def leave_pair_dents(
    instances: Instances,
    pairs: Pairs,
    constraints: PointConstraints,
    # State in and out:
    dent: wp.array[wp.vec3],  # (particle_count,) [m]
):
    """Add the dents at contacts with soft bodies: of both compliances each body has its own."""
    i, s = wp.tid()
    if s >= instances.sample_count[i] or pairs.near[i] == 0:
        return
    particle = instances.particle_start[i] + s
    for slot in range(SLOTS):
        e = pairs.held[i, s, slot]
        if e < 0:
            continue
        depth = own_dent(constraints, pairs.share[i, s, slot], i, e)
        dent[particle] = with_dent(dent[particle], wp.vec3(constraints.normal[i, e]), depth)
