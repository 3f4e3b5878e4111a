"""What ``model.softmode``, ``state.softmode`` and ``control.softmode`` hold, as types."""

from typing import Any, Protocol, overload

import newton
import warp as wp

NAMESPACE = "softmode"


class SoftState(Protocol):
    """Reduced coordinates of all instances, one after another, and what the step before left behind."""

    q: wp.array
    """Coordinates [m], vec3d (function_total,)."""
    qd: wp.array
    """Their velocities [m/s], vec3d (function_total,)."""
    q_before: wp.array
    """Coordinates at the start of the last step [m], vec3d (function_total,)."""
    qd_before: wp.array
    """Velocities at the start of the last step [m/s], vec3d (function_total,)."""
    dt_before: wp.array
    """Length of the last step [s], float64 (instance_count,); 0 where there was none, its negative where it was near a
    shape, so that BDF2 starts over."""
    stick_shape: wp.array
    """Shapes that a surface sample touches, vec2i (particle_count,); -1 for none."""
    stick_point: wp.array
    """Where it sticks to them [m], 2 x 3 float64 (particle_count,)."""
    stick_partner: wp.array
    """Soft bodies of its world that a surface sample sticks to, vec2i (particle_count,); -1 for none."""
    stick_slip: wp.array
    """Its slip on them, carried back to rest [m], 2 x 3 float64 (particle_count,)."""
    dent: wp.array
    """How far its skin lies outside of what the functions of the body say [m], vec3 (particle_count,)."""


class SoftControl(Protocol):
    """Where parts of soft bodies are to be at the end of the next step."""

    q_driven: wp.array
    """Targets of the driven functions [m], vec3d (function_total,)."""
    pin_target: wp.array
    """Targets of the pins, in the world or in the frame of their link [m], vec3d (pin_total,); absent without pins."""


class SoftModel(SoftState, SoftControl, Protocol):
    """Parameters of soft bodies, (instance_count,) where not said, with the initial state and the initial targets."""

    instance_world: wp.array
    """World of the instance, int; -1 outside all worlds."""
    body_key: wp.array
    """Number that ties the instance to its ``ReducedBody``, int64."""
    function_start: wp.array
    """First of its coordinates, int."""
    particle_start: wp.array
    """First of its surface samples among Newton's particles, int."""
    material_model: wp.array
    """A ``MaterialModel``, int."""
    youngs_modulus: wp.array
    """E [Pa], float."""
    poissons_ratio: wp.array
    """nu, float."""
    density: wp.array
    """rho [kg/m^3], float."""
    viscosity: wp.array
    """Relaxation time tau [s], float."""
    mass_damping: wp.array
    """alpha [1/s], float."""
    friction: wp.array
    """Coulomb coefficient of the surface, float."""
    scale: wp.array
    """Size over that of the asset, float."""
    placed_scale: wp.array
    """Scale that the initial coordinates were made for, float."""
    contact_stiffness: wp.array
    """Contact stiffness per area [Pa/m], float; 0 lets it follow the material and the step."""
    contact_radius: wp.array
    """How far the surface that touches stands out [m], float."""
    self_contact: wp.array
    """Whether the body may touch itself, int."""
    pin_instance: wp.array
    """Instance of each pin, int (pin_total,); absent without pins, as all that follow."""
    pin_body: wp.array
    """Rigid body that holds its target, int (pin_total,); -1 for the world."""
    pin_point: wp.array
    """Its rest point in the asset [m], vec3d (pin_total,)."""
    pin_stiffness: wp.array
    """Its stiffness [N/m], float (pin_total,); negative while it is released."""


@overload
def soft(owner: newton.Model) -> SoftModel: ...
@overload
def soft(owner: newton.State) -> SoftState: ...
@overload
def soft(owner: newton.Control) -> SoftControl: ...
def soft(owner: Any) -> Any:
    """Return the soft bodies' part of a model, a state or a control.

    Raises:
        AttributeError: If it holds no reduced body.
    """
    return getattr(owner, NAMESPACE)
