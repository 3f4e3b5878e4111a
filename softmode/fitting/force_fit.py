"""`fit_force`: Young's modulus from forces over a way, of a ball that presses an object or of two jaws."""

from __future__ import annotations

from dataclasses import dataclass, replace

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares

from softmode.checks import require_number, require_numbers
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import add_reduced_body
from softmode.deformables.model.status import WORLD_COLLAPSED, WORLD_CONTACT_OVERFLOW, WORLD_NOT_FINITE, status_reasons
from softmode.deformables.model.tables import present
from softmode.errors import ConfigError, FitError, SolverDiverged
from softmode.fitting.estimates import Estimate, Fitted, floor_of
from softmode.fitting.tables import ForceLog
from softmode.fitting.worlds import FitWorlds
from softmode.objects.frame import in_body
from softmode.objects.soft_object import SoftObject

Array = NDArray[np.float64]
START = 1.0e5
"""Young's modulus of the run [Pa]: without weight, forces go with it."""
DEPTHS = 8
"""Depths that are simulated, a world each."""
STEP, RAMP, REST = 0.01, 40, 40
"""Step [s], steps while it presses, and steps until it lies still."""
BALL = 0.12
"""Standard deviation of ln E that the contact of a ball leaves: against Hertz's law."""
FAILED = WORLD_CONTACT_OVERFLOW | WORLD_NOT_FINITE | WORLD_COLLAPSED
"""Status of a world whose force is none."""
FOAM = 0.15
"""Relative change of E over the depth from which on one E does not fit."""


@dataclass(frozen=True, kw_only=True)
class Press:
    """A ball that presses an object on a table, or two jaws with the object between them."""

    point: tuple[float, float, float] | None = None
    """Where the ball presses, in the axes of the object's file [m]."""
    radius: float = 0.006
    """Of the ball [m]."""
    between: int | None = None
    """Axis along which jaws close, 0 to 2."""

    def __post_init__(self) -> None:
        """Refuse what is neither a ball nor two jaws."""
        if (self.point is None) == (self.between not in (0, 1, 2)):
            hint = "give --press X Y Z --radius R, or --between y"
            raise ConfigError("a force log, and not one way in which it was taken", hint=hint)
        if self.point is not None:
            require_numbers("press", self.point, 3)
        require_number("radius", self.radius, above=0.0, unit="m", hint="give it like 0.006")

    def forces(self, body: ReducedBody, material: Material, depths: Array, device: wp.DeviceLike = None) -> Array:
        """Return the forces at depths [m], each in a world of its own [N], shape (D,).

        Raises:
            ConfigError: If the point is not near the object.
            SolverDiverged: If a depth is more than the body can be pressed.
        """
        low, high = body.surface.points.min(axis=0), body.surface.points.max(axis=0)
        wide = 2.0 * float((high - low).max())
        world, builder = newton.ModelBuilder(), newton.ModelBuilder()
        add_reduced_body(world, body, material=replace(material, mass_damping=20.0))
        press = world.add_body(is_kinematic=True, xform=wp.transform((0.0, 0.0, 10.0 * wide), wp.quat_identity()))
        config = newton.ModelBuilder.ShapeConfig(mu=1.0)
        plate = {"hx": wide, "hy": wide, "hz": wide, "cfg": config}
        axis = np.eye(3)[2 if self.between is None else self.between]
        behind = 0.5 * (low + high) - axis * (0.5 * float((high - low) @ axis) + wide)
        world.add_shape_box(-1, xform=wp.transform(tuple(behind), wp.quat_identity()), **plate)
        if self.point is not None:
            start, toward = self._contact(body, self.point)
            world.add_shape_sphere(press, radius=self.radius, cfg=config)
        else:
            start, toward = low + high - behind, -axis
            world.add_shape_box(press, **plate)
        builder.replicate(world, len(depths))
        worlds = FitWorlds(builder.finalize(device=device), body, dt=STEP)
        # the file has the object as it rests, and forces are those beyond its weight
        worlds.model.set_gravity((0.0, 0.0, 0.0))
        poses = present(worlds.pair[0].body_q).numpy()
        poses[:, 3:] = (0.0, 0.0, 0.0, 1.0)

        def place(share: float) -> None:
            poses[:, :3] = start + toward * (share * depths)[:, None]
            for state in worlds.pair:
                present(state.body_q).assign(poses)

        place(0.0)
        worlds.reset()
        for k in range((RAMP + REST) // 2):
            place(min(1.0, (2 * k + 2) / RAMP))
            worlds.step_twice()
        for depth, bits in zip(depths, worlds.solver.status.numpy(), strict=True):
            if bits & FAILED:
                what = f"{1e3 * depth:.3g} mm deep: {', '.join(status_reasons(int(bits)))}"
                raise SolverDiverged(what, hint="check the units of the depths, the place and the size of the object")
        return -(worlds.solver.body_wrench.numpy().reshape(len(depths), -1)[:, :3] @ toward)

    def _contact(self, body: ReducedBody, place: ArrayLike) -> tuple[Array, Array]:
        """Return where the ball's centre is when it touches a place of the file, and its way, in the body frame."""
        point = in_body(body, place)
        off = np.linalg.norm(body.surface.points - point, axis=1)
        nearest = int(off.argmin())
        size = float(np.ptp(body.bounds, axis=0).max())
        if off[nearest] > 0.15 * size:
            hint = "give a place on the surface, in metres, as softmode splat show draws them"
            raise ConfigError(f"press: {self.point} lies {off[nearest]:.3g} m from the object", hint=hint)
        near = off < max(self.radius, 1.5 * off[nearest])
        normal = body.surface.normals[near].mean(axis=0)
        normal /= np.linalg.norm(normal)
        # the ball touches where the first sample does
        away = body.surface.points[near] - point
        along = away @ normal
        aside = np.linalg.norm(away - along[:, None] * normal, axis=1)
        reach = along + np.sqrt(np.maximum(self.radius**2 - np.minimum(aside, self.radius) ** 2, 0.0))
        return point + normal * float(reach.max()), -normal


def _curve(depths: Array, forces: Array, wanted: Array) -> Array:
    """Return forces at wanted depths, by monotone cubics through none and those at some depths."""
    curve = PchipInterpolator(np.append(0.0, depths), np.append(0.0, forces))
    return curve(np.clip(wanted, 0.0, depths[-1]))


def fit_force(
    thing: SoftObject, log: ForceLog, press: Press, *, material: Material, device: wp.DeviceLike = None
) -> Fitted:
    """Fit Young's modulus to forces: the body's forces go with it, so that one run finds it.

    Args:
        thing: The object, free, with samples as fine as what touches.
        log: The forces.
        press: What presses.
        material: Poisson's ratio and density; the rest is where the fit begins.
        device: Warp device.

    Raises:
        ConfigError: If the log has openings and a ball presses, or the ball is not near the object.
        FitError: If no depth is pressed at which the body resists, or one between jaws is all of the object.
        SolverDiverged: If a depth is more than the body can be pressed.
    """
    axis = press.between
    extent = float(np.ptp(thing.body.surface.points, axis=0)[axis]) if axis is not None else 0.0
    if log.opening and axis is None:
        raise ConfigError("the log has openings, and nothing is between jaws", hint="give --between x, y or z")
    way = extent - log.way if log.opening else log.way
    pressed = (way > 0.0) & (log.force > 0.0)
    if pressed.sum() < 4:
        what = f"{log.source}: {int(pressed.sum())} forces at depths > 0"
        raise FitError(what, hint="count the depth from the first touch, and check the size of the object")
    way, force = way[pressed], log.force[pressed]
    if axis is not None and way.max() >= extent:
        what = f"{log.source}: {1e3 * way.max():.3g} mm of an object that is {1e3 * extent:.3g} mm thick there"
        raise FitError(what, hint="check the unit of the way and the size of the object")
    depths = way.max() * np.linspace(0.15, 1.0, DEPTHS)
    made = press.forces(thing.body, replace(material, youngs_modulus=START), depths, device)
    if not made.max() > 0.0:
        raise FitError(f"{log.source}: nothing presses the body there", hint="check the place and the depths")
    slack = 0.03 * float(way.max())

    def residuals(x: Array) -> Array:
        return np.append((np.exp(x[0]) * _curve(depths, made, way - x[1]) - force) / (0.03 * force.max()), x[1] / slack)

    found = least_squares(residuals, [0.0, 0.0], x_scale=[0.1, slack])
    factor, shift = float(np.exp(found.x[0])), float(found.x[1])
    modulus = START * factor
    inverse = np.linalg.inv(found.jac.T @ found.jac)
    spread = float(np.sqrt(inverse[0, 0] * max(2.0 * found.cost / max(len(way) - 2, 1), 0.1)))
    bar = float(np.hypot(spread, floor_of(thing) if press.point is None else BALL))
    estimate = Estimate.of_logarithm(np.log(modulus), bar, unit="Pa")
    curve = factor * _curve(depths, made, way - shift)
    shallow, deep = (
        modulus * float(force[part].sum() / max(curve[part].sum(), 1e-12))
        for part in ((way > 0.2 * way.max()) & (way < 0.5 * way.max()), way > 0.75 * way.max())
    )
    notes = [f"from {len(way)} forces up to {1e3 * way.max():.3g} mm"]
    if abs(np.log(max(deep, 1.0) / max(shallow, 1.0))) > FOAM and shallow > 0.0:
        law = "a foam that yields" if deep < shallow else "a foam that has closed"
        notes.append(
            f"no single E fits: {shallow / 1e3:.3g} kPa when it is pressed a little, {deep / 1e3:.3g} kPa at the end,"
            f" as {law} does"
        )
    details = {"depths": depths.tolist(), "forces": (factor * made).tolist(), "touch": shift}
    return Fitted.of(log, {"youngs_modulus": estimate}, material, notes, **details)
