"""Device side of `explicit`: springs on particles."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def pull_particles(
    # Particles:
    x: wp.array2d[wp.vec3],
    v: wp.array2d[wp.vec3],
    mass: wp.array2d[float],
    # Springs:
    index: wp.array[int],
    stiffness: wp.array[float],
    target: wp.array[wp.vec3],
    dt: float,
):
    """Add the impulse of a spring to its particle, by implicit Euler in that spring alone."""
    i = wp.tid()
    k = index[i]
    rate = dt * stiffness[i] / mass[0, k]
    v[0, k] = (v[0, k] + rate * (target[i] - x[0, k])) / (1.0 + dt * rate)
