"""Splats of rigid bodies: robot links and things that carry a capture of their own instead of a mesh."""

from collections.abc import Sequence
from dataclasses import dataclass

import newton
import numpy as np
import warp as wp
from newton import ShapeFlags

from softmode.deformables.model.declare import launch
from softmode.errors import ConfigError
from softmode.splats.cameras import rigid_splats_kernels as kernels
from softmode.splats.raster.rasterizer import SplatArrays
from softmode.splats.splats import Splats, rotations_from_quats


@dataclass(frozen=True, kw_only=True)
class RigidSplats:
    """Splats that a rigid body carries in every world."""

    splats: Splats
    """The splats in a frame of their own."""
    body: str
    """Label of the body (all of it or its last part)."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where that frame lies in the frame of the body [m]."""
    quat: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Rotation xyzw from that frame to the frame of the body."""
    hide_meshes: bool = False
    """Do not draw the body's own shapes; they collide as before."""

    def __post_init__(self) -> None:
        """Check the rotation."""
        norm = float(np.linalg.norm(self.quat))
        if len(self.quat) != 4 or not (np.isfinite(norm) and norm > 1e-8):
            raise ConfigError(f"RigidSplats: quat is {self.quat}", hint="Pass a unit quaternion (x, y, z, w)")

    def in_body(self) -> Splats:
        """Return the splats in the frame of the body, view-dependent colour turned along."""
        return self.splats.transformed(rotation=rotations_from_quats(self.quat), translation=self.position)


class RigidSplatsSkin:
    """Moves the splats of rigid bodies: x = R X + t, Sigma = R S R^T, colours turned by R.

    Args:
        model: The model that holds the bodies. Its `shape_flags` lose VISIBLE for hidden shapes and its shape BVH is
            built anew; make this object before cameras and captured graphs.
        parts: The splats, each an object of its own.

    Raises:
        ConfigError: If there are no parts, or one names a body that some world lacks.
    """

    def __init__(self, model: newton.Model, parts: Sequence[RigidSplats]) -> None:
        """Upload the splats in the frames of their bodies."""
        if isinstance(parts, RigidSplats) or not parts:
            raise ConfigError("parts is empty or no list", hint="Pass a list of at least one RigidSplats")
        self.objects = tuple(part.in_body() for part in parts)
        """The splats in the frames of their bodies; append them to the objects of `SplatArrays.from_splats`."""
        self.device = model.device
        bodies = np.stack([world_bodies(model, part.body, "RigidSplats") for part in parts], axis=1)
        owner = np.repeat(np.arange(len(parts), dtype=np.int32), [splats.count for splats in self.objects])
        rest = SplatArrays.from_splats(self.objects, sh_degree=0, device=self.device)
        self._means, self._covariances = rest.means, rest.covariances
        self._owner = wp.array(owner, dtype=wp.int32, device=self.device)
        self._body = wp.array(bodies, dtype=wp.int32, device=self.device)
        hidden = [bodies[:, index] for index, part in enumerate(parts) if part.hide_meshes]
        if hidden:
            hide_shapes(model, np.concatenate(hidden))

    @property
    def count(self) -> int:
        """Number of splats of all parts."""
        return self._owner.shape[0]

    def launch(self, state: newton.State, arrays: SplatArrays, *, first_splat: int | None = None) -> None:
        """Write means, covariances and rotations of all worlds where the bodies are; capturable.

        Args:
            state: Where the bodies are.
            arrays: Splats of all objects, with means, covariances and, above degree 0, rotations per world.
            first_splat: Column where the parts begin; None if they are the last ones.

        Raises:
            ConfigError: If the arrays have not a row per world or too few columns.
        """
        worlds, total = self._body.shape[0], arrays.means.shape[1]
        first = total - self.count if first_splat is None else first_splat
        shapes = {arrays.covariances.shape, arrays.means.shape}
        if arrays.rotations.shape != (1, 1):  # read by nobody
            shapes.add(arrays.rotations.shape)
        if shapes != {(worlds, total)} or not 0 <= first <= total - self.count:
            raise ConfigError(
                f"splats of shape {' or '.join(map(str, sorted(shapes)))} do not hold {self.count} from column "
                f"{first} on in each of {worlds} worlds",
                hint="Build them by SplatArrays.from_splats([*soft, *skin.objects], world_count=model.world_count)",
            )
        rest = (self._means, self._covariances, self._owner, self._body)
        moved = (arrays.means, arrays.covariances, arrays.rotations)
        launch(self.device, kernels.move_rigid_splats, (worlds, self.count), *rest, state.body_q, first, *moved)


def world_bodies(model: newton.Model, label: str, what: str) -> np.ndarray:
    """Return the body of that label (all of it or its last part) in every world, int32, shape (world_count,).

    Raises:
        ConfigError: If a world has none or several; the message begins with `what`.
    """
    worlds = max(int(model.world_count), 1)
    named = [i for i, known in enumerate(model.body_label) if label in (known, known.rsplit("/", maxsplit=1)[-1])]
    body_world = model.body_world
    world = np.zeros(0, np.int32) if body_world is None or not named else body_world.numpy()[named]
    if len(named) == worlds == 1 or np.array_equal(world, np.arange(worlds)):
        return np.asarray(named, dtype=np.int32)
    raise ConfigError(
        f"{what}: {len(named)} bodies are called {label!r}, expected one in each of {worlds} worlds",
        hint=f"Known bodies: {', '.join(sorted(set(model.body_label))[:12])}",
    )


def hide_shapes(model: newton.Model, bodies: np.ndarray) -> None:
    """Make all shapes of the bodies invisible to cameras and viewers; they collide as before.

    Not for captured graphs: it reads from the device and builds the model's shape BVH anew.

    Args:
        model: The model.
        bodies: Indices of the bodies.
    """
    flags, carrier = model.shape_flags, model.shape_body
    if flags is None or carrier is None or model.shape_count == 0:
        return
    values = flags.numpy()
    values[np.isin(carrier.numpy(), bodies)] &= ~int(ShapeFlags.VISIBLE)
    flags.assign(values)
    model.bvh_build_shapes(model.state())
