"""Device side of the losses: node by node, with the derivative by the node's mass."""

from typing import Any

import warp as wp

from softmode.mpm.step_kernels import moves

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False, module="unique")
def log_mass_at_nodes(
    grid_mass: wp.array4d[Any],
    target: wp.array4d[Any],
    scale: Any,
    weight: wp.array[wp.float64],
    loss: wp.array[wp.float64],
    bar: wp.array4d[Any],
    active: wp.array[int],
):
    """Add a weight times 1/2 (ln(m/s + 1) - ln(m*/s + 1))^2 of every node; write its derivative by m."""
    world, i, j, k = wp.tid()
    if not moves(active, world):
        return
    m = grid_mass[world, i, j, k]
    goal = target[world % target.shape[0], i, j, k]
    r = type(scale)(0.0)
    if m > r or goal > r:
        r = wp.log((m + scale) / (goal + scale))  # ln(m/s + 1) - ln(m*/s + 1)
        wp.atomic_add(loss, world, wp.float64(0.5) * weight[0] * wp.float64(r) * wp.float64(r))
    bar[world, i, j, k] = type(scale)(weight[0]) * r / (m + scale)


@wp.kernel(enable_backward=False, module="unique")
def mass_at_nodes(
    grid_mass: wp.array4d[Any],
    target: wp.array4d[Any],
    loss: wp.array[wp.float64],
    bar: wp.array4d[Any],
    active: wp.array[int],
):
    """Add 1/2 (m - m*)^2 of every node, and its derivative by m."""
    world, i, j, k = wp.tid()
    if not moves(active, world):
        return
    r = grid_mass[world, i, j, k] - target[world % target.shape[0], i, j, k]
    wp.atomic_add(loss, world, wp.float64(0.5) * wp.float64(r) * wp.float64(r))
    bar[world, i, j, k] = r


@wp.kernel(enable_backward=False, module="unique")
def position_at_particles(
    x: wp.array2d[Any], mass: wp.array2d[Any], target: wp.array2d[Any], loss: wp.array[wp.float64], bar: wp.array2d[Any]
):
    """Add 1/2 |x - x*|^2 of every particle, and its derivative by x."""
    world, p = wp.tid()
    r = type(x[world, p])()
    if mass[world, p] > type(r[0])(0.0):
        r = x[world, p] - target[world % target.shape[0], p]
    wp.atomic_add(loss, world, wp.float64(0.5) * wp.float64(wp.length_sq(r)))
    bar[world, p] = r


@wp.kernel(enable_backward=False, module="unique")
def stray_at_nodes(
    grid_mass: wp.array4d[Any],
    stray: wp.array3d[Any],
    weights: wp.array[wp.float64],
    loss: wp.array[wp.float64],
    bar: wp.array4d[Any],
    active: wp.array[int],
):
    """Add a weight times what a unit of mass costs at every node, and its derivative by m."""
    world, i, j, k = wp.tid()
    cost = stray.dtype(weights[1]) * stray[i, j, k]
    if not moves(active, world) or cost == stray.dtype(0.0):
        return
    m = grid_mass[world, i, j, k]
    if m > stray.dtype(0.0):
        wp.atomic_add(loss, world, wp.float64(cost) * wp.float64(m))
    bar[world, i, j, k] = bar[world, i, j, k] + cost


@wp.kernel(enable_backward=False, module="unique")
def place_at_particles(
    x: wp.array2d[Any],
    volume: wp.array2d[Any],
    place: wp.array2d[Any],
    weights: wp.array[wp.float64],
    loss: wp.array[wp.float64],
    bar: wp.array2d[Any],
    active: wp.array[int],
):
    """Add w V/2 |x - y|^2 of every particle, and write its derivative by x."""
    world, p = wp.tid()
    if not moves(active, world):
        return
    k = volume.dtype(weights[0]) * volume[world, p]
    r = x[world, p] - place[world, p]
    if weights[0] > wp.float64(0.0):
        wp.atomic_add(loss, world, wp.float64(0.5) * wp.float64(k) * wp.float64(wp.length_sq(r)))
    bar[world, p] = k * r
