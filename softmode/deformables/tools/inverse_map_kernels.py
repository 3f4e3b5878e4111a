"""Device code of `inverse_map`: a moved lattice, a grid of rest points over it, and Newton on the lattice."""

import warp as wp

from softmode.deformables.model.declare import struct
from softmode.deformables.skinning.skinning_kernels import polar_rotation

wp.set_module_options({"enable_backward": False})

OUTSIDE = wp.constant(0)
FOUND = wp.constant(1)
FOLDED = wp.constant(2)
NOBODY = wp.constant(2147483647)
STEPS = wp.constant(5)


@struct
class Lattice:
    """Nodes that ride on a body, and the cells between them that hold some of it."""

    low: wp.vec3  # first node, at rest [m]
    edge: float  # of a cell [m]
    size: wp.vec3i  # nodes along each axis
    node: wp.array2d[wp.vec3]  # (world_count, node_count) where they are [m]
    bend: wp.array3d[wp.vec3]  # (world_count, node_count, 3) second differences along the axes [m]
    cell: wp.array[int]  # (cell_count,) lowest node of each cell that holds some of the body, then of their neighbours
    core_count: int  # how many hold some
    wanted: wp.array[int]  # (node_count,) 1 if the cell above the node is one of these


@struct
class RestGrid:
    """Rest points at the nodes of a grid over the moved body, (world_count, node_max), rows by dims."""

    low: wp.array[wp.vec3]  # (world_count,) first node [m]
    edge: wp.array[float]  # (world_count,) of a cell [m]
    size: wp.array[wp.vec3i]  # (world_count,) nodes along each axis
    bound: wp.array2d[wp.vec3]  # (world_count, 2) corners of the box of the moved body [m]
    owner: wp.array3d[int]  # (world_count, node_max, 2) first tetrahedron that holds the node, last one of the body
    rest: wp.array2d[wp.vec3]  # rest points [m]
    flag: wp.array2d[int]  # OUTSIDE, FOUND or FOLDED
    turn: wp.array2d[wp.quat]  # rotation of F from rest, or of size zero: not wanted


@wp.func
def node_of(size: wp.vec3i, i: int, j: int, k: int) -> int:
    """Return the index of a node."""
    return (i * size[1] + j) * size[2] + k


@wp.func
def place_of(size: wp.vec3i, n: int) -> wp.vec3i:
    """Return where a node is."""
    k = n % size[2]
    m = n // size[2]
    return wp.vec3i(m // size[1], m % size[1], k)


@wp.kernel
def bend_lattice(lattice: Lattice):
    """Write the second differences of the lattice; at its rim those of the next node."""
    world, n = wp.tid()
    p = place_of(lattice.size, n)
    stride = wp.vec3i(lattice.size[1] * lattice.size[2], lattice.size[2], 1)
    for d in range(3):
        middle = n + (wp.clamp(p[d], 1, lattice.size[d] - 2) - p[d]) * stride[d]
        x = lattice.node[world, middle - stride[d]] + lattice.node[world, middle + stride[d]]
        lattice.bend[world, n, d] = x - 2.0 * lattice.node[world, middle]


@wp.kernel
def clear_bound(grid: RestGrid):
    """Empty the box of each world."""
    world = wp.tid()
    big = float(1.0e30)
    grid.bound[world, 0] = wp.vec3(big, big, big)
    grid.bound[world, 1] = wp.vec3(-big, -big, -big)


@wp.kernel
def find_bound(lattice: Lattice, grid: RestGrid):
    """Grow the box of a world by the corners of a cell."""
    world, c = wp.tid()
    n = lattice.cell[c]
    for i in range(2):
        for j in range(2):
            for k in range(2):
                x = lattice.node[world, n + node_of(lattice.size, i, j, k)]
                wp.atomic_min(grid.bound, world, 0, x)
                wp.atomic_max(grid.bound, world, 1, x)


@wp.kernel
def fit_grid(grid: RestGrid):
    """Lay a grid of cubes over the box, as fine as the room for nodes allows; no grid over what is not finite."""
    world = wp.tid()
    low = grid.bound[world, 0]
    extent = grid.bound[world, 1] - low
    longest = wp.max(extent[0], wp.max(extent[1], extent[2]))
    if not (longest > 0.0 and longest < 1.0e6):
        grid.size[world] = wp.vec3i(0, 0, 0)
        return
    room = grid.rest.shape[1]
    edge = longest / (wp.pow(float(room), 1.0 / 3.0) - 3.0)
    # The box may be flat: start where it would fit if it were full, and take what fits.
    edge = wp.max(0.25 * edge, wp.pow(wp.max(extent[0] * extent[1] * extent[2], 1.0e-24) / float(room), 1.0 / 3.0))
    size = wp.vec3i()
    for _ in range(400):
        for d in range(3):
            size[d] = int(wp.ceil(extent[d] / edge)) + 3
        if float(size[0]) * float(size[1]) * float(size[2]) <= float(room):
            break
        edge *= 1.01
    grid.low[world] = low - wp.vec3(edge, edge, edge)
    grid.edge[world] = edge
    grid.size[world] = size


@wp.kernel
def clear_grid(grid: RestGrid):
    """Let no tetrahedron hold a node."""
    world, n = wp.tid()
    grid.owner[world, n, 0] = NOBODY
    grid.owner[world, n, 1] = -1


@wp.func
def tetrahedron(lattice: Lattice, t: int) -> wp.vec4i:
    """Return the offsets of the nodes of one of the six tetrahedra of a cell, all around its diagonal (Kuhn).

    They are the orders in which the three axes can be walked; neighbouring cells share faces, so there is no gap.
    """
    sx = lattice.size[1] * lattice.size[2]
    sy = lattice.size[2]
    a = int(sx)
    b = int(sy)
    if t == 1:
        b = 1
    elif t == 2:
        a = sy
        b = sx
    elif t == 3:
        a = sy
        b = 1
    elif t == 4:
        a = 1
        b = sx
    elif t == 5:
        a = 1
        b = sy
    return wp.vec4i(0, a, a + b, sx + sy + 1)


@wp.func
def edges_of(lattice: Lattice, world: int, n: int, corner: wp.vec4i) -> wp.mat33:
    """Return the moved edges of a tetrahedron from its first corner, as columns [m]."""
    x = lattice.node[world, n]
    return wp.matrix_from_cols(
        lattice.node[world, n + corner[1]] - x,
        lattice.node[world, n + corner[2]] - x,
        lattice.node[world, n + corner[3]] - x,
    )


@wp.kernel
def own_nodes(lattice: Lattice, grid: RestGrid):
    """Find the grid nodes in the tetrahedra of a cell; where several hold one, the first and the last are kept.

    Cells of the body come first, so that a neighbour of it that is folded over it does not count.
    """
    world, c = wp.tid()
    n = lattice.cell[c]
    size = grid.size[world]
    if size[0] == 0:
        return
    origin = grid.low[world]
    edge = grid.edge[world]
    low = lattice.node[world, n]
    high = low
    for i in range(2):
        for j in range(2):
            for k in range(2):
                x = lattice.node[world, n + node_of(lattice.size, i, j, k)]
                low = wp.min(low, x)
                high = wp.max(high, x)
    a = (low - origin) / edge
    b = (high - origin) / edge
    i0 = wp.max(int(wp.ceil(a[0] - 1.0e-4)), 0)
    j0 = wp.max(int(wp.ceil(a[1] - 1.0e-4)), 0)
    k0 = wp.max(int(wp.ceil(a[2] - 1.0e-4)), 0)
    i1 = wp.min(int(wp.floor(b[0] + 1.0e-4)) + 1, size[0])
    j1 = wp.min(int(wp.floor(b[1] + 1.0e-4)) + 1, size[1])
    k1 = wp.min(int(wp.floor(b[2] + 1.0e-4)) + 1, size[2])
    if i1 <= i0 or j1 <= j0 or k1 <= k0:
        return
    first = lattice.node[world, n]
    for t in range(6):
        m = edges_of(lattice, world, n, tetrahedron(lattice, t))
        if wp.abs(wp.determinant(m)) > 1.0e-9 * edge * edge * edge:
            inverse = wp.inverse(m)
            for i in range(i0, i1):
                for j in range(j0, j1):
                    for k in range(k0, k1):
                        x = origin + edge * wp.vec3(float(i), float(j), float(k)) - first
                        s = inverse * x
                        if s[0] > -1.0e-4 and s[1] > -1.0e-4 and s[2] > -1.0e-4 and s[0] + s[1] + s[2] < 1.0001:
                            g = node_of(size, i, j, k)
                            wp.atomic_min(grid.owner, world, g, 0, 6 * c + t)
                            if c < lattice.core_count:
                                wp.atomic_max(grid.owner, world, g, 1, 6 * c + t)


@wp.func
def rest_in(lattice: Lattice, world: int, owner: int, x: wp.vec3) -> wp.vec4:
    """Return the rest point of a place in a tetrahedron [m], and the sign of its volume."""
    n = lattice.cell[owner // 6]
    corner = tetrahedron(lattice, owner % 6)
    m = edges_of(lattice, world, n, corner)
    s = wp.inverse(m) * (x - lattice.node[world, n])
    p0 = place_of(lattice.size, n)
    p = wp.vec3(float(p0[0]), float(p0[1]), float(p0[2]))
    for e in range(3):
        q = place_of(lattice.size, n + corner[e + 1]) - p0
        p += s[e] * wp.vec3(float(q[0]), float(q[1]), float(q[2]))
    rest = lattice.low + lattice.edge * p
    # At rest the edges of a tetrahedron have the sign of the order in which it walks the axes.
    t = owner % 6
    even = t == 0 or t == 3 or t == 4
    volume = wp.determinant(m)
    return wp.vec4(rest[0], rest[1], rest[2], wp.where(even, volume, -volume))


@wp.struct
class Moved:
    """Where a rest point is, and F there."""

    x: wp.vec3
    gradient: wp.mat33


@wp.func
def moved_point(lattice: Lattice, world: int, rest: wp.vec3) -> Moved:
    """Return the cubic interpolation of the lattice and the gradient of the trilinear one.

    Along each axis (1 - f) x_0 + f x_1 - f (1 - f) / 6 ((2 - f) D_0 + (1 + f) D_1), D second differences: Lagrange's
    cubic; along the others linear. Trilinear alone is wrong by edge^2 / 8 times the curvature, 4e-4 of a bar bent by
    90 degrees with 24 nodes.
    """
    u = (rest - lattice.low) / lattice.edge
    i = wp.clamp(int(wp.floor(u[0])), 0, lattice.size[0] - 2)
    j = wp.clamp(int(wp.floor(u[1])), 0, lattice.size[1] - 2)
    k = wp.clamp(int(wp.floor(u[2])), 0, lattice.size[2] - 2)
    f = wp.vec3(u[0] - float(i), u[1] - float(j), u[2] - float(k))
    c = wp.vec3(f[0] * (1.0 - f[0]), f[1] * (1.0 - f[1]), f[2] * (1.0 - f[2])) * (-1.0 / 6.0)
    x = wp.vec3()
    gx = wp.vec3()
    gy = wp.vec3()
    gz = wp.vec3()
    for a in range(2):
        wa = wp.where(a == 1, f[0], 1.0 - f[0])
        for b in range(2):
            wb = wp.where(b == 1, f[1], 1.0 - f[1])
            for d in range(2):
                wd = wp.where(d == 1, f[2], 1.0 - f[2])
                n = node_of(lattice.size, i + a, j + b, k + d)
                node = lattice.node[world, n]
                x += wa * wb * wd * node
                x += (c[0] * (1.0 + wa) * wb * wd) * lattice.bend[world, n, 0]
                x += (c[1] * (1.0 + wb) * wa * wd) * lattice.bend[world, n, 1]
                x += (c[2] * (1.0 + wd) * wa * wb) * lattice.bend[world, n, 2]
                gx += wp.where(a == 1, wb * wd, -wb * wd) * node
                gy += wp.where(b == 1, wa * wd, -wa * wd) * node
                gz += wp.where(d == 1, wa * wb, -wa * wb) * node
    out = Moved()
    out.x = x
    out.gradient = wp.matrix_from_cols(gx, gy, gz) * (1.0 / lattice.edge)
    return out


@wp.func
def newton_step(lattice: Lattice, world: int, rest: wp.vec3, x: wp.vec3) -> wp.vec3:
    """Return the rest point after one step towards the place x, of at most one cell; itself where F is singular."""
    at = moved_point(lattice, world, rest)
    if wp.abs(wp.determinant(at.gradient)) < 1.0e-9:
        return rest
    step = wp.inverse(at.gradient) * (x - at.x)
    length = wp.length(step)
    if not length < 1.0e6:
        return rest
    return rest + step * wp.min(1.0, lattice.edge / wp.max(length, 1.0e-20))


@wp.func
def is_wanted(lattice: Lattice, rest: wp.vec3) -> bool:
    """Return whether a rest point lies in a cell that holds some of the body, to a thousandth of a cell."""
    for d in range(2):
        nudge = 1.0e-3 * (1.0 - 2.0 * float(d))
        u = (rest - lattice.low) / lattice.edge + wp.vec3(nudge, nudge, nudge)
        i = int(wp.floor(u[0]))
        j = int(wp.floor(u[1]))
        k = int(wp.floor(u[2]))
        size = lattice.size
        if i >= 0 and j >= 0 and k >= 0 and i < size[0] - 1 and j < size[1] - 1 and k < size[2] - 1:
            if lattice.wanted[node_of(size, i, j, k)] == 1:
                return True
    return False


@wp.kernel
def fill_grid(lattice: Lattice, grid: RestGrid, steps: int):
    """Write the rest point of every node that a tetrahedron holds."""
    world, n = wp.tid()
    size = grid.size[world]
    if n >= size[0] * size[1] * size[2]:
        return
    grid.flag[world, n] = OUTSIDE
    owner = grid.owner[world, n, 0]
    if owner == NOBODY:
        return
    p = place_of(size, n)
    x = grid.low[world] + grid.edge[world] * wp.vec3(float(p[0]), float(p[1]), float(p[2]))
    start = rest_in(lattice, world, owner, x)
    rest = wp.vec3(start[0], start[1], start[2])
    flag = wp.where(start[3] > 0.0, FOUND, FOLDED)
    other = grid.owner[world, n, 1]
    if owner >= 6 * lattice.core_count:
        if start[3] <= 0.0:
            return
    elif other != owner:
        last = rest_in(lattice, world, other, x)
        apart = wp.length(wp.vec3(last[0], last[1], last[2]) - rest)
        if apart > 0.5 * lattice.edge or last[3] <= 0.0:
            flag = FOLDED
    for _ in range(steps):
        rest = newton_step(lattice, world, rest, x)
    grid.rest[world, n] = rest
    grid.flag[world, n] = flag
    if grid.turn.shape[0] > 0:
        grid.turn[world, n] = polar_rotation(moved_point(lattice, world, rest).gradient)


@wp.kernel
def find_rest(
    lattice: Lattice,
    grid: RestGrid,
    point: wp.array2d[wp.vec3],  # (world_count, point_count) [m]
    tolerance: float,  # [m]
    # Out:
    rest_out: wp.array2d[wp.vec3],  # [m]
    flag_out: wp.array2d[int],
):
    """Find the rest points of places: from the grid, then Newton on the lattice."""
    world, i = wp.tid()
    x = point[world, i]
    rest_out[world, i] = x
    flag_out[world, i] = OUTSIDE
    size = grid.size[world]
    if size[0] == 0:
        return
    u = (x - grid.low[world]) / grid.edge[world]
    if not (u[0] >= 0.0 and u[1] >= 0.0 and u[2] >= 0.0):
        return
    a = int(u[0])
    b = int(u[1])
    c = int(u[2])
    if a > size[0] - 2 or b > size[1] - 2 or c > size[2] - 2:
        return
    # The start is the nearest node of the cell that has a rest point.
    best = float(1.0e30)
    rest = wp.vec3()
    folded = wp.int32(OUTSIDE)
    for k in range(8):
        n = node_of(size, a + k // 4, b + k // 2 % 2, c + k % 2)
        flag = grid.flag[world, n]
        if flag != OUTSIDE:
            apart = wp.length(u - wp.vec3(float(a + k // 4), float(b + k // 2 % 2), float(c + k % 2)))
            if apart < best:
                best = apart
                folded = flag
                rest = grid.rest[world, n]
    if best > 1.0e29:
        return
    for _ in range(STEPS):
        rest = newton_step(lattice, world, rest, x)
    at = moved_point(lattice, world, rest)
    if wp.length(at.x - x) < tolerance and is_wanted(lattice, rest):
        rest_out[world, i] = rest
        flag_out[world, i] = wp.where(folded == FOLDED or wp.determinant(at.gradient) <= 0.0, FOLDED, FOUND)
