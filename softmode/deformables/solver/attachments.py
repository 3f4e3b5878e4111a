"""Attachments: parts of a soft body held by a rigid body or by the world, two-way, until they are released.

An attachment is a layer of glue: springs from surface samples (or rest points, or the quadrature of a soft region) to
targets that move with the rigid body. The springs are pins (see ``authoring``), so they are unknowns of the same solve
as everything else, and what they pull at one end they pull at the other.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp
from scipy.spatial import KDTree

from softmode.checks import require_number
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.model.authoring import NAMESPACE, add_pins, attribute_values, body_key, bulk_stiffness
from softmode.deformables.model.layout import Layout
from softmode.deformables.model.namespaces import soft
from softmode.errors import ConfigError

UNTOLD_SHARE = 0.02
"""Fraction of a body's surface up to which pins may hold it where the build was not told of it."""


@dataclass(frozen=True, kw_only=True)
class Attachment:
    """Where the pins of an attachment stand; what :meth:`SolverReduced.release` and ``hold`` take."""

    instance: int
    """Index of the soft body in the builder of one world."""
    first: int
    """Its first pin among the pins of the soft body."""
    count: int
    """Number of pins."""


def attach(
    builder: newton.ModelBuilder,
    instance: int,
    body: ReducedBody,
    *,
    link: int = -1,
    region: str | None = None,
    box: tuple[Sequence[float], Sequence[float]] | None = None,
    points: np.ndarray | None = None,
    stiffness: float | None = None,
    link_pose: wp.transform | None = None,
) -> Attachment:
    """Fix a part of a soft body to a rigid body or to the world, where both are now.

    The body does not touch the shapes of the link while it is held. It can be let go at run time by
    :meth:`softmode.deformables.solver.solver_reduced.SolverReduced.release`; a reset holds it again.

    Args:
        builder: Builder of the world that holds the soft body and the link.
        instance: Index from :func:`softmode.deformables.model.authoring.add_reduced_body`.
        body: The soft body.
        link: Rigid body of the builder, -1 for the world.
        region: Name of a soft region that the body was built with; or
        box: lower and upper corner in the body's rest frame, at its scale [m]: the surface samples inside; or
        points: rest points, likewise [m], shape (count, 3). One of the three.
        stiffness: Per area of surface [Pa/m]; default twenty times the bulk's. A region brings its own, as it was
            built; for points it is shared equally, as if they covered the whole surface.
        link_pose: Pose of the link in the world, a ``wp.transform``; default ``builder.body_q[link]``. Give it when the
            joint coordinates of the builder do not put the link there.

    Returns:
        The attachment.

    Raises:
        ConfigError: If not one of region, box and points is given, no point lies in it, a point lies
            outside the body, the region is exact or unknown,
            or the link or the instance of the body does not exist.
    """
    if sum(where is not None for where in (region, box, points)) != 1:
        raise ConfigError("attach needs exactly one of region, box and points")
    if not -1 <= link < builder.body_count:
        raise ConfigError(f"link must be a rigid body of the builder or -1, got {link}; it has {builder.body_count}")
    keys = attribute_values(builder, "body_key") if f"{NAMESPACE}:body_key" in builder.custom_attributes else []
    if not 0 <= instance < len(keys):
        raise ConfigError(
            f"instance must be the index of a soft body of the builder, got {instance}; it has {len(keys)}",
            hint="pass what add_reduced_body returned",
        )
    if keys[instance] != body_key(body):
        raise ConfigError(
            f"instance {instance} is not of body {body.name!r}", hint="pass the body that add_reduced_body was given"
        )
    modulus, ratio = (float(attribute_values(builder, name)[instance]) for name in ("youngs_modulus", "poissons_ratio"))
    s = float(attribute_values(builder, "scale")[instance])
    per_area = bulk_stiffness(body, modulus, ratio, s) if stiffness is None else stiffness
    require_number("stiffness", per_area, above=0.0, unit="[Pa/m]")
    if region is not None:
        X, pins = _region_pins(body, region, modulus)
        pins = s * pins  # kappa of the larger region is less by s^2, its volume more by s^3
    elif points is not None:
        X = np.asarray(points, float).reshape(-1, 3) / s
        pins = np.full(len(X), s * s * per_area * body.surface.areas.sum() / max(len(X), 1))
        outside = X[~np.isfinite(X).all(axis=1)] if not np.isfinite(X).all() else X[~body.holds(X)]
        if len(outside):
            raise ConfigError(
                f"{len(outside)} of {len(X)} points lie outside body {body.name!r}, the first at {s * outside[0]} [m]",
                hint=f"give points of its rest frame; it spans {s * body.bounds[0]} to {s * body.bounds[1]}",
            )
    else:
        assert box is not None
        lower, upper = np.asarray(box[0], float) / s, np.asarray(box[1], float) / s
        inside = ((body.surface.points >= lower) & (body.surface.points <= upper)).all(axis=1)
        X, pins = body.surface.points[inside], s * s * per_area * body.surface.areas[inside]
    if len(X) == 0:
        low, high = s * body.surface.points.min(axis=0), s * body.surface.points.max(axis=0)
        raise ConfigError(
            f"the attachment of body {body.name!r} holds no point", hint=f"its surface spans {low} to {high} [m]"
        )
    first = attribute_values(builder, "pin_instance").count(instance)
    pose: Any = wp.transform_identity()
    if link >= 0:
        pose = builder.body_q[link] if link_pose is None else link_pose
    world = X + body.evaluate(X)[0] @ _coordinates(builder, instance, body)
    matrix = np.asarray(wp.transform_to_matrix(pose), float).reshape(4, 4)
    add_pins(builder, instance, s * X, stiffness=pins, targets=(world - matrix[:3, 3]) @ matrix[:3, :3], link=link)
    return Attachment(instance=instance, first=first, count=len(X))


def _region_pins(body: ReducedBody, name: str, youngs_modulus: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the rest points [m] of a soft region, shape (count, 3), and the stiffness [N/m] it was built for.

    Raises:
        ConfigError: If the region is unknown or exact.
    """
    if name not in body.regions.names:
        raise ConfigError(f"body {body.name!r} has no region {name!r}", hint=f"it has {list(body.regions.names)}")
    stiffness = float(body.regions.stiffness[body.regions.names.index(name)])
    if stiffness == 0.0:
        raise ConfigError(f"region {name!r} is held exactly and needs no pins", hint="move it with drive_regions")
    rows = body.regions.rows(name)
    rows = rows[body.regions.weights[rows] > 0.0]
    return body.regions.points[rows], stiffness * youngs_modulus * body.regions.weights[rows]


def _coordinates(builder: newton.ModelBuilder, instance: int, body: ReducedBody) -> np.ndarray:
    """Return the initial coordinates of an instance [m], shape (function_count, 3)."""
    start = attribute_values(builder, "function_start")[instance]
    return np.array(
        [[float(x) for x in q] for q in attribute_values(builder, "q")[start : start + body.function_count]]
    )


def warn_untold_pins(model: newton.Model, layout: Layout) -> None:
    """Warn of every body of which pins hold more than 2 % of the surface outside the regions that its build knew.

    Smooth functions cannot stand still in one part and move beside it: such a body is too stiff, and stiffer springs
    make it stiffer still.
    """
    data = soft(model)
    if not layout.pin_max:
        return
    owner, point, stiffness = (getattr(data, f"pin_{name}").numpy() for name in ("instance", "point", "stiffness"))
    told: set[tuple[int, bytes]] = set()
    for instance in np.unique(owner[stiffness > 0.0]):
        asset, X = int(layout.asset[instance]), point[(owner == instance) & (stiffness > 0.0)]
        if (key := (asset, X.tobytes())) in told:
            continue
        told.add(key)
        share = untold_share(layout.bodies[asset], X)
        if share > UNTOLD_SHARE:
            warnings.warn(
                f"pins hold {share:.0%} of the surface of body {layout.bodies[asset].name!r} (instance {instance}), "
                "which was not built to be held there, and is too stiff; build it with regions=[Region(...)], or use "
                "softmode.deformables.hold(body, Region(...))",
                UserWarning,
                stacklevel=4,
            )


def untold_share(body: ReducedBody, points: np.ndarray, reach: float = 0.0) -> float:
    """Return the fraction of a body's surface that points hold, except in regions that its build knew.

    Args:
        body: The body.
        points: Held points of its rest frame [m], shape (N, 3).
        reach: How far a point holds what is around it [m], at least the distance between samples of the surface.
    """
    spacing = float(np.sqrt(body.surface.areas.mean()))
    for region in body.regions.parts:
        points = points[region.distance(points)[0] > spacing]
    if not len(points):
        return 0.0
    apart = KDTree(points).query(body.surface.points)[0]
    return float(body.surface.areas[apart <= max(spacing, reach)].sum() / body.surface.areas.sum())
