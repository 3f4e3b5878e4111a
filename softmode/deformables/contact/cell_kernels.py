"""Device code of the cells that contact samples stand for: which part of a cell touches, and how much around it does.

A sample stands for a cell of the surface, of the area A at rest. Its contact is the mean of springs over the gaps of
that cell, which tilt and curvature spread evenly over a range e, the *onset* (see ``penalty_kernels``). With the normal
n of what is touched, the rest normal N and F of the body a step's velocity ahead,

    m = P_N F^T n                             slope of the gap over the cell
    x = sqrt(m . M m)                         range of a strip with the variance of the cell, M twelve times its moments
    u = 1 / (1 + (x/a)^8) r^4/(49 + r^4)      how far it turns, a steep cell not at all; r: compliance of the dent over
                                              that of the penalty, a: ``steepest``
    t = u x                                   range by tilt
    b = A (H + H_other) / (2 pi)              range by the mean curvatures of both: exact for a sphere
    e = sqrt(e_0^2 + t^2 + b^2)               e_0: ``contact_smoothing``
    q = e/2 - b/2 - l e_0 (e_0/e)^2 - u m . d - gap    penetration, a step's velocity ahead, d the middle of the cell
    T = u (d - (1/2 - q/(3 e)) u M m / e)     centre of pressure from the sample, at rest, in the onset;
        u (d - 1/(12 q - 6 e) u M m)          beyond. Either is what the potential changes by as the cell tilts, over
                                              its force: what rolls gets back on one side what it gave on the other

The row of the contact is that of the sample plus T . grad: force and friction act at the centre of pressure. The dent
of the sample is as much less as its neighbourhood touches the same thing: the functions carry what is wide.
"""

import warp as wp

from softmode.deformables.model.declare import struct
from softmode.deformables.model.deformation_kernels import displacement_gradient
from softmode.deformables.model.lane_kernels import vec8d
from softmode.deformables.model.struct_kernels import SLOTS, Basis, Instances

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float64(3.14159265358979))
FADE = wp.constant(1.0e-3)
"""Gap over the size of the body, besides its cell's range, over which a neighbour counts as touching less and less:
long against a dent, or a face that rides in its onset is soft and stiff in turns."""
FACING = wp.constant(wp.float64(0.2))
"""Cosine below which a cell belongs to a face around an edge, whose tilt says nothing of the gaps."""
LATE = wp.constant(wp.float64(0.406))
"""How deep a level face lies in its onset when it is squeezed by 1 %, in e_0 at nu 0, see ``late_of``."""
NEAR = wp.constant(wp.float64(0.35))
"""Share of that bound, as a gap, beyond which a cell is level and nothing around it counts, as it cannot touch but by
an impact: what flies past a shape must not feel that it might lean against it."""
TURNING = wp.constant(wp.float64(49.0))
"""Fourth power of the dent, in penalties, with which a cell turns half of its way."""
LEVEL = wp.constant(wp.float64(1.0e-3))
"""Share of its way below which a cell does not turn."""


@struct
class Surface:
    """What contact knows of the surface samples of all bodies, (sample_total,) where not said."""

    relative_stiffness: wp.array[float]  # shear modulus relative to the body's
    dent_length: wp.array[float]  # dent at scale 1 under the pressure E / (1 - nu^2), see ``dents`` [m]
    slenderness: wp.array[float]  # size of the body over the smaller of it and three thicknesses
    curvature: wp.array[float]  # mean curvature of the asset at rest [1/m]
    middle: wp.array[wp.vec3]  # of its cell, from the sample [m]
    moments: wp.array[wp.mat33]  # twelve times the second moments of its cell about that [m^2]
    inset: wp.array[wp.vec3]  # middle of the square that stands for it at a rim, likewise [m]
    start: wp.array[int]  # (sample_total + 1,), where each sample's neighbourhood begins in
    neighbour: wp.array[int]  # samples, counted within their body, and
    weight: wp.array[float]  # their weights, of sum ``CARRIED``
    first_row: int  # of the rows at centres of pressure
    row_max: int  # such rows of an instance


@struct
class Cell:
    """The cell of a sample in a contact."""

    onset: wp.float64  # range of its gaps [m]
    lead: wp.float64  # how much earlier than the sample it begins to touch [m]
    centre: wp.vec3d  # centre of pressure from the sample, at rest [m]


@struct
class CellShape:
    """What a cell is, whatever its body does."""

    normal: wp.vec3d  # at rest, outward
    middle: wp.vec3d  # d [m]
    moments: wp.mat33d  # M [m^2]
    bend: wp.float64  # b [m]
    least: wp.float64  # e_0 [m]
    steepest: wp.float64  # range by tilt beyond which a cell counts as level again: the margin, less where thin [m]
    fade: wp.float64  # that of a level and flat cell [m]
    poissons_ratio: wp.float64


@wp.func
def late_of(poissons_ratio: wp.float64):
    """Return l, the share of e_0 by which a level contact begins later than half its range outside.

    A face that is squeezed by 1 % then stands where it should, and within 1 % of that from there to 10 %. It rides in
    its onset, sqrt(2 P e_0 / kappa) deep, and kappa goes with the constrained modulus. A cell that leans or bends has
    less of it, by the square of e_0 / e: a ball is pressed by its springs.
    """
    one = wp.float64(1.0)
    softer = (one + poissons_ratio) * (one - wp.float64(2.0) * poissons_ratio) / (one - poissons_ratio)
    return wp.float64(0.5) - LATE * wp.sqrt(softer)


@wp.func
def shape_of_cell(surface: Surface, instances: Instances, basis: Basis, i: int, row: int, other: float):
    """Return what the cell of a sample is against something of a mean curvature [1/m]."""
    shape = CellShape()
    s = instances.scale[i]
    area = wp.float64(basis.row_area[row])
    shape.normal = wp.vec3d(basis.row_normal[row])
    shape.middle = wp.vec3d(surface.middle[row])
    shape.moments = wp.mat33d(surface.moments[row])
    bend = wp.float64(s * s) * area * wp.float64(surface.curvature[row] / s + other) / (wp.float64(2.0) * PI)
    shape.bend = wp.max(bend, wp.float64(0.0))
    shape.least = wp.float64(instances.smoothing[i] / surface.slenderness[row])
    shape.steepest = wp.float64(instances.margin[i] / surface.slenderness[row])
    shape.fade = wp.float64(FADE * instances.size[i])
    shape.poissons_ratio = wp.float64(instances.poissons_ratio[i])
    return shape


@wp.func
def slope_of(shape: CellShape, part: wp.float64, F: wp.mat33d, n: wp.vec3d):
    """Return m of a part of a cell, and how level that is; F is the gradient, n the normal of what the cell touches."""
    one = wp.float64(1.0)
    pull = wp.transpose(F) * n
    facing = -wp.dot(pull, shape.normal)
    slope = pull + facing * shape.normal
    share = wp.dot(slope, part * shape.moments * slope) / (shape.steepest * shape.steepest)
    share *= share
    steady = one / (one + share * share)
    if facing <= FACING * wp.length(pull):
        steady = wp.float64(0.0)
    return slope, steady


@wp.func
def fade_of(shape: CellShape, F: wp.mat33d, n: wp.vec3d):
    """Return the range of the gap over which a neighbour counts as touching less and less [m]."""
    slope, steady = slope_of(shape, wp.float64(1.0), F, n)
    ranges = steady * steady * wp.dot(slope, shape.moments * slope) + shape.bend * shape.bend
    return shape.fade + wp.sqrt(ranges + wp.float64(1.0e-24))  # which has a derivative at zero


@wp.func
def cell_at(
    shape: CellShape,
    part: wp.float64,
    F: wp.mat33d,
    n: wp.vec3d,
    gap: wp.float64,
    closing: wp.float64,
    ratio: wp.float64,
):
    """Return a cell whose sample has a gap [m], ``closing`` [m] more ahead, and a dent of ``ratio`` penalties.

    The cell turns with the dent: where there is none and the penalty alone keeps surfaces apart, so stiff a centre of
    pressure would move the body to and fro. What begins a step farther away than any cell reaches is level: it may pass
    what it would lean against.
    """
    half = wp.float64(0.5)
    slope, turn = slope_of(shape, part, F, n)
    dent = ratio * ratio * ratio * ratio
    turn *= dent / (TURNING + dent)
    if gap > NEAR * shape.steepest:
        turn = wp.float64(0.0)
    slope = turn * slope
    lean = part * shape.moments * slope
    bend = part * shape.bend
    cell = Cell()
    cell.onset = wp.sqrt(shape.least * shape.least + bend * bend + wp.dot(slope, lean))
    level = shape.least / cell.onset
    cell.lead = half * (cell.onset - bend) - late_of(shape.poissons_ratio) * level * level * shape.least
    cell.lead -= wp.dot(slope, shape.middle)
    if turn > LEVEL:
        q = wp.max(cell.lead - gap - closing, wp.float64(0.0))
        arm = half / cell.onset - q / (wp.float64(3.0) * cell.onset * cell.onset)
        if q > cell.onset:
            arm = wp.float64(1.0) / (wp.float64(12.0) * q - wp.float64(6.0) * cell.onset)
        cell.centre = turn * (shape.middle - arm * lean)
    return cell


@wp.func
def gradient_of(instances: Instances, basis: Basis, q: wp.array2d[vec8d], i: int, row: int):
    """Return the deformation gradient F of an instance at a surface sample."""
    G = displacement_gradient(basis.row_gradient, q, i, row, instances.function_count[i])
    return wp.identity(n=3, dtype=wp.float64) + G


@wp.func
def touching(x: wp.float64):
    """Return how much a neighbour counts as touching, from none at 0 to all at 1."""
    y = wp.min(wp.max(x, wp.float64(0.0)), wp.float64(1.0))
    return y * y * (wp.float64(3.0) - wp.float64(2.0) * y)


@wp.func
def neighbour_at(shape: CellShape, fade: wp.float64, gap: wp.float64):
    """Return where a neighbour with a gap [m] stands between not touching, 0, and touching, 1."""
    half = wp.float64(0.5)
    return wp.float64(1.0) - (gap + half * (shape.bend - shape.least)) / fade


@wp.func
def touched_share(
    surface: Surface,
    found: wp.array3d[int],  # (instance_count, sample_max, SLOTS), what is touched
    gap: wp.array3d[wp.float64],  # likewise [m]
    part: wp.array3d[float],  # likewise, of the cell what lies under it
    cut: bool,  # whether that counts, as of boxes; else the whole cell
    shape: CellShape,
    fade: wp.float64,
    i: int,
    row: int,
    other: int,
):
    """Return c, the share of a sample's neighbourhood that touches the same thing at the start of the step."""
    carried = wp.float64(0.0)
    for k in range(surface.start[row], surface.start[row + 1]):
        t = surface.neighbour[k]
        for slot in range(SLOTS):
            if found[i, t, slot] == other:
                weight = wp.float64(surface.weight[k])
                if cut:
                    weight *= wp.float64(part[i, t, slot])
                carried += weight * touching(neighbour_at(shape, fade, gap[i, t, slot]))
    return carried


@wp.func
def write_row(basis: Basis, row: int, sample: int, X: wp.vec3d):
    """Write the row at a place beside a sample [m]."""
    basis.row_point[row] = basis.row_point[sample] + X
    x = wp.vec3(X)
    for b in range(basis.row.shape[1]):
        value = basis.row[sample, b] + x[0] * basis.row_gradient[b, sample, 0]
        basis.row[row, b] = value + x[1] * basis.row_gradient[b, sample, 1] + x[2] * basis.row_gradient[b, sample, 2]
