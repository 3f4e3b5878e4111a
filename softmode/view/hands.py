"""What a person holds in a live session: the drag and the pins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from softmode.checks import require_number
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.rkpm import sample_farthest
from softmode.deformables.tools.grips import Grip, Grips
from softmode.errors import ConfigError
from softmode.scenes.scene import Scene
from softmode.view.live_types import DragView, Hit, LiveOptions, PinView, finite_vector

KeptPin = tuple[int, Grip, NDArray[np.float64], NDArray[np.float64]]
"""The object of a pin, the grip, its position [m] and rotation, a quaternion xyzw."""
PIN_RADIUS = 0.1
"""How far a pinned region reaches if nothing is said, as a fraction of the object's size."""


class Hands:
    """The drag and the pins, as grips of the objects of a scene; see `LiveSession` for what the methods do.

    Args:
        options: How the session runs.
    """

    def __init__(self, options: LiveOptions) -> None:
        """Hold nothing."""
        self._options, self._next = options, 1
        self._pins: dict[int, tuple[int, int]] = {}
        self._own: set[int] = set()  # pins that a scene holds by itself; numbers are not used twice
        self._drag: tuple[int, int, NDArray[np.float64]] | None = None
        self.moved = False
        """Whether a step has been taken since the drag began."""

    def take_up(self, scene: Scene) -> None:
        """Start over with a scene; what it holds by itself is a pin."""
        self._scene, self._drag = scene, None
        self._pins.clear()
        for index, grips in enumerate(scene.grips):
            for grip in grips.held:
                self._add(index, grip)
        self._own.update(self._pins)

    @property
    def busy(self) -> bool:
        """Whether anything is held."""
        return self._drag is not None or bool(self._pins)

    @property
    def dragging(self) -> bool:
        """Whether something is dragged."""
        return self._drag is not None

    def let_go(self) -> None:
        """Let go of everything."""
        for grips in self._scene.grips:
            grips.let_go_all()
        self._pins.clear()
        self._drag = None

    def kept(self) -> dict[int, KeptPin]:
        """Return the pins with object, position and rotation, for `hold_again`."""
        pins = self._pins.items()
        return {
            number: (index, self._scene.grips[index].held[grip], *self._scene.grips[index].pose(grip))
            for number, (index, grip) in pins
        }

    def hold_again(self, kept: dict[int, KeptPin], before: Sequence[ReducedBody], came_from: Sequence[int]) -> None:
        """Hold other builds of the objects, or parts of them, by the pins that they had, and by nothing else.

        A pin whose points are in several parts keeps the part that has most of them.

        Args:
            kept: The pins.
            before: The bodies that they held.
            came_from: Of each object now, which of these it is or is a part of.
        """
        self.let_go()
        for number, (index, grip, position, rotation) in kept.items():
            X = grip.rest_points + before[index].offset
            owners = [k for k, origin in enumerate(came_from) if origin == index]
            bodies = [self._scene.grips[k].body for k in owners]
            places = [np.concatenate([body.surface.points, body.cubature.points]) + body.offset for body in bodies]
            nearest = np.argmin([KDTree(place).query(X)[0] for place in places], axis=0)
            most = int(np.bincount(nearest).argmax())
            mine = nearest == most
            moved = replace(grip, rest_points=X[mine] - bodies[most].offset, offsets=grip.offsets[mine])
            self._pins[number] = (
                owners[most],
                self._scene.grips[owners[most]].restore(moved, position, rotation.tolist()),
            )

    # -- the drag -----------------------------------------------------------------------------------------------------

    def begin_drag(self, hit: Hit) -> None:
        """Pull a point."""
        self.end_drag()
        grips = self._grips(hit.object_index)
        grip = grips.take(hit.rest_point[None], self._scene.state, pulls=True)
        self._drag = (hit.object_index, grip, hit.point - grips.pose(grip)[0])
        self.moved = False

    def drag_to(self, point: ArrayLike) -> None:
        """Pull to a point."""
        if self._drag is None:
            raise ConfigError("nothing is dragged", hint="call begin_drag with a hit of pick")
        index, grip, offset = self._drag
        self._grips(index).aim(grip, finite_vector("point", point) - offset)

    def end_drag(self) -> None:
        """Stop pulling."""
        if self._drag is not None:
            self._grips(self._drag[0]).let_go(self._drag[1])
            self._drag = None

    def drag(self) -> DragView | None:
        """Return the drag."""
        if self._drag is None:
            return None
        index, grip, offset = self._drag
        grips = self._grips(index)
        return DragView(
            point=grips.points(grip, self._scene.state)[0] + offset,
            target=grips.pose(grip, goal=True)[0] + offset,
            force=grips.force(grip) if self.moved else np.zeros(3),
        )

    # -- pins ---------------------------------------------------------------------------------------------------------

    def pin(self, hit: Hit, radius: float | None) -> int:
        """Hold the region around a point."""
        grips = self._grips(hit.object_index)
        body = grips.body
        reach = PIN_RADIUS * float(np.linalg.norm(np.ptp(body.bounds, axis=0))) if radius is None else radius
        require_number("radius", reach, above=0.0, unit="m")
        if len(self._pins.keys() - self._own) >= self._options.pin_max:
            raise ConfigError(f"there are {self._options.pin_max} pins already", hint="let go of one first")
        X = np.concatenate([body.surface.points, body.cubature.points])
        distance = np.linalg.norm(X - hit.rest_point, axis=1)
        inside = np.argsort(distance)[: max(int((distance <= reach).sum()), 4)]
        spread = sample_farthest(X[inside], self._options.pin_points, first=0)
        return self._add(hit.object_index, grips.take(X[inside][spread], self._scene.state))

    def move_pin(self, pin: int, position: ArrayLike, wxyz: ArrayLike | None) -> None:
        """Move and turn a pinned region."""
        index, grip = self._pin(pin)
        turn = None
        if wxyz is not None:
            w, x, y, z = unit_quaternion(wxyz)
            turn = (x, y, z, w)
        self._grips(index).aim(grip, finite_vector("position", position), turn)

    def unpin(self, pin: int) -> None:
        """Let a region go."""
        index, grip = self._pin(pin)
        self._grips(index).let_go(grip)
        del self._pins[pin]

    def pins(self) -> dict[int, PinView]:
        """Return the pins."""
        found = {}
        for number, (index, grip) in self._pins.items():
            grips = self._grips(index)
            position, (x, y, z, w) = grips.pose(grip)
            points = grips.points(grip, self._scene.state)
            error = float(np.linalg.norm(points - grips.targets(grip), axis=1).max())
            found[number] = PinView(
                position=position, wxyz=np.array([w, x, y, z]), points=points, error=error, object_index=index
            )
        return found

    # -- inside -------------------------------------------------------------------------------------------------------

    def _grips(self, index: int) -> Grips:
        require_number("object_index", index, at_least=0, at_most=len(self._scene.grips) - 1)
        return self._scene.grips[index]

    def _pin(self, pin: int) -> tuple[int, int]:
        if pin not in self._pins:
            raise ConfigError(f"there is no pin {pin}", hint=f"there are {sorted(self._pins)}")
        return self._pins[pin]

    def _add(self, index: int, grip: int) -> int:
        number = self._next
        self._next += 1
        self._pins[number] = (index, grip)
        return number


def unit_quaternion(wxyz: ArrayLike) -> list[float]:
    """Return a quaternion of length one.

    Raises:
        ConfigError: If it is not four finite numbers, or all are zero.
    """
    numbers = finite_vector("wxyz", wxyz, 4)
    length = float(np.linalg.norm(numbers))
    if not length > 1e-9:
        raise ConfigError(f"wxyz must be four finite numbers, not all zero, got {wxyz!r}")
    return (numbers / length).tolist()
