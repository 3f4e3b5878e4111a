"""Where objects are put down at a reset: by their parameters, and those of a set about object 0, none in another."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import numpy as np
import warp as wp

from softmode.deformables.model.declare import launch
from softmode.deformables.model.structs import filled
from softmode.envs import task_kernels as kernels
from softmode.envs.parameters import Parameter, ParameterTable
from softmode.envs.task_config import TaskConfig
from softmode.errors import ConfigError
from softmode.scenes.occupancy import Occupancy
from softmode.scenes.table_scene import GAP, TABLE_PLACE, TABLE_SIZE, TableScene

BASE = 0.12
"""Half of the edges of the square about the robot's base in which nothing lies [m]."""


@dataclass(frozen=True, kw_only=True)
class Arcs:
    """Directions from object 0 in which others may lie."""

    ranges: tuple[tuple[float, float], ...] = ()
    """Ranges of the direction, from the x axis about z [rad]; none for all around, turned at random."""
    aside: float = math.pi / 2
    """Angle between these ranges and the ways that are to stay free [rad], a right angle where there are none."""

    within: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Least and largest x and y of the centres [m]; None for all of the table."""


@dataclass(frozen=True)
class Place:
    """Where one of the objects lies, as seen from object 0."""

    angle: float
    """Middle of its direction [rad]."""
    play: float
    """By how much it may lie to either side [rad]."""
    distance: float
    """Least distance of the centres [m]."""


def ring_places(count: int, spacing: float, spread: float, arcs: Arcs) -> list[Place]:
    """Return places on rings about object 0, evenly on each, the nearest ring first.

    Args:
        count: How many.
        spacing: Least distance of two centres [m].
        spread: By how much each may lie farther from object 0 [m].
        arcs: Where they may lie.
    """
    ranges = arcs.ranges or ((-math.pi, math.pi),)
    distance = spacing / math.sin(min(arcs.aside, math.pi / 2))
    places: list[Place] = []
    while len(places) < count:
        half = math.asin(0.5 * spacing / distance)
        room = [max(1, int((b - a) / (2.0 * half) + 1.0e-9)) for a, b in ranges]
        given = [0] * len(ranges)
        for _ in range(min(sum(room), count - len(places))):
            free = [k for k in range(len(ranges)) if given[k] < room[k]]
            given[min(free, key=lambda k: given[k] / room[k])] += 1
        rows = [_row(a, b, number, half, distance) for (a, b), number in zip(ranges, given, strict=True)]
        places += [place for turn in zip_longest(*rows) for place in turn if place is not None]
        distance += spacing + spread
    return places


def _row(low: float, high: float, number: int, half: float, distance: float) -> list[Place]:
    """Return a number of places side by side in a range of directions; each takes `half` to either side [rad]."""
    width = (high - low) / max(number, 1)
    play = max(0.5 * width - (half if number > 1 else 0.0), 0.0)
    return [Place(low + (k + 0.5) * width, play, distance) for k in range(number)]


def clutter_parameters(config: TaskConfig, held: Occupancy, arcs: Arcs) -> tuple[Parameter, ...]:
    """Return what is drawn of the objects beside object 0: `others_turn`, and for each `other_place_k`, `other_yaw_k`.

    A place is a direction [rad], which the turn is added to, and a distance [m] from object 0.

    Args:
        config: The task's configuration.
        held: What the worlds hold; nothing is drawn where they have room for one object.
        arcs: Where the others may lie.

    Raises:
        ConfigError: If so many do not fit on the table.
    """
    count = held.slots - 1
    if not count:
        return ()
    scale = (config.scale_range or (1.0, 1.0))[1]
    radius = scale * max(float(np.linalg.norm(one.body.surface.points[:, :2], axis=1).max()) for one in held.choices)
    spread = 0.5 * config.others_clearance
    places = ring_places(count, 2.0 * radius + config.others_clearance, spread, arcs)
    _check_table(config, places, radius, spread, arcs)
    turn = 0.0 if arcs.ranges else math.pi
    made = [_number("others_turn", turn)]
    for k, place in enumerate(places, 1):
        low, high = (place.angle - place.play, place.distance), (place.angle + place.play, place.distance + spread)
        least, most = (-2.0 * math.tau, 0.0), (2.0 * math.tau, 0.6)
        made += [
            Parameter(name=f"other_place_{k}", low=low, high=high, least=least, most=most),
            _number(f"other_yaw_{k}", math.pi),
        ]
    return tuple(made)


def _number(name: str, half: float) -> Parameter:
    """Return an angle that is drawn from -half to half [rad]."""
    return Parameter(name=name, low=(-half,), high=(half,), least=(-math.tau,), most=(math.tau,))


def _check_table(config: TaskConfig, places: Sequence[Place], radius: float, spread: float, arcs: Arcs) -> None:
    """Refuse places that are not on the table, out of bounds, or in the robot's base.

    Args:
        config: The task's configuration.
        places: The places.
        radius: Of the largest object [m].
        spread: How far an object may lie beyond the least distance of its place [m].
        arcs: Where they may lie.
    """
    points = []
    for place in places:
        half = place.play if arcs.ranges else math.pi
        angles = place.angle + np.linspace(-half, half, 33)
        points.append((place.distance + spread) * np.column_stack([np.cos(angles), np.sin(angles)]))
    x = np.concatenate(points) + np.array(config.scene.object_position)
    play = np.array(config.position_range)
    on_table = np.abs(x - TABLE_PLACE[:2]) + play + radius <= TABLE_SIZE[:2]
    in_base = (np.abs(x) - play - radius < BASE).all(axis=1)
    fits = on_table.all() and not in_base.any()
    if arcs.within is not None:
        fits = fits and (x - play >= arcs.within[0]).all() and (x + play <= arcs.within[1]).all()
    if not fits:
        where = "on the table" if arcs.within is None else f"within x, y of {arcs.within[0]} to {arcs.within[1]} m"
        raise ConfigError(
            f"{len(places) + 1} objects of radius up to {radius:.3f} m do not fit {where}",
            hint="make objects.per_world, the objects, others_clearance or position_range smaller",
        )


class Placement:
    """Puts the objects of the worlds that are reset down, where their parameters say.

    Args:
        scene: The scene.
        table: The parameters.
        state: The task's `WorldState`.

    Attributes:
        heights: Heights of the centres of the unscaled objects at rest [m], shape (world_count, objects).
    """

    def __init__(self, scene: TableScene, table: ParameterTable, state: Any) -> None:
        """Find the heights and columns."""
        held = scene.occupancy
        others = [thing.height for thing in held.others]
        heights = [[*[thing.height] * held.slots, *others] for thing in held.choices]
        self.heights = held.follow(heights, every_slot=held.slots > 1)
        self._scene, self._table, self._state, self._beside = scene, table, state, held.slots - 1
        self._no_shift = wp.zeros(scene.world_count, dtype=float, device=scene.device)

    def put(
        self,
        index: int,
        position: str = "position",
        yaw: str = "yaw",
        *,
        ground: float = 0.0,
        turn: float = 0.0,
        shift: wp.array | None = None,
    ) -> None:
        """Put an object down; capturable.

        Args:
            index: Which object of a world.
            position: The parameter that says where its centre is [m].
            yaw: The one that says its rotation about the vertical [rad].
            ground: Height over the table of what it stands on [m].
            turn: What is added to the yaw [rad].
            shift: From the centre of the unscaled object to what lies at the position, along the yaw [m], shape
                (world_count,); None for the centre itself.
        """
        scene, names = self._scene, {"position": position, "yaw": yaw, "scale": "scale"}
        columns = {field: self._table.column(name) for field, name in names.items()}
        shift = self._no_shift if shift is None else shift
        given = {"turn": turn, "shift": shift, "gap": GAP + ground, "index": index, "height": self.heights}
        place = filled(kernels.Placement, **columns, **given)
        out = (scene.place_position, scene.place_yaw)
        launch(scene.device, kernels.place_object, scene.world_count, scene.world_mask, self._state, place, *out)

    def put_others(self) -> None:
        """Put the objects of a set beside object 0 down, about it; capturable."""
        if not self._beside:
            return
        scene, table = self._scene, self._table
        names = {"turn": "others_turn", "place": "other_place_1", "yaw": "other_yaw_1", "scale": "scale"}
        columns = {field: table.column(name) for field, name in names.items()}
        stride = table.column("other_place_2") - columns["place"] if self._beside > 1 else 0
        clutter = filled(kernels.Clutter, **columns, stride=stride, height=self.heights, gap=GAP)
        dim, out = (scene.world_count, self._beside), (scene.place_position, scene.place_yaw)
        launch(scene.device, kernels.place_beside, dim, scene.world_mask, self._state, clutter, *out)
