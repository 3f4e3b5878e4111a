"""PlaceInBin: put a soft toy, or several, into a bin that may hold other soft objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray

from softmode.checks import require_fields, require_number, require_numbers
from softmode.deformables.materials.material import Material
from softmode.deformables.reduction.options import BuildOptions
from softmode.envs.cameras import square_camera
from softmode.envs.episodes import FALL
from softmode.envs.observation import Segment
from softmode.envs.parameters import Parameter
from softmode.envs.placement import Arcs
from softmode.envs.presets import RL_SOLVER, gentle
from softmode.envs.soft_env import SoftEnv
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.envs.task import Task
from softmode.envs.task_config import TaskConfig
from softmode.envs.tasks.place_in_bin import kernels
from softmode.errors import ConfigError
from softmode.objects.config import ObjectConfig
from softmode.robots.arm import ArmDescription
from softmode.robots.control import ArmControlOptions
from softmode.scenes.table_scene import Fixture, TableSceneConfig
from softmode.splats.raster.pinhole import PinholeCamera

CLEARANCE = 0.015
"""Between the rim and the bottom of what is carried over it [m]."""
LIGHT = 5.0
"""Force of a finger that counts half in letting go [N]; in proportion for hands that may press with less."""
PACKED = 0.6
"""Most of the bin's volume that the bounding boxes of several toys may take."""
_BUILD = BuildOptions(mode_count=1, cubature_count=48)
TOY = ObjectConfig(
    shape="box",
    extents=(0.05, 0.05, 0.05),
    surface_count=150,
    build=BuildOptions(mode_count=3, cubature_count=128),
)
"""A soft die."""
BALL = ObjectConfig(
    shape="sphere",
    extents=(0.045, 0.045, 0.045),
    surface_count=80,
    colors=((0.25, 0.45, 0.80), (0.85, 0.88, 0.95)),
    build=_BUILD,
)
"""A soft ball."""
DISC = ObjectConfig(
    shape="cylinder",
    extents=(0.05, 0.05, 0.03),
    surface_count=80,
    colors=((0.75, 0.25, 0.45), (0.97, 0.85, 0.80)),
    build=_BUILD,
)
"""A soft disc."""


@dataclass(frozen=True, kw_only=True)
class Bin:
    """An open box on the table, its edges along x and y."""

    position: tuple[float, float] = (0.45, 0.14)
    """Where its centre is [m]."""
    inner: tuple[float, float] = (0.16, 0.16)
    """Inner edges [m]."""
    height: float = 0.06
    """Height of the rim above the table [m]."""
    wall: float = 0.01
    """Thickness of the walls [m]."""
    floor: float = 0.004
    """Thickness of the floor [m]."""
    friction: float = 0.6
    """Coulomb coefficient of walls and floor."""
    color: tuple[float, float, float] = (0.30, 0.42, 0.36)
    """Its colour, sRGB."""

    def __post_init__(self) -> None:
        """Check the sizes."""
        require_numbers("bin: inner", self.inner, 2, at_least=0.02, at_most=0.5, unit="m")
        require_number("bin: height", self.height, above=0.0, at_most=0.3, unit="m")
        require_number("bin: floor", self.floor, above=0.0, below=self.height, unit="m")
        require_number("bin: wall", self.wall, at_least=0.002, at_most=0.05, unit="m")

    def fixtures(self) -> tuple[Fixture, ...]:
        """Return floor and walls."""
        (x, y), (a, b), t = self.position, (0.5 * self.inner[0], 0.5 * self.inner[1]), 0.5 * self.wall
        z = 0.5 * self.height
        boxes = {
            "floor": ((x, y, 0.5 * self.floor), (a, b, 0.5 * self.floor)),
            "near": ((x - a - t, y, z), (t, b + 2.0 * t, z)),
            "far": ((x + a + t, y, z), (t, b + 2.0 * t, z)),
            "right": ((x, y - b - t, z), (a, t, z)),
            "left": ((x, y + b + t, z), (a, t, z)),
        }
        return tuple(
            Fixture(label=f"bin/{name}", position=place, size=size, friction=self.friction, color=self.color)
            for name, (place, size) in boxes.items()
        )


def bin_scene() -> TableSceneConfig:
    """Return the scene without its bin: a die on the table, a ball and a disc for the bin."""
    return TableSceneConfig(
        object=TOY,
        others=(BALL, DISC),
        material=Material(youngs_modulus=1.0e5, poissons_ratio=0.3, density=300.0, friction=0.8),
        arm=ArmDescription(home_position=(0.43, 0.0, 0.18)),
        control=ArmControlOptions(workspace_lower=(0.25, -0.35, 0.022), workspace_upper=(0.65, 0.35, 0.40)),
        solver=RL_SOLVER,
        substeps=4,
        object_position=(0.43, -0.13),
        constraint_max=160,
        rigid_contact_max=64,
    )


@dataclass(frozen=True, kw_only=True)
class PlaceInBinConfig(TaskConfig):
    """Bin and success of PlaceInBin."""

    scene: TableSceneConfig = field(default_factory=bin_scene)
    """Objects, robot and physics, without the bin; `others` start inside it."""
    position_range: tuple[float, float] = (0.06, 0.06)
    """Half-width of the toy's random position in x and y [m]."""
    bin: Bin = field(default_factory=Bin)
    """The container."""
    other_range: tuple[float, float] = (0.045, 0.012)
    """Half-width of the random positions of the other objects in x and y [m], about places side by side along y."""
    rim_allowance: float = 0.02
    """Height over the rim below which the centre of an object in the bin, maybe upon others, counts as in [m]."""
    rest_speed: float = 0.03
    """Speed of the toy under which it counts as at rest [m/s]."""
    hold_steps: int = 10
    """Control steps in a row at rest in the bin, let go, that make a success."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        super().__post_init__()
        require_numbers("other_range", self.other_range, 2, at_least=0.0, unit="m")
        require_fields(self, ("rim_allowance",), at_least=0.0, at_most=0.1, unit="m")
        require_fields(self, ("rest_speed",), above=0.0, unit="m/s")
        require_fields(self, ("hold_steps",), at_least=1)

    def spots(self) -> tuple[tuple[float, float, float], ...]:
        """Return places over the middle of the bin, between its walls and over its rim."""
        return tuple((*self.bin.position, self.bin.height + up) for up in (0.03, 0.09))

    @classmethod
    def presets(cls) -> Mapping[str, Self]:
        """Return "plush", three plush toys, which cost more time, and "gentle"."""
        build = BuildOptions(mode_count=3, cubature_count=128)
        toy, other = (ObjectConfig(size=size, surface_count=160, build=build) for size in (0.07, 0.055))
        plush = cls(scene=replace(bin_scene(), object=toy, others=(other, other)))
        return {"plush": plush, "gentle": gentle(cls())}


class PlaceInBin(Task):
    """Put the toy into the bin, let it go, and leave the other objects in.

    Reward terms: ``reach`` (0..1, tool to toy), ``grasp`` (0 or 0.5, both fingers hold it), ``carry`` (0..3, how little
    of the way up, across and down is left while it is held), ``release`` (0..2, in or over the bin, how little the
    fingers squeeze, of what `squeeze_lead` lets them), ``rest`` (0 or 2, no finger touches anything, at rest, all other
    objects in the bin), ``gentle`` (at most 0, see `TaskConfig.care`). What is in or over the bin keeps ``reach`` and
    ``grasp``, held or not. Success: ``rest`` for ``hold_steps`` steps in a row. Failure: ``spilled``, another object
    is outside the bin's walls.

    Of several toys (`ObjectSet.per_world`) each earns its share of the terms, those in the bin and the first that is
    not; the figures are those of the latter. Success: all toys are in.
    """

    config: PlaceInBinConfig
    config_class = PlaceInBinConfig
    step_kernels = (kernels.observe, kernels.evaluate)
    grasps = True
    any_robot = True
    takes_sets = True
    takes_several = True
    term_names = tuple(kernels.Term.__members__)
    metric_names = tuple(kernels.Metric.__members__)

    def scene_config(self) -> TableSceneConfig:
        """Add the bin."""
        scene = super().scene_config()
        return replace(scene, fixtures=(*scene.fixtures, *self.config.bin.fixtures()))

    def build(self) -> None:
        """Check that everything starts where it has room."""
        given = self.config.bin
        self.rim = (*given.position, given.height)
        """Centre of the bin's opening [m]."""
        self.half = (0.5 * given.inner[0], 0.5 * given.inner[1])
        """Half of its inner edges [m]."""
        self.highest = given.height + self.config.rim_allowance
        """Height of its centre below which an object is in the bin [m]."""
        held = self.scene.occupancy
        toys = [thing.body.surface.points for thing in held.choices]
        others = [thing.body.surface.points for thing in held.others]
        self.wall, self.floor, self.margin, self.clearance = given.wall, given.floor, 0.3 * min(self.half), CLEARANCE
        self.light = LIGHT * min(self.config.scene.control.squeeze_lead, 1.0)
        radius = [[thing.radius] * held.slots for thing in held.choices]
        self.radius = held.follow(radius, every_slot=held.slots > 1)
        """From the centre of each unscaled toy to its farthest point [m], shape (world_count, slots)."""
        self.heights, self.dropped = self.placement.heights, -FALL
        self.column_other_offsets = 0  # where there are no others
        scale = (self.config.scale_range or (1.0, 1.0))[1]
        radii = [[scale * float(np.linalg.norm(x[:, :2], axis=1).max()) for x in each] for each in (toys, others)]
        self._check_room(max(radii[0]), radii[1])
        self._check_widths([scale * np.ptp(x[:, :2], axis=0) for x in toys])
        self._check_volume(max(float(np.prod(scale * np.ptp(x, axis=0))) for x in toys))

    def _check_widths(self, widths: list[NDArray[np.float64]]) -> None:
        """Refuse toys that lie in the bin neither along nor across; their horizontal widths are given [m].

        Raises:
            ConfigError: If there is one; it names the toy.
        """
        inner = np.sort(self.config.bin.inner)
        for name, width in zip(self.scene.occupancy.names, widths, strict=True):
            if (np.sort(width) > inner).any():
                raise ConfigError(
                    f"{name} is {width[0]:.3f} m by {width[1]:.3f} m wide and does not fit the bin",
                    hint="give it another size, leave it out of the set, or make bin.inner larger",
                )

    def _check_volume(self, volume: float) -> None:
        """Refuse more toys than the bin can hold.

        Args:
            volume: That of the largest toy's bounding box [m^3].
        """
        room = 4.0 * self.half[0] * self.half[1] * (self.highest - self.floor)
        slots = self.scene.occupancy.slots
        if slots > 1 and slots * volume > PACKED * room:
            raise ConfigError(
                f"{slots} toys of {1.0e6 * volume:.0f} cm^3 do not fit a bin of {1.0e6 * room:.0f} cm^3",
                hint="make objects.per_world or the toys smaller, or bin.inner larger",
            )

    def other_arcs(self) -> Arcs:
        """Return the half of the directions that leads away from the bin, as far as the tool reaches."""
        away = np.array(self.config.scene.object_position) - self.config.bin.position
        apart = np.abs(away) - 0.5 * np.array(self.config.bin.inner)
        axis = int(apart.argmax())
        middle = (0.5 * np.pi if axis else 0.0) + (np.pi if away[axis] < 0.0 else 0.0)
        control = self.config.scene.control
        within = (control.workspace_lower[:2], control.workspace_upper[:2])
        return Arcs(ranges=((middle - 0.5 * np.pi, middle + 0.5 * np.pi),), within=within)

    def _check_room(self, toy: float, others: list[float]) -> None:
        """Refuse objects that may start in each other or in a wall.

        Args:
            toy: Horizontal radius of the largest toy [m].
            others: Those of the other objects [m].
        """
        config, (a, b) = self.config, self.half
        dx, dy = config.other_range
        width = 2.0 * b / max(len(others), 1)
        fits = (
            all(dx + r <= a for r in others)
            and all(dy + r <= 0.5 * width for r in (*others[:1], *others[-1:]))
            and all(2.0 * dy + r + s <= width for r, s in pairwise(others))
        )
        if not fits:
            raise ConfigError(
                f"other objects with radii {np.round(others, 3).tolist()} m have no room in the bin",
                hint="make them, scale_range or other_range smaller, or bin.inner larger",
            )
        (x, y), (x_range, y_range) = config.scene.object_position, config.position_range
        apart = max(
            abs(x - self.rim[0]) - x_range - a - config.bin.wall, abs(y - self.rim[1]) - y_range - b - config.bin.wall
        )
        if apart < toy:
            hint = "move scene.object_position or bin.position, or make position_range smaller"
            raise ConfigError(f"a toy of radius {toy:.3f} m may start in the bin's wall", hint=hint)

    def parameters(self) -> tuple[Parameter, ...]:
        """Add place [m] and yaw [rad] of every other object."""
        config = self.config
        count = len(config.scene.others)
        (x, y), (a, b) = config.bin.position, config.bin.inner
        (dx, dy) = config.other_range
        more: list[Parameter] = []
        for k in range(count):
            middle = y + b * ((k + 0.5) / count - 0.5)
            more += [
                Parameter(
                    name=f"other_position_{k + 1}",
                    low=(x - dx, middle - dy),
                    high=(x + dx, middle + dy),
                    least=(x - 0.5 * a, y - 0.5 * b),
                    most=(x + 0.5 * a, y + 0.5 * b),
                ),
                Parameter(name=f"other_yaw_{k + 1}", low=(-np.pi,), high=(np.pi,), least=(-7.0,), most=(7.0,)),
            ]
        return (*super().parameters(), *more)

    def goal_segments(self) -> tuple[Segment, ...]:
        """The centre of the bin's opening, and the same from the tool [m]."""
        return (Segment("goal", 3, -2.0, 2.0), Segment("goal_offset", 3, -4.0, 4.0))

    def object_segments(self) -> tuple[Segment, ...]:
        """The way of the toy to the bin, and the other objects' centres from the toy's [m]."""
        count = len(self.config.scene.others)
        others = (Segment("other_offsets", 3 * count, -4.0, 4.0),) if count else ()
        return (Segment("object_goal", 3, -4.0, 4.0), *others)

    def place(self) -> None:
        """Put the toy on the table and the others into the bin."""
        super().place()
        for k in range(len(self.config.scene.others)):
            name = k + 1
            index = self.scene.occupancy.slots + k
            self.placement.put(index, f"other_position_{name}", f"other_yaw_{name}", ground=self.floor)

    def front_camera(self, name: str, edge: int) -> PinholeCamera:
        """Return the camera that looks over the rim into the bin, with pictures of `edge` x `edge` pixels."""
        return square_camera(name, edge, (0.98, 0.02, 0.52), (0.42, 0.022, 0.04), 0.70)


class PlaceInBinEnv(SoftEnv[PlaceInBin]):
    """One arm, a toy, a bin with other soft objects; see :class:`PlaceInBin` and :class:`SoftEnv`."""


class PlaceInBinVectorEnv(SoftVectorEnv[PlaceInBin]):
    """Many worlds of it; see :class:`PlaceInBin` and :class:`SoftVectorEnv`."""
