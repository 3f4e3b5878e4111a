"""Device side of scattering cell by cell: what the particles of a cell give to a node is summed up, then added at once.

A scatter is bound by its atomic operations: 64 for each particle. With eight particles in a cell an eighth of them are
left. Particles are strung on their cells as they come; the 64 nodes around a cell are served by a thread each.
"""

from typing import Any

import warp as wp

from softmode.mpm.spline_kernels import cell_of, spline_at

wp.set_module_options({"enable_backward": False})


@wp.struct
class Cells:
    """Particles of all worlds by cell."""

    head: wp.array2d[int]
    """One particle of each cell, -1 where there is none, (W, nodes)."""
    after: wp.array2d[int]
    """The next particle of a particle's cell, -1 after the last, (W, N)."""
    used: wp.array2d[int]
    """Cells that have particles, (W, N)."""
    count: wp.array[int]
    """Number of them, (W,)."""


@wp.func
def enter(cells: Cells, world: int, p: int, cell: int):
    """String a particle on its cell."""
    before = wp.atomic_exch(cells.head, world, cell, p)
    cells.after[world, p] = before
    if before < 0:
        cells.used[world, wp.atomic_add(cells.count, world, 1)] = cell


@wp.func
def cell_index(i: int, j: int, k: int, shape: wp.vec3i):
    """Return the number of a cell."""
    return (i * shape[1] + j) * shape[2] + k


@wp.func
def node_of(cell: int, node: int, shape: wp.vec3i):
    """Return the indices of one of the 64 nodes around a cell."""
    i = cell // (shape[1] * shape[2])
    j = (cell // shape[2]) % shape[1]
    return wp.vec3i(i + node // 16 - 1, j + (node // 4) % 4 - 1, cell % shape[2] + node % 4 - 1)


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


@wp.func
def give(
    cells: Cells, given: wp.array3d[Any], world: int, p: int, cell: int, base: Any, A: Any, inside: Any, mass: Any
):
    """Note what a particle gives to nodes: base + A (a, b, c) to node (a, b, c) of its cell, times the weight there."""
    enter(cells, world, p, cell)
    store_row(given, world, p, 0, given.dtype(base[0], base[1], base[2], mass))
    store_row(given, world, p, 1, given.dtype(A[0, 0], A[1, 0], A[2, 0], inside[0]))
    store_row(given, world, p, 2, given.dtype(A[0, 1], A[1, 1], A[2, 1], inside[1]))
    store_row(given, world, p, 3, given.dtype(A[0, 2], A[1, 2], A[2, 2], inside[2]))


@wp.kernel(enable_backward=False, module="unique")
def scatter_cells(cells: Cells, given: wp.array3d[Any], scattered: wp.array4d[Any], groups: int):
    """Add to the nodes what particles gave by :func:`give`; each group of 64 threads serves cells in turn."""
    world, group, node = wp.tid()
    shape = wp.vec3i(scattered.shape[1], scattered.shape[2], scattered.shape[3])
    for q in range(group, cells.count[world], groups):
        cell = cells.used[world, q]
        p = cells.head[world, cell]
        total = scattered.dtype()
        a = type(total[0])(node // 16 - 1)
        b = type(total[0])((node // 4) % 4 - 1)
        c = type(total[0])(node % 4 - 1)
        while p >= 0:
            first = load_row(given, world, p, 0)
            x = load_row(given, world, p, 1)
            y = load_row(given, world, p, 2)
            z = load_row(given, world, p, 3)
            w = spline_at(wp.vector(x[3] - a, y[3] - b, z[3] - c))
            both = first + a * x + b * y + c * z
            total += w * scattered.dtype(both[0], both[1], both[2], first[3])
            p = cells.after[world, p]
        n = node_of(cell, node, shape)
        add_to_node(scattered, world, n[0], n[1], n[2], total)


@wp.kernel(enable_backward=False, module="unique")
def scatter_cell_masses(
    cells: Cells,
    x_in: wp.array2d[Any],
    mass: wp.array2d[Any],
    origin: Any,
    dx: Any,
    grid_mass: wp.array4d[Any],
    groups: int,
):
    """Add the masses of particles that were strung on cells to the nodes, as :func:`scatter_cells`."""
    world, group, node = wp.tid()
    shape = wp.vec3i(grid_mass.shape[1], grid_mass.shape[2], grid_mass.shape[3])
    at = type(origin)(type(dx)(node // 16 - 1), type(dx)((node // 4) % 4 - 1), type(dx)(node % 4 - 1))
    for q in range(group, cells.count[world], groups):
        cell = cells.used[world, q]
        p = cells.head[world, cell]
        total = type(dx)(0.0)
        while p >= 0:
            _i, _j, _k, inside = cell_of(x_in[world, p], origin, dx)
            total += spline_at(inside - at) * mass[world, p]
            p = cells.after[world, p]
        n = node_of(cell, node, shape)
        wp.atomic_add(grid_mass, world, n[0], n[1], n[2], total)
