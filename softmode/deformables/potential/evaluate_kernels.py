"""Device side of the potential at an iterate: points, pins and contacts with derivatives, and the sums of a body."""

from typing import Any

import warp as wp

from softmode.deformables.contact.response_kernels import FIRST, KEEP, RELAX, SET, contact_response
from softmode.deformables.materials.hessian_kernels import hessian
from softmode.deformables.materials.material_kernels import (
    MaterialParameters,
    determinant_minus_one,
    energy_and_stress,
    lame,
)
from softmode.deformables.model.declare import kernel_over
from softmode.deformables.model.deformation_kernels import elastic_gradient
from softmode.deformables.model.lane_kernels import (
    LANES,
    chunk_number,
    number_of,
    set_number,
    team_rank,
    vec8d,
)
from softmode.deformables.model.newton_step_kernels import ALL, ENERGIES, NewtonStep, add_outer_3d, mat38d
from softmode.deformables.model.struct_kernels import (
    Basis,
    Instances,
    PointConstraints,
    interpolate_change,
)

wp.set_module_options({"enable_backward": False})
RELAXED_AFTER = wp.constant(16)
"""Iterations after which the normal force that limits friction goes half way only, where `friction_lag` is longer."""


@wp.func
def material_of(instances: Instances, basis: Basis, i: int, point: int):
    """Return the material of an instance at a cubature point."""
    parameters = MaterialParameters()
    mu, lam = lame(instances.youngs_modulus[i] * basis.stiffness_scale[point], instances.poissons_ratio[i])
    parameters.model = instances.material_model[i]
    parameters.mu = mu
    parameters.lam = wp.float64(basis.lame_ratio[point]) * lam
    parameters.viscosity = wp.float64(instances.viscosity[i])
    return parameters


@wp.func
def store_hessian(C: Any, i: int, p: int, hessian_out: wp.array3d[wp.mat33]):
    """Store the blocks of the Hessian of a point, see ``Points.hessian``."""
    for pair in range(6):
        r = 3 * pair
        hessian_out[i, pair, p] = wp.mat33(
            C[r, 0], C[r, 1], C[r, 2], C[r + 1, 0], C[r + 1, 1], C[r + 1, 2], C[r + 2, 0], C[r + 2, 1], C[r + 2, 2]
        )


@wp.func
def evaluate_point(
    step: NewtonStep,
    # State in:
    selected: wp.array[int],  # (world_count,)
    q: wp.array2d[vec8d],
    derivatives: int,
    i: int,
    p: int,
    lane: int = 0,
    lanes: int = 1,
):
    """Evaluate V_p Psi(F_p) and, where asked, its derivatives by F_p at every cubature point.

    A body of scale s has V_p s^3 and the elastic F_p / s: each derivative takes one s off. ``derivatives`` is one of
    ENERGIES, ALL and TRIAL. A warp may share a point: each of its 32 threads is a ``lane`` of them.
    """
    dt = step.options.dt
    w = step.instances.world[i]
    if selected[w] == 0 or p >= step.instances.point_count[i]:
        return
    if derivatives == ALL and step.state.evaluated[w] != 0 and step.state.refresh[w] == 0:
        return
    point = step.instances.point_start[i] + p
    parameters = material_of(step.instances, step.basis, i, point)
    s = wp.float64(step.instances.scale[i])
    weight = s * step.basis.point_weight[point]

    G = elastic_gradient(step.basis.gradient, q, i, point, step.instances.function_count[i], s, lane, lanes)
    if lane != 0:
        return
    G_start = G
    if step.instances.viscosity[i] > 0.0:
        G_start = step.points.start[i, p]
    psi, P = energy_and_stress(parameters, G, G_start, dt)
    step.points.energy[i, p] = s * s * weight * psi
    if derivatives != ENERGIES:
        step.points.stress[i, p] = s * weight * P
        step.points.volume_ratio[i, p] = float(wp.float64(1.0) + determinant_minus_one(G))
    if derivatives == ALL and step.state.refresh[w] != 0:
        C = float(weight) * hessian(parameters, G, G_start, dt, step.state.project[w])
        store_hessian(C, i, p, step.points.hessian)


evaluate_points = kernel_over(evaluate_point, "evaluate_points", "i", "p", "lane")


@wp.func
def normal_force_mode(iteration: int, lag: int, derivatives: int):
    """Return what becomes of the normal force that friction goes by, see ``response_kernels.KEEP``.

    Not of the step's struct, 8 kB, which each thread on CUDA would copy: that cost a third of a step.
    """
    if derivatives == 0 or iteration > lag:
        return int(KEEP)
    if iteration == 0:
        return int(FIRST)
    if iteration > RELAXED_AFTER:
        return int(RELAX)
    return int(SET)


@wp.func
def evaluate_constraint(
    step: NewtonStep,
    # State in:
    selected: wp.array[int],
    q: wp.array2d[vec8d],
    r: wp.array2d[wp.float64],
    derivatives: int,
    i: int,
    e: int,
    lane: int = 0,
    lanes: int = 1,
):
    """Evaluate pins and contacts at displacement d = sum_k b_k (q_k - q_nk) - J r, less that of a soft partner.

    A contact of two soft bodies is a constraint of each, which has one half of its energy and all of its force. A warp
    may share a constraint: each of its 32 threads is a ``lane`` of them.
    """
    w = step.instances.world[i]
    if selected[w] == 0 or e >= step.constraints.count[i]:
        return
    row = step.constraints.row[i, e]
    known = derivatives != 0 and step.state.evaluated[w] != 0
    d = step.constraints.displacement[i, e]
    if not known:
        count = step.instances.function_count[i]
        d = interpolate_change(step.basis.row, row, q, step.motion.q_start, i, count, lane, lanes)
    share = wp.float64(1.0)
    if e >= step.constraints.count[i] - step.constraints.pair_count[i]:
        j = step.constraints.partner[i, e]
        if j >= 0:
            if not known:
                row = step.constraints.partner_row[i, e]
                count = step.instances.function_count[j]
                d -= interpolate_change(step.basis.row, row, q, step.motion.q_start, j, count, lane, lanes)
            share = wp.float64(0.5)
    if lane != 0:
        return
    if not known:
        for k in range(step.constraints.dof_begin[i, e], step.constraints.dof_end[i, e]):
            d -= r[w, k] * wp.vec3d(step.constraints.jacobian[i, e, k])
        step.constraints.displacement[i, e] = d
    mode = normal_force_mode(step.state.iteration[w], step.state.friction_lag, derivatives)
    pinned = e < step.instances.pin_count[i]
    energy, force, H, pressed, slip = contact_response(
        pinned,
        step.constraints.offset[i, e],
        step.constraints.normal[i, e],
        d,
        step.constraints.stiffness[i, e],
        step.constraints.dent_compliance[i, e],
        step.constraints.dent_depth[i, e],
        step.constraints.ridge[i, e],
        step.constraints.ridge_lead[i, e],
        step.constraints.friction[i, e],
        step.constraints.stick[i, e],
        step.constraints.stick_deep[i, e],
        step.constraints.normal_force[i, e],
        step.constraints.onset[i, e],
        step.options.stick_range,
        mode,
        step.state.exact[w],
    )
    step.constraints.energy[i, e] = share * energy
    step.constraints.force[i, e] = force
    if not pinned:
        step.constraints.slip[i, e] = slip
        if mode != int(KEEP):
            step.constraints.normal_force[i, e] = pressed
    if derivatives != 0:
        step.constraints.hessian[i, e] = wp.mat33(H)
        for k in range(step.constraints.dof_begin[i, e], step.constraints.dof_end[i, e]):
            step.constraints.coupling[i, e, k] = wp.mat33(H) * step.constraints.jacobian[i, e, k]


evaluate_constraints = kernel_over(evaluate_constraint, "evaluate_constraints", "i", "e", "lane")


@wp.func
def acts(constraints: PointConstraints, i: int, e: int):
    """Return whether a constraint has a force or a Hessian; what is no number does."""
    total = wp.float64(0.0)
    for a in range(3):
        total += wp.abs(constraints.force[i, e][a])
        for b in range(3):
            total += wp.float64(wp.abs(constraints.hessian[i, e][a, b]))
    return not (total == wp.float64(0.0))


@wp.func
def list_acting(step: NewtonStep, team: int, i: int, member: int):
    """List the constraints of an instance that act at the iterate: more than half of the contacts are only near."""
    if step.state.active[step.instances.world[i]] == 0:
        return
    pins = step.instances.pin_count[i]
    count = step.constraints.count[i]
    for e in range(member, pins, team):
        step.constraints.acting[i, e] = e
    found = int(pins)
    for first in range(pins, count, team):
        e = first + member
        flag = int(0)
        if e < count:
            if acts(step.constraints, i, e):
                flag = 1
        rank = team_rank(flag)
        if flag != 0:
            step.constraints.acting[i, found + rank % 65536] = e
        found += rank / 65536
    if member == 0:
        step.constraints.acting_count[i] = found


list_constraints = kernel_over(list_acting, "list_constraints", "i", "member")


@wp.func
def sum_force_block(step: NewtonStep, active: wp.array[int], i: int, chunk: int, b: int):
    """Sum V P grad b_k over one chunk of the points, less b_k f over one chunk of the constraints."""
    if active[step.instances.world[i]] == 0 or LANES * b >= step.instances.function_count[i]:
        return
    stride = step.basis.row.shape[1]
    chunk_count = step.arrays.gradient_chunk.shape[1]
    total = mat38d()
    first = step.instances.point_start[i]
    count = step.instances.point_count[i]
    for p in range(chunk * count / chunk_count, (chunk + 1) * count / chunk_count):
        P = wp.transpose(step.points.stress[i, p])
        for k in range(3):
            total = add_outer_3d(total, P[k], vec8d(step.basis.gradient_across[b, first + p, k]))
    count = step.constraints.acting_count[i]
    for k in range(chunk * count / chunk_count, (chunk + 1) * count / chunk_count):
        e = step.constraints.acting[i, k]
        total = add_outer_3d(total, -step.constraints.force[i, e], vec8d(step.basis.row[step.constraints.row[i, e], b]))
    for axis in range(3):
        step.arrays.gradient_chunk[i, chunk, axis * stride + b] = total[axis]


sum_forces = kernel_over(sum_force_block, "sum_forces", "i", "chunk", "b")


@wp.func
def gradient_block(step: NewtonStep, i: int, e: int):
    """Compute g = m c^2/dt^2 (q - q_inertial) + m alpha c/dt (q - q_rate) - f + sum_p V P grad b - sum_e b f_e."""
    dt = step.options.dt
    stride = step.basis.row.shape[1]
    b = e % stride
    if step.state.active[step.instances.world[i]] == 0 or LANES * b >= step.instances.function_count[i]:
        return
    q = step.arrays.q
    c = step.motion.rate[i]
    mass = step.instances.mass[i]
    damping = mass * wp.float64(step.instances.mass_damping[i]) * c / dt
    g = mass * c * c / (dt * dt) * (q[i, e] - step.motion.q_inertial[i, e])
    g = g + damping * (q[i, e] - step.motion.q_rate[i, e]) - step.motion.force[i, e]
    for k in range(step.arrays.gradient_chunk.shape[1]):
        g = g + step.arrays.gradient_chunk[i, k, e]
    reaction = vec8d()
    for lane in range(LANES):
        if LANES * b + lane < step.instances.driven_count[i]:
            reaction[lane] = g[lane]
            g[lane] = wp.float64(0.0)
    step.arrays.gradient[i, e] = g
    step.arrays.reaction[i, e] = reaction


@wp.func
def gradient_number(step: NewtonStep, parts: int, i: int, k: int):
    """Compute number ``k`` of the same, of an active world, from so many parts of the sums over points."""
    dt = step.options.dt
    function = k % (LANES * step.basis.row.shape[1])
    if function >= step.instances.function_count[i]:
        return
    rate = step.motion.rate[i] / dt
    damping = wp.float64(step.instances.mass_damping[i])
    q = number_of(step.arrays.q, i, k)
    g = rate * (q - number_of(step.motion.q_inertial, i, k)) + damping * (q - number_of(step.motion.q_rate, i, k))
    g = step.instances.mass[i] * rate * g - number_of(step.motion.force, i, k)
    row = i * step.arrays.gradient_chunk.shape[1]
    for part in range(parts):
        g = g + chunk_number(step.arrays.gradient_chunk, row + part, k)
    reaction = wp.float64(0.0)
    if function < step.instances.driven_count[i]:
        reaction = g
        g = wp.float64(0.0)
    set_number(step.arrays.gradient, i, k, g)
    set_number(step.arrays.reaction, i, k, reaction)


sum_gradient = kernel_over(gradient_block, "sum_gradient", "i", "e")
