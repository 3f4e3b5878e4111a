"""Energy of pins and of contact between surface samples and rigid shapes; the reactions.

With the displacement d of the sample relative to the shape during the step, a contact adds

    E(d) = A kappa psi_n(-g0 - n . d) + psi_t(|s + d_t|; mu f_n, k_t),

psi_n the C2 penalty p^3/(6 eps) for p < eps, p^2/2 - eps p/2 + eps^2/6 beyond (p the penetration): the mean of linear
springs over gaps that are spread evenly over eps, see ``cell_kernels``. Each is a penalty in series with the dent that
the functions of the body cannot carry; a stiffer one comes in where p is large (see ``normal_potential``); s the
slip that the contact remembers (see ``friction_memory_kernels``); psi_t the
incremental potential of elastic-plastic friction, a spring k_t up to the force mu f_n and that force beyond (Cundall
and Strack 1979, doi:10.1680/geot.1979.29.1.47), with the normal force f_n of the last Newton iterate. k_t does not
depend on f_n: the energy of the spring cannot grow but by work, whatever the normal force does, so friction takes
energy in every closed cycle.

Contacts without memory (k_t = 0) have the smoothed Coulomb potential of Li et al. 2020 instead (IPC,
doi:10.1145/3386569.3392425, eq. 13), mu f_n f0(|d_t|), which creeps.
"""

import warp as wp

from softmode.deformables.model.struct_kernels import (
    OVERLAP,
    Instances,
    NewtonState,
    PointConstraints,
    first_coupled,
    p_wave_modulus,
)

wp.set_module_options({"enable_backward": False})

BULK_FACTOR = wp.constant(150.0)
"""Contact stiffness per area over P-wave modulus per size: under a pressure that squeezes a body by 10 %, contact sinks
by 0.067 % of its size. The dent gives way, the penalty only keeps surfaces apart."""
SHEAR_FACTOR = wp.constant(40.0)
"""The same of the spring of friction: with 400 stiff bodies that hit the ground hop between sticking and sliding (40
iterations instead of 11 at 1e9 Pa)."""
INERTIA_FACTOR = wp.constant(100.0)
"""Contact stiffness over effective mass / dt^2, per area: what hits flat is stopped within a step, v dt / 100 deep. 0
sinks 1.5 to 3 mm at 5 m/s instead of 0.2 to 0.9; 1000 sinks 0.2 mm for a third more iterations."""
STIFFNESS_FLOOR = wp.constant(1.0e8)
"""Least contact stiffness per area [Pa/m]: under 25 kPa, a firm grasp, contact sinks by 0.25 mm."""
HARDENING = wp.constant(wp.float64(9.0))
"""Stiffness that contact gains where it is deep, over that where it is not: what an arm presses with its full force
sinks in 1.4 to 2.4 mm instead of 7 to 8. Ten times the stiffness throughout costs light bodies momentum."""
HARDENING_DEPTH = wp.constant(wp.float64(2.0))
"""Penetration beyond which it does besides the dent, in ranges of the onset of a level face."""
ALONG = wp.constant(wp.float64(0.15))
"""Largest dent along the surface over that across it. What rolls needs 0.05 mm of it, what turns under a finger 0.3 mm.
Without a bound a soft body that fingers pinch at few samples gets out from between them: contact there hardens across,
and must along."""
LEAST_ALONG, GROWTH = wp.constant(wp.float64(0.46)), wp.constant(wp.float64(2.7))
"""Dent along the surface over Mindlin's where nothing around is touched, and how much more per share c."""
HARDENING_RANGE = wp.constant(wp.float64(2.0))
"""Range of the onset of what it gains, in ranges of the contact's onset."""


@wp.func
def penalty(penetration: wp.float64, eps: wp.float64):
    """Return the C2 penalty of a penetration [m] per unit stiffness, and its first two derivatives."""
    p = wp.max(penetration, wp.float64(0.0))
    half = wp.float64(0.5)
    six = wp.float64(6.0)
    if p < eps:
        return p * p * p / (six * eps), half * p * p / eps, p / eps
    return half * p * p - half * eps * p + eps * eps / six, p - half * eps, wp.float64(1.0)


@wp.func
def beside_ridge(ratio: wp.float64, ridge: wp.float64, ridge_lead: wp.float64):
    """Return what a face adds to the edges in its cell, over the penalty, and how much deeper [m]: the larger counts.

    Beyond the depth at which both press alike, they are as stiff as the face.
    """
    share = wp.float64(1.0) / (wp.float64(1.0) + ratio) - ridge
    share = wp.max(share, wp.float64(1.0e-9))
    return share, ridge * ridge_lead / share


@wp.func
def normal_potential(
    penetration: wp.float64,
    eps: wp.float64,
    ratio: wp.float64,
    depth: wp.float64,
    ridge: wp.float64,
    ridge_lead: wp.float64,
):
    """Return the contact potential of a penetration [m] per unit stiffness, and its first two derivatives.

    The C2 penalty of springs in series with the dent, 1 / (1 + ratio) as stiff, and a stiffer penalty that sets in
    twice as deep and as slowly, ``depth`` deeper where there is a dent. Of a face and of the edges in its cell the one
    counts that presses more, so that how many samples an edge happens to lie on says little.

    Args:
        penetration: p [m].
        eps: Range of the onset [m].
        ratio: Compliance of the dent over that of the penalty; 0 for none.
        depth: Dent [m] from which on the stiffer penalty carries.
        ridge: Stiffness of edges, see ``ridge_kernels``.
        ridge_lead: How much deeper they are in, at least 0 [m].
    """
    share, after = beside_ridge(ratio, ridge, ridge_lead)
    psi, slope, curvature = penalty(penetration - after, eps)
    psi_deep, slope_deep, curvature_deep = penalty(penetration - depth, HARDENING_RANGE * eps)
    psi_edge, slope_edge, curvature_edge = penalty(penetration + ridge_lead, eps)
    return (
        share * psi + HARDENING * psi_deep + ridge * psi_edge,
        share * slope + HARDENING * slope_deep + ridge * slope_edge,
        share * curvature + HARDENING * curvature_deep + ridge * curvature_edge,
    )


@wp.func
def contact_potential(constraints: PointConstraints, penetration: wp.float64, i: int, e: int):
    """Return the potential of a contact at a penetration [m] per unit stiffness, and its first two derivatives."""
    ratio = constraints.stiffness[i, e] * constraints.dent_compliance[i, e]
    return normal_potential(
        penetration,
        constraints.onset[i, e],
        ratio,
        constraints.dent_depth[i, e],
        constraints.ridge[i, e],
        constraints.ridge_lead[i, e],
    )


@wp.func
def friction_potential(y: wp.float64, eps: wp.float64):
    """Return f0(y), f1(y) / y and f1'(y), f1 = f0', of the smoothed Coulomb potential with stick range ``eps`` [m]."""
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    three = wp.float64(3.0)
    if y < eps:
        return (
            y * y / eps - y * y * y / (three * eps * eps) + eps / three,
            two / eps - y / (eps * eps),
            two / eps - two * y / (eps * eps),
        )
    return y, one / y, wp.float64(0.0)


@wp.func
def elastic_slip(force: wp.float64, stiffness: wp.float64, deep: wp.float64, depth: wp.float64):
    """Return the slip [m] at which the spring of friction has a force [N]; 0 of friction without memory."""
    if stiffness <= wp.float64(0.0):
        return wp.float64(0.0)
    most = ALONG * depth
    if force <= stiffness * most:
        return force / stiffness
    return most + (force - stiffness * most) / deep


@wp.func
def stick_potential(y: wp.float64, limit: wp.float64, stiffness: wp.float64, deep: wp.float64, depth: wp.float64):
    """Return energy [J], force over slip and curvature along the slip [N/m] of elastic-plastic friction at slip y [m].

    A spring up to the force ``limit`` [N], constant force beyond; nothing where the limit is 0. It has the stiffness
    ``deep`` from ALONG times the dent ``depth`` [m] on.
    """
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    if limit <= zero:
        return zero, zero, zero
    most = elastic_slip(limit, stiffness, deep, depth)
    x = wp.min(y, most)
    over = wp.max(x - ALONG * depth, zero)
    energy = half * stiffness * x * x + half * (deep - stiffness) * over * over + limit * (y - x)
    if y > most:
        return energy, limit / y, zero
    if over > zero:
        return energy, stiffness + (deep - stiffness) * over / y, deep
    return energy, stiffness, stiffness


@wp.func
def slip_potential(
    y: wp.float64, limit: wp.float64, stick: wp.float64, deep: wp.float64, depth: wp.float64, stick_range: wp.float64
):
    """Return energy [J], force over slip and curvature along the slip [N/m] of friction, with memory or smoothed."""
    if stick > wp.float64(0.0):
        return stick_potential(y, limit, stick, deep, depth)
    f0, secant, tangent = friction_potential(y, stick_range)
    return limit * f0, limit * secant, limit * tangent


@wp.func
def stiffness_sources(
    instances: Instances, i: int, factor: float, relative: float, partner_mass: float, partner_area: float, dt: float
):
    """Return what the contact stiffness per area [Pa/m] would be of the material alone, and of the inertia alone."""
    wave = p_wave_modulus(relative * instances.youngs_modulus[i], instances.poissons_ratio[i])
    mass = float(instances.mass[i])
    if partner_mass > 0.0:
        mass *= partner_mass / (mass + partner_mass)
    inertia = mass / (wp.min(instances.area[i], partner_area) * dt * dt)
    return factor * wave / instances.size[i], INERTIA_FACTOR * inertia


@wp.func
def stiffness_per_area(
    instances: Instances, i: int, factor: float, relative: float, partner_mass: float, partner_area: float, dt: float
):
    """Return the contact stiffness per area [Pa/m] of a body against a partner, from the parameters as they are now.

    What ``contact_stiffness`` gives, or, where that is 0, the largest of ``factor`` times the wave modulus there over
    the size, INERTIA_FACTOR times the effective mass per area over dt^2, and STIFFNESS_FLOOR.

    Args:
        instances: The bodies.
        i: The body.
        factor: BULK_FACTOR across the surface, SHEAR_FACTOR along it.
        relative: Young's modulus where they touch relative to the body's.
        partner_mass: Mass of what it touches [kg]; 0 where that does not yield.
        partner_area: Its surface area [m^2].
        dt: Step [s].
    """
    if instances.contact_stiffness[i] > 0.0:
        return instances.contact_stiffness[i]
    bulk, inertia = stiffness_sources(instances, i, factor, relative, partner_mass, partner_area, dt)
    return wp.max(wp.max(bulk, inertia), STIFFNESS_FLOOR)


@wp.func
def stiffness_exponents(instances: Instances, i: int, factor: float, relative: float, partner_area: float, dt: float):
    """Return d ln(A kappa) / d(ln E, nu, ln m, ln s) of a contact with what does not yield, s the body's scale.

    The sample's area A grows with s^2. Where two sources of the stiffness are equal it has a kink, and no derivative.
    """
    none = wp.float64(0.0)
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    bulk, inertia = stiffness_sources(instances, i, factor, relative, 0.0, partner_area, dt)
    if instances.contact_stiffness[i] > 0.0 or wp.max(bulk, inertia) <= STIFFNESS_FLOOR:
        return wp.vec4d(none, none, none, two)
    if inertia > bulk:
        return wp.vec4d(none, none, one, wp.where(instances.area[i] < partner_area, none, two))
    nu = wp.float64(instances.poissons_ratio[i])
    by_nu = two / (one - two * nu) - one / (one - nu) - one / (one + nu)
    return wp.vec4d(one, by_nu, none, one)


@wp.func
def dent_depth(instances: Instances, i: int, length: float, edged: bool):
    """Return the dent [m] beyond which the contact of a body hardens.

    It is what the pressure E / (2 - 2 nu^2) dents, E that where it is touched. Where what presses has edges, three
    tenths of the overlap that a step may start from at the most: deeper, samples at an edge would take one face for the
    other in turns.
    Zero where ``contact_stiffness`` is given: the penalty is then the whole law of the contact.

    Args:
        instances: The bodies.
        i: The body.
        length: Dent at scale 1 under the pressure E / (1 - nu^2) [m], see ``dents``.
        edged: Whether what presses has edges.
    """
    if instances.contact_stiffness[i] > 0.0:
        return float(0.0)
    depth = 0.5 * instances.scale[i] * length
    if edged:
        depth = wp.min(depth, 0.3 * OVERLAP * instances.size[i])
    return depth


@wp.func
def shear_growth(touched: wp.float64):
    """Return how much softer a dent is along the surface the wider its patch, and the derivative by that share c.

    What turns on a patch of radius a is as stiff as a^3, a bed of springs as a^4.
    """
    return LEAST_ALONG + GROWTH * touched, GROWTH


@wp.func
def shear_yield(instances: Instances, i: int, compliance: wp.float64, touched: wp.float64):
    """Return the compliance along the surface [m/N] of a dent: Mindlin's ratio to that across, less where narrow."""
    nu = wp.float64(instances.poissons_ratio[i])
    two = wp.float64(2.0)
    growth, _by_touched = shear_growth(touched)
    return growth * compliance * (two - nu) / (two - two * nu)


@wp.func
def dent_compliance(instances: Instances, i: int, relative: float, length: float):
    """Return the dent per pressure w [m/Pa] of a body, from the parameters as they are now; 0 as ``dent_depth``.

    Args:
        instances: The bodies.
        i: The body.
        relative: Young's modulus where they touch relative to the body's.
        length: Dent at scale 1 under the pressure E / (1 - nu^2) [m].
    """
    if instances.contact_stiffness[i] > 0.0:
        return float(0.0)
    nu = instances.poissons_ratio[i]
    return instances.scale[i] * length * (1.0 - nu * nu) / (relative * instances.youngs_modulus[i])


@wp.func
def beyond_penalty(stiffness: wp.float64, compliance: wp.float64):
    """Return what a dent of a compliance [m/N] gives besides the penalty in series with it, which is part of it [m/N].

    Smooth: w^2 / (w + 1/kappa), w - 1/kappa of a large dent.
    """
    ratio = stiffness * compliance
    return compliance * ratio / (wp.float64(1.0) + ratio)


@wp.func
def beyond_exponent(ratio: wp.float64):
    """Return d ln of that by ln of the dent, one more than by ln of the penalty; ``ratio``: that over the penalty's."""
    half = wp.float64(0.5) * ratio
    one = wp.float64(1.0)
    return one + one / (one + half + wp.sqrt(half * half + ratio))


@wp.func
def dent_exponents(instances: Instances, i: int):
    """Return d ln(w / A) / d(ln E, nu, ln m, ln s) of a dent, w its compliance and A the sample's area."""
    one = wp.float64(1.0)
    nu = wp.float64(instances.poissons_ratio[i])
    return wp.vec4d(-one, wp.float64(-2.0) * nu / (one - nu * nu), wp.float64(0.0), -one)


@wp.func
def shear_exponents(instances: Instances, i: int):
    """Return d ln of the compliance of a dent along the surface over that across, by the same."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    nu = wp.float64(instances.poissons_ratio[i])
    return wp.vec4d(zero, one / (one - nu) - one / (wp.float64(2.0) - nu), zero, zero)


@wp.kernel
def sum_reactions(
    instances: Instances,
    state: NewtonState,
    constraints: PointConstraints,
    # Out:
    body_wrench_out: wp.array[wp.spatial_vector],  # (body_count,) on the rigid bodies, about their COM [N, N m]
    instance_force_out: wp.array[wp.vec3d],  # (instance_count,) total contact force on the body [N]
):
    """Sum the forces of contacts and links per rigid body (equal and opposite), of contacts per instance, in order."""
    w = wp.tid()
    for i in range(state.instance_start[w], state.instance_start[w + 1]):
        total = wp.vec3d()
        for e in range(first_coupled(instances, i), constraints.count[i]):
            f = constraints.force[i, e]
            paired = e >= constraints.count[i] - constraints.pair_count[i]
            if e >= instances.pin_count[i] and not (paired and constraints.partner[i, e] < 0):
                total += f  # a contact of the body with itself is none of the world's business
            body = constraints.body[i, e]
            if body >= 0:
                reaction = -wp.vec3(f)
                body_wrench_out[body] = body_wrench_out[body] + wp.spatial_vector(
                    reaction, wp.cross(constraints.arm[i, e], reaction)
                )
        instance_force_out[i] = total
