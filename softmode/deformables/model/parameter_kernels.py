"""Device side of parameters: what is written into masked worlds, and sizes and masses that follow from them."""

import warp as wp

from softmode.deformables.model.declare import struct
from softmode.deformables.model.struct_kernels import Instances, exists, in_mask

wp.set_module_options({"enable_backward": False})


@struct
class RestQuantities:
    """What has a size, at scale 1."""

    volume: wp.array[wp.float64]  # (instance_count,) [m^3]
    area: wp.array[float]  # (instance_count,), of the surface samples [m^2]
    size: wp.array[float]  # (instance_count,) [m], as all that follow
    tolerance: wp.array[float]
    margin: wp.array[float]
    smoothing: wp.array[float]
    spacing: wp.array[float]  # of the surface samples
    radius: wp.array[float]  # (particle_count,)


@struct
class Parameters:
    """Parameters of the bodies, (instance_count,)."""

    youngs_modulus: wp.array[float]  # [Pa]
    poissons_ratio: wp.array[float]
    density: wp.array[float]  # [kg/m^3]
    friction: wp.array[float]
    scale: wp.array[float]


@wp.kernel
def derive_quantities(
    rest: RestQuantities,
    scale: wp.array[float],  # (instance_count,), as the model has it
    density: wp.array[float],  # [kg/m^3]
    instance_world: wp.array[int],
    world_mask: wp.array[wp.bool],
    # Out:
    instances: Instances,
    spacing_out: wp.array[float],
):
    """Compute masses and sizes of the bodies in masked worlds: lengths times s, areas times s^2, volumes times s^3."""
    i = wp.tid()
    if not in_mask(instance_world[i], world_mask):
        return
    s = scale[i]
    size = s * rest.size[i]
    s3 = wp.float64(s) * wp.float64(s) * wp.float64(s)
    instances.scale[i] = s
    instances.mass[i] = wp.float64(density[i]) * (s3 * rest.volume[i])
    instances.size[i] = size
    instances.inertia[i] = density[i] * size * size
    instances.area[i] = s * s * rest.area[i]
    instances.tolerance[i] = s * rest.tolerance[i]
    instances.margin[i] = s * rest.margin[i]
    instances.smoothing[i] = s * rest.smoothing[i]
    spacing_out[i] = s * rest.spacing[i]


@wp.kernel
def derive_tolerances(
    instance_start: wp.array[int],  # (world_count + 1,)
    instances: Instances,
    # Out:
    rigid_tolerance_out: wp.array[float],  # (world_count,) [m or rad]
):
    """Find the least tolerance of the bodies of each world."""
    w = wp.tid()
    least = float(wp.inf)
    for i in range(instance_start[w], instance_start[w + 1]):
        if exists(instances, i):
            least = wp.min(least, instances.tolerance[i])
    rigid_tolerance_out[w] = least


@wp.kernel
def derive_particles(
    rest: RestQuantities,
    instances: Instances,
    instance_world: wp.array[int],
    world_mask: wp.array[wp.bool],
    # Out, (particle_count,):
    radius_out: wp.array[float],  # [m]
    mass_out: wp.array[float],  # [kg]
    inv_mass_out: wp.array[float],
):
    """Give the surface samples of masked worlds their radii and equal shares of the mass, for viewers and couplers."""
    i, s = wp.tid()
    count = instances.sample_count[i]
    if s >= count or not in_mask(instance_world[i], world_mask):
        return
    particle = instances.particle_start[i] + s
    mass = float(instances.mass[i] / wp.float64(count))
    radius_out[particle] = instances.scale[i] * rest.radius[particle]
    mass_out[particle] = mass
    inv_mass_out[particle] = 1.0 / mass


@wp.func
def admissible(value: float, current: float, limits: wp.vec2, bit: int):
    """Return a value clamped to its limits and the bit where it lay outside; ``current`` in place of no number."""
    if wp.isnan(value):
        return current, bit
    inside = wp.clamp(value, limits[0], limits[1])
    return inside, wp.where(inside == value, 0, bit)


@wp.func
def write_admissible(given: wp.array[float], own: wp.array[float], i: int, limits: wp.vec2, bit: int):
    """Write a parameter of an instance, clamped; return the bit where it had to be."""
    value, found = admissible(given[i], own[i], limits, bit)
    own[i] = value
    return found


@wp.kernel
def write_parameters(
    instances: Instances,
    given: Parameters,
    youngs_modulus: wp.vec2,  # limits, as all that follow
    poissons_ratio: wp.vec2,
    density: wp.vec2,
    friction: wp.vec2,
    scale: wp.vec2,
    held: int,  # bit of a scale that cannot change
    instance_world: wp.array[int],
    world_mask: wp.array[wp.bool],
    # In and out:
    parameters: Parameters,
    # Out:
    flags_out: wp.array[int],  # (instance_count,)
):
    """Write the parameters of the bodies in masked worlds, clamped; flag what had to be."""
    i = wp.tid()
    if not in_mask(instance_world[i], world_mask):
        return
    flags = write_admissible(given.youngs_modulus, parameters.youngs_modulus, i, youngs_modulus, 1)
    flags |= write_admissible(given.poissons_ratio, parameters.poissons_ratio, i, poissons_ratio, 2)
    flags |= write_admissible(given.density, parameters.density, i, density, 4)
    flags |= write_admissible(given.friction, parameters.friction, i, friction, 8)
    value, bit = admissible(given.scale[i], parameters.scale[i], scale, 16)
    flags = flags | bit
    if instances.pin_count[i] > 0 or instances.driven_count[i] > 0:
        # its targets are places in the world or on a link: they would pull the body to its old size
        if value != parameters.scale[i]:
            flags = flags | held
    else:
        parameters.scale[i] = value
    flags_out[i] = flags


@wp.kernel
def write_shape_friction(
    shape: wp.array2d[int],  # (world_count, shape_count)
    given: wp.array[float],  # (world_count,)
    limits: wp.vec2,
    bit: int,
    world_mask: wp.array[wp.bool],
    # In and out:
    friction: wp.array[float],  # of the model's shapes
    # Out:
    flags_out: wp.array[int],  # (world_count,)
):
    """Write the friction of shapes in masked worlds, clamped."""
    w = wp.tid()
    if not world_mask[w]:
        return
    flags = int(0)
    for k in range(shape.shape[1]):
        value, found = admissible(given[w], friction[shape[w, k]], limits, bit)
        friction[shape[w, k]] = value
        flags = flags | found
    flags_out[w] = flags
