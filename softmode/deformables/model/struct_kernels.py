"""What the kernels of a step read and write, in groups.

One *instance* is one body in one world; replicas of a body share the rows of its basis. Functions are stored in blocks
of eight (see ``lanes``): an array over the unknowns of an instance has the blocks of x first, then those of y and z,
entry ``component * block_count + block``, which is also the order of the linear system. Padding is zero everywhere.
"""

from typing import Any

import warp as wp

from softmode.deformables.model.declare import struct
from softmode.deformables.model.lane_kernels import by_eights, sum8d, sum_of_lanes, vec8, vec8d

OVERLAP = wp.constant(0.05)
"""Deepest gap that a step starts from, as a fraction of the body's size: what overlaps more, as when it was placed
wrongly, is pushed out by that much a step instead of being thrown out."""
VANISHING = wp.constant(1.0e-6)
"""Largest value of a function that counts as none. Their mean square over the body is one; on an exact region rounding
leaves 1e-15."""
SLOTS = 2
"""What a surface sample may touch at a time: the deepest two shapes, and the nearest two other soft bodies."""
vec6 = wp.types.vector(length=6, dtype=float)
mat23d: Any = wp.types.matrix(shape=(SLOTS, 3), dtype=wp.float64)


@struct
class Basis:
    """The bases of all bodies, one after another; *rows* are the points at which functions are evaluated."""

    gradient: wp.array3d[vec8]  # (block_count, point_total, 3) [1/m], points side by side in memory
    gradient_across: wp.array3d[vec8]  # the same; on CUDA with blocks side by side, for kernels with a thread per block
    point_weight: wp.array[wp.float64]  # (point_total,) [m^3]
    stiffness_scale: wp.array[float]  # (point_total,), mu over the body's
    lame_ratio: wp.array[float]  # (point_total,), lambda / mu over the body's
    mean: wp.array2d[vec8d]  # (asset_count, block_count)
    linear: wp.array2d[wp.vec4d]  # (asset_count, stride), c with sum_k b_k c_k = (X, Y, Z, 1)
    row: wp.array2d[vec8]  # (row_total, block_count): samples of all bodies, pins, dynamic rows of shapes, of pairs
    row_point: wp.array[wp.vec3d]  # (row_total,), less those of pairs [m]
    row_area: wp.array[float]  # (row_total,), less dynamic rows [m^2]
    row_normal: wp.array[wp.vec3]  # (sample_total,), outward at rest
    row_gradient: wp.array3d[vec8]  # (block_count, sample_total, 3) [1/m]
    inner_row: wp.array2d[vec8]  # (sample_total, block_count), difference to a point inside the body
    inner_point: wp.array[wp.vec3d]  # (sample_total,) [m]


@struct
class Instances:
    """Where each instance finds its data, and its parameters."""

    world: wp.array[int]
    asset: wp.array[int]
    function_start: wp.array[int]  # first function in the state's arrays
    function_count: wp.array[int]
    driven_count: wp.array[int]  # leading functions that are prescribed
    point_start: wp.array[int]
    point_count: wp.array[int]
    row_start: wp.array[int]
    sample_count: wp.array[int]
    particle_start: wp.array[int]
    system: wp.array[int]  # linear system that holds its unknowns, and
    system_block: wp.array[int]  # their first block there
    pin_start: wp.array[int]
    pin_count: wp.array[int]
    link_pin_count: wp.array[int]  # pins that follow a rigid body
    scale: wp.array[float]  # size over that of the asset, s; what follows from it and from density is derived with it:
    mass: wp.array[wp.float64]  # [kg]
    inertia: wp.array[float]  # density times the square of the size [kg/m]
    size: wp.array[float]  # diagonal of the bounding box [m]
    tolerance: wp.array[float]  # [m], root mean square
    margin: wp.array[float]  # contact detection distance [m]
    smoothing: wp.array[float]  # range of the onset of a level contact where the body is not thin [m]
    material_model: wp.array[int]
    youngs_modulus: wp.array[float]  # [Pa]
    poissons_ratio: wp.array[float]
    viscosity: wp.array[float]  # [s]
    mass_damping: wp.array[float]  # [1/s]
    friction: wp.array[float]
    area: wp.array[float]  # of the surface samples [m^2]
    contact_stiffness: wp.array[float]  # [Pa/m], 0 where it follows the body; see ``stiffness_per_area``
    contact_radius: wp.array[float]  # how far the surface stands out [m]
    self_contact: wp.array[int]  # whether the body may touch itself


@struct
class Motion:
    """The step's data per unknown, shape (instance_count, 3 block_count) where not said."""

    q_start: wp.array2d[vec8d]  # q_n [m]
    qd_start: wp.array2d[vec8d]  # v_n [m/s]
    q_rate: wp.array2d[vec8d]  # v = c (q - q_rate) / dt at the end of the step [m]
    q_inertial: wp.array2d[vec8d]  # where the body would go without forces [m]
    change: wp.array2d[vec8d]  # dt (v_n - v_(n-1)), 0 where there was no step before [m]
    force: wp.array2d[vec8d]  # gravity and external forces [N]
    rate: wp.array[wp.float64]  # (instance_count,), c: 1 implicit Euler, 3/2 BDF2


@struct
class Points:
    """Results at the cubature points."""

    start: wp.array2d[wp.mat33d]  # (instance_count, point_max), elastic F - I at the step's start, of viscous bodies
    energy: wp.array2d[wp.float64]  # (instance_count, point_max) [J]
    stress: wp.array2d[wp.mat33d]  # (instance_count, point_max), V P [N m]
    hessian: wp.array3d[wp.mat33]  # (instance_count, 6, point_max), blocks 00, 01, 02, 11, 12, 22 of V d2Psi/dF2 [N m]
    volume_ratio: wp.array2d[float]  # (instance_count, point_max), J


@struct
class PointConstraints:
    """Point constraints of an instance: pins, contacts with shapes in sample order, contacts with soft bodies."""

    count: wp.array[int]  # (instance_count,)
    pair_count: wp.array[int]  # (instance_count,), the last of them: contacts with soft bodies
    row: wp.array2d[int]  # (instance_count, constraint_max)
    shape: wp.array2d[int]  # -1 for a pin
    body: wp.array2d[int]  # rigid body on the other side: of the shape, or that a pin follows; -1 for none
    partner: wp.array2d[int]  # the other instance, of a contact between two soft bodies; -1 within one
    partner_row: wp.array2d[int]  # and the row of its touched point; of a contact with a shape that of its sample
    arm: wp.array2d[wp.vec3]  # from the centre of mass of that body [m]
    normal: wp.array2d[wp.vec3d]
    offset: wp.array2d[wp.vec3d]  # pin: x_n - target; contact: gap n + memory; less the drift of a prescribed body [m]
    stiffness: wp.array2d[wp.float64]  # [N/m]
    dent_compliance: wp.array2d[wp.float64]  # contacts: of the dent in series with it [m/N]
    dent_depth: wp.array2d[wp.float64]  # contacts: dent from which on they harden [m]
    onset: wp.array2d[wp.float64]  # contacts: range of the gaps of the sample's cell [m], and
    lead: wp.array2d[wp.float64]  # how much earlier than the sample its cell begins to touch [m]
    ridge: wp.array2d[wp.float64]  # contacts: stiffness of edges in the sample's cell over that of its penalty, and
    ridge_lead: wp.array2d[wp.float64]  # how much deeper they are in than its face [m]
    friction: wp.array2d[wp.float64]
    stick: wp.array2d[wp.float64]  # tangential stiffness of a contact with memory [N/m]; 0: smoothed Coulomb friction
    stick_deep: wp.array2d[wp.float64]  # the same where the dent along the surface is used up [N/m]
    anchor: wp.array2d[wp.vec3d]  # where the sample stuck at the start of the step, in the shape's frame [m]
    displacement: wp.array2d[wp.vec3d]  # of the last evaluation, relative to the other side [m]
    slip: wp.array2d[wp.vec3d]  # tangential displacement, that of the memory included [m]
    normal_force: wp.array2d[wp.float64]  # of the last iterates, for friction [N]
    energy: wp.array2d[wp.float64]  # [J]
    force: wp.array2d[wp.vec3d]  # on the soft body [N]
    hessian: wp.array2d[wp.mat33]  # [N/m]
    acting: wp.array2d[int]  # all pins, then the contacts that act, in order: those with a force or a Hessian
    acting_count: wp.array[int]  # (instance_count,)
    dof_begin: wp.array2d[int]  # the rigid unknowns that move the shape; an empty range where none does
    dof_end: wp.array2d[int]
    jacobian: wp.array3d[wp.vec3]  # (instance_count, constraint_max, rigid_max), motion of the shape per such unknown
    coupling: wp.array3d[wp.vec3]  # hessian times jacobian


@struct
class Rigid:
    """Joint dofs that are unknowns of the solve, r = dt * joint velocity; see ``rigid_dofs``."""

    count: wp.array[int]  # (world_count,), 0 in a step in which no soft body of the world is near a rigid one
    dof_start: wp.array[int]  # (world_count,), first joint dof of a world
    inertia: wp.array3d[wp.float64]  # (world_count, rigid_max, rigid_max), M_eff / dt^2
    predicted: wp.array2d[wp.float64]  # (world_count, rigid_max)
    r: wp.array2d[wp.float64]
    trial: wp.array2d[wp.float64]
    gradient: wp.array2d[wp.float64]
    direction: wp.array2d[wp.float64]
    matrix: wp.array3d[wp.float64]  # (world_count, rigid_max, rigid_max)
    pivot_floor: wp.array2d[wp.float64]  # (world_count, rigid_max), Cholesky pivots of the inertia
    pivot_min: wp.array2d[wp.float64]  # (world_count, rigid_max), least pivots of the condensed matrix
    body_articulation: wp.array[int]  # (body_count,), -1 for none
    body_link: wp.array[int]  # (body_count,), row block in the articulation's Jacobian
    articulation_dof_start: wp.array[int]
    articulation_dof_count: wp.array[int]
    jacobian: wp.array3d[float]  # (articulation_count, 6 link_max, dof_max), twists of centres of mass, world frame
    # MuJoCo's constraint rows, (world_count, row_max), see ``rigid_row_kernels``:
    row_count: wp.array[int]  # (world_count,)
    row_kind: wp.array2d[int]
    row_size: wp.array2d[int]  # rows of an elliptic cone, at its first
    row_start: wp.array2d[wp.float64]  # x = J a - a_ref in the prediction
    row_stiffness: wp.array2d[wp.float64]  # D
    row_limit: wp.array2d[wp.float64]  # friction loss; in a cone mu, then the friction coefficients
    row_jacobian: wp.array3d[float]  # (world_count, row_max, rigid_max)
    row_change: wp.array2d[wp.float64]  # x - x of the prediction, in cones
    row_energy: wp.array2d[wp.float64]  # [J]
    row_force: wp.array2d[wp.float64]
    row_coupling: wp.array3d[wp.float64]  # second derivative times Jacobian / dt^2


@struct
class NewtonState:
    """Where Newton's iteration stands in each world, shape (world_count,) where not said."""

    instance_start: wp.array[int]  # (world_count + 1,)
    active: wp.array[int]
    searching: wp.array[int]
    solving: wp.array[int]  # whether this round of launches is to find a direction
    extends: wp.array[int]  # whether steps longer than the full one are tried: until one was none the better
    evaluated: wp.array[int]  # whether the iterate is the last trial: what does not depend on friction is evaluated
    last: wp.array[int]  # whether every body moves less than its tolerance in this iteration
    in_contact: wp.array[int]  # whether a body of the world is near a shape
    refresh: wp.array[int]  # whether the elastic Hessian is to be evaluated
    project: wp.array[int]  # whether it is projected to positive semidefinite; Newton's own converges faster
    failures: wp.array[int]  # how often Newton's own was indefinite in this step
    exact: wp.array[int]  # whether friction takes its own curvature
    iteration: wp.array[int]
    status: wp.array[int]
    potential: wp.array[wp.float64]  # [J]
    slope: wp.array[wp.float64]  # [J]
    step_length: wp.array[wp.float64]
    rounding: wp.array[wp.float64]  # what rounding leaves of the elastic energy [J]
    reached: wp.array[wp.float64]  # potential after a full step, while a longer one is tried [J]
    cached: wp.array[int]  # whether the elastic Hessian in memory is Newton's own, of some iterate
    cached_q: wp.array2d[vec8d]  # (instance_count, 3 block_count), that iterate [m], and
    cached_key: wp.array[vec6]  # (instance_count,), what else it is made of: see ``hessian_key``
    friction_lag: int  # iterations during which the normal force of friction follows the contact
    any_active: wp.array[int]  # (1,)
    any_searching: wp.array[int]  # (1,)
    any_left: wp.array[int]  # (1,), whether another round of launches is worth it
    rounds_left: wp.array[int]  # (1,), how many more there may be
    expected: wp.array[float]  # iterations that a world is expected to take, from those of the steps before
    level_count: wp.array[int]  # (LEVELS,), how many worlds are expected to take so many
    aside: wp.array[int]  # whether the world goes its whole way beside the rounds of launches


@wp.func
def exists(instances: Instances, i: int):
    """Return whether an instance is a body: one that is none has no functions, points and samples."""
    return instances.function_count[i] > 0


@wp.func
def instance_end(instances: Instances, instance_start: wp.array[int], w: int):
    """Return the end of the instances of a world, less the last ones that are no bodies."""
    end = instance_start[w + 1]
    while end > instance_start[w]:
        if exists(instances, end - 1):
            break
        end -= 1
    return end


@wp.func
def has_contacts(instances: Instances, constraints: PointConstraints, i: int):
    """Return whether an instance is near a shape: its constraints are more than its pins."""
    return constraints.count[i] > instances.pin_count[i]


@wp.func
def pushes(instances: Instances, constraints: PointConstraints, i: int):
    """Return whether an instance may push another body: it is near a shape or fixed to a rigid body."""
    return instances.link_pin_count[i] > 0 or has_contacts(instances, constraints, i)


@wp.func
def first_coupled(instances: Instances, i: int):
    """Return an instance's first constraint that may push a rigid body: a pin only where some pin follows a body."""
    return wp.where(instances.link_pin_count[i] > 0, 0, instances.pin_count[i])


@wp.func
def hessian_key(instances: Instances, i: int, dt: float):
    """Return what the elastic Hessian of an instance depends on besides its coordinates."""
    return vec6(
        float(instances.material_model[i]),
        instances.youngs_modulus[i],
        instances.poissons_ratio[i],
        instances.viscosity[i],
        instances.scale[i],
        dt,
    )


@wp.func
def in_mask(world: int, world_mask: wp.array[wp.bool]):
    """Return whether a mask of shape (world_count + 1,) selects a world; the last entry is that of world -1."""
    if world < 0:
        return world_mask[world_mask.shape[0] - 1]
    return world_mask[world]


@wp.func
def sample_area(scale: float, area: float):
    """Return the area [m^2] that a surface sample of the asset has on a body of some scale."""
    return scale * scale * area


@wp.func
def p_wave_modulus(youngs_modulus: float, poissons_ratio: float):
    """Return E (1 - nu) / ((1 + nu) (1 - 2 nu)) [Pa], the stiffness of a layer; callable on the host too."""
    return youngs_modulus * (1.0 - poissons_ratio) / ((1.0 + poissons_ratio) * (1.0 - 2.0 * poissons_ratio))


@wp.func
def blocks_of(function_count: int):
    """Return the number of blocks that hold so many functions."""
    return (function_count + 7) / 8


@wp.func
def interpolate(row: wp.array2d[vec8], r: int, q: wp.array2d[vec8d], i: int, function_count: int):
    """Return sum_k b_k q_k at a row."""
    stride = row.shape[1]
    x = vec8d()
    y = vec8d()
    z = vec8d()
    for b in range(blocks_of(function_count)):
        value = vec8d(row[r, b])
        x = x + wp.cw_mul(value, q[i, b])
        y = y + wp.cw_mul(value, q[i, stride + b])
        z = z + wp.cw_mul(value, q[i, 2 * stride + b])
    return wp.vec3d(sum8d(x), sum8d(y), sum8d(z))


@wp.func_native(
    snippet="""
    const int stride = 8 * row.shape[1];
    const double* x = (const double*)((const char*)q.data + (size_t)i * q.strides[0]);
    const double* from = (const double*)((const char*)q_from.data + (size_t)i * q_from.strides[0]);
    const char* values = (const char*)row.data + (size_t)r * row.strides[0];
    struct alignas(16) Four { float v[4]; };
    struct alignas(16) Two { double v[2]; };
    double sum[6] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    #pragma unroll 2
    for (int k = 4 * lane; k < function_count; k += 4 * lanes) {
        const Four b = *(const Four*)(values + k * sizeof(float));
        #pragma unroll
        for (int axis = 0; axis < 3; ++axis) {
            #pragma unroll
            for (int half = 0; half < 4; half += 2) {
                const int at = axis * stride + k + half;
                const Two here = *(const Two*)(x + at);
                const Two there = *(const Two*)(from + at);
                sum[axis] += b.v[half] * (here.v[0] - there.v[0]);
                sum[3 + axis] += b.v[half + 1] * (here.v[1] - there.v[1]);
            }
        }
    }
"""
    + sum_of_lanes("sum", 6)
    + """    return wp::vec_t<3, double>(sum[0] + sum[3], sum[1] + sum[4], sum[2] + sum[5]);
"""
)
def interpolate_change_by_fours(
    row: wp.array2d[vec8],
    r: int,
    q: wp.array2d[vec8d],
    q_from: wp.array2d[vec8d],
    i: int,
    function_count: int,
    lane: int,
    lanes: int,
) -> wp.vec3d:  # pyright: ignore[reportReturnType]
    """Return the same as ``interpolate_change``, with few registers, of functions four at a time.

    The threads of a warp, which know their ``lane``, may share it if all 32 call this with ``lanes`` 32; else it is 1.
    """
    ...


@wp.func
def interpolate_change(
    row: wp.array2d[vec8],
    r: int,
    q: wp.array2d[vec8d],
    q_from: wp.array2d[vec8d],
    i: int,
    function_count: int,
    lane: int = 0,
    lanes: int = 1,
):
    """Return sum_k b_k (q_k - q_from_k) at a row."""
    if by_eights() == 0:
        return interpolate_change_by_fours(row, r, q, q_from, i, function_count, lane, lanes)
    stride = row.shape[1]
    x = vec8d()
    y = vec8d()
    z = vec8d()
    for b in range(blocks_of(function_count)):
        value = vec8d(row[r, b])
        x = x + wp.cw_mul(value, q[i, b] - q_from[i, b])
        y = y + wp.cw_mul(value, q[i, stride + b] - q_from[i, stride + b])
        z = z + wp.cw_mul(value, q[i, 2 * stride + b] - q_from[i, 2 * stride + b])
    return wp.vec3d(sum8d(x), sum8d(y), sum8d(z))


@struct
class Samples:
    """Surface samples at the start of the step, shape (instance_count, sample_max), and what they found."""

    position: wp.array2d[wp.vec3d]  # [m]
    drift: wp.array2d[wp.vec3]  # dt v [m]
    near: wp.array2d[int]  # a bit per candidate shape that it may touch, of the first 31; all where nothing is culled
    shape: wp.array3d[int]  # (..., SLOTS), -1 where empty
    gap: wp.array3d[wp.float64]  # (..., SLOTS) [m]
    normal: wp.array3d[wp.vec3]  # (..., SLOTS)
    part: wp.array3d[float]  # (..., SLOTS), of the sample's cell what lies under a face
    constraint: wp.array3d[int]  # (..., SLOTS), the point constraint it became, -1 for none
    lower: wp.array[wp.vec3]  # (instance_count,) bounds, grown by margin and drift [m]
    upper: wp.array[wp.vec3]
    drift_lower: wp.array[wp.vec3]  # (instance_count,) bounds of the drift [m]
    drift_upper: wp.array[wp.vec3]
    reach: wp.array3d[wp.vec3]  # (instance_count, team, 4), scratch of the bounds
    tally: wp.array3d[int]  # (instance_count, team, 2), scratch of the contacts' order
