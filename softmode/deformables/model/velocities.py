"""Velocities written into a state: rigid motion about the body as it is deformed, and fields over rest points."""

from collections.abc import Sequence

import newton
import numpy as np

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.model.authoring import VelocityField, body_key, finite_vector
from softmode.deformables.model.namespaces import soft
from softmode.deformables.model.tables import present
from softmode.errors import ConfigError


def set_velocity(
    model: newton.Model,
    state: newton.State,
    instance: int,
    body: ReducedBody,
    *,
    velocity: Sequence[float] = (0.0, 0.0, 0.0),
    angular_velocity: Sequence[float] = (0.0, 0.0, 0.0),
    velocity_field: VelocityField | None = None,
) -> None:
    """Give a soft body a velocity in place of the one it has, whatever its deformation.

    Writes ``state.softmode.qd`` and the velocities of its particles on the host; in a captured loop copy into these
    arrays on the device instead. Driven functions move as they are prescribed all the same.

    Args:
        model: Finalised model.
        state: Its state.
        instance: Index of the instance in the model.
        body: Its body.
        velocity: Velocity of the centre of mass [m/s].
        angular_velocity: Angular velocity about the centre of mass as the body is now [rad/s].
        velocity_field: What is added to them, as for
            :func:`softmode.deformables.model.authoring.add_reduced_body`.

    Raises:
        ConfigError: If the instance does not exist or has another body, or a velocity is not finite or of another
            shape.
    """
    data, own = soft(model), soft(state)
    keys = data.body_key.numpy()
    if not 0 <= instance < len(keys):
        raise ConfigError(f"instance must be the index of one of the model's {len(keys)} soft bodies, got {instance}")
    if keys[instance] != body_key(body):
        raise ConfigError(f"instance {instance} is not of body {body.name!r}", hint="pass the one that it was added as")
    first, count = int(data.function_start.numpy()[instance]), body.function_count
    v, omega = finite_vector("velocity", velocity), finite_vector("angular_velocity", angular_velocity)
    q, linear = own.q.numpy()[first : first + count], body.linear_coordinates
    qd = np.cross(omega, q + linear[:, :3]) + np.outer(linear[:, 3], v - np.cross(omega, body.mean_basis @ q))
    if velocity_field is not None:
        s = float(data.scale.numpy()[instance])
        qd += body.project(lambda X: velocity_field(s * X))
    own.qd[first : first + count].assign(qd)
    own.dt_before[instance : instance + 1].zero_()  # no step led here: BDF2 starts over
    particle = int(data.particle_start.numpy()[instance])
    present(state.particle_qd)[particle : particle + body.surface_count].assign(body.surface.basis @ qd)
