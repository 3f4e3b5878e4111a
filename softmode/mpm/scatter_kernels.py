"""Device side of scattering: adding to nodes, and on a GPU a kernel that does nothing else.

What a particle gives takes float64 registers, so many that few threads fit; adding it to 64 nodes wants many threads.
"""

from typing import Any

import warp as wp

from softmode.mpm.spline_kernels import cell_of, spline, spline_along

wp.set_module_options({"enable_backward": False})


@wp.func
def in_grid(i: int, j: int, k: int, shape: wp.vec3i):
    """Return whether all nodes of a particle in cell (i, j, k) exist."""
    return i >= 1 and j >= 1 and k >= 1 and i < shape[0] - 2 and j < shape[1] - 2 and k < shape[2] - 2


@wp.func
def in_lane(a: int, b: int, lane: int, lanes: int):
    """Return whether row (a, b) of the nodes around a particle is served by its thread ``lane`` of ``lanes``."""
    return ((4 * a + b) & (lanes - 1)) == lane


@wp.func
def moves(active: wp.array[int], world: int):
    """Return whether a world takes part in a run; one entry stands for all worlds."""
    return active[world % active.shape[0]] != 0


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


@wp.func_native("""
    wp::vec_t<4, wp::float32>* at = wp::address(rows, world, p, row);
#if defined(__CUDA_ARCH__)
    *reinterpret_cast<float4*>(at) = make_float4(value[0], value[1], value[2], value[3]);
#else
    *at = value;
#endif
""")
def store_row(rows: wp.array3d[wp.vec4f], world: int, p: int, row: int, value: wp.vec4f):
    """Write four numbers of a particle."""


@wp.func
def store_row(rows: wp.array3d[wp.vec4d], world: int, p: int, row: int, value: wp.vec4d):  # noqa: F811
    """Write four numbers of a particle."""
    rows[world, p, row] = value


@wp.func_native("""
    wp::vec_t<4, wp::float32>* at = wp::address(rows, world, p, row);
#if defined(__CUDA_ARCH__)
    const float4 found = *reinterpret_cast<const float4*>(at);
    return wp::vec_t<4, wp::float32>(found.x, found.y, found.z, found.w);
#else
    return *at;
#endif
""")
def load_row(rows: wp.array3d[wp.vec4f], world: int, p: int, row: int) -> wp.vec4f:
    """Read four numbers of a particle."""
    ...


@wp.func
def load_row(rows: wp.array3d[wp.vec4d], world: int, p: int, row: int):  # noqa: F811
    """Read four numbers of a particle."""
    return rows[world, p, row]


@wp.func_native("""
    wp::vec_t<4, wp::float32>* at = wp::address(grid, world, i, j, k);
#if defined(__CUDA_ARCH__)
    const float4 found = *reinterpret_cast<const float4*>(at);
    return wp::vec_t<4, wp::float32>(found.x, found.y, found.z, found.w);
#else
    return *at;
#endif
""")
def load_node(grid: wp.array4d[wp.vec4f], world: int, i: int, j: int, k: int) -> wp.vec4f:
    """Read four numbers of a node."""
    ...


@wp.func
def load_node(grid: wp.array4d[wp.vec4d], world: int, i: int, j: int, k: int):  # noqa: F811
    """Read four numbers of a node."""
    return grid[world, i, j, k]


@wp.func
def give(given: wp.array3d[Any], world: int, p: int, base: Any, A: Any, mass: Any):
    """Note what a particle gives to nodes: base + A (a, b, c) to node (a, b, c) of its cell, times the weight there."""
    none = type(mass)(0.0)
    store_row(given, world, p, 0, given.dtype(base[0], base[1], base[2], mass))
    store_row(given, world, p, 1, given.dtype(A[0, 0], A[1, 0], A[2, 0], none))
    store_row(given, world, p, 2, given.dtype(A[0, 1], A[1, 1], A[2, 1], none))
    store_row(given, world, p, 3, given.dtype(A[0, 2], A[1, 2], A[2, 2], none))


@wp.kernel(enable_backward=False, module="unique")
def scatter_given(
    x_in: wp.array2d[Any],
    mass: wp.array2d[Any],
    given: wp.array3d[Any],
    origin: Any,
    dx: Any,
    scattered: wp.array4d[Any],
    active: wp.array[int],
    turn: int,
    lanes: int,
):
    """Add to the nodes what particles gave by :func:`give`; ``lanes`` threads of each share the 16 rows of nodes."""
    world, lane, p = wp.tid()
    if mass[world, p] <= type(dx)(0.0) or not moves(active, world):
        return
    i, j, k, f = cell_of(x_in[world, p], origin, dx)
    if not in_grid(i, j, k, wp.vec3i(scattered.shape[1], scattered.shape[2], scattered.shape[3])):
        return
    base = load_row(given, world, p, 0)
    along_x = load_row(given, world, p, 1)
    along_y = load_row(given, world, p, 2)
    along_z = load_row(given, world, p, 3)
    wz = spline(f[2])
    for q in range(lane, 16, lanes):
        # Neighbours, which mostly share a cell, begin with different rows: else they add to one node at once.
        row = (q + turn * p) & 15
        a = type(dx)(row >> 2) - type(dx)(1.0)
        b = type(dx)(row & 3) - type(dx)(1.0)
        wxy = spline_along(f[0] - a) * spline_along(f[1] - b)
        there = base + a * along_x + b * along_y
        for c in range(4):
            both = (wxy * wz[c]) * (there + type(dx)(c - 1) * along_z)
            add_to_node(scattered, world, i + (row >> 2) - 1, j + (row & 3) - 1, k + c - 1, both)
