"""Where everything stands in the solver's arrays: bases one after another, instances ordered by world, pins."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any

import newton
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.model.authoring import CONTACT_FIELDS, MATERIAL_FIELDS, body_key
from softmode.deformables.model.inner_offsets import inner_offsets
from softmode.deformables.model.lane_kernels import LANES, pad
from softmode.deformables.model.namespaces import SoftModel, soft
from softmode.deformables.model.struct_kernels import Basis, Instances
from softmode.deformables.model.tables import allocate, starts_of
from softmode.errors import ConfigError

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Counts of a model with reduced bodies."""

    bodies: tuple[ReducedBody, ...]
    """The distinct bodies."""
    asset: np.ndarray
    """Index into ``bodies`` per instance."""
    instance_world: np.ndarray
    """World per instance."""
    instance_start: np.ndarray
    """First instance of each world, and the end: shape (world_count + 1,)."""
    pin_count: np.ndarray
    """Pins per instance."""
    pair_max: int
    """Contacts that the samples of an instance may have with soft bodies; 0 where soft bodies never touch."""

    @property
    def instance_count(self) -> int:
        """Number of instances."""
        return len(self.asset)

    @property
    def world_count(self) -> int:
        """Number of worlds."""
        return len(self.instance_start) - 1

    @cached_property
    def block_count(self) -> int:
        """Blocks of eight functions per component, enough for the largest body."""
        return pad(max(body.function_count for body in self.bodies)) // LANES

    @property
    def stride(self) -> int:
        """Functions of an instance with their padding."""
        return LANES * self.block_count

    @cached_property
    def point_max(self) -> int:
        """Cubature points of the largest body."""
        return max(body.point_count for body in self.bodies)

    @cached_property
    def sample_max(self) -> int:
        """Surface samples of the largest body."""
        return max(body.surface_count for body in self.bodies)

    @cached_property
    def pin_max(self) -> int:
        """Pins of the instance with the most."""
        return int(self.pin_count.max(initial=0))

    @cached_property
    def first_pin_row(self) -> int:
        """Row of the first pin in ``basis.row``."""
        return sum(body.surface_count for body in self.bodies)

    @cached_property
    def part_count(self) -> int:
        """Bodies that share a linear system: all of a world where soft bodies may touch each other, else one."""
        return int(np.diff(self.instance_start).max()) if self.pair_max else 1

    @cached_property
    def size(self) -> Array:
        """Diagonal of the bounding box of each instance's asset [m]."""
        return np.array([_size(body) for body in self.bodies])[self.asset]


def lay_out(model: newton.Model, bodies: Sequence[ReducedBody], *, pair_max: int = 0) -> Layout:
    """Find where the bodies of a model stand.

    Args:
        model: Finalised model.
        bodies: Its bodies, in any order.
        pair_max: Contacts that the samples of an instance may have with soft bodies, in worlds where some may touch.

    Raises:
        ConfigError: If an instance uses a body that is not given, or instances or pins are out of order.
    """
    data = soft(model)
    keys = {body_key(body): a for a, body in enumerate(bodies)}
    wanted = data.body_key.numpy()
    missing = [int(k) for k in wanted if int(k) not in keys]
    if missing:
        raise ConfigError(
            f"{len(missing)} instance(s) of the model use a body that is not in bodies",
            hint="pass every ReducedBody given to add_reduced_body",
        )
    asset = np.array([keys[int(k)] for k in wanted])
    world = data.instance_world.numpy()
    if (world < 0).any() and model.world_count > 1:
        raise ConfigError("a reduced body lies outside all worlds", hint="add it to the builder that is replicated")
    world = np.maximum(world, 0)
    if (np.diff(world) < 0).any():
        raise ConfigError("instances are not ordered by world", hint="add bodies to one world before the next")
    counts = np.bincount(world, minlength=max(model.world_count, 1))
    crowded = bool((counts > 1).any()) or bool(data.self_contact.numpy().any())
    return Layout(
        bodies=tuple(bodies),
        asset=asset,
        instance_world=world,
        instance_start=np.append(starts_of(counts), len(world)),
        pin_count=_pin_count(data, len(asset)),
        pair_max=pair_max if crowded else 0,
    )


def lay_out_instances(model: newton.Model, layout: Layout) -> Instances:
    """Allocate where each instance finds its data; what follows from scale and density is computed later."""
    data, bodies, asset = soft(model), layout.bodies, layout.asset
    names = ("function_count", "driven_count", "point_count", "surface_count")
    functions, driven, points, samples = (np.array([getattr(body, name) for body in bodies]) for name in names)
    given: dict[str, Any] = {
        "world": layout.instance_world,
        "asset": asset,
        "function_count": functions[asset],
        "driven_count": driven[asset],
        "point_count": points[asset],
        "sample_count": samples[asset],
        "point_start": starts_of(points)[asset],
        "row_start": starts_of(samples)[asset],
        "pin_count": layout.pin_count,
        "pin_start": starts_of(layout.pin_count),
        "link_pin_count": np.zeros(len(asset), int),
    }
    if layout.pin_max:
        followers = data.pin_instance.numpy()[data.pin_body.numpy() >= 0]
        given["link_pin_count"] = np.bincount(followers, minlength=len(asset))
    for name in ("function_start", "particle_start", "material_model", *CONTACT_FIELDS, *MATERIAL_FIELDS):
        if name != "density":
            given[name] = getattr(data, name)
    return allocate(Instances, "instance", {"instance": len(asset)}, model.device, given=given)


def lay_out_bases(model: newton.Model, layout: Layout, contact_max: int) -> Basis:
    """Concatenate the bases of all bodies, padded to whole blocks of eight functions.

    Behind the rows of samples and pins are those that contact writes: at centres of pressure on shapes, ``contact_max``
    for each instance, then those of soft bodies that are touched.
    """
    bodies, stride, device = layout.bodies, LANES * layout.block_count, model.device

    def joined(name: str) -> Array:
        return np.concatenate([attrgetter(name)(body) for body in bodies])

    def padded(values: Sequence[np.ndarray]) -> np.ndarray:
        return np.concatenate([_padded(v, stride) for v in values])

    def across(gradients: Array) -> Array:
        """Return gradients (rows, functions, 3) as (block_count, rows, 3) blocks."""
        return gradients.reshape(len(gradients), -1, LANES, 3).transpose(1, 0, 3, 2)

    def blocks(values: Array) -> Array:
        return values.reshape(len(values), -1, LANES)

    pin_rows, pin_points = _pins(model, layout, stride)
    contact_rows = layout.instance_count * contact_max
    dynamic = np.zeros((contact_rows + layout.instance_count * layout.pair_max, stride))
    linear = np.zeros((len(bodies), stride, 4))
    for a, body in enumerate(bodies):
        linear[a, : body.function_count] = body.linear_coordinates
    inner = [inner_offsets(body.surface.points, body.surface.normals, _size(body)) for body in bodies]
    inner_rows = [
        body.evaluate(body.surface.points + offset)[0] - body.surface.basis
        for body, offset in zip(bodies, inner, strict=True)
    ]
    gradient = across(padded([body.cubature.grad_basis for body in bodies]))
    given: dict[str, Any] = {
        "gradient": gradient,
        "point_weight": joined("cubature.weights"),
        "stiffness_scale": joined("cubature.stiffness_scale"),
        "lame_ratio": np.concatenate([_lame_ratio(body) for body in bodies]),
        "mean": blocks(padded([body.mean_basis[None] for body in bodies])),
        "linear": linear,
        "row": blocks(np.concatenate([padded([body.surface.basis for body in bodies]), pin_rows, dynamic])),
        "row_point": np.concatenate([joined("surface.points"), pin_points, np.zeros((contact_rows, 3))]),
        "row_area": np.append(joined("surface.areas"), np.zeros(len(pin_points))),
        "inner_row": blocks(padded(inner_rows)),
        "inner_point": np.concatenate(inner),
        "row_normal": joined("surface.normals"),
        "row_gradient": across(padded([body.evaluate(body.surface.points)[1] for body in bodies])),
    }
    if device.is_cuda:
        given["gradient_across"] = gradient.transpose(1, 2, 0, 3)
    basis = allocate(Basis, {"gradient_across": "1 1 1"}, {}, device, given=given)
    basis.gradient_across = basis.gradient_across.transpose((2, 0, 1)) if device.is_cuda else basis.gradient
    return basis


def surface_stiffness(bodies: Sequence[ReducedBody]) -> np.ndarray:
    """Return Young's modulus at the surface samples of all bodies relative to the body's, shape (sample_total,).

    That of the nearest cubature point. Contact alone reads it, so that it is no part of ``Basis``: a CPU kernel copies
    its structs in every thread.
    """
    nearest = [KDTree(body.cubature.points).query(body.surface.points)[1] for body in bodies]
    return np.concatenate([body.cubature.stiffness_scale[index] for body, index in zip(bodies, nearest, strict=True)])


def _lame_ratio(body: ReducedBody) -> np.ndarray:
    """Return lambda / mu at the cubature points of a body relative to the body's, shape (point_count,)."""
    return body.cubature.lame_ratio if len(body.cubature.lame_ratio) else np.ones(body.point_count)


def _size(body: ReducedBody) -> float:
    """Return the diagonal of a body's bounds [m]."""
    return float(np.linalg.norm(np.ptp(body.bounds, axis=0)))


def _padded(values: np.ndarray, stride: int) -> np.ndarray:
    """Pad the function axis (the second) of basis values with zeros."""
    widths = [(0, 0)] * values.ndim
    widths[1] = (0, stride - values.shape[1])
    return np.pad(np.asarray(values, float), widths)


def _pin_count(data: SoftModel, instance_count: int) -> np.ndarray:
    """Return the number of pins of each instance."""
    owner = data.pin_instance.numpy() if hasattr(data, "pin_instance") else np.zeros(0, int)
    if len(owner) and (owner.min() < 0 or owner.max() >= instance_count):
        raise ConfigError(
            "a pin belongs to an instance that does not exist", hint="pass what add_reduced_body returned"
        )
    if (np.diff(owner) < 0).any():
        raise ConfigError("pins are not ordered by instance", hint="add the pins of one body before the next")
    return np.bincount(owner, minlength=instance_count)


def _pins(model: newton.Model, layout: Layout, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate the basis at the pins; return rows and rest points."""
    counts = layout.pin_count
    rows = np.zeros((int(counts.sum()), stride))
    points = soft(model).pin_point.numpy().reshape(-1, 3) if len(rows) else np.zeros((0, 3))
    known: dict[tuple[int, bytes], Array] = {}
    for a, start, count in zip(layout.asset, starts_of(counts), counts, strict=True):
        mine = slice(start, start + count)
        key = (int(a), points[mine].tobytes())
        if count and key not in known:
            known[key] = _padded(layout.bodies[a].evaluate(points[mine])[0], stride)
        if count:
            rows[mine] = known[key]
    return rows, points
