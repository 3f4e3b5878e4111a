"""Device side of a step of the moving-least-squares material point method: particles to grid, grid, grid to particles.

World is axis 0 of every array. Particles of mass zero are padding. Cubic B-splines (Hu et al. 2018, doi:10.1145/3197517
.3201293, with D = dx^2/3), affine transfer (Jiang et al. 2015, doi:10.1145/2766996), symplectic Euler.
"""

from typing import Any

import warp as wp

from softmode.mpm.spline_kernels import cell_of, spline
from softmode.mpm.stress_kernels import kirchhoff, polar_rotation

wp.set_module_options({"enable_backward": False})

LEFT_GRID = wp.constant(1)
"""Failure: a particle came within two nodes of the border of the grid."""
INVERTED = wp.constant(2)
"""Failure: det F <= 0."""
NOT_FINITE = wp.constant(3)
"""Failure: a position is not finite."""


@wp.func
def fail(failure: wp.array2d[int], world: int, kind: int, step: int, particle: int):
    """Note the first failure of a world: how many there were, its kind, step and particle."""
    if wp.atomic_add(failure, world, 0, 1) == 0:
        failure[world, 1] = kind
        failure[world, 2] = step
        failure[world, 3] = particle


@wp.func
def controlled(F: Any, control: Any, material: int):
    """Return the deformation gradient that the stress sees: F + A, or F (I + A) where the control is the material's."""
    if material != 0:
        return F + F * control
    return F + control


@wp.func
def in_grid(i: int, j: int, k: int, shape: wp.vec3i):
    """Return whether all nodes of a particle in cell (i, j, k) exist."""
    return i >= 1 and j >= 1 and k >= 1 and i < shape[0] - 2 and j < shape[1] - 2 and k < shape[2] - 2


# Four floats in one operation where the GPU has it: scatters are bound by the number of atomic operations.
@wp.func_native("""
    wp::vec_t<4, wp::float32>* at = wp::address(grid, world, i, j, k);
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    atomicAdd(reinterpret_cast<float4*>(at), make_float4(value[0], value[1], value[2], value[3]));
#else
    wp::atomic_add(at, value);
#endif
""")
def add_to_node(grid: wp.array4d[wp.vec4f], world: int, i: int, j: int, k: int, value: wp.vec4f):
    """Add to a node."""


@wp.func
def add_to_node(grid: wp.array4d[wp.vec4d], world: int, i: int, j: int, k: int, value: wp.vec4d):  # noqa: F811
    """Add to a node."""
    wp.atomic_add(grid, world, i, j, k, value)


@wp.func
def in_lane(a: int, b: int, lane: int, lanes: int):
    """Return whether row (a, b) of the nodes around a particle is served by its thread ``lane`` of ``lanes``."""
    return ((4 * a + b) & (lanes - 1)) == lane


@wp.func
def moves(active: wp.array[int], world: int):
    """Return whether a world takes part in a run; one entry stands for all worlds."""
    return active[world % active.shape[0]] != 0


@wp.kernel(enable_backward=False, module="unique")
def clear_failures(failure: wp.array2d[int], active: wp.array[int]):
    """Forget the failures of the worlds that take part in the run to come."""
    world = wp.tid()
    if moves(active, world):
        failure[world, 0] = 0


@wp.kernel(enable_backward=False, module="unique")
def particles_to_grid(
    # State in:
    x_in: wp.array2d[Any],
    v_in: wp.array2d[Any],
    C_in: wp.array2d[Any],
    F_in: wp.array2d[Any],
    control: wp.array2d[Any],
    # Particles:
    mass: wp.array2d[Any],
    volume: wp.array2d[Any],
    mu: wp.array2d[Any],
    lam: wp.array2d[Any],
    model: int,
    material_control: int,
    # Grid:
    origin: Any,
    dx: Any,
    first: wp.array[wp.vec3i],
    dt: Any,
    damping: Any,
    # Out:
    scattered: wp.array4d[Any],
    failure: wp.array2d[int],
    step: int,
    active: wp.array[int],
    lanes: int,
):
    """Scatter momentum and mass: p_i = sum_p w_ip (m v (1 - zeta dt) + A (x_i - x_p)), A = m C - 3/dx^2 dt V tau.

    Each of the ``lanes`` threads of a particle, a power of two, serves its share of the 16 rows of nodes.
    """
    world, lane, p = wp.tid()
    m = mass[world, p]
    if m > type(dx)(0.0) and moves(active, world):
        x = x_in[world, p]
        i, j, k, f = cell_of(x, origin, dx, first[0])
        shape = wp.vec3i(scattered.shape[1], scattered.shape[2], scattered.shape[3])
        if in_grid(i, j, k, shape):
            F = controlled(F_in[world, p], control[world, p], material_control)
            if lane == 0 and wp.determinant(F) <= type(dx)(0.0):
                fail(failure, world, INVERTED, step, p)
            scale = type(dx)(3.0) * dt * volume[world, p] / (dx * dx)
            R = polar_rotation(model, F)
            A = m * C_in[world, p] - scale * kirchhoff(model, mu[world, p], lam[world, p], F, R)
            base = (m * (type(dx)(1.0) - damping * dt)) * v_in[world, p] - (A * f) * dx
            wx = spline(f[0])
            wy = spline(f[1])
            wz = spline(f[2])
            A = A * dx
            for a in range(4):
                for b in range(4):
                    if in_lane(a, b, lane, lanes):
                        wxy = wx[a] * wy[b]
                        row = base + A * type(x)(type(dx)(a - 1), type(dx)(b - 1), type(dx)(0.0))
                        for c in range(4):
                            w = wxy * wz[c]
                            lift = type(x)(A[0, 2], A[1, 2], A[2, 2]) * type(dx)(c - 1)
                            q = w * (row + lift)
                            both = scattered.dtype(q[0], q[1], q[2], w * m)
                            add_to_node(scattered, world, i + a - 1, j + b - 1, k + c - 1, both)


@wp.kernel(enable_backward=False, module="unique")
def mass_to_grid(
    x_in: wp.array2d[Any],
    mass: wp.array2d[Any],
    origin: Any,
    dx: Any,
    first: wp.array[wp.vec3i],
    grid_mass: wp.array4d[Any],
    active: wp.array[int],
    lanes: int,
):
    """Scatter mass alone; the ``lanes`` threads of a particle as in :func:`particles_to_grid`."""
    world, lane, p = wp.tid()
    m = mass[world, p]
    if m > type(dx)(0.0) and moves(active, world):
        i, j, k, f = cell_of(x_in[world, p], origin, dx, first[0])
        if in_grid(i, j, k, wp.vec3i(grid_mass.shape[1], grid_mass.shape[2], grid_mass.shape[3])):
            wx = spline(f[0])
            wy = spline(f[1])
            wz = spline(f[2])
            for a in range(4):
                for b in range(4):
                    if in_lane(a, b, lane, lanes):
                        wxy = wx[a] * wy[b]
                        for c in range(4):
                            wp.atomic_add(grid_mass, world, i + a - 1, j + b - 1, k + c - 1, wxy * (wz[c] * m))


@wp.kernel(enable_backward=False, module="unique")
def particle_volumes(
    x_in: wp.array2d[Any],
    mass: wp.array2d[Any],
    grid_mass: wp.array4d[Any],
    origin: Any,
    dx: Any,
    first: wp.array[wp.vec3i],
    volume: wp.array2d[Any],
):
    """Find the volume that a particle stands for: V = m dx^3 / sum_i w_ip m_i."""
    world, p = wp.tid()
    m = mass[world, p]
    if m > type(dx)(0.0):
        i, j, k, f = cell_of(x_in[world, p], origin, dx, first[0])
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        around = m * type(dx)(0.0)
        for a in range(4):
            for b in range(4):
                for c in range(4):
                    around += wx[a] * wy[b] * wz[c] * grid_mass[world, i + a - 1, j + b - 1, k + c - 1]
        volume[world, p] = m * dx * dx * dx / around


@wp.kernel(enable_backward=False, module="unique")
def move_grid(
    # In: momentum and mass; out: zero, for the next scatter.
    scattered: wp.array4d[Any],
    least_mass: Any,
    gravity_dt: Any,
    # Out:
    grid_mass: wp.array4d[Any],
    grid_velocity: wp.array4d[Any],
    active: wp.array[int],
):
    """Turn momentum into velocity, v = p / m + dt g; nodes without mass stand still.

    Most nodes are empty, and were when they were written last: what is zero already is not written again.
    """
    world, i, j, k = wp.tid()
    if not moves(active, world):
        return
    both = scattered[world, i, j, k]
    if both == scattered.dtype() and grid_mass[world, i, j, k] == both[3]:
        return
    scattered[world, i, j, k] = scattered.dtype()
    m = both[3]
    v = type(gravity_dt)()
    if m > least_mass:
        v = type(gravity_dt)(both[0], both[1], both[2]) / m + gravity_dt
    grid_mass[world, i, j, k] = m
    grid_velocity[world, i, j, k] = v


@wp.kernel(enable_backward=False, module="unique")
def grid_to_particles(
    # State in:
    x_in: wp.array2d[Any],
    F_in: wp.array2d[Any],
    control: wp.array2d[Any],
    mass: wp.array2d[Any],
    material_control: int,
    # Grid:
    grid_velocity: wp.array4d[Any],
    origin: Any,
    dx: Any,
    first: wp.array[wp.vec3i],
    dt: Any,
    smoothing: Any,
    # State out:
    x_out: wp.array2d[Any],
    v_out: wp.array2d[Any],
    C_out: wp.array2d[Any],
    F_out: wp.array2d[Any],
    failure: wp.array2d[int],
    step: int,
    active: wp.array[int],
):
    """Gather v and C, move, and deform: F' = (1 - gamma) (I + dt C) F(control) + gamma F."""
    world, p = wp.tid()
    if not moves(active, world):
        return
    x = x_in[world, p]
    if mass[world, p] > type(dx)(0.0):
        i, j, k, f = cell_of(x, origin, dx, first[0])
        shape = wp.vec3i(grid_velocity.shape[1], grid_velocity.shape[2], grid_velocity.shape[3])
        if in_grid(i, j, k, shape):
            wx = spline(f[0])
            wy = spline(f[1])
            wz = spline(f[2])
            v = type(x)()
            B = F_in.dtype()
            for a in range(4):
                for b in range(4):
                    along = type(x)()
                    along_z = type(x)()
                    for c in range(4):
                        node = wz[c] * grid_velocity[world, i + a - 1, j + b - 1, k + c - 1]
                        along += node
                        along_z += type(dx)(c - 1) * node
                    along = (wx[a] * wy[b]) * along
                    v += along
                    for r in range(3):
                        B[r, 0] += type(dx)(a - 1) * along[r]
                        B[r, 1] += type(dx)(b - 1) * along[r]
                        B[r, 2] += (wx[a] * wy[b]) * along_z[r]
            C = (B - wp.outer(v, f)) * (type(dx)(3.0) / dx)
            F = F_in[world, p]
            moved = x + dt * v
            Fs = controlled(F, control[world, p], material_control)
            x_out[world, p] = moved
            v_out[world, p] = v
            C_out[world, p] = C
            F_out[world, p] = (type(dx)(1.0) - smoothing) * (Fs + dt * (C * Fs)) + smoothing * F
            if not wp.isfinite(wp.length_sq(moved)):
                fail(failure, world, NOT_FINITE, step, p)
        else:
            x_out[world, p] = x
            v_out[world, p] = type(x)()
            C_out[world, p] = F_in.dtype()
            F_out[world, p] = F_in[world, p]
            fail(failure, world, LEFT_GRID, step, p)
    else:
        x_out[world, p] = x
        v_out[world, p] = type(x)()
        C_out[world, p] = F_in.dtype()
        F_out[world, p] = F_in[world, p]
