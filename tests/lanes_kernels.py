"""Device functions of one point with every construct that is read in lanes, and kernels that run them in both forms."""

from typing import Any

import warp as wp

from softmode.lanes import LANES, lanes_code

wp.set_module_options({"enable_backward": False})

vec8d: Any = wp.types.vector(length=LANES, dtype=wp.float64)
vec6d: Any = wp.types.vector(length=6, dtype=wp.float64)
mat23d: Any = wp.types.matrix(shape=(2, 3), dtype=wp.float64)
SCALE = wp.constant(wp.float64(1.5))
UP, DOWN = range(2)


@wp.struct
class Spring:
    """A struct with what differs between lanes and what does not."""

    kind: int
    stiffness: wp.float64
    rate: wp.float64


@wp.func
def sides(x: wp.float64, y: wp.float64, n: int, rate: wp.float64):
    """An ``if`` per lane within another, with an ``elif``, that changes variables of before."""
    z = x
    sign = wp.float64(1.0)
    if x > y:
        z = x - y
        if y > wp.float64(0.0) and not x > wp.float64(1.0):
            z *= SCALE
            sign = -sign
    elif x < wp.float64(-1.0) or y < wp.float64(-1.0):
        z = wp.sqrt(y - x)
    else:
        z += wp.float64(3.0)
    return sign * z


@wp.func
def early(x: wp.float64, y: wp.float64, n: int, rate: wp.float64):
    """Early returns, of which one needs what would be no number in the other lanes."""
    if x <= wp.float64(0.0):
        return -y
    logarithm = wp.log(x)
    if logarithm > y:
        return logarithm
    return logarithm - sides(x, y, n, rate)


@wp.func
def uniform(x: wp.float64, y: wp.float64, n: int, rate: wp.float64):
    """Branches that all lanes take: by an option, and by a number that is declared to be the same."""
    z = x
    if n == int(UP):
        z = x + y
    if rate > wp.float64(0.5):
        return z * rate
    if n == int(DOWN) or rate < wp.float64(0.1):
        z = wp.where(n == 0, y, z - y)
    return z + wp.float64(2.0)


@wp.func
def loops(x: wp.float64, y: wp.float64, n: int, rate: wp.float64):
    """A loop whose lanes end at different times, with a counter, and constant loops with what is known in them."""
    a = wp.abs(x) + wp.float64(0.1)
    root = wp.float64(1.0)
    rounds = int(0)
    moved = int(1)
    while moved != 0 and rounds < 9:
        new = wp.float64(0.5) * (root + a / root)
        moved = wp.where(wp.abs(new - root) > wp.float64(1.0e-3), int(1), int(0))
        root = new
        rounds += 1
    row = int(0)
    total = wp.float64(0.0)
    for i in range(3):
        for j in range(i, 3):
            if i == j:
                total += root
            if i != j and (j - i + 3) % 3 == 1:
                total -= y
            row += 1
    if rounds > 4:
        total += wp.float64(10.0)
    return total * wp.float64(row)


@wp.func
def vectors(x: wp.float64, y: wp.float64, n: int, rate: wp.float64):
    """Vectors and their functions; a copy that is changed leaves the original alone, also in a branch and a loop."""
    a = wp.vec3d(x, y, wp.float64(1.0))
    b = a
    b[1] = wp.float64(2.0)
    b[2] += x
    if y > x:
        b[0] = y
    count = wp.float64(0.0)
    while count < x:
        a[2] = a[2] + wp.float64(0.5)
        count += wp.float64(0.7)
    c = wp.cross(a, b) - b / wp.float64(3.0) + wp.float64(2.0) * wp.normalize(a) + wp.normalize(wp.vec3d())
    d = wp.max(c, wp.vec3d()) - wp.min(a, b)
    s = vec6d(x, y, x, y, x, y)
    s[5] = wp.float64(0.0)
    return wp.dot(c, d) + wp.length(a) - wp.length_sq(-b) + wp.dot(wp.cw_mul(s, s), s)


@wp.func
def rows(A: wp.mat33d):
    """Return two of the rows as a matrix that is not square, and one as a vector."""
    out = mat23d()
    for k in range(3):
        out[0, k] = A[0, k]
        out[1, k] = A[2, k]
    return out, wp.vec3d(A[1, 0], A[1, 1], A[1, 2])


@wp.func
def matrices(x: wp.float64, y: wp.float64, n: int, rate: wp.float64):
    """Matrices, their products and functions, and a function with several results."""
    A = wp.mat33d(x, y, wp.float64(1.0), y, x * y, x, wp.float64(2.0), y, wp.float64(-1.0))
    B = wp.transpose(A) * A - y * wp.identity(n=3, dtype=wp.float64)
    if x > wp.float64(0.0):
        B = B + wp.outer(wp.vec3d(x, y, x), wp.vec3d(y, y, x))
    R, u = rows(B)
    C = R * A * wp.transpose(R)
    v = B * u + wp.diag(u) * wp.vec3d(x, x, y)
    w = float(C[0, 1])
    return (
        wp.determinant(A)
        + wp.trace(B)
        + wp.ddot(A, wp.cw_mul(B, A))
        + C[1, 0]
        - C[0, 1]
        + wp.dot(v, u)
        + wp.float64(wp.where(w > w, 1.0, 0.0))
    )


@wp.func
def force(spring: Spring, x: wp.float64):
    """Return a force and an energy of a struct."""
    if spring.kind == int(DOWN):
        return -spring.stiffness, spring.stiffness * x
    return -spring.stiffness * x + spring.rate, wp.float64(0.5) * spring.stiffness * x * x


@wp.func
def of_struct(spring: Spring, x: wp.float64):
    """Use a struct in a function that is called, and its results."""
    f, energy = force(spring, x)
    _f, other = force(spring, f)
    swapped, f = f, other
    return energy + f * swapped


FUNCTIONS = sides, early, uniform, loops, vectors, matrices
_CALLS = "".join(f"if (which == {k}) r = Law::{f.key}(x, y, n, rate);\n" for k, f in enumerate(FUNCTIONS))


@wp.func_native(
    snippet=f"""{{{lanes_code(*FUNCTIONS, of_struct, uniform=("rate",))}
    lanes x, y, r = 0.0;
    __builtin_memcpy(&x, &x_in, sizeof(x));
    __builtin_memcpy(&y, &y_in, sizeof(y));
    {_CALLS}
    Law::Spring spring = {{n, y, rate}};
    if (which == {len(FUNCTIONS)}) r = Law::of_struct(spring, x);
    if (which == {len(FUNCTIONS) + 1}) r = Law::lane_log(x);
    wp::vec_t<{LANES}, wp::float64> out;
    __builtin_memcpy(&out, &r, sizeof(out));
    return out;
}}"""
)
def in_lanes(which: int, x_in: vec8d, y_in: vec8d, n: int, rate: wp.float64) -> vec8d:
    """Return what a function gives at eight points."""
    ...


@wp.kernel
def eight_at_a_time(which: int, n: int, rate: wp.float64, x: wp.array[vec8d], y: wp.array[vec8d], out: wp.array[vec8d]):
    """Evaluate a function at eight points."""
    i = wp.tid()
    out[i] = in_lanes(which, x[i], y[i], n, rate)


@wp.kernel
def one_at_a_time(
    which: int, n: int, rate: wp.float64, x: wp.array[wp.float64], y: wp.array[wp.float64], out: wp.array[wp.float64]
):
    """Evaluate a function at a point."""
    i = wp.tid()
    if which == 0:
        out[i] = sides(x[i], y[i], n, rate)
    if which == 1:
        out[i] = early(x[i], y[i], n, rate)
    if which == 2:
        out[i] = uniform(x[i], y[i], n, rate)
    if which == 3:
        out[i] = loops(x[i], y[i], n, rate)
    if which == 4:
        out[i] = vectors(x[i], y[i], n, rate)
    if which == 5:
        out[i] = matrices(x[i], y[i], n, rate)
    if which == 6:
        spring = Spring()
        spring.kind = n
        spring.stiffness = y[i]
        spring.rate = rate
        out[i] = of_struct(spring, x[i])
    if which == 7:
        out[i] = wp.log(x[i])
