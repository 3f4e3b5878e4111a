"""Device side of the adjoint through what a contact takes from the start of a step: its cell, what touches around it.

Onset, centre of pressure T and the fade of the neighbourhood follow the gradient F and the gap of the sample a step's
velocity ahead, and the share of the neighbourhood that does not touch follows the gaps of its samples at the start; see
``cell_kernels``. With lambda the costate, a contact's row b + T . grad b, force f and displacement x feel T by

    dL/dT = (grad lambda)^T f - (grad (q_t - q_(t-1)))^T x_bar + (n . x_bar) (F_ahead - F_start)^T n,

x_bar = -dL/dx, the last of the offset, which leaves out what T closes by turning.
"""

import warp as wp

from softmode.deformables.contact.cell_kernels import (
    NEAR,
    PI,
    CellShape,
    Surface,
    cell_at,
    fade_of,
    gradient_of,
    neighbour_at,
    shape_of_cell,
    touched_share,
    touching,
    write_row,
)
from softmode.deformables.contact.detection_kernels import (
    Shapes,
    box_beside,
    curvature_of,
    face_part,
    motion_of_cell,
    pressed_by,
    shape_area,
)
from softmode.deformables.contact.face_kernels import part_under_face
from softmode.deformables.contact.penalty_kernels import (
    BULK_FACTOR,
    HARDENING,
    HARDENING_DEPTH,
    HARDENING_RANGE,
    beside_ridge,
    beyond_exponent,
    dent_exponents,
    penalty,
    shear_growth,
    stiffness_exponents,
)
from softmode.deformables.contact.ridge_kernels import Box, ridge_at
from softmode.deformables.gradients.adjoint_kernels import Linearised, Sums, turned_back
from softmode.deformables.model.deformation_kernels import displacement_gradient
from softmode.deformables.model.lane_kernels import vec8d
from softmode.deformables.model.struct_kernels import (
    OVERLAP,
    SLOTS,
    Basis,
    Instances,
    Motion,
    PointConstraints,
    Samples,
    interpolate,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def slot_of(samples: Samples, i: int, s: int, shape: int):
    """Return the slot of a sample, counted from the first of its body, in which a shape stands."""
    found = int(0)
    for slot in range(1, SLOTS):
        if samples.shape[i, s, slot] == shape:
            found = slot
    return found


@wp.func
def gap_of(instances: Instances, samples: Samples, i: int, sample: int, shape: int):
    """Return the gap [m] of a sample with a shape at the start of the step, as its contact takes it."""
    s = sample - instances.row_start[i]
    return wp.max(samples.gap[i, s, slot_of(samples, i, s, shape)], -wp.float64(OVERLAP * instances.size[i]))


@wp.func
def normal_of(instances: Instances, samples: Samples, i: int, sample: int, shape: int):
    """Return the normal of a shape at a sample, which its cell is found with; edges turn that of the contact."""
    s = sample - instances.row_start[i]
    return wp.normalize(wp.vec3d(samples.normal[i, s, slot_of(samples, i, s, shape)]))


@wp.func
def part_of(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    shapes: Shapes,
    samples: Samples,
    surface: Surface,
    i: int,
    sample: int,
    shape: int,
):
    """Return the part of a cell that lies under a face of a shape, and its middle at rest [m]."""
    s = sample - instances.row_start[i]
    part = wp.float64(samples.part[i, s, slot_of(samples, i, s, shape)])
    middle = wp.vec3d()
    if part < wp.float64(1.0):
        _box, _frame, _axis, _part, middle = face_part(
            instances, basis, motion, shapes, samples, surface.inset, i, sample, shape
        )
    return part, middle


@wp.func
def cell_loss(
    shape: CellShape,
    part: wp.float64,
    F: wp.mat33d,
    n: wp.vec3d,
    gap: wp.float64,
    closing: wp.float64,
    ratio: wp.float64,
    onset_bar: wp.float64,
    lead_bar: wp.float64,
    centre_bar: wp.vec3d,
):
    """Return the loss to first order in what ``cell_at`` returns."""
    cell = cell_at(shape, part, F, n, gap, closing, ratio)
    return onset_bar * cell.onset + lead_bar * cell.lead + wp.dot(centre_bar, cell.centre)


@wp.func
def part_loss(box: Box, part_bar: wp.float64, middle_bar: wp.vec3d):
    """Return the loss to first order in the part of a cell under a face, by its ln, and in the middle of that."""
    _axis, part, middle = part_under_face(box)
    return part_bar * wp.log(part) + wp.dot(middle_bar, middle)


@wp.func
def edge_loss(
    box: Box,
    face: wp.float64,
    onset: wp.float64,
    least: wp.float64,
    ridge_bar: wp.float64,
    lead_bar: wp.float64,
    normal_bar: wp.vec3d,
):
    """Return the loss to first order in what ``ridge_at`` returns."""
    ridge, lead, normal = ridge_at(box, face, onset, least)
    return ridge_bar * ridge + lead_bar * lead + wp.dot(normal_bar, normal)


@wp.func
def by_onset(p: wp.float64, eps: wp.float64):
    """Return the derivative of the slope of the penalty by its range."""
    half = wp.float64(0.5)
    x = wp.min(wp.max(p, wp.float64(0.0)) / eps, wp.float64(1.0))
    return -half * x * x


@wp.func
def slope_of_touching(y: wp.float64):
    """Return the derivative of ``touching``."""
    if y <= wp.float64(0.0) or y >= wp.float64(1.0):
        return wp.float64(0.0)
    return wp.float64(6.0) * y * (wp.float64(1.0) - y)


# Warp writes the adjoints of what ``wp.grad`` calls only if nothing in the module called it before, and takes kernels
# in the order of their hashes: so this one has a module of its own, and ``wp.grad`` comes first in it.
@wp.kernel(module="unique", enable_backward=False)
def accumulate_cells(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    shapes: Shapes,
    samples: Samples,
    surface: Surface,
    constraints: PointConstraints,
    q: wp.array2d[vec8d],
    costate: wp.array2d[vec8d],
    dt: float,
    # In and out:
    sums: Sums,
    step: Linearised,
):
    """Find the loss by the cell of each contact; add what the scale of the body does to it."""
    i, e = wp.tid()
    step.cell_gradient[i, e] = wp.mat33d()
    step.cell_place[i, e] = wp.vec3d()
    step.cell_spared[i, e] = wp.float64(0.0)
    step.edge_gradient[i, e] = wp.mat33d()
    step.edge_place[i, e] = wp.vec3d()
    step.part_bar[i, e] = wp.float64(0.0)
    if e < instances.pin_count[i] or e >= constraints.count[i]:
        return
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    row = constraints.partner_row[i, e]
    shape = constraints.shape[i, e]
    n = constraints.normal[i, e]
    k = constraints.stiffness[i, e]
    eps = constraints.onset[i, e]
    depth = constraints.dent_depth[i, e]
    p = -wp.dot(n, constraints.offset[i, e] + constraints.displacement[i, e])
    deep = HARDENING_RANGE * eps
    ratio = k * constraints.dent_compliance[i, e]
    ridge = constraints.ridge[i, e]
    ridge_lead = constraints.ridge_lead[i, e]
    beside, after = beside_ridge(ratio, ridge, ridge_lead)
    _psi, slope, curvature = penalty(p - after, eps)
    _deep_psi, _deep_slope, deep_curvature = penalty(p - depth, deep)
    steep = HARDENING * deep_curvature
    force_bar = k * step.normal_bar[i, e][0]
    onset_bar = HARDENING_RANGE * HARDENING * by_onset(p - depth, deep)
    _edge_psi, edge_slope, edge_curvature = penalty(p + ridge_lead, eps)
    onset_bar += ridge * by_onset(p + ridge_lead, eps)
    onset_bar = force_bar * (onset_bar + beside * by_onset(p - after, eps))
    lead_bar = force_bar * (beside * curvature + ridge * edge_curvature + steep)
    depth_bar = step.normal_bar[i, e][2] - force_bar * steep * depth

    face = normal_of(instances, samples, i, row, shape)
    start, ahead, closing = motion_of_cell(instances, basis, motion, shapes, samples, i, row, shape, face, dt)
    gap = gap_of(instances, samples, i, row, shape)
    other = curvature_of(shapes, shape, face)
    cell_shape = shape_of_cell(surface, instances, basis, i, row, other)
    part, middle = part_of(instances, basis, motion, shapes, samples, surface, i, row, shape)
    open_gap = gap + wp.dot(face, start * middle)
    closing += wp.dot(face, (ahead - start) * middle)
    back = step.contact_bar[i, e]
    along = wp.dot(n, back)
    centre_bar = wp.vec3d()
    if constraints.row[i, e] != row:
        moved = gradient_of(instances, basis, q, i, row) - start
        pulled = displacement_gradient(basis.row_gradient, costate, i, row, instances.function_count[i])
        centre_bar = wp.transpose(pulled) * constraints.force[i, e] - wp.transpose(moved) * back
        centre_bar += wp.transpose(start) * turned_back(shapes, shape, back, dt)
    middle_bar = centre_bar - along * (wp.transpose(start) * face)
    centre_bar += along * (wp.transpose(ahead - start) * face)
    give_bar = zero
    by_unit = zero
    by_length = zero
    if ridge > zero:
        dent = instances.scale[i] * surface.dent_length[row]
        box, frame, _beside = box_beside(instances, basis, motion, shapes, samples, i, row, shape, face, gap, dent)
        box = pressed_by(box, instances, surface, i, row, k, ratio)
        # a force turns with its normal if the displacement does too; of that the gap alone lies along the normal
        x = constraints.offset[i, e] + constraints.displacement[i, e]
        f = constraints.force[i, e]
        memory = step.memory[i, e]
        L = interpolate(basis.row, constraints.row[i, e], costate, i, instances.function_count[i]) - memory
        turned = wp.cross(f, L) + wp.cross(x, back) + wp.dot(n, f) * wp.cross(n, memory)
        normal_bar = wp.cross(turned, n)
        start_gap = wp.dot(n, constraints.offset[i, e])
        normal_bar += along * (constraints.offset[i, e] - start_gap * n) - start_gap * back
        by_box, by_face, by_range, by_least, _r, _d, _n = wp.grad(edge_loss)(
            box,
            constraints.lead[i, e] - gap,
            eps,
            cell_shape.least,
            force_bar * (edge_slope - slope - (ridge_lead + after) * curvature),
            force_bar * ridge * (edge_curvature - curvature),
            wp.transpose(frame) * normal_bar,
        )
        onset_bar += by_range
        lead_bar += by_face
        give_bar = by_box.give
        step.edge_gradient[i, e] = frame * by_box.F
        step.edge_place[i, e] = frame * by_box.x - by_face * face + along * (n - face)
        by_unit = by_box.unit * box.unit
        by_length = wp.float64(2.0) * by_box.area * box.area + by_box.reach * box.reach + by_box.dent * box.dent
        by_length += by_least * cell_shape.least - by_unit
    by_shape, by_part, by_F, _by_n, _by_gap, by_place, by_ratio, _o, _l, _c = wp.grad(cell_loss)(
        cell_shape, part, ahead, face, open_gap, closing, ratio, onset_bar, lead_bar, centre_bar
    )
    fade_shape, fade_F, _fade_n = wp.grad(fade_of)(cell_shape, ahead, face)
    cell = cell_at(cell_shape, part, ahead, face, open_gap, closing, ratio)
    if part < wp.float64(1.0):
        middle_bar += by_place * (wp.transpose(ahead) * face)
        by_F += by_place * wp.outer(face, middle)
        pressed = interpolate(basis.row, constraints.row[i, e], costate, i, instances.function_count[i])
        step.part_bar[i, e] = wp.dot(pressed, constraints.force[i, e]) + by_part * part
        step.middle_bar[i, e] = middle_bar
    fade = fade_of(cell_shape, ahead, face)
    touched = zero
    spared = zero  # or one, far away: either does not change
    if gap <= NEAR * cell_shape.steepest:
        touched = touched_share(
            surface, samples.shape, samples.gap, samples.part, True, cell_shape, fade, i, row, shape
        )
        spared = wp.float64(1.0) - touched * touched
    by_gap = zero
    by_fade = zero
    for m in range(surface.start[row], surface.start[row + 1]):
        t = surface.neighbour[m]
        for slot in range(SLOTS):
            if samples.shape[i, t, slot] == shape:
                y = neighbour_at(cell_shape, fade, samples.gap[i, t, slot])
                change = wp.float64(surface.weight[m] * samples.part[i, t, slot]) * slope_of_touching(y) / fade
                by_gap += change
                by_fade -= (wp.float64(1.0) - y) * change

    exponent = beyond_exponent(ratio)
    by_log = (by_ratio + give_bar) * ratio * exponent
    spared_bar = zero
    if spared > zero:
        own = depth_bar * (wp.float64(1.0) - HARDENING_DEPTH * cell_shape.least / depth)  # a part no dent shifts
        spared_bar = (exponent * step.normal_bar[i, e][1] + own + by_log) / spared
        growth, by_touched = shear_growth(touched)
        spared_bar = wp.float64(2.0) * touched * spared_bar - by_touched / growth * step.normal_bar[i, e][3]  # by -c
    step.cell_spared[i, e] = spared_bar
    step.cell_fade[i, e] = wp.vec2d(fade * neighbour_at(cell_shape, fade, zero), fade)
    fade_bar = spared_bar * by_fade
    step.cell_gradient[i, e] = by_F + fade_bar * fade_F + along * wp.outer(face, cell.centre)
    step.cell_place[i, e] = by_place * face
    step.edge_gradient[i, e] = step.edge_gradient[i, e] + along * wp.outer(n - face, cell.centre)

    # lengths grow with the scale, but not the radius of what is touched
    above = half * spared_bar * by_gap
    bend_bar = by_shape.bend + fade_bar * fade_shape.bend + above
    by_scale = by_length + depth_bar + fade_bar * fade_shape.fade * cell_shape.fade
    by_scale += (by_shape.steepest + fade_bar * fade_shape.steepest) * cell_shape.steepest
    by_scale += (by_shape.least - above) * cell_shape.least
    if cell_shape.bend > zero:
        area = instances.scale[i] * instances.scale[i] * basis.row_area[row]
        by_scale += bend_bar * (cell_shape.bend + wp.float64(area * other) / (wp.float64(2.0) * PI))
    firm = surface.relative_stiffness[row] * surface.slenderness[row]
    powers = stiffness_exponents(instances, i, BULK_FACTOR, firm, shape_area(shapes, shape), dt)
    powers = (by_log - by_unit) * (powers + dent_exponents(instances, i))
    sums.contact[i, e] = sums.contact[i, e] + powers + wp.vec4d(zero, by_shape.poissons_ratio, zero, by_scale)


@wp.kernel(module="unique", enable_backward=False)
def accumulate_parts(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    shapes: Shapes,
    samples: Samples,
    surface: Surface,
    constraints: PointConstraints,
    # In and out:
    sums: Sums,
    step: Linearised,
):
    """Pass the loss by the parts of cells under faces, which their neighbours count too, to what they follow."""
    i, e = wp.tid()
    if e < instances.pin_count[i] or e >= constraints.count[i]:
        return
    row = constraints.partner_row[i, e]
    shape = constraints.shape[i, e]
    s = row - instances.row_start[i]
    slot = slot_of(samples, i, s, shape)
    if samples.part[i, s, slot] == 1.0:
        return
    part_bar = step.part_bar[i, e]
    for other in range(instances.pin_count[i], constraints.count[i]):
        near = constraints.partner_row[i, other]
        if constraints.shape[i, other] == shape and step.cell_spared[i, other] != wp.float64(0.0):
            for m in range(surface.start[near], surface.start[near + 1]):
                if surface.neighbour[m] == s:
                    y = (step.cell_fade[i, other][0] - samples.gap[i, s, slot]) / step.cell_fade[i, other][1]
                    counted = wp.float64(surface.weight[m] * samples.part[i, s, slot]) * touching(y)
                    part_bar -= step.cell_spared[i, other] * counted
    rim, turn, _axis, _part, _middle = face_part(
        instances, basis, motion, shapes, samples, surface.inset, i, row, shape
    )
    by_rim, _by_part, _by_middle = wp.grad(part_loss)(rim, part_bar, step.middle_bar[i, e])
    step.edge_gradient[i, e] = step.edge_gradient[i, e] + turn * by_rim.F
    step.edge_place[i, e] = step.edge_place[i, e] + turn * by_rim.x
    by_scale = wp.float64(2.0) * by_rim.area * rim.area
    sums.contact[i, e] = sums.contact[i, e] + wp.vec4d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), by_scale)


@wp.kernel
def restore_rows(
    instances: Instances,
    basis: Basis,
    motion: Motion,
    shapes: Shapes,
    samples: Samples,
    surface: Surface,
    constraints: PointConstraints,
    dt: float,
):
    """Write the rows at the centres of pressure of a recorded step."""
    i, e = wp.tid()
    if e < instances.pin_count[i] or e >= constraints.count[i]:
        return
    row = constraints.partner_row[i, e]
    if constraints.row[i, e] == row:
        return
    shape = constraints.shape[i, e]
    n = normal_of(instances, samples, i, row, shape)
    start, ahead, closing = motion_of_cell(instances, basis, motion, shapes, samples, i, row, shape, n, dt)
    cell_shape = shape_of_cell(surface, instances, basis, i, row, curvature_of(shapes, shape, n))
    part, middle = part_of(instances, basis, motion, shapes, samples, surface, i, row, shape)
    gap = gap_of(instances, samples, i, row, shape) + wp.dot(n, start * middle)
    closing += wp.dot(n, (ahead - start) * middle)
    ratio = constraints.stiffness[i, e] * constraints.dent_compliance[i, e]
    cell = cell_at(cell_shape, part, ahead, n, gap, closing, ratio)
    write_row(basis, constraints.row[i, e], row, cell.centre + middle)


@wp.kernel
def spread_over_neighbours(
    instances: Instances,
    samples: Samples,
    surface: Surface,
    constraints: PointConstraints,
    # In and out:
    step: Linearised,
):
    """Sum the loss by the gap of each sample over the contacts whose neighbourhood it is in, in their order."""
    i = wp.tid()
    for s in range(instances.sample_count[i]):
        step.sample_place[i, s] = wp.vec3d()
    for e in range(instances.pin_count[i], constraints.count[i]):
        if step.cell_spared[i, e] == wp.float64(0.0):
            continue
        row = constraints.partner_row[i, e]
        for m in range(surface.start[row], surface.start[row + 1]):
            t = surface.neighbour[m]
            for slot in range(SLOTS):
                if samples.shape[i, t, slot] == constraints.shape[i, e]:
                    y = (step.cell_fade[i, e][0] - samples.gap[i, t, slot]) / step.cell_fade[i, e][1]
                    weight = wp.float64(surface.weight[m] * samples.part[i, t, slot])
                    change = weight * step.cell_spared[i, e] * slope_of_touching(y)
                    normal = normal_of(instances, samples, i, instances.row_start[i] + t, constraints.shape[i, e])
                    pull = change / step.cell_fade[i, e][1] * normal
                    step.sample_place[i, t] = step.sample_place[i, t] + pull


@wp.kernel
def propagate_cells(
    instances: Instances,
    basis: Basis,
    constraints: PointConstraints,
    step: Linearised,
    dt: wp.float64,
    # In and out: dL/dq and dL/dv at the start of the step
    q_bar: wp.array2d[vec8d],
    qd_bar: wp.array2d[vec8d],
):
    """Pass the loss by cells and gaps to the start of the step."""
    i, e = wp.tid()
    stride = basis.row.shape[1]
    b = e % stride
    axis = e / stride
    ahead = vec8d()
    start = vec8d()
    for k in range(instances.pin_count[i], constraints.count[i]):
        row = constraints.partner_row[i, k]
        start = start + step.edge_place[i, k][axis] * vec8d(basis.row[row, b])
        ahead = ahead + step.cell_place[i, k][axis] * vec8d(basis.row[row, b])
        for j in range(3):
            ahead = ahead + step.cell_gradient[i, k][axis, j] * vec8d(basis.row_gradient[b, row, j])
            start = start + step.edge_gradient[i, k][axis, j] * vec8d(basis.row_gradient[b, row, j])
    for s in range(instances.sample_count[i]):
        start = start + step.sample_place[i, s][axis] * vec8d(basis.row[instances.row_start[i] + s, b])
    q_bar[i, e] = q_bar[i, e] + ahead + start
    qd_bar[i, e] = qd_bar[i, e] + dt * ahead
