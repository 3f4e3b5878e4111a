"""Device side of contact between soft bodies, and of a body with itself.

The surface of a body is what its samples x_k with deformed normals n_k say: near a point x the implicit moving
least-squares surface (Kolluri 2008, doi:10.1145/1361192.1361195, eq. 1)

    gap(x) = sum_k theta_k (n_k . (x - x_k) + H_k d_k^2 / 2) / sum_k theta_k,
    theta_k = exp(-(|x - x_k|^2 - d_min^2) / h^2) max(-n . n_k - c, 0)^2,

h three quarters of the spacing of the samples, n the normal of the sample at x, c = 0.3, d_k the distance across n_k
and H_k the mean curvature at rest, by which the surface falls off its tangent planes: else a coarse ball reaches 0.6 mm
too far. It is exact for a plane, to second order for a sphere, has none of the bumps of a ball around every sample, and
is blind to what lies around a sharp edge. Samples of each body are tested against the surfaces of the others. What is
touched of the other body is the material at x, less the gap n that has to close before,

    sum_k theta_k b(X_k) / sum_k theta_k + grad b(X_t) . F_t^-1 (x - max(gap, 0) n - sum_k theta_k x_k / sum_k theta_k),

t the nearest sample: exact where the body moves affinely. Force and reaction then act on one point, and neither the
normal force nor friction turns the two bodies together.

A pair of a sample and a surface becomes a point constraint of each of the two bodies, with normal and offset of
opposite sign and one half of the energy, so that both feel the same force. Their rows are the sample's row, and a
*dynamic row*, the touched material above, written behind the static ones. A pair within one body is one constraint
whose row is the difference.
"""

import warp as wp

from softmode.deformables.contact.cell_kernels import (
    Surface,
    cell_at,
    fade_of,
    gradient_of,
    shape_of_cell,
    touched_share,
)
from softmode.deformables.contact.detection_kernels import rank_contacts
from softmode.deformables.contact.penalty_kernels import (
    BULK_FACTOR,
    HARDENING_DEPTH,
    SHEAR_FACTOR,
    beyond_penalty,
    dent_compliance,
    dent_depth,
    elastic_slip,
    shear_yield,
    stiffness_per_area,
)
from softmode.deformables.model.declare import struct
from softmode.deformables.model.lane_kernels import vec8
from softmode.deformables.model.status import WORLD_CONTACT_OVERFLOW, WORLD_PENETRATION
from softmode.deformables.model.struct_kernels import (
    OVERLAP,
    SLOTS,
    Basis,
    Instances,
    Motion,
    NewtonState,
    PointConstraints,
    Samples,
    mat23d,
    sample_area,
)

wp.set_module_options({"enable_backward": False})

NEIGHBOURS = 32
"""Samples that make up the surface about a sample: those within three spacings of it."""
BLADE_DISTANCE = wp.constant(wp.float64(1.0e10))
"""Squared distance by which samples that are not looked at come after those that are [m^2]."""
FACING = wp.constant(0.3)
"""c: one sample looks at another where the cosine between their normals is below -c. Above c they look the same way and
cannot touch: the far side of a thin body."""
WIDTH = wp.constant(0.75)
"""h in spacings."""
CUTOFF = wp.constant(9.0)
"""Exponent of theta beyond which a sample says nothing: three h."""
LATERAL = wp.constant(wp.float64(1.2))
"""How far beside the samples, in spacings, a point may lie and still be above the surface."""
FLAT = wp.constant(wp.float64(0.95))
"""How much of a surface must look one way, |sum theta n| / sum theta, to be touched by a sample that does not look at
it, as on a blade."""
ACROSS = wp.constant(wp.float64(0.5))
"""Cosine between a sample's normal and the surface's below which the sample belongs to a face around an edge."""
NEIGHBOURHOOD = wp.constant(wp.float64(2.0))
"""Distance in spacings within which such faces are looked for."""
DEPTH = wp.constant(0.3)
"""How deep a point may lie below a surface, as a fraction of the thicker of the two bodies there: beyond, it is seen
from the far side, through both."""
WINDING = wp.constant(wp.float64(0.4 * 4.0 * 3.141592653589793))
"""4 pi times the winding number, 1 inside and 0 outside, from which on a point that is said to lie half a spacing deep,
or half a wall, is in the body. Behind a wall, beside a corner and in a hollow a face that looks at it is no surface
above it: a block that fell across the rim of a mug was told to be 12 mm deep in a wall of 4 mm. Where it does cut the
wall, the wall's own samples say so."""
SELF_DISTANCE = wp.constant(wp.float64(4.0))
"""Distance at rest, in spacings, below which samples of one body are neighbours and do not touch, unless"""
SELF_OPENING = wp.constant(wp.float64(1.0))
"""they see each other across an opening at least so wide."""
VOLUME_RATIO_MIN = wp.constant(wp.float64(1.0e-2))
"""det F / s^3 below which F^-1 is kept from growing."""


@struct
class Pairs:
    """Surfaces at the start of the step and the pairs that touch, shape (instance_count, sample_max) where not said."""

    first_row: int  # first dynamic row
    neighbour: wp.array2d[int]  # (sample_total, NEIGHBOURS), nearest samples at rest, the sample itself first; -1 pads
    surface_normal: wp.array2d[wp.vec3]  # outward, of unit length
    surface_area: wp.array2d[float]  # of the cells as they are deformed [m^2]
    thickness: wp.array[float]  # (sample_total,), of the asset at rest below each static row [m]
    spacing: wp.array[float]  # (instance_count,) of the samples [m]
    near: wp.array[int]  # (instance_count,), whether its bounds meet those of another body
    other: wp.array3d[int]  # (..., SLOTS), instance, -1 where empty
    gap: wp.array3d[wp.float64]  # (..., SLOTS) [m]
    normal: wp.array3d[wp.vec3d]  # (..., SLOTS), outward from the other body
    nearest: wp.array3d[int]  # (..., SLOTS), its nearest sample
    share: wp.array3d[float]  # (..., SLOTS), of the sample's own body in the dent of both
    tally: wp.array3d[int]  # (instance_count, team, 2), scratch of the list
    held: wp.array3d[int]  # (..., SLOTS), the point constraint it became, -1 for none
    count: wp.array[int]  # (instance_count,)
    sample: wp.array2d[int]  # (instance_count, pair_max): sample * SLOTS + slot
    constraint: wp.array2d[int]  # (instance_count, pair_max), -1 where dropped
    mirror: wp.array2d[int]  # (instance_count, pair_max), constraint of the other body


@struct
class Patch:
    """The surface of a body near a point."""

    total: wp.float64  # sum theta, 0 where there is no surface
    gap: wp.float64  # [m]
    normal: wp.vec3d
    drift: wp.vec3  # mean motion of the step [m]


@wp.func
def cofactor(F: wp.mat33d):
    """Return cof F = det(F) F^-T, whose columns are the cross products of those of F."""
    T = wp.transpose(F)
    return wp.matrix_from_cols(wp.cross(T[1], T[2]), wp.cross(T[2], T[0]), wp.cross(T[0], T[1]))


@wp.func
def clamped_inverse(F: wp.mat33d, scale: float):
    """Return F^-1, with det F raised where a body of scale s is crushed."""
    s = wp.float64(scale)
    return wp.transpose(cofactor(F)) / wp.max(wp.determinant(F), s * s * s * VOLUME_RATIO_MIN)


@wp.func
def meets(instances: Instances, samples: Samples, i: int, j: int):
    """Return whether the grown bounds of two instances overlap."""
    for axis in range(3):
        if samples.lower[i][axis] > samples.upper[j][axis] or samples.lower[j][axis] > samples.upper[i][axis]:
            return False
    return True


@wp.kernel
def mark_near(
    instances: Instances,
    state: NewtonState,
    samples: Samples,
    # Out:
    pairs: Pairs,
    any_near: wp.array[int],  # (1,), set before to 0
):
    """Mark the instances that may touch another one or themselves."""
    i = wp.tid()
    w = instances.world[i]
    near = instances.self_contact[i]
    for j in range(state.instance_start[w], state.instance_start[w + 1]):
        if j != i and meets(instances, samples, i, j):
            near = 1
    pairs.near[i] = near
    if near != 0:
        wp.atomic_max(any_near, 0, 1)


@wp.kernel
def place_surface(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    samples: Samples,
    # Out:
    pairs: Pairs,
):
    """Write the areas A |cof(F) N| and the normals cof(F) N of the bodies that are near another."""
    i, s = wp.tid()
    if s >= instances.sample_count[i] or pairs.near[i] == 0:
        return
    row = instances.row_start[i] + s
    F = gradient_of(instances, basis, motion.q_start, i, row)
    normal = cofactor(F) * wp.vec3d(basis.row_normal[row])
    pairs.surface_normal[i, s] = wp.vec3(wp.normalize(normal))
    pairs.surface_area[i, s] = basis.row_area[row] * float(wp.length(normal))


@wp.func
def may_touch(instances: Instances, basis: Basis, pairs: Pairs, i: int, s: int, j: int, t: int):
    """Return whether sample s of instance i may touch sample t of instance j."""
    facing = wp.dot(pairs.surface_normal[i, s], pairs.surface_normal[j, t])
    if j != i:
        return pairs.near[j] != 0 and facing < FACING
    if instances.self_contact[i] == 0 or facing >= 0.0:
        return False
    own = instances.row_start[i] + s
    row = instances.row_start[i] + t
    away = wp.float64(instances.scale[i]) * (basis.row_point[row] - basis.row_point[own])
    spacing = wp.float64(pairs.spacing[i])
    opening = wp.min(wp.dot(wp.vec3d(basis.row_normal[own]), away), -wp.dot(wp.vec3d(basis.row_normal[row]), away))
    return wp.length(away) > SELF_DISTANCE * spacing or opening > SELF_OPENING * spacing


@wp.func
def looks_at(pairs: Pairs, i: int, s: int, j: int, t: int):
    """Return whether sample s of instance i looks at sample t of instance j."""
    return wp.dot(pairs.surface_normal[i, s], pairs.surface_normal[j, t]) < -FACING


@wp.func
def weigh(samples: Samples, pairs: Pairs, i: int, s: int, j: int, t: int, nearest: int):
    """Return theta of sample t of instance j for sample s of instance i, 0 where it is negligible.

    Where s does not look at the nearest sample it looks at none, and all count alike.
    """
    h = wp.float64(WIDTH * pairs.spacing[j])
    x = samples.position[i, s]
    least = wp.length_sq(x - samples.position[j, nearest])
    distance = wp.length_sq(x - samples.position[j, t])
    exponent = (distance - least) / (h * h)
    if exponent > wp.float64(CUTOFF):
        return wp.float64(0.0)
    ramp = float(1.0)
    if looks_at(pairs, i, s, j, nearest):
        ramp = wp.max(-wp.dot(pairs.surface_normal[i, s], pairs.surface_normal[j, t]) - FACING, 0.0)
    return wp.exp(-exponent) * wp.float64(ramp * ramp)


@wp.func
def beside(samples: Samples, pairs: Pairs, x: wp.vec3d, j: int, row: int, centre: wp.vec3d, n: wp.vec3d):
    """Return whether x lies beyond a convex edge of the surface with normal n about ``centre``; ``row`` is nearest.

    So it does where it is in front of a face around the edge, and the surface is behind that face.
    """
    reach = NEIGHBOURHOOD * wp.float64(pairs.spacing[j])
    found = bool(False)
    for k in range(NEIGHBOURS):
        t = pairs.neighbour[row, k]
        if t < 0:
            break
        face = wp.vec3d(pairs.surface_normal[j, t])
        at = samples.position[j, t]
        if (
            wp.abs(wp.dot(face, n)) < ACROSS
            and wp.length_sq(x - at) < reach * reach
            and wp.dot(face, x - at) > wp.float64(0.0)
            and wp.dot(face, centre - at) < wp.float64(0.0)
            and wp.dot(n, at - centre) < wp.float64(0.0)
        ):
            found = True
    return found


@wp.func
def is_nearer(samples: Samples, pairs: Pairs, i: int, s: int, j: int, row: int, depth: wp.float64):
    """Return whether a face of j that sample s of i does not look at is nearer to it than half of a depth.

    The sample then pushes along that face at most: those of its own body that look at the face do.
    """
    x = samples.position[i, s]
    reach = LATERAL * wp.float64(pairs.spacing[j])
    found = bool(False)
    for k in range(NEIGHBOURS):
        t = pairs.neighbour[row, k]
        if t < 0:
            break
        away = x - samples.position[j, t]
        height = wp.dot(wp.vec3d(pairs.surface_normal[j, t]), away)
        aside = wp.length_sq(away) - height * height
        if wp.float64(2.0) * wp.abs(height) < depth and aside < reach * reach and not looks_at(pairs, i, s, j, t):
            found = True
    return found


@wp.func
def is_inside(instances: Instances, samples: Samples, pairs: Pairs, x: wp.vec3d, j: int):
    """Return whether x lies in instance j by the winding number of its samples, sum A_k n_k . r_k / (4 pi r_k^3)."""
    total = wp.float64(0.0)
    for t in range(instances.sample_count[j]):
        away = samples.position[j, t] - x
        area = wp.float64(pairs.surface_area[j, t])
        distance = wp.length_sq(away) + wp.float64(0.1) * area  # finite at a sample
        slope = wp.dot(wp.vec3d(pairs.surface_normal[j, t]), away)
        total += area * slope / (distance * wp.sqrt(distance))
    return total > WINDING


@wp.func
def fit_patch(
    instances: Instances,
    basis: Basis,
    samples: Samples,
    curvature: wp.array[float],
    pairs: Pairs,
    i: int,
    s: int,
    j: int,
    t: int,
):
    """Fit the surface of instance j near sample s of instance i; t is its nearest sample, as ``find_pairs`` says."""
    patch = Patch()
    x = samples.position[i, s]
    offset = wp.vec3d()
    row = instances.row_start[j] + t
    for k in range(NEIGHBOURS):
        u = pairs.neighbour[row, k]
        if u < 0:
            break
        if may_touch(instances, basis, pairs, i, s, j, u):
            away = x - samples.position[j, u]
            theta = weigh(samples, pairs, i, s, j, u, t)
            n = wp.vec3d(pairs.surface_normal[j, u])
            height = wp.dot(n, away)
            bend = 0.5 * curvature[instances.row_start[j] + u] / instances.scale[j]
            patch.total += theta
            patch.gap += theta * (height + wp.float64(bend) * (wp.length_sq(away) - height * height))
            patch.normal += theta * n
            patch.drift += float(theta) * samples.drift[j, u]
            offset += theta * away
    if patch.total <= wp.float64(0.0):
        return patch
    inverse = wp.float64(1.0) / patch.total
    patch.gap = inverse * patch.gap
    flat = inverse * wp.length(patch.normal)
    patch.normal = wp.normalize(patch.normal)
    patch.drift = float(inverse) * patch.drift
    offset = inverse * offset
    lateral = offset - wp.dot(offset, patch.normal) * patch.normal
    own = instances.scale[i] * pairs.thickness[instances.row_start[i] + s]
    wall = instances.scale[j] * pairs.thickness[row]
    thick = wp.max(own, wall)
    if wp.length(lateral) > LATERAL * wp.float64(pairs.spacing[j]) or patch.gap < wp.float64(-DEPTH * thick):
        patch.total = wp.float64(0.0)
    elif flat < FLAT and not looks_at(pairs, i, s, j, t):
        patch.total = wp.float64(0.0)
    elif beside(samples, pairs, x, j, row, x - offset, patch.normal):
        patch.total = wp.float64(0.0)
    elif j != i and patch.gap < wp.float64(-0.5) * wp.min(wp.float64(pairs.spacing[j]), wp.float64(wall)):
        if is_nearer(samples, pairs, i, s, j, row, -patch.gap) or not is_inside(instances, samples, pairs, x, j):
            patch.total = wp.float64(0.0)
    return patch


@wp.func
def search_radius(instances: Instances, samples: Samples, pairs: Pairs, i: int, s: int, j: int):
    """Return how far from sample s of instance i samples of instance j are looked for [m], 0 where it is not near.

    Margin, contact radii and twice the motion relative to the other body, whichever of the two moves.
    """
    if pairs.near[j] == 0 or (j == i and instances.self_contact[i] == 0):
        return float(0.0)
    x = wp.vec3(samples.position[i, s])
    drift = samples.drift[i, s]
    motion = wp.max(wp.abs(drift - samples.drift_lower[j]), wp.abs(drift - samples.drift_upper[j]))
    reach = instances.margin[i] + 2.0 * wp.length(motion) + instances.contact_radius[i]
    grow = wp.vec3(reach)
    if wp.min(x - samples.lower[j] + grow) < 0.0 or wp.min(samples.upper[j] + grow - x) < 0.0:
        return float(0.0)
    return reach + instances.contact_radius[j] + wp.sqrt(CUTOFF) * WIDTH * pairs.spacing[j]


@wp.kernel
def find_pairs(
    instances: Instances,
    basis: Basis,
    state: NewtonState,
    samples: Samples,
    curvature: wp.array[float],  # (sample_total,), mean of the asset at rest [1/m]
    # In and out:
    pairs: Pairs,
):
    """Find the surfaces within reach of each sample: margin plus twice the relative motion of the step."""
    i, s = wp.tid()
    if pairs.near[i] == 0 or s >= instances.sample_count[i]:
        return
    for slot in range(SLOTS):
        pairs.other[i, s, slot] = -1
        pairs.held[i, s, slot] = -1
    x = samples.position[i, s]
    if not wp.isfinite(wp.length_sq(x)):
        return
    # the nearest samples of the nearest two bodies, those that it looks at before others
    body = wp.vec2i(-1, -1)
    sample = wp.vec2i(-1, -1)
    first = wp.float64(1.0e30)
    second = wp.float64(1.0e30)
    w = instances.world[i]
    for j in range(state.instance_start[w], state.instance_start[w + 1]):
        radius = wp.float64(search_radius(instances, samples, pairs, i, s, j))
        if radius > wp.float64(0.0):
            best = wp.float64(1.0e30)
            nearest = int(-1)
            for t in range(instances.sample_count[j]):
                distance = wp.length_sq(x - samples.position[j, t])
                if distance > radius * radius or not may_touch(instances, basis, pairs, i, s, j, t):
                    continue
                if not looks_at(pairs, i, s, j, t):
                    distance += BLADE_DISTANCE
                if distance < best:
                    best = distance
                    nearest = t
            if best < first:
                second = first
                body[1] = body[0]
                sample[1] = sample[0]
                first = best
                body[0] = j
                sample[0] = nearest
            elif best < second:
                second = best
                body[1] = j
                sample[1] = nearest
    for slot in range(SLOTS):
        j = body[slot]
        nearest = sample[slot]
        if j < 0:
            return
        patch = fit_patch(instances, basis, samples, curvature, pairs, i, s, j, nearest)
        gap = patch.gap - wp.float64(instances.contact_radius[i] + instances.contact_radius[j])
        reach = instances.margin[i]
        if looks_at(pairs, i, s, j, nearest):
            reach += 2.0 * wp.length(samples.drift[i, s] - patch.drift)
        if patch.total > wp.float64(0.0) and gap < wp.float64(reach):
            pairs.other[i, s, slot] = j
            pairs.gap[i, s, slot] = gap
            pairs.normal[i, s, slot] = patch.normal
            pairs.nearest[i, s, slot] = nearest


@wp.kernel
def compact_pairs(
    instances: Instances,
    team: int,
    # In and out:
    pairs: Pairs,
    status: wp.array[int],
):
    """List the pairs of each instance in sample order, those that touch first.

    Each thread of a team counts its own run of samples, then writes where the counts before it end.
    """
    i, member = wp.tid()
    if pairs.near[i] == 0:
        if member == 0:
            pairs.count[i] = 0
        return
    begin = member * instances.sample_count[i] / team
    end = (member + 1) * instances.sample_count[i] / team
    at_touching, at_close, total = rank_contacts(pairs.other, pairs.gap, pairs.tally, i, begin, end, member, team)
    if member == 0:
        pairs.count[i] = wp.min(total, pairs.sample.shape[1])
        if total > pairs.sample.shape[1]:
            wp.atomic_or(status, instances.world[i], WORLD_CONTACT_OVERFLOW)
    for s in range(begin, end):
        for slot in range(SLOTS):
            if pairs.other[i, s, slot] < 0:
                continue
            at = at_close
            if pairs.gap[i, s, slot] <= wp.float64(0.0):
                at = at_touching
                at_touching += 1
            else:
                at_close += 1
            if at < pairs.sample.shape[1]:
                pairs.sample[i, at] = s * SLOTS + slot


@wp.kernel
def accept_pairs(
    state: NewtonState,
    constraint_max: int,
    # In and out:
    pairs: Pairs,
    constraints: PointConstraints,
    status: wp.array[int],
):
    """Give each pair its two constraints, or none: no force without its reaction. What touches comes first."""
    w = wp.tid()
    first = state.instance_start[w]
    end = state.instance_start[w + 1]
    for i in range(first, end):
        constraints.pair_count[i] = 0
    for turn in range(2):
        for i in range(first, end):
            for k in range(pairs.count[i]):
                s = pairs.sample[i, k] / SLOTS
                slot = pairs.sample[i, k] % SLOTS
                if (pairs.gap[i, s, slot] > wp.float64(0.0)) != (turn == 1):
                    continue
                j = pairs.other[i, s, slot]
                pairs.constraint[i, k] = -1
                pairs.mirror[i, k] = -1
                if constraints.count[i] >= constraint_max or constraints.count[j] >= constraint_max:
                    status[w] = status[w] | WORLD_CONTACT_OVERFLOW
                    continue
                pairs.constraint[i, k] = constraints.count[i]
                constraints.count[i] = constraints.count[i] + 1
                constraints.pair_count[i] = constraints.pair_count[i] + 1
                if j != i:
                    pairs.mirror[i, k] = constraints.count[j]
                    constraints.count[j] = constraints.count[j] + 1
                    constraints.pair_count[j] = constraints.pair_count[j] + 1


@wp.func
def layers_in_series(instances: Instances, i: int, j: int, factor: float, ri: float, rj: float, dt: float):
    """Return the stiffness per area [Pa/m] of the surfaces of two bodies; see ``stiffness_per_area``."""
    ki = stiffness_per_area(instances, i, factor, ri, float(instances.mass[j]), instances.area[j], dt)
    kj = stiffness_per_area(instances, j, factor, rj, float(instances.mass[i]), instances.area[i], dt)
    return ki * kj / (ki + kj)


@wp.kernel
def write_pairs(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    samples: Samples,
    state: NewtonState,
    surface: Surface,
    stick_ratio: wp.float64,
    stick_partner: wp.array[wp.vec2i],  # (particle_count,), see ``friction_memory_kernels``
    stick_slip: wp.array[mat23d],  # (particle_count,) [m]
    dt: float,
    # In and out:
    pairs: Pairs,
    # Out:
    constraints: PointConstraints,
):
    """Write the constraints of a pair and its dynamic row."""
    i, k = wp.tid()
    if k >= pairs.count[i] or pairs.constraint[i, k] < 0:
        return
    s = pairs.sample[i, k] / SLOTS
    slot = pairs.sample[i, k] % SLOTS
    j = pairs.other[i, s, slot]
    x = samples.position[i, s]
    own = instances.row_start[i] + s
    row = pairs.first_row + i * pairs.sample.shape[1] + k

    # the mean of the samples of the other body,
    nearest = pairs.nearest[i, s, slot]
    total = wp.float64(0.0)
    offset = wp.vec3d()
    for b in range(basis.row.shape[1]):
        basis.row[row, b] = vec8()
    at = instances.row_start[j] + nearest
    for neighbour in range(NEIGHBOURS):
        t = pairs.neighbour[at, neighbour]
        if t < 0:
            break
        if may_touch(instances, basis, pairs, i, s, j, t):
            theta = weigh(samples, pairs, i, s, j, t, nearest)
            if theta > wp.float64(0.0):
                total += theta
                offset += theta * (x - samples.position[j, t])
                for b in range(basis.row.shape[1]):
                    basis.row[row, b] = basis.row[row, b] + float(theta) * basis.row[instances.row_start[j] + t, b]
    inverse = wp.float64(1.0) / total
    # carried on to x; of the same body, the difference to it
    offset = inverse * offset - wp.max(pairs.gap[i, s, slot], wp.float64(0.0)) * pairs.normal[i, s, slot]
    F = gradient_of(instances, basis, motion.q_start, j, at)
    X = wp.vec3(clamped_inverse(F, instances.scale[j]) * offset)
    for b in range(basis.row.shape[1]):
        value = float(inverse) * basis.row[row, b]
        value = value + X[0] * basis.row_gradient[b, at, 0]
        value = value + X[1] * basis.row_gradient[b, at, 1]
        value = value + X[2] * basis.row_gradient[b, at, 2]
        if j == i:
            value = basis.row[own, b] - value
        basis.row[row, b] = value

    # each of the two surfaces brings its samples, so that each counts one half
    half_area = wp.max(0.5 * sample_area(instances.scale[i], basis.row_area[own]), 1.0e-30)
    ri = surface.relative_stiffness[own]
    rj = surface.relative_stiffness[at]
    firm_i = ri * surface.slenderness[own]
    firm_j = rj * surface.slenderness[at]
    stiffness = wp.float64(layers_in_series(instances, i, j, BULK_FACTOR, firm_i, firm_j, dt) * half_area)
    shear = wp.float64(layers_in_series(instances, i, j, SHEAR_FACTOR, ri, rj, dt) * half_area)
    n = pairs.normal[i, s, slot]
    mine = shape_of_cell(surface, instances, basis, i, own, surface.curvature[at] / instances.scale[j])
    F_own = gradient_of(instances, basis, motion.q_start, i, own)
    fade = fade_of(mine, F_own, n)
    theirs = shape_of_cell(surface, instances, basis, j, at, surface.curvature[own] / instances.scale[i])
    touched_i = touched_share(surface, pairs.other, pairs.gap, samples.part, False, mine, fade, i, own, j)
    touched_j = touched_share(surface, pairs.other, pairs.gap, samples.part, False, theirs, fade, j, at, i)
    spared_i = float(wp.float64(1.0) - touched_i)
    spared_j = float(wp.float64(1.0) - touched_j)
    wi = wp.float64(spared_i * dent_compliance(instances, i, ri, surface.dent_length[own]) / half_area)
    wj = wp.float64(spared_j * dent_compliance(instances, j, rj, surface.dent_length[at]) / half_area)
    compliance = beyond_penalty(stiffness, wi + wj)
    cell = cell_at(mine, wp.float64(1.0), F_own, n, pairs.gap[i, s, slot], wp.float64(0.0), stiffness * compliance)
    stick = stick_ratio * shear
    deep = stick
    part = wi / wp.max(wi + wj, wp.float64(1.0e-30))
    along = part * shear_yield(instances, i, compliance, touched_i)
    along += (wp.float64(1.0) - part) * shear_yield(instances, j, compliance, touched_j)
    stick = stick / (wp.float64(1.0) + stick * along)
    pairs.share[i, s, slot] = float(part)
    thick = wp.max(instances.scale[i] * pairs.thickness[own], instances.scale[j] * pairs.thickness[at])
    depth = spared_i * dent_depth(instances, i, surface.dent_length[own], True)
    depth += spared_j * dent_depth(instances, j, surface.dent_length[at], True)
    depth = wp.min(depth, 0.5 * DEPTH * thick)
    friction = wp.float64(wp.sqrt(instances.friction[i] * instances.friction[j]))
    deepest = -wp.float64(OVERLAP * wp.min(instances.size[i], instances.size[j]))
    if pairs.gap[i, s, slot] < deepest:
        wp.atomic_or(state.status, instances.world[i], WORLD_PENETRATION)
    offset = (wp.max(pairs.gap[i, s, slot], deepest) - cell.lead) * n
    particle = instances.particle_start[i] + s
    for before in range(SLOTS):
        if stick_partner[particle][before] == j - state.instance_start[instances.world[i]]:
            slip = F_own * stick_slip[particle][before]
            offset += slip - wp.dot(n, slip) * n
    pairs.held[i, s, slot] = pairs.constraint[i, k]
    for side in range(2):
        a = i
        e = pairs.constraint[i, k]
        direction = wp.float64(1.0)
        if side == 1:
            a = j
            e = pairs.mirror[i, k]
            direction = wp.float64(-1.0)
        if e >= 0:
            constraints.shape[a, e] = -1
            constraints.body[a, e] = -1
            constraints.dof_begin[a, e] = 0
            constraints.dof_end[a, e] = 0
            constraints.row[a, e] = wp.where(side == 1 or j == i, row, own)
            constraints.partner[a, e] = wp.where(j == i, -1, wp.where(side == 1, i, j))
            constraints.partner_row[a, e] = wp.where(side == 1, own, row)
            constraints.normal[a, e] = direction * n
            constraints.offset[a, e] = direction * offset
            constraints.stiffness[a, e] = stiffness
            constraints.stick[a, e] = stick
            constraints.stick_deep[a, e] = deep
            constraints.dent_compliance[a, e] = compliance
            constraints.dent_depth[a, e] = wp.float64(depth) + HARDENING_DEPTH * mine.least
            constraints.onset[a, e] = cell.onset
            constraints.lead[a, e] = cell.lead
            constraints.ridge[a, e] = wp.float64(0.0)
            constraints.ridge_lead[a, e] = wp.float64(0.0)
            constraints.friction[a, e] = friction


@wp.kernel
def remember_pairs(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    state: NewtonState,
    pairs: Pairs,
    constraints: PointConstraints,
    # State out:
    stick_partner_out: wp.array[wp.vec2i],
    stick_slip_out: wp.array[mat23d],
):
    """Write which soft bodies a sample sticks to at the end of the step, and its elastic slip carried back to rest.

    Carried on by the body's own gradient in the next step, it turns with the body.
    """
    i, s = wp.tid()
    if s >= instances.sample_count[i]:
        return
    partner = wp.vec2i(-1, -1)
    slips = mat23d()
    for slot in range(SLOTS):
        e = int(-1)
        if pairs.near[i] != 0:
            e = pairs.held[i, s, slot]
        if e < 0:
            continue
        limit = constraints.friction[i, e] * constraints.normal_force[i, e]
        total = constraints.slip[i, e]
        slid = wp.length(total)
        most = elastic_slip(limit, constraints.stick[i, e], constraints.stick_deep[i, e], constraints.dent_depth[i, e])
        if not (most > wp.float64(0.0) and slid > wp.float64(0.0) and wp.isfinite(slid + most)):
            continue
        F = gradient_of(instances, basis, motion.q_start, i, instances.row_start[i] + s)
        elastic = clamped_inverse(F, instances.scale[i]) * (wp.min(wp.float64(1.0), most / slid) * total)
        partner[slot] = pairs.other[i, s, slot] - state.instance_start[instances.world[i]]
        slips[slot] = elastic
    particle = instances.particle_start[i] + s
    stick_partner_out[particle] = partner
    stick_slip_out[particle] = slips
