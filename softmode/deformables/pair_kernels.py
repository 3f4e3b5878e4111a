"""Device side of contact between soft bodies, and of a body with itself.

The surface of a body is what its samples x_k with deformed normals n_k say: near a point x the implicit moving
least-squares surface (Kolluri 2008, doi:10.1145/1361192.1361195, eq. 1)

    gap(x) = sum_k theta_k n_k . (x - x_k) / sum_k theta_k,
    theta_k = exp(-(|x - x_k|^2 - d_min^2) / h^2) max(-n . n_k, 0)^2,

h three quarters of the spacing of the samples, n the normal of the sample at x: exact for a plane, without the bumps
that a ball around every sample would have, and blind to what lies around a sharp edge. Samples of each body are tested
against the surfaces of the others. The point of the other body that is touched moves with sum_k w_k x_k, the weights
theta_k corrected to first order so that they reproduce the point itself: force and reaction act on one line.

A pair of a sample and a surface becomes an entry of each of the two bodies (``contact``), with normal and offset of
opposite sign and one half of the energy, so that both feel the same force. Their rows are the sample's row, and a
*dynamic row*, sum_k w_k b(x_k), written behind the static ones. A pair within one body is one entry whose row is the
difference.
"""

import warp as wp

from softmode.deformables.contact import stiffness_per_area
from softmode.deformables.detection import Samples
from softmode.deformables.kernels import displacement_gradient
from softmode.deformables.status import WORLD_CONTACT_OVERFLOW
from softmode.deformables.tables import Basis, Entries, Instances, Motion, Progress

wp.set_module_options({"enable_backward": False})

SLOTS = 2
"""Other bodies that one sample may touch: the nearest two."""
FACING = wp.constant(0.3)
"""Cosine between normals above which two samples look the same way and cannot touch: the far side of a thin body."""
ASIDE = wp.constant(wp.float64(1.0e-4))
"""Weight of a sample that looks across, against one that looks at the point: behind a sharp edge it says nothing."""
WIDTH = wp.constant(0.75)
"""h in spacings."""
CUTOFF = wp.constant(9.0)
"""Exponent of theta beyond which a sample says nothing: three h."""
LATERAL = wp.constant(wp.float64(1.2))
"""How far beside the samples, in spacings, a point may lie and still be above the surface."""
SELF_DISTANCE = wp.constant(wp.float64(4.0))
"""Distance at rest, in spacings, below which samples of one body are neighbours and do not touch."""


@wp.struct
class Pairs:
    """Surfaces at the start of the step and the pairs that touch, shape (instance_count, sample_max) where not said."""

    grid: wp.uint64
    spacing_max: float  # [m]
    radius_max: float  # largest contact radius [m]
    first_row: int  # first dynamic row
    point: wp.array[wp.vec3]  # (instance_count * sample_max,) [m], for the grid
    surface_normal: wp.array2d[wp.vec3]  # outward, of unit length
    spacing: wp.array[float]  # (instance_count,) of the samples [m]
    near: wp.array[int]  # (instance_count,), whether its bounds meet those of another body
    other: wp.array3d[int]  # (..., SLOTS), instance, -1 where empty
    gap: wp.array3d[wp.float64]  # (..., SLOTS) [m]
    normal: wp.array3d[wp.vec3d]  # (..., SLOTS), outward from the other body
    nearest: wp.array3d[wp.float64]  # (..., SLOTS), squared distance to its nearest sample [m^2]
    count: wp.array[int]  # (instance_count,)
    sample: wp.array2d[int]  # (instance_count, pair_max): sample * SLOTS + slot
    entry: wp.array2d[int]  # (instance_count, pair_max), -1 where dropped
    mirror: wp.array2d[int]  # (instance_count, pair_max), entry of the other body


@wp.struct
class Patch:
    """The surface of a body near a point."""

    total: wp.float64  # sum theta
    nearest: wp.float64  # squared distance of the nearest sample [m^2]
    gap: wp.float64  # [m]
    normal: wp.vec3d
    centre: wp.vec3d  # sum theta x_k / sum theta [m]
    slope: wp.vec3d  # w_k = theta_k / total (1 + slope . (x_k - centre)) [1/m]
    drift: wp.vec3  # mean motion of the step [m]


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
    progress: Progress,
    samples: Samples,
    # Out:
    pairs: Pairs,
):
    """Mark the instances that may touch another one or themselves."""
    i = wp.tid()
    w = instances.world[i]
    near = instances.self_contact[i]
    for j in range(progress.instance_start[w], progress.instance_start[w + 1]):
        if j != i and meets(instances, samples, i, j):
            near = 1
    pairs.near[i] = near


@wp.kernel
def place_surface(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    samples: Samples,
    # Out:
    pairs: Pairs,
):
    """Write the points of the grid, and where a body is near another its normals, cof(F) N."""
    i, s = wp.tid()
    if s >= instances.sample_count[i]:
        return
    x = wp.vec3(samples.position[i, s])
    if not wp.isfinite(wp.length_sq(x)):
        x = wp.vec3()
    pairs.point[i * samples.position.shape[1] + s] = x
    if pairs.near[i] == 0:
        return
    row = instances.row_start[i] + s
    G = displacement_gradient(basis.row_gradient, motion.q_start, i, row, instances.function_count[i])
    F = wp.identity(n=3, dtype=wp.float64) + G
    a = wp.vec3d(F[0, 0], F[1, 0], F[2, 0])
    b = wp.vec3d(F[0, 1], F[1, 1], F[2, 1])
    c = wp.vec3d(F[0, 2], F[1, 2], F[2, 2])
    N = wp.vec3d(basis.row_normal[row])
    pairs.surface_normal[i, s] = wp.vec3(
        wp.normalize(N[0] * wp.cross(b, c) + N[1] * wp.cross(c, a) + N[2] * wp.cross(a, b))
    )


@wp.func
def may_touch(instances: Instances, basis: Basis, pairs: Pairs, i: int, s: int, j: int, t: int):
    """Return whether sample s of instance i may touch sample t of instance j."""
    facing = wp.dot(pairs.surface_normal[i, s], pairs.surface_normal[j, t])
    if j != i:
        return pairs.near[j] != 0 and facing < FACING
    if instances.self_contact[i] == 0 or facing >= 0.0:
        return False
    apart = basis.row_point[instances.row_start[i] + s] - basis.row_point[instances.row_start[i] + t]
    return wp.length(apart) > SELF_DISTANCE * wp.float64(pairs.spacing[i])


@wp.func
def search_radius(instances: Instances, samples: Samples, pairs: Pairs, i: int, s: int):
    """Return how far from a sample others are looked for [m]."""
    reach = instances.margin[i] + 2.0 * wp.length(samples.drift[i, s])
    return reach + instances.contact_radius[i] + pairs.radius_max + wp.sqrt(CUTOFF) * WIDTH * pairs.spacing_max


@wp.func
def weigh(samples: Samples, pairs: Pairs, i: int, s: int, j: int, t: int, nearest: wp.float64):
    """Return theta of sample t of instance j for sample s of instance i, 0 where it is negligible."""
    h = wp.float64(WIDTH * pairs.spacing[j])
    exponent = (wp.length_sq(samples.position[i, s] - samples.position[j, t]) - nearest) / (h * h)
    if exponent > wp.float64(CUTOFF):
        return wp.float64(0.0)
    facing = wp.float64(wp.max(-wp.dot(pairs.surface_normal[i, s], pairs.surface_normal[j, t]), 0.0))
    return wp.exp(-exponent) * (facing * facing + ASIDE)


@wp.func
def fit_patch(
    instances: Instances,
    basis: Basis,
    samples: Samples,
    pairs: Pairs,
    i: int,
    s: int,
    j: int,
    nearest: wp.float64,
):
    """Fit the surface of instance j near sample s of instance i; ``nearest`` is the squared distance to it."""
    patch = Patch()
    patch.nearest = nearest
    x = samples.position[i, s]
    h = wp.float64(pairs.spacing[j])
    count = samples.position.shape[1]
    outer = wp.mat33d()
    radius = search_radius(instances, samples, pairs, i, s)
    query = wp.hash_grid_query(pairs.grid, wp.vec3(x), radius, instances.world[i])
    k = int(0)
    while wp.hash_grid_query_next(query, k):
        t = k % count
        if k / count == j and may_touch(instances, basis, pairs, i, s, j, t):
            away = x - samples.position[j, t]
            theta = weigh(samples, pairs, i, s, j, t, nearest)
            n = wp.vec3d(pairs.surface_normal[j, t])
            patch.total += theta
            patch.gap += theta * wp.dot(n, away)
            patch.normal += theta * n
            patch.centre += theta * away
            patch.drift += float(theta) * samples.drift[j, t]
            outer += theta * wp.outer(away, away)
    if patch.total <= wp.float64(0.0):
        return patch
    inverse = wp.float64(1.0) / patch.total
    patch.gap = inverse * patch.gap
    patch.normal = wp.normalize(patch.normal)
    patch.drift = float(inverse) * patch.drift
    offset = inverse * patch.centre  # x - centre
    patch.centre = x - offset
    lateral = offset - wp.dot(offset, patch.normal) * patch.normal
    S = inverse * outer - wp.outer(offset, offset)
    S += h * h * (wp.outer(patch.normal, patch.normal) + wp.float64(1.0e-3) * wp.identity(n=3, dtype=wp.float64))
    slope = wp.inverse(S) * lateral
    patch.slope = slope / wp.max(wp.float64(1.0), wp.length(slope) * h)
    if wp.length(lateral) > LATERAL * h:
        patch.total = wp.float64(0.0)
    return patch


@wp.kernel
def find_pairs(
    instances: Instances,
    basis: Basis,
    progress: Progress,
    # In and out:
    samples: Samples,
    pairs: Pairs,
):
    """Find the surfaces within reach of each sample: margin plus twice the relative motion of the step."""
    i, s = wp.tid()
    if pairs.near[i] == 0 or s >= instances.sample_count[i]:
        return
    for slot in range(SLOTS):
        pairs.other[i, s, slot] = -1
    x = wp.vec3(samples.position[i, s])
    w = instances.world[i]
    inside = instances.self_contact[i]
    for j in range(progress.instance_start[w], progress.instance_start[w + 1]):
        grow = wp.vec3(instances.margin[i] + 2.0 * wp.length(samples.drift[i, s]))
        if j != i and wp.min(x - samples.lower[j] + grow) >= 0.0 and wp.min(samples.upper[j] + grow - x) >= 0.0:
            inside = 1
    if inside == 0:
        return
    count = samples.position.shape[1]
    taken = int(-1)
    for slot in range(SLOTS):
        best = int(-1)
        nearest = wp.float64(1.0e30)
        radius = search_radius(instances, samples, pairs, i, s)
        query = wp.hash_grid_query(pairs.grid, x, radius, w)
        k = int(0)
        while wp.hash_grid_query_next(query, k):
            j = k / count
            if j != taken and may_touch(instances, basis, pairs, i, s, j, k % count):
                distance = wp.length_sq(samples.position[i, s] - samples.position[j, k % count])
                if distance < nearest:
                    nearest = distance
                    best = j
        if best < 0:
            return
        taken = best
        patch = fit_patch(instances, basis, samples, pairs, i, s, best, nearest)
        gap = patch.gap - wp.float64(instances.contact_radius[i] + instances.contact_radius[best])
        reach = instances.margin[i] + 2.0 * wp.length(samples.drift[i, s] - patch.drift)
        if patch.total > wp.float64(0.0) and gap < wp.float64(reach):
            pairs.other[i, s, slot] = best
            pairs.gap[i, s, slot] = gap
            pairs.normal[i, s, slot] = patch.normal
            pairs.nearest[i, s, slot] = nearest


@wp.kernel
def compact_pairs(
    instances: Instances,
    # In and out:
    pairs: Pairs,
    status: wp.array[int],
):
    """List the pairs of each instance in sample order, those that touch first."""
    i = wp.tid()
    total = int(0)
    if pairs.near[i] != 0:
        for turn in range(2):
            for s in range(instances.sample_count[i]):
                for slot in range(SLOTS):
                    if pairs.other[i, s, slot] >= 0 and (pairs.gap[i, s, slot] > wp.float64(0.0)) == (turn == 1):
                        if total < pairs.sample.shape[1]:
                            pairs.sample[i, total] = s * SLOTS + slot
                        total += 1
        if total > pairs.sample.shape[1]:
            wp.atomic_or(status, instances.world[i], WORLD_CONTACT_OVERFLOW)
    pairs.count[i] = wp.min(total, pairs.sample.shape[1])


@wp.kernel
def accept_pairs(
    progress: Progress,
    entry_max: int,
    # In and out:
    pairs: Pairs,
    entries: Entries,
    status: wp.array[int],
):
    """Give each pair its two entries, or none: a force without its reaction must not be."""
    w = wp.tid()
    first = progress.instance_start[w]
    end = progress.instance_start[w + 1]
    for i in range(first, end):
        entries.pair_count[i] = 0
    for i in range(first, end):
        for k in range(pairs.count[i]):
            j = pairs.other[i, pairs.sample[i, k] / SLOTS, pairs.sample[i, k] % SLOTS]
            pairs.entry[i, k] = -1
            pairs.mirror[i, k] = -1
            if entries.count[i] >= entry_max or entries.count[j] >= entry_max:
                status[w] = status[w] | WORLD_CONTACT_OVERFLOW
                continue
            pairs.entry[i, k] = entries.count[i]
            entries.count[i] = entries.count[i] + 1
            entries.pair_count[i] = entries.pair_count[i] + 1
            if j != i:
                pairs.mirror[i, k] = entries.count[j]
                entries.count[j] = entries.count[j] + 1
                entries.pair_count[j] = entries.pair_count[j] + 1


@wp.kernel
def write_pairs(
    instances: Instances,
    basis: Basis,
    samples: Samples,
    pairs: Pairs,
    dt: float,
    # Out:
    entries: Entries,
):
    """Write the entries of a pair and its dynamic row."""
    i, k = wp.tid()
    if k >= pairs.count[i] or pairs.entry[i, k] < 0:
        return
    s = pairs.sample[i, k] / SLOTS
    slot = pairs.sample[i, k] % SLOTS
    j = pairs.other[i, s, slot]
    count = samples.position.shape[1]
    x = samples.position[i, s]
    radius = search_radius(instances, samples, pairs, i, s)
    nearest = pairs.nearest[i, s, slot]
    patch = fit_patch(instances, basis, samples, pairs, i, s, j, nearest)

    # the touched point of the other body; of the same body, the difference to it
    own = instances.row_start[i] + s
    row = pairs.first_row + i * pairs.sample.shape[1] + k
    sign = float(1.0)
    for b in range(basis.row.shape[1]):
        if j == i:
            sign = -1.0
            basis.row[row, b] = basis.row[own, b]
        else:
            basis.row[row, b] = type(basis.row[own, b])()
    query = wp.hash_grid_query(pairs.grid, wp.vec3(x), radius, instances.world[i])
    point = int(0)
    while wp.hash_grid_query_next(query, point):
        t = point % count
        if point / count == j and may_touch(instances, basis, pairs, i, s, j, t):
            theta = weigh(samples, pairs, i, s, j, t, nearest) / patch.total
            along = wp.dot(patch.slope, samples.position[j, t] - patch.centre)
            weight = sign * float(theta * (wp.float64(1.0) + along))
            if weight != 0.0:
                for b in range(basis.row.shape[1]):
                    basis.row[row, b] = basis.row[row, b] + weight * basis.row[instances.row_start[j] + t, b]

    ki = stiffness_per_area(instances, i, float(instances.mass[j]), instances.area[j], dt)
    kj = stiffness_per_area(instances, j, float(instances.mass[i]), instances.area[i], dt)
    # two layers in series; each of the two surfaces brings its samples, so that each counts one half
    stiffness = wp.float64(0.5 * ki * kj / (ki + kj) * basis.row_area[own])
    friction = wp.float64(wp.sqrt(instances.friction[i] * instances.friction[j]))
    offset = pairs.gap[i, s, slot] * pairs.normal[i, s, slot]
    for side in range(2):
        a = i
        e = pairs.entry[i, k]
        direction = wp.float64(1.0)
        if side == 1:
            a = j
            e = pairs.mirror[i, k]
            direction = wp.float64(-1.0)
        if e >= 0:
            entries.shape[a, e] = -1
            entries.body[a, e] = -1
            entries.dof_begin[a, e] = 0
            entries.dof_end[a, e] = 0
            entries.row[a, e] = wp.where(side == 1 or j == i, row, own)
            entries.partner[a, e] = wp.where(j == i, -1, wp.where(side == 1, i, j))
            entries.partner_row[a, e] = wp.where(side == 1, own, row)
            entries.normal[a, e] = direction * pairs.normal[i, s, slot]
            entries.offset[a, e] = direction * offset
            entries.stiffness[a, e] = stiffness
            entries.stick[a, e] = wp.float64(0.0)
            entries.friction[a, e] = friction
