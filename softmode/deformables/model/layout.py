"""Where everything stands in the solver's arrays: bases one after another, instances ordered by world, pins, shapes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.model.authoring import CONTACT_FIELDS, MATERIAL_FIELDS, NAMESPACE, body_key
from softmode.deformables.model.inner_offsets import inner_offsets
from softmode.deformables.model.lane_kernels import LANES, pad, vec8, vec8d
from softmode.deformables.model.struct_kernels import Basis, Instances
from softmode.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Sizes and tables of a model with reduced bodies."""

    bodies: tuple[ReducedBody, ...]
    """The distinct bodies."""
    asset: np.ndarray
    """Index into ``bodies`` per instance."""
    instance_world: np.ndarray
    """World per instance."""
    instance_start: np.ndarray
    """First instance of each world, and the end: shape (world_count + 1,)."""
    block_count: int
    """Blocks of eight functions per component, enough for the largest body."""
    point_max: int
    """Cubature points of the largest body."""
    sample_max: int
    """Surface samples of the largest body."""
    pin_max: int
    """Pins of the instance with the most."""
    first_pin_row: int
    """Row of the first pin in ``basis.row``."""
    size: np.ndarray
    """Diagonal of the bounding box of each instance's asset [m]."""
    basis: Any
    """The bases, a :class:`softmode.deformables.model.struct_kernels.Basis`."""
    instances: Any
    """Offsets, counts and parameters, :class:`softmode.deformables.model.struct_kernels.Instances`; scale and what
    follows from it are filled in by :class:`softmode.deformables.model.sizes.Sizes`."""

    @property
    def instance_count(self) -> int:
        """Number of instances."""
        return len(self.asset)

    @property
    def world_count(self) -> int:
        """Number of worlds."""
        return len(self.instance_start) - 1


def lay_out(model: Any, bodies: Sequence[ReducedBody]) -> Layout:
    """Build the tables of a model.

    Raises:
        ConfigError: If an instance uses a body that is not given, or instances or pins are out of order.
    """
    data = getattr(model, NAMESPACE)
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
    stride = pad(max(body.function_count for body in bodies))

    pin_rows, pin_points, pin_count = _pins(model, bodies, asset, stride)
    device = model.device
    basis = _basis(bodies, stride, pin_rows, pin_points, device)
    instances = Instances()
    ends = {
        "point_start": [body.point_count for body in bodies],
        "row_start": [body.surface_count for body in bodies],
    }
    per_instance = {name: np.concatenate([[0], np.cumsum(sizes)[:-1]])[asset] for name, sizes in ends.items()}
    per_instance |= {
        "world": world,
        "asset": asset,
        "function_count": np.array([body.function_count for body in bodies])[asset],
        "driven_count": np.array([body.driven_count for body in bodies])[asset],
        "point_count": np.array([body.point_count for body in bodies])[asset],
        "sample_count": np.array([body.surface_count for body in bodies])[asset],
        "pin_count": pin_count,
        "pin_start": np.concatenate([[0], np.cumsum(pin_count)[:-1]]),
        "link_pin_count": _link_pins(model, pin_count),
    }
    for name, values in per_instance.items():
        setattr(instances, name, wp.array(values, dtype=int, device=device))
    for name in ("function_start", "particle_start", "material_model", *CONTACT_FIELDS, *MATERIAL_FIELDS):
        if name != "density":
            setattr(instances, name, getattr(data, name))
    return Layout(
        bodies=tuple(bodies),
        asset=asset,
        instance_world=world,
        instance_start=np.concatenate([[0], np.cumsum(counts)]),
        block_count=stride // LANES,
        point_max=max(body.point_count for body in bodies),
        sample_max=max(body.surface_count for body in bodies),
        pin_max=int(pin_count.max(initial=0)),
        first_pin_row=sum(body.surface_count for body in bodies),
        size=np.array([_size(body) for body in bodies])[asset],
        basis=basis,
        instances=instances,
    )


def _basis(
    bodies: Sequence[ReducedBody], stride: int, pin_rows: np.ndarray, pin_points: np.ndarray, device: Any
) -> Any:
    """Concatenate the bases of all bodies, padded to ``stride`` functions, in blocks of eight."""
    gradient = np.concatenate([_padded(body.grad_basis, stride) for body in bodies])
    gradient = gradient.reshape(len(gradient), -1, LANES, 3).transpose(1, 0, 3, 2)
    row = np.concatenate([*(_padded(body.surface_basis, stride) for body in bodies), pin_rows])
    mean = np.concatenate([_padded(body.mean_basis[None], stride) for body in bodies])

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(body, name) for body in bodies])

    def table(values: np.ndarray, dtype: Any, kind: Any = None) -> wp.array:
        return wp.array(np.ascontiguousarray(values, dtype=kind), dtype=dtype, device=device)

    basis = Basis()
    basis.gradient = basis.gradient_across = table(gradient, vec8, np.float32)
    if wp.get_device(device).is_cuda:
        basis.gradient_across = table(gradient.transpose(1, 2, 0, 3), vec8, np.float32).transpose((2, 0, 1))
    basis.point_weight = table(joined("weights"), wp.float64)
    basis.stiffness_scale = table(joined("stiffness_scale"), float, np.float32)
    basis.mean = table(mean.reshape(len(bodies), -1, LANES), vec8d)
    linear = np.zeros((len(bodies), stride, 4))
    for a, body in enumerate(bodies):
        linear[a, : body.function_count] = body.linear_coordinates
    basis.linear = table(linear, wp.vec4d)
    basis.row = table(row.reshape(len(row), -1, LANES), vec8, np.float32)
    basis.row_point = table(np.concatenate([joined("surface_points"), pin_points]), wp.vec3d)
    inner = [inner_offsets(body.surface_points, body.surface_normals, _size(body)) for body in bodies]
    inner_row = [
        body.evaluate(body.surface_points + offset)[0] - body.surface_basis
        for body, offset in zip(bodies, inner, strict=True)
    ]
    inner_row = np.concatenate([_padded(values, stride) for values in inner_row])
    basis.inner_row = table(inner_row.reshape(len(inner_row), -1, LANES), vec8, np.float32)
    basis.inner_point = table(np.concatenate(inner), wp.vec3d)
    basis.row_area = table(np.append(joined("surface_areas"), np.zeros(len(pin_points))), float, np.float32)
    return basis


def _size(body: ReducedBody) -> float:
    """Return the diagonal of a body's bounds [m]."""
    return float(np.linalg.norm(np.ptp(body.bounds, axis=0)))


def _padded(values: np.ndarray, stride: int) -> np.ndarray:
    """Pad the function axis (the second) of basis values with zeros."""
    widths = [(0, 0)] * values.ndim
    widths[1] = (0, stride - values.shape[1])
    return np.pad(np.asarray(values, float), widths)


def _pins(
    model: Any, bodies: Sequence[ReducedBody], asset: np.ndarray, stride: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evaluate the basis at the pins; return rows, rest points, and the number of pins per instance."""
    data = getattr(model, NAMESPACE)
    owner = data.pin_instance.numpy() if hasattr(data, "pin_instance") else np.zeros(0, int)
    points = data.pin_point.numpy().reshape(-1, 3) if len(owner) else np.zeros((0, 3))
    if len(owner) and (owner.min() < 0 or owner.max() >= len(asset)):
        raise ConfigError(
            "a pin belongs to an instance that does not exist", hint="pass what add_reduced_body returned"
        )
    counts = np.bincount(owner, minlength=len(asset)) if len(owner) else np.zeros(len(asset), int)
    if (np.diff(owner) < 0).any():
        raise ConfigError("pins are not ordered by instance", hint="add the pins of one body before the next")
    rows = np.zeros((len(owner), stride))
    known: dict[tuple[int, bytes], np.ndarray] = {}
    for i in range(len(asset)):
        mine = slice(counts[:i].sum(), counts[: i + 1].sum())
        key = (int(asset[i]), points[mine].tobytes())
        if counts[i] and key not in known:
            known[key] = _padded(bodies[asset[i]].evaluate(points[mine])[0], stride)
        if counts[i]:
            rows[mine] = known[key]
    return rows, points, counts


def _link_pins(model: Any, pin_count: np.ndarray) -> np.ndarray:
    """Return how many pins of each instance follow a rigid body."""
    data = getattr(model, NAMESPACE)
    if not pin_count.any():
        return np.zeros(len(pin_count), int)
    followers = data.pin_instance.numpy()[data.pin_body.numpy() >= 0]
    return np.bincount(followers, minlength=len(pin_count))
