"""What a model knows of reduced bodies: Newton custom attributes, and how bodies and pins get into a builder."""

import hashlib
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_number
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.model.namespaces import NAMESPACE, soft
from softmode.deformables.model.struct_kernels import mat23d, p_wave_modulus
from softmode.errors import ConfigError, MaterialError

_INSTANCE = f"{NAMESPACE}:instance"
_FUNCTION = f"{NAMESPACE}:function"
_PIN = f"{NAMESPACE}:pin"

MATERIAL_FIELDS = ("youngs_modulus", "poissons_ratio", "density", "viscosity", "mass_damping", "friction")
"""Numbers of a :class:`Material` that a model stores per instance."""

SCALE_MIN, SCALE_MAX = 0.25, 4.0
"""Sizes that an asset may be scaled to; beyond, build one: splats follow a total stretch up to 8, scale included."""

CONTACT_FIELDS = ("contact_stiffness", "contact_radius", "self_contact")
"""What a model stores per instance of its surface."""


VelocityField = Callable[[NDArray[np.float64]], ArrayLike]
"""Velocities in the world's axes [m/s], shape (N, 3), of rest points of a body, at its scale, in its frame [m]."""


def body_key(body: ReducedBody) -> int:
    """Return the number that ties an instance in a model to its body: 62 bits of the body's fingerprint."""
    return int.from_bytes(hashlib.sha256(body.fingerprint.encode()).digest()[:8], "little") >> 2


def finite_vector(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return three finite numbers.

    Raises:
        ConfigError: If they are not.
    """
    found = np.asarray(value, dtype=float)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ConfigError(f"{name} must be three finite numbers, got {value!r}")
    return found


def register_custom_attributes(builder: newton.ModelBuilder) -> None:
    """Declare the attributes of reduced bodies on a builder; once per builder, also on the one that replicates."""
    if f"{NAMESPACE}:q" in builder.custom_attributes:
        return
    attribute = newton.ModelBuilder.CustomAttribute
    assignment = newton.Model.AttributeAssignment
    for name in ("instance", "function", "pin"):
        builder.add_custom_frequency(newton.ModelBuilder.CustomFrequency(name=name, namespace=NAMESPACE))

    def declare(names: str, dtype: Any, frequency: Any, **options: Any) -> None:
        for name in names.split():
            builder.add_custom_attribute(
                attribute(name=name, dtype=dtype, frequency=frequency, namespace=NAMESPACE, **options)
            )

    state, control = {"assignment": assignment.STATE}, {"assignment": assignment.CONTROL}
    declare("instance_world", wp.int32, _INSTANCE, references="world")
    declare("body_key", wp.int64, _INSTANCE)
    declare("function_start", wp.int32, _INSTANCE, references=_FUNCTION)
    declare("particle_start", wp.int32, _INSTANCE, references="particle")
    declare("material_model self_contact", wp.int32, _INSTANCE)
    # a contact_stiffness of 0 follows the body, see ``penalty_kernels``
    declare(" ".join(MATERIAL_FIELDS) + " contact_stiffness contact_radius", wp.float32, _INSTANCE)
    declare("scale placed_scale", wp.float32, _INSTANCE, default=1.0)  # the latter: what the model's q and qd are for
    # q_before, qd_before: the step before, for BDF2 and for Newton's start; dt_before = 0 says that there is none
    declare("q qd q_before qd_before", wp.vec3d, _FUNCTION, **state)
    declare("dt_before", wp.float64, _INSTANCE, **state)
    # friction's memory: the shapes that a surface sample sticks to, and where (``friction_memory_kernels``);
    # and the soft bodies of its world that it sticks to, counted within the world, with its slip at rest
    particle = newton.Model.AttributeFrequency.PARTICLE
    declare("stick_shape stick_partner", wp.vec2i, particle, default=wp.vec2i(-1, -1), **state)
    declare("stick_point stick_slip", mat23d, particle, **state)
    # how far the skin lies outside of what the functions say, see ``dent_kernels``
    declare("dent", wp.vec3, particle, **state)
    declare("q_driven", wp.vec3d, _FUNCTION, **control)
    declare("pin_instance", wp.int32, _PIN, references=_INSTANCE)
    declare("pin_body", wp.int32, _PIN, references="body")
    declare("pin_point", wp.vec3d, _PIN)
    declare("pin_stiffness", wp.float32, _PIN)
    declare("pin_target", wp.vec3d, _PIN, **control)


def bulk_stiffness(body: ReducedBody, youngs_modulus: float, poissons_ratio: float, scale: float = 1.0) -> float:
    """Return twenty times the stiffness per area [Pa/m] of the bulk: the P-wave modulus over the size.

    Args:
        body: The body.
        youngs_modulus: E [Pa].
        poissons_ratio: nu.
        scale: Size over that of ``body``.
    """
    wave = p_wave_modulus(float(youngs_modulus), float(poissons_ratio))
    return 20.0 * wave / (scale * float(np.linalg.norm(np.ptp(body.bounds, axis=0))))


def rotation_matrix(rotation: ArrayLike) -> NDArray[np.float64]:
    """Return a rotation as a float64 matrix, shape (3, 3).

    Raises:
        ConfigError: If it is no rotation.
    """
    R = np.asarray(rotation, dtype=np.float64)
    if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3), atol=1e-5) or np.linalg.det(R) < 0.0:
        raise ConfigError("rotation must be a rotation matrix of shape (3, 3)", hint="orthonormalise it")
    return R


def add_reduced_body(
    builder: newton.ModelBuilder,
    body: ReducedBody,
    *,
    material: Material | None = None,
    position: Sequence[float] = (0.0, 0.0, 0.0),
    rotation: np.ndarray | None = None,
    velocity: Sequence[float] = (0.0, 0.0, 0.0),
    angular_velocity: Sequence[float] = (0.0, 0.0, 0.0),
    velocity_field: VelocityField | None = None,
    contact_stiffness_per_area: float | None = None,
    contact_radius: float = 0.0,
    self_contact: bool = False,
    particle_radius: float | None = None,
    scale: float = 1.0,
) -> int:
    """Add a body to a world; its surface samples become Newton particles.

    Args:
        builder: Builder of the world; the attributes are registered if they are not yet.
        body: The reduced body.
        material: Its material; default ``Material()``.
        position: Where the body's centre of mass rests [m].
        rotation: Rotation matrix of the rest pose, shape (3, 3); default identity.
        velocity: Initial velocity of the centre of mass [m/s].
        angular_velocity: Initial angular velocity [rad/s].
        velocity_field: What is added to them: velocities in the world's axes [m/s], shape (N, 3), of rest points of the
            body, at its scale, in its frame [m], shape (N, 3). The body takes the nearest that its functions can; see
            :meth:`softmode.deformables.body.reduced_body.ReducedBody.project`.
        contact_stiffness_per_area: Penalty stiffness of contact [Pa/m]; None or 0 lets it follow the material and the
            step, see :func:`softmode.deformables.contact.penalty_kernels.stiffness_per_area`. A number is the whole law
            of the contact: nothing is added to it for the dent that the functions are too few for.
        contact_radius: How far the surface that touches stands out from the body's [m].
        self_contact: Whether the body may touch itself.
        particle_radius: Radius of the particles for viewers and picking [m]; default half their spacing.
        scale: Size over that of ``body``, 0.25 to 4: the body that ``body`` would be had the same object been built so
            much larger. ``model.softmode.scale`` holds it; see ``docs/bodies.md`` for what follows it.

    Returns:
        Index of the instance in this builder.

    Raises:
        ConfigError: If the pose, a velocity, a stiffness or a radius is not finite, the rotation is no rotation, or the
            scale lies outside its range.
        MaterialError: If Poisson's ratio is negative and that of the body varies: lambda / mu would keep its
            proportions down to where nothing is stable.
    """
    register_custom_attributes(builder)
    material = material or Material()
    R = np.eye(3) if rotation is None else rotation_matrix(rotation)
    p, v0 = finite_vector("position", position), finite_vector("velocity", velocity)
    omega = finite_vector("angular_velocity", angular_velocity)
    stiffness = contact_stiffness_per_area or 0.0
    require_number("contact_stiffness_per_area", stiffness, at_least=0.0, unit="[Pa/m]")
    require_number("contact_radius", contact_radius, at_least=0.0, unit="[m]")
    hint = "build the body at that size instead"
    require_number("scale", scale, at_least=SCALE_MIN, at_most=SCALE_MAX, hint=hint)
    s = float(np.float32(scale))  # as the model stores it
    spin = np.array([[0, -omega[2], omega[1]], [omega[2], 0, -omega[0]], [-omega[1], omega[0], 0]])
    if len(body.cubature.lame_ratio) and material.poissons_ratio < 0.0:
        raise MaterialError(
            f"poissons_ratio is {material.poissons_ratio:g}, and that of body {body.name!r} varies",
            hint="give one of 0 or more, or build the body without a field of Poisson's ratios",
        )
    if not body.serves_ratio(material.poissons_ratio):
        warnings.warn(
            f"body {body.name!r} has functions for another Poisson's ratio than {material.poissons_ratio:g}: it comes"
            f" out too stiff; build it with BuildOptions(poissons_ratio={material.poissons_ratio:g})",
            RuntimeWarning,
            stacklevel=2,
        )
    q = body.affine(s * R, p)
    # the velocity field v + omega x (R s X) as coordinates: affine() of I + A subtracts the identity again
    qd = body.affine(np.eye(3) + spin @ (s * R), v0)
    x = s * body.surface.points @ R.T + p
    v = v0 + x @ spin.T - p @ spin.T
    if velocity_field is not None:
        more = body.project(lambda X: velocity_field(s * X))
        qd, v = qd + more, v + body.surface.basis @ more
    radius = 0.5 * s * float(np.sqrt(body.surface.areas.mean())) if particle_radius is None else particle_radius
    mass = material.density * s**3 * body.volume / body.surface_count

    particle_start = builder.particle_count
    builder.add_particles(
        pos=[wp.vec3(*row) for row in x],
        vel=[wp.vec3(*row) for row in v],
        mass=[mass] * body.surface_count,
        radius=[radius] * body.surface_count,
    )
    function_start = len(builder.custom_attributes[f"{NAMESPACE}:q"].values or [])
    builder.add_custom_values_batch(
        [
            {f"{NAMESPACE}:q": wp.vec3d(*a), f"{NAMESPACE}:qd": wp.vec3d(*b), f"{NAMESPACE}:q_driven": wp.vec3d(*a)}
            for a, b in zip(q, qd, strict=True)
        ]
    )
    values = {
        "body_key": body_key(body),
        "function_start": function_start,
        "particle_start": particle_start,
        "material_model": int(material.model),
        "scale": s,
        "placed_scale": s,
        "contact_stiffness": float(stiffness),
        "contact_radius": float(contact_radius),
        "self_contact": int(self_contact),
        **{name: getattr(material, name) for name in MATERIAL_FIELDS},
    }
    index = builder.add_custom_values(**{f"{NAMESPACE}:{name}": value for name, value in values.items()})
    return index[f"{NAMESPACE}:function_start"]


def reserve_room(builder: newton.ModelBuilder, functions: int, samples: int) -> None:
    """Leave room behind the body that was added last, for a larger one that may take its place while the model runs.

    Args:
        builder: Builder of the world.
        functions: More functions than the body has.
        samples: More surface samples; they become particles without mass that nothing moves or touches.
    """
    if samples:
        place = wp.vec3(*builder.particle_q[-1])
        builder.add_particles(
            pos=[place] * samples, vel=[wp.vec3()] * samples, mass=[0.0] * samples, radius=[1.0e-4] * samples
        )
    if functions:
        empty = {f"{NAMESPACE}:{name}": wp.vec3d() for name in ("q", "qd", "q_driven")}
        builder.add_custom_values_batch([dict(empty) for _ in range(functions)])


def add_pins(
    builder: newton.ModelBuilder,
    instance: int,
    points: np.ndarray,
    *,
    stiffness: float | np.ndarray,
    targets: np.ndarray | None = None,
    link: int = -1,
) -> None:
    """Pin rest points of a body to targets in the world or on a rigid body by springs (soft boundary conditions).

    Args:
        builder: Builder that holds the instance.
        instance: Index from :func:`add_reduced_body`.
        points: Rest points of the body, at its scale, in the body frame [m], shape (pin_count, 3).
        stiffness: Spring stiffness [N/m], a number or one per pin; scale it with a volume or an area for a clamp.
        targets: Positions in the frame of the link, or in the world [m], shape (pin_count, 3); default: the points
            themselves, so give them for a body that is not placed at the origin. Move them at run time through
            ``control.softmode.pin_target``.
        link: Rigid body that holds the targets, -1 for the world.

    Raises:
        ConfigError: If there is no point, a shape does not fit, or a stiffness is negative.
    """
    X = np.atleast_2d(np.asarray(points, float))
    T = X if targets is None else np.atleast_2d(np.asarray(targets, float))
    k = np.atleast_1d(np.asarray(stiffness, float))
    if k.shape not in ((1,), (len(X),)):
        raise ConfigError(f"stiffness must be one number or one per pin, got shape {k.shape} for {len(X)} pins")
    k = np.broadcast_to(k, (len(X),))
    if X.ndim != 2 or X.shape[1:] != (3,) or T.shape != X.shape or len(X) == 0:
        raise ConfigError(f"points and targets must have shape (pin_count > 0, 3), got {X.shape} and {T.shape}")
    if not -1 <= link < builder.body_count:
        raise ConfigError(
            f"link must be a rigid body of the builder or -1, got {link}; it has {builder.body_count} bodies"
        )
    if not (np.isfinite(k).all() and (k >= 0).all() and np.isfinite(X).all() and np.isfinite(T).all()):
        raise ConfigError("stiffness must be finite and >= 0 [N/m], points and targets finite [m]")
    scales = attribute_values(builder, "scale")
    s = scales[instance] if 0 <= instance < len(scales) else 1.0  # the solver refuses an instance that is not there
    builder.add_custom_values_batch(
        [
            {
                f"{NAMESPACE}:pin_instance": instance,
                f"{NAMESPACE}:pin_body": link,
                f"{NAMESPACE}:pin_point": wp.vec3d(*a),
                f"{NAMESPACE}:pin_stiffness": float(b),
                f"{NAMESPACE}:pin_target": wp.vec3d(*c),
            }
            for a, b, c in zip(X / s, k, T, strict=True)
        ]
    )


def attribute_values(builder: newton.ModelBuilder, name: str) -> list[Any]:
    """Return the values of an attribute of soft bodies that a builder holds so far."""
    values: Any = builder.custom_attributes[f"{NAMESPACE}:{name}"].values
    return list(values.values() if isinstance(values, dict) else values or [])


def drive_regions(
    model: newton.Model,
    control: newton.Control,
    instance: int,
    body: ReducedBody,
    matrices: np.ndarray,
    translations: np.ndarray,
) -> None:
    """Say where the exact regions of a body shall be at the end of the next step.

    Writes ``control.softmode.q_driven`` on the host; in a captured loop copy into that array on the device instead.
    A reset of the state leaves the control as it is: drive the regions back too.

    Args:
        model: Finalised model.
        control: Its control.
        instance: Index of the instance in the model.
        body: Its body.
        matrices: Matrix A of each region, x = A X + t with X the rest position of the body, at its scale, in the body
            frame, shape (region_count, 3, 3).
        translations: Vector t of each region [m], shape (region_count, 3).
    """
    data = soft(model)
    q = body.regions.driven_affine(float(data.scale.numpy()[instance]) * np.asarray(matrices, float), translations)
    start = int(data.function_start.numpy()[instance])
    target = soft(control).q_driven
    target[start : start + len(q)].assign(q)
