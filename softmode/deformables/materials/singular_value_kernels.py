"""Singular values of 3x3 matrices to float64 precision, in Warp: one-sided Jacobi rotations."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

_vec6d = wp.types.vector(length=6, dtype=wp.float64)
"""A column of A V on top of the same column of V."""

_VERSION = tuple(int(part) for part in wp.__version__.split(".")[:2])
_func_out_of_line: Any = wp.func(inline=False) if _VERSION >= (1, 18) else wp.func
"""A device function compiled once, not into each of its callers: a third less compile time here."""


@wp.func
def _orthogonal_pair(x: _vec6d, y: _vec6d):
    """Return columns x, y turned until their upper halves are orthogonal, the longer first, and whether they moved.

    A turn by less than 1e-7 is none: what it does to the other pairs, themselves that close, is below rounding.
    """
    alpha = x[0] * x[0] + x[1] * x[1] + x[2] * x[2]
    beta = y[0] * y[0] + y[1] * y[1] + y[2] * y[2]
    gamma = x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
    longer = wp.max(alpha, beta)
    c = wp.float64(1.0)
    s = wp.float64(0.0)
    # Orthogonal to 1e-15 of both lengths, or to rounding of the longer one where the other has all but vanished.
    if gamma * gamma > wp.max(wp.float64(1.0e-30) * alpha * beta, wp.float64(1.0e-33) * longer * longer):
        gap = wp.abs(alpha - beta)
        h = wp.sqrt(gap * gap + wp.float64(4.0) * gamma * gamma)
        scale = wp.float64(1.0) / wp.sqrt(wp.float64(2.0) * h * (h + gap))
        c = (h + gap) * scale
        s = wp.float64(2.0) * gamma * scale
    if alpha >= beta:
        return c * x + s * y, c * y - s * x, wp.where(wp.abs(s) > wp.float64(1.0e-7), int(1), int(0))
    return s * x + c * y, s * y - c * x, int(1)


@_func_out_of_line
def orthogonal_columns(A: wp.mat33d):
    """Return B = A V with orthogonal columns of falling length, and the rotation V.

    Rotates pairs of columns until all are orthogonal (Hestenes 1958; Golub and Van Loan, section 8.6.3): three or four
    rounds, each column to the relative precision of float64 however short it is.
    """
    x = _vec6d(A[0, 0], A[1, 0], A[2, 0], wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    y = _vec6d(A[0, 1], A[1, 1], A[2, 1], wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
    z = _vec6d(A[0, 2], A[1, 2], A[2, 2], wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    moved = int(1)
    rounds = int(0)
    while moved != 0 and rounds < 12:
        x, y, first = _orthogonal_pair(x, y)
        x, z, second = _orthogonal_pair(x, z)
        y, z, third = _orthogonal_pair(y, z)
        moved = first + second + third
        rounds += 1
    B = wp.mat33d(x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2])
    V = wp.mat33d(x[3], y[3], z[3], x[4], y[4], z[4], x[5], y[5], z[5])
    return B, V


@wp.func
def _perpendicular(u: wp.vec3d):
    """Return a vector at a right angle to u, not short."""
    if wp.abs(u[0]) < wp.float64(0.6):
        return wp.vec3d(wp.float64(0.0), u[2], -u[1])
    return wp.vec3d(-u[2], wp.float64(0.0), u[0])


@wp.func
def singular_values(F: wp.mat33d):
    """Return U, sigma, V with F = U diag(sigma) V^T, U and V rotations.

    sigma_0 >= sigma_1 >= |sigma_2|; the last has the sign of det F. U V^T is then the rotation nearest to F, also for
    singular and mirrored F, where it is one of several.
    """
    B, V = orthogonal_columns(F)
    x = wp.vec3d(B[0, 0], B[1, 0], B[2, 0])
    y = wp.vec3d(B[0, 1], B[1, 1], B[2, 1])
    z = wp.vec3d(B[0, 2], B[1, 2], B[2, 2])
    u = wp.normalize(x)
    if wp.length_sq(x) == wp.float64(0.0):
        u = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    w = y - wp.dot(u, y) * u
    # A column that lies along the first to rounding has no direction of its own.
    if wp.length_sq(w) <= wp.float64(0.25) * wp.length_sq(y):
        w = _perpendicular(u)
    v = wp.normalize(w)
    n = wp.cross(u, v)
    U = wp.mat33d(u[0], v[0], n[0], u[1], v[1], n[1], u[2], v[2], n[2])
    return U, wp.vec3d(wp.dot(u, x), wp.dot(v, y), wp.dot(n, z)), V


@wp.func
def positive_part(S: wp.mat33d):
    """Return the symmetric matrix S with its negative eigenvalues set to zero."""
    zero = wp.float64(0.0)
    # Sylvester's criterion: nothing to do where all leading minors are positive.
    minor = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    if S[0, 0] > zero and minor > zero and wp.determinant(S) > zero:
        return S
    # The columns of (S + c I) V are orthogonal when V holds the eigenvectors; c makes all eigenvalues positive, so that
    # two of opposite sign are not mistaken for one.
    shift = wp.sqrt(wp.ddot(S, S))
    B, V = orthogonal_columns(S + wp.diag(wp.vec3d(shift, shift, shift)))
    values = wp.vec3d(zero, zero, zero)
    for k in range(3):
        values[k] = wp.max(B[0, k] * V[0, k] + B[1, k] * V[1, k] + B[2, k] * V[2, k] - shift, zero)
    return V * wp.diag(values) * wp.transpose(V)
