"""Device side of the adjoint of a step, written by hand: one kernel for each of the step's, in reverse.

A bar is the derivative of the loss by what it stands over. The grid of a step is computed again, not stored.
"""

from typing import Any

import warp as wp

from softmode.mpm.spline_kernels import cell_of, spline, spline_slope
from softmode.mpm.step_kernels import add_to_node, controlled, in_grid, in_lane
from softmode.mpm.stress_kernels import kirchhoff, kirchhoff_adjoint, polar_rotation

wp.set_module_options({"enable_backward": False})


@wp.func
def control_adjoint(F: Any, control: Any, bar: Any, material: int):
    """Return dL/dF and dL/dA from the derivative by the controlled gradient."""
    if material != 0:
        return bar + bar * wp.transpose(control), wp.transpose(F) * bar
    return bar, bar


@wp.kernel(enable_backward=False, module="unique")
def grid_to_particles_adjoint(
    # State in:
    x_in: wp.array2d[Any],
    F_in: wp.array2d[Any],
    control: wp.array2d[Any],
    C_next: wp.array2d[Any],
    mass: wp.array2d[Any],
    material_control: int,
    # Grid:
    grid_velocity: wp.array4d[Any],
    origin: Any,
    dx: Any,
    first: wp.array[wp.vec3i],
    dt: Any,
    smoothing: Any,
    # Bars in:
    x_bar_next: wp.array2d[Any],
    v_bar_next: wp.array2d[Any],
    C_bar_next: wp.array2d[Any],
    F_bar_next: wp.array2d[Any],
    # Bars out: that of the velocity, and zero.
    scattered: wp.array4d[Any],
    x_bar: wp.array2d[Any],
    Fs_bar: wp.array2d[Any],
    F_bar: wp.array2d[Any],
    lanes: int,
):
    """Adjoint of the gather: scatter to the grid what particles ask of its velocity.

    The ``lanes`` threads of a particle share the scatter; the first writes what the particle's bars are.
    """
    world, lane, p = wp.tid()
    x = x_in[world, p]
    i, j, k, f = cell_of(x, origin, dx, first[0])
    shape = wp.vec3i(grid_velocity.shape[1], grid_velocity.shape[2], grid_velocity.shape[3])
    if mass[world, p] > type(dx)(0.0) and in_grid(i, j, k, shape):
        F = F_in[world, p]
        G = F_bar_next[world, p]
        C = C_next[world, p]
        rest = type(dx)(1.0) - smoothing
        Fs = controlled(F, control[world, p], material_control)
        v_bar = v_bar_next[world, p] + dt * x_bar_next[world, p]
        B_bar = (C_bar_next[world, p] + (rest * dt) * (G * wp.transpose(Fs))) * (type(dx)(3.0) / (dx * dx))
        if lane == 0:
            Fs_bar[world, p] = rest * (G + dt * (wp.transpose(C) * G))
            F_bar[world, p] = smoothing * G
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        hx = spline_slope(f[0])
        hy = spline_slope(f[1])
        hz = spline_slope(f[2])
        slope = type(x)()
        v = type(x)()
        base = v_bar - (B_bar * f) * dx
        B_dx = B_bar * dx
        lift = type(x)(B_dx[0, 2], B_dx[1, 2], B_dx[2, 2])
        for a in range(4):
            for b in range(4):
                wxy = wx[a] * wy[b]
                row = base + B_dx * type(x)(type(dx)(a - 1), type(dx)(b - 1), type(dx)(0.0))
                along = type(x)()
                work = type(dx)(0.0)
                slope_z = type(dx)(0.0)
                for c in range(4):
                    asked = row + type(dx)(c - 1) * lift
                    node = grid_velocity[world, i + a - 1, j + b - 1, k + c - 1]
                    if in_lane(a, b, lane, lanes):
                        push = (wxy * wz[c]) * asked
                        both = scattered.dtype(push[0], push[1], push[2], type(dx)(0.0))
                        add_to_node(scattered, world, i + a - 1, j + b - 1, k + c - 1, both)
                    power = wp.dot(node, asked)
                    work += wz[c] * power
                    slope_z += hz[c] * power
                    along += wz[c] * node
                slope += type(x)(hx[a] * wy[b] * work, wx[a] * hy[b] * work, wxy * slope_z)
                v += wxy * along
        if lane == 0:
            x_bar[world, p] = x_bar_next[world, p] + slope / dx - wp.transpose(B_bar) * v
    elif lane == 0:
        x_bar[world, p] = x_bar_next[world, p]
        Fs_bar[world, p] = F_in.dtype()
        F_bar[world, p] = F_bar_next[world, p]


@wp.kernel(enable_backward=False, module="unique")
def move_grid_adjoint(
    grid_mass: wp.array4d[Any],
    grid_velocity: wp.array4d[Any],
    least_mass: Any,
    gravity_dt: Any,
    # In: bar of velocity; out: zero, for the next scatter.
    scattered: wp.array4d[Any],
    # Out: bars of momentum and mass.
    grid_bar: wp.array4d[Any],
):
    """Adjoint of v = p / m + dt g."""
    world, i, j, k = wp.tid()
    m = grid_mass[world, i, j, k]
    both = grid_bar.dtype()
    if m > least_mass:
        given = scattered[world, i, j, k]
        bar = type(gravity_dt)(given[0], given[1], given[2]) / m
        by_mass = -wp.dot(grid_velocity[world, i, j, k] - gravity_dt, bar)
        both = grid_bar.dtype(bar[0], bar[1], bar[2], by_mass)
    scattered[world, i, j, k] = grid_bar.dtype()
    grid_bar[world, i, j, k] = both


@wp.kernel(enable_backward=False, module="unique")
def particles_to_grid_adjoint(
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
    # Bars in:
    grid_bar: wp.array4d[Any],
    Fs_bar_in: wp.array2d[Any],
    # Bars out, added to:
    x_bar: wp.array2d[Any],
    v_bar: wp.array2d[Any],
    C_bar: wp.array2d[Any],
    F_bar: wp.array2d[Any],
    control_bar: wp.array2d[Any],
    mass_bar: wp.array2d[Any],
    mu_bar: wp.array2d[Any],
    lam_bar: wp.array2d[Any],
):
    """Adjoint of the scatter: gather what the grid asks of particles."""
    world, p = wp.tid()
    x = x_in[world, p]
    m = mass[world, p]
    i, j, k, f = cell_of(x, origin, dx, first[0])
    shape = wp.vec3i(grid_bar.shape[1], grid_bar.shape[2], grid_bar.shape[3])
    if m > type(dx)(0.0) and in_grid(i, j, k, shape):
        F = F_in[world, p]
        A_control = control[world, p]
        C = C_in[world, p]
        Fs = controlled(F, A_control, material_control)
        scale = -type(dx)(3.0) * dt * volume[world, p] / (dx * dx)
        R = polar_rotation(model, Fs)
        A = m * C + scale * kirchhoff(model, mu[world, p], lam[world, p], Fs, R)
        kept = type(dx)(1.0) - damping * dt
        momentum = (m * kept) * v_in[world, p]
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        hx = spline_slope(f[0])
        hy = spline_slope(f[1])
        hz = spline_slope(f[2])
        slope = type(x)()
        p_bar = type(x)()
        A_bar = F_in.dtype()
        m_bar = m * type(dx)(0.0)
        base = momentum - (A * f) * dx
        A_dx = A * dx
        lift = type(x)(A_dx[0, 2], A_dx[1, 2], A_dx[2, 2])
        for a in range(4):
            for b in range(4):
                wxy = wx[a] * wy[b]
                row = base + A_dx * type(x)(type(dx)(a - 1), type(dx)(b - 1), type(dx)(0.0))
                along = type(x)()
                along_z = type(x)()
                mass_along = type(dx)(0.0)
                work = type(dx)(0.0)
                slope_z = type(dx)(0.0)
                for c in range(4):
                    both = grid_bar[world, i + a - 1, j + b - 1, k + c - 1]
                    bar = type(x)(both[0], both[1], both[2])
                    node = both[3]
                    weighed = wz[c] * bar
                    along += weighed
                    along_z += type(dx)(c - 1) * weighed
                    mass_along += wz[c] * node
                    power = m * node + wp.dot(bar, row + type(dx)(c - 1) * lift)
                    work += wz[c] * power
                    slope_z += hz[c] * power
                along = wxy * along
                p_bar += along
                m_bar += wxy * mass_along
                slope += type(x)(hx[a] * wy[b] * work, wx[a] * hy[b] * work, wxy * slope_z)
                for r in range(3):
                    A_bar[r, 0] += type(dx)(a - 1) * along[r]
                    A_bar[r, 1] += type(dx)(b - 1) * along[r]
                    A_bar[r, 2] += wxy * along_z[r]
        A_bar = (A_bar - wp.outer(p_bar, f)) * dx
        x_bar[world, p] = x_bar[world, p] + slope / dx - wp.transpose(A) * p_bar
        v_bar[world, p] = (m * kept) * p_bar
        C_bar[world, p] = m * A_bar
        by_F, by_mu, by_lam = kirchhoff_adjoint(model, mu[world, p], lam[world, p], Fs, R, scale * A_bar)
        by_F, by_control = control_adjoint(F, A_control, Fs_bar_in[world, p] + by_F, material_control)
        F_bar[world, p] = F_bar[world, p] + by_F
        control_bar[world, p] = control_bar[world, p] + by_control
        mass_bar[world, p] = mass_bar[world, p] + m_bar + kept * wp.dot(v_in[world, p], p_bar) + wp.ddot(C, A_bar)
        mu_bar[world, p] = mu_bar[world, p] + by_mu
        lam_bar[world, p] = lam_bar[world, p] + by_lam
    else:
        v_bar[world, p] = type(x)()
        C_bar[world, p] = F_in.dtype()


@wp.kernel(enable_backward=False, module="unique")
def mass_to_grid_adjoint(
    x_in: wp.array2d[Any],
    mass: wp.array2d[Any],
    origin: Any,
    dx: Any,
    first: wp.array[wp.vec3i],
    grid_mass_bar: wp.array4d[Any],
    # Out, added to:
    x_bar: wp.array2d[Any],
    mass_bar: wp.array2d[Any],
):
    """Adjoint of :func:`mass_to_grid`: dL/dx_p = m sum_i dL/dm_i grad w_ip."""
    world, p = wp.tid()
    x = x_in[world, p]
    m = mass[world, p]
    i, j, k, f = cell_of(x, origin, dx, first[0])
    slope = type(x)()
    m_bar = m * type(dx)(0.0)
    shape = wp.vec3i(grid_mass_bar.shape[1], grid_mass_bar.shape[2], grid_mass_bar.shape[3])
    if m > type(dx)(0.0) and in_grid(i, j, k, shape):
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        hx = spline_slope(f[0])
        hy = spline_slope(f[1])
        hz = spline_slope(f[2])
        for a in range(4):
            for b in range(4):
                for c in range(4):
                    node = grid_mass_bar[world, i + a - 1, j + b - 1, k + c - 1]
                    m_bar += wx[a] * wy[b] * wz[c] * node
                    slope += node * type(x)(hx[a] * wy[b] * wz[c], wx[a] * hy[b] * wz[c], wx[a] * wy[b] * hz[c])
    x_bar[world, p] = x_bar[world, p] + (m / dx) * slope
    mass_bar[world, p] = mass_bar[world, p] + m_bar
