"""Kernels through which the tests reach device functions."""

import warp as wp

from softmode.deformables.contact import penalty_kernels as contact
from softmode.deformables.contact import ridge_kernels
from softmode.deformables.contact import shape_query_kernels as shape_queries
from softmode.deformables.materials.hessian_kernels import HessianBlocks, hessian, stress_derivative
from softmode.deformables.materials.material_cpu_kernels import LANES, energy_and_stress, hessian_lanes, mat98d, vec8d
from softmode.deformables.materials.material_kernels import MaterialParameters, energy, stress
from softmode.deformables.materials.singular_value_kernels import positive_part, singular_values

wp.set_module_options({"enable_backward": False})


@wp.kernel
def evaluate_materials(
    parameters: MaterialParameters,
    G: wp.array[wp.mat33d],
    G_start: wp.array[wp.mat33d],
    direction: wp.array[wp.mat33d],
    dt: wp.float64,
    project: int,
    # Out:
    energy_out: wp.array[wp.float64],
    stress_out: wp.array[wp.mat33d],
    derivative_out: wp.array[wp.mat33d],
    hessian_out: wp.array[HessianBlocks],
):
    """Evaluate energy, stress, its derivative in a direction, and the Hessian at every G = F - I."""
    i = wp.tid()
    energy_out[i] = energy(parameters, G[i], G_start[i], dt)
    stress_out[i] = stress(parameters, G[i], G_start[i], dt)
    derivative_out[i] = stress_derivative(parameters, G[i], G_start[i], dt, direction[i])
    hessian_out[i] = hessian(parameters, G[i], G_start[i], dt, project)


@wp.func
def in_lanes(G: wp.array[wp.mat33d], first: int):
    """Return eight matrices from ``first`` on; the last one stands for those behind it."""
    out = mat98d()
    for lane in range(LANES):
        M = G[wp.min(first + lane, G.shape[0] - 1)]
        for k in range(9):
            out[k, lane] = M[k / 3, k % 3]
    return out


@wp.kernel
def evaluate_materials_in_lanes(
    parameters: MaterialParameters,
    G: wp.array[wp.mat33d],
    G_start: wp.array[wp.mat33d],
    direction: wp.array[wp.mat33d],
    dt: wp.float64,
    project: int,
    # Out:
    energy_out: wp.array[wp.float64],
    stress_out: wp.array[wp.mat33d],
    derivative_out: wp.array[wp.mat33d],
    hessian_out: wp.array[HessianBlocks],
):
    """Do the same, eight at a time; what has no form in lanes comes from the functions of a point."""
    first = LANES * wp.tid()
    one = vec8d(wp.float64(1.0))
    mu = parameters.mu * one
    lam = parameters.lam * one
    rate = parameters.viscosity / dt
    place = in_lanes(G, first)
    start = in_lanes(G_start, first)
    found = energy_and_stress(parameters.model, mu, lam, rate, place, start)
    C = hessian_lanes(parameters.model, mu, lam, rate, place, start, project)
    for lane in range(wp.min(LANES, G.shape[0] - first)):
        i = first + lane
        energy_out[i] = found[0, lane]
        P = wp.mat33d()
        for k in range(9):
            P[k / 3, k % 3] = found[1 + k, lane]
        stress_out[i] = P
        derivative_out[i] = stress_derivative(parameters, G[i], G_start[i], dt, direction[i])
        blocks = HessianBlocks()
        for k in range(54):
            blocks[k / 3, k % 3] = C[k, lane]
        hessian_out[i] = blocks


@wp.kernel
def decompose(
    F: wp.array[wp.mat33d],
    # Out:
    U_out: wp.array[wp.mat33d],
    sigma_out: wp.array[wp.vec3d],
    V_out: wp.array[wp.mat33d],
    positive_out: wp.array[wp.mat33d],
):
    """Evaluate the singular values of every F, and the positive part of F + F^T."""
    i = wp.tid()
    U, sigma, V = singular_values(F[i])
    U_out[i] = U
    sigma_out[i] = sigma
    V_out[i] = V
    positive_out[i] = positive_part(F[i] + wp.transpose(F[i]))


@wp.kernel
def query_points(
    shape_type: int,
    scale: wp.vec3,
    mesh: wp.uint64,
    fields: shape_queries.Heightfields,
    x: wp.array[wp.vec3],
    reach: float,
    # Out:
    distance_out: wp.array[float],
    normal_out: wp.array[wp.vec3],
):
    """Evaluate the distance of every point to one shape."""
    i = wp.tid()
    query = shape_queries.query_shape(shape_type, scale, mesh, x[i], reach)
    if shape_type == shape_queries.HEIGHTFIELD:
        query = shape_queries.query_heightfield(x[i], fields, fields.index[0], reach)
    distance_out[i] = query.distance
    normal_out[i] = query.normal


@wp.kernel
def evaluate_ridges(
    half: wp.array[wp.vec3d],
    x: wp.array[wp.vec3d],
    inward: wp.array[wp.vec3d],
    side: wp.array[float],
    dent: wp.array[float],
    front: wp.array[wp.float64],
    # Out:
    ridge_out: wp.array[wp.vec3d],
):
    """Evaluate length and depth of the edges of a box in cells, and the reach of these."""
    i = wp.tid()
    area = wp.float64(side[i] * side[i])
    reach = wp.float64(ridge_kernels.reach_of(side[i], dent[i]))
    length, depth = ridge_kernels.ridge_in_cell(half[i], x[i], inward[i], area, reach, front[i])
    ridge_out[i] = wp.vec3d(length, depth, reach)


@wp.kernel
def evaluate_potentials(
    x: wp.array[wp.float64],
    eps: wp.float64,
    ratio: wp.float64,
    depth: wp.float64,
    ridge: wp.float64,
    ridge_lead: wp.float64,
    # Out:
    normal_out: wp.array[wp.vec3d],
    friction_out: wp.array[wp.vec3d],
):
    """Evaluate both contact potentials: (value, slope, curvature) and (f0, f1 / y, f1')."""
    i = wp.tid()
    value, slope, curvature = contact.normal_potential(x[i], eps, ratio, depth, ridge, ridge_lead)
    normal_out[i] = wp.vec3d(value, slope, curvature)
    f0, f1_over_y, f1_slope = contact.friction_potential(x[i], eps)
    friction_out[i] = wp.vec3d(f0, f1_over_y, f1_slope)


@wp.kernel
def evaluate_stick(
    x: wp.array[wp.float64],
    limit: wp.float64,
    stiffness: wp.float64,
    deep: wp.float64,
    depth: wp.float64,
    # Out:
    out: wp.array[wp.vec3d],
):
    """Evaluate friction with memory: energy, force over slip, curvature along the slip."""
    i = wp.tid()
    energy, secant, tangent = contact.stick_potential(x[i], limit, stiffness, deep, depth)
    out[i] = wp.vec3d(energy, secant, tangent)
