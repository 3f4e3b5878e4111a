"""Device side of a pin and of a contact: energy, force and Hessian at a displacement, and the friction's normal force.

CUDA takes one at a time; the code that takes eight on a CPU is written from these functions.
"""

import warp as wp

from softmode.deformables.contact.penalty_kernels import normal_potential, slip_potential

wp.set_module_options({"enable_backward": False})

KEEP, SET, FIRST, RELAX = range(4)
"""What becomes of the normal force that friction goes by: as it is, that of the iterate, that with the bound of a
step's first guess, the mean of the two."""


@wp.func
def pressed_by(slope: wp.float64, bound: wp.float64, held: wp.float64, stiffness: wp.float64, mode: int):
    """Return the normal force [N] that friction goes by, ``bound`` the largest slope of a step's first guess."""
    if mode == int(KEEP):
        return held
    if mode == int(FIRST):
        return stiffness * wp.min(slope, bound)
    if mode == int(RELAX):
        # the fixed point between normal force and friction may be repelling: a mean of two iterates is not
        return wp.float64(0.5) * (stiffness * slope + held)
    return stiffness * slope


@wp.func
def contact_response(
    pinned: bool,
    offset: wp.vec3d,
    n: wp.vec3d,
    d: wp.vec3d,
    stiffness: wp.float64,
    compliance: wp.float64,
    depth: wp.float64,
    ridge: wp.float64,
    ridge_lead: wp.float64,
    friction: wp.float64,
    stick: wp.float64,
    deep: wp.float64,
    held: wp.float64,
    eps: wp.float64,
    stick_range: wp.float64,
    mode: int,
    exact: int,
):
    """Return energy [J], force [N], Hessian [N/m], normal force [N] and slip [m] of a pin or a contact.

    Args:
        pinned: Whether it is a pin.
        offset: Where the sample is relative to the other side at the start of the step, slip remembered included [m].
        n: Normal, outward of the other side.
        d: Displacement relative to the other side during the step [m].
        stiffness: Of the pin, or of the contact's penalty [N/m].
        compliance: That of the dent [m/N].
        depth: Dent [m] from which on the contact hardens.
        ridge: Stiffness of edges over that of the penalty.
        ridge_lead: How much deeper they are in [m].
        friction: Coefficient of friction.
        stick: Stiffness of the spring of friction [N/m]; 0 for friction without memory.
        deep: The same where the dent along the surface is used up [N/m].
        held: Normal force that friction went by [N].
        eps: Range of the onset [m].
        stick_range: That of friction without memory [m].
        mode: What becomes of the normal force: KEEP, SET, FIRST or RELAX.
        exact: Whether the Hessian has the curvature of friction's potential along the slip.
    """
    half = wp.float64(0.5)
    identity = wp.identity(n=3, dtype=wp.float64)
    total = offset + d
    if pinned:
        return half * stiffness * wp.dot(total, total), -stiffness * total, stiffness * identity, held, total
    gap = wp.dot(n, total)
    ratio = stiffness * compliance
    psi, slope, curvature = normal_potential(-gap, eps, ratio, depth, ridge, ridge_lead)
    bound = slope
    if mode == int(FIRST):
        # in an impact the first guess lies far too deep: friction of such a force would be too stiff to solve
        start = wp.min(wp.dot(n, offset), wp.float64(0.0))
        first = eps - wp.float64(2.0) * start
        _psi, bound, _curvature = normal_potential(first, eps, ratio, depth, ridge, ridge_lead)
    pressed = pressed_by(slope, bound, held, stiffness, mode)
    # offset = gap n + memory - drift of the shape: the tangential part is the slip
    t = total - gap * n
    y = wp.length(t)
    energy, secant, tangent = slip_potential(y, friction * pressed, stick, deep, depth, stick_range)
    # the energy is concave in y^2, so the quadratic of the secant's curvature lies above it and its steps cannot
    # overshoot, from however far away; the potential's own curvature along the slip converges faster once it is close,
    # and is the larger where the dent along the surface is used up
    N = wp.outer(n, n)
    H = stiffness * curvature * N + secant * (identity - N)
    if (exact != 0 or tangent > secant) and y > wp.float64(1.0e-9) * stick_range:
        H += (tangent - secant) / (y * y) * wp.outer(t, t)
    return stiffness * psi + energy, stiffness * slope * n - secant * t, H, pressed, t
