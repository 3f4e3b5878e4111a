"""The configuration that all tasks have: scene, ranges of what is random, pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, Self, get_args

from softmode.checks import require_choice, require_number, require_numbers, require_range
from softmode.envs.disturbances import LIMITS, SIM_TO_REAL
from softmode.errors import ConfigError
from softmode.objects.object_set import ObjectSet
from softmode.scenes.table_scene import TableSceneConfig
from softmode.splats.cameras.camera_randomization import CameraRandomization

ObservationType = Literal["state", "pixels", "pixels_agent_pos"]
CameraName = Literal["front", "wrist"]
ImageOutput = Literal["depth", "segmentation"]
RewardMode = Literal["dense", "sparse"]

_RANGES: dict[str, dict[str, float]] = {
    "youngs_modulus_range": {"above": 0.0},
    "poissons_ratio_range": {"above": -1.0, "below": 0.5},
    "density_range": {"above": 0.0},
    "friction_range": {"at_least": 0.0},
    "scale_range": {"above": 0.49, "below": 2.01},
    **{f"{name}_range": {"at_least": least, "at_most": most} for name, (least, most) in LIMITS.items()},
}
"""Limits of the ranges that may be None."""

_SIZES = (0.005, 1.0)
"""Least and largest longest edge of a file's object on a table [m]."""


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """Scene, randomisation and pictures, common to all tasks."""

    heights_of_tips: ClassVar[bool] = False
    """Whether heights of home pose and workspace are meant for the tips of the fingers; those of another robot are then
    raised by how much longer its fingers are."""
    samples_for_tips: ClassVar[bool] = False
    """Whether objects get as many surface samples as it takes for finger tips not to sink in between them."""
    tool_stiffness: ClassVar[float | None] = None
    """Vertical stiffness that the drives of another robot are to have at its tool in the home pose [N/m]; None keeps
    them."""

    reward_modes: ClassVar[tuple[str, ...]] = get_args(RewardMode)
    """What `reward_mode` may be."""
    terms_follow_mode: ClassVar[bool] = False
    """Whether the reward's terms are those of the mode; else "sparse" pays 1 for success in place of their sum."""

    scene: TableSceneConfig = field(default_factory=TableSceneConfig)
    """Objects, robot and physics."""
    reward_mode: str = "dense"
    """"dense": the sum of the reward's terms; "sparse": 1 where the task counts as solved, 0 elsewhere."""
    objects: ObjectSet | None = None
    """Objects of which every world gets one, or several, in place of `scene.object`; material properties without a
    range are those of the object, E of a fitted one within its bars; the range of another property holds for all."""
    others_clearance: float = 0.03
    """With several objects per world (`ObjectSet.per_world`): room around each where they are put down [m]."""
    objects_one_hot: bool = False
    """Whether observations end with a number per object of the set: 1 for the one that is there, 0 for others; of
    several per world those of one after another."""
    position_range: tuple[float, float] = (0.05, 0.08)
    """Half-width of the object's random position in x and y [m]."""
    yaw_range: float = math.pi
    """Half-width of its random yaw [rad]."""
    youngs_modulus_range: tuple[float, float] | None = (2.0e4, 2.0e6)
    """Range of the random Young's modulus [Pa], log-uniform; None keeps the scene's material, as for all of these."""
    poissons_ratio_range: tuple[float, float] | None = None
    """Range of the random Poisson's ratio."""
    density_range: tuple[float, float] | None = None
    """Range of the random density [kg/m^3], log-uniform."""
    friction_range: tuple[float, float] | None = None
    """Range of the random friction coefficient of the object."""
    scale_range: tuple[float, float] | None = None
    """Range of the random size of the objects, as a factor."""
    action_delay_range: tuple[float, float] | None = None
    """Range of the random delay of actions [control steps]; of this and the six below None is off. What lies between
    two steps is interpolated."""
    observation_delay_range: tuple[float, float] | None = None
    """Range of the random delay of observations [control steps]; with a delay the last three actions are observed."""
    observation_noise_range: tuple[float, float] | None = None
    """Range of the noise of observations in every step: 1 is 2 mm, 1 mm for the tool, 2 mrad for joints, 0.2 N."""
    observation_bias_range: tuple[float, float] | None = None
    """Range of an error of observations that stays throughout an episode, in the same units."""
    gain_range: tuple[float, float] | None = None
    """Range of a factor of stiffness and damping of the drives."""
    drive_friction_range: tuple[float, float] | None = None
    """Range of a dry friction of the drives, as a share of their effort limits."""
    effort_range: tuple[float, float] | None = None
    """Range of a factor of those limits."""
    strain_limit: float = 0.3
    """Largest principal strain of an object for a success to be safe."""
    force_limit: float | None = None
    """Largest contact force on it [N]; None for 15 N, or three times what holds its weight, if that is more."""
    care: float = 0.0
    """What the reward of a step loses for rough handling, of tasks with the term ``gentle``: this times how far force
    or strain in it, whichever is a larger share of its limit, is beyond half of the limit."""
    terminate_when_rough: bool = False
    """Whether an episode ends, failed, where force or strain is beyond its limit: then rough hands earn no more."""
    camera: CameraName = "front"
    """Camera of pixel observations: one in front of the table, or one on the hand."""
    image_size: int = 96
    """Edge of a pixel observation [px]."""
    image_outputs: tuple[ImageOutput, ...] = ()
    """What pixel observations hold beside colours: "depth" [m], "segmentation" (int32, see ``SplatCamera.labels``)."""
    camera_randomization: CameraRandomization | None = None
    """Random pose, lens, light and colours of every episode."""
    render_size: int = 256
    """Edge of each half of a rendered frame [px]."""
    mesh_samples: int = 1
    """Rays per pixel for robot and table, in observations and renderings: 1, or 4 for smooth edges."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_choice("reward_mode", self.reward_mode, self.reward_modes)
        if self.objects is not None and not isinstance(self.objects, ObjectSet):
            raise ConfigError(f"objects is a {type(self.objects).__name__}", hint="give an ObjectSet([...])")
        if self.objects is not None and self.scene.objects is not None and self.objects != self.scene.objects:
            raise ConfigError("objects and scene.objects are two sets", hint="give one of them")
        if self.objects_one_hot and self.object_set is None:
            raise ConfigError("objects_one_hot without objects", hint="give objects=ObjectSet([...])")
        require_numbers("position_range", self.position_range, 2, at_least=0.0, unit="m")
        require_number("others_clearance", self.others_clearance, at_least=0.0, at_most=0.5, unit="m")
        require_number("strain_limit", self.strain_limit, above=0.0)
        require_number("care", self.care, at_least=0.0)
        if self.force_limit is not None:
            require_number("force_limit", self.force_limit, above=0.0, unit="N")
        require_number("yaw_range", self.yaw_range, at_least=0.0, unit="rad")
        for name, limits in _RANGES.items():
            if getattr(self, name) is not None:
                require_range(name, getattr(self, name), **limits)
        require_choice("camera", self.camera, get_args(CameraName))
        if not set(self.image_outputs) <= set(get_args(ImageOutput)):
            raise ConfigError(f"image_outputs is {self.image_outputs}", hint="name 'depth', 'segmentation' or nothing")
        require_number("image_size", self.image_size, at_least=36, at_most=640, unit="px")
        require_number("render_size", self.render_size, at_least=64, at_most=1024, unit="px")
        require_choice("mesh_samples", self.mesh_samples, (1, 4))
        for thing in (self.scene.object, *self.scene.others):
            hint = "a table and its gripper take 5 mm to 1 m; larger and smaller bodies are for scenes of your own"
            if thing.longest_edge is not None:
                low, high = _SIZES
                require_number("an object's size", thing.longest_edge, at_least=low, at_most=high, unit="m", hint=hint)

    @property
    def object_set(self) -> ObjectSet | None:
        """The objects of which every world gets one; None where all have the same."""
        return self.scene.objects if self.objects is None else self.objects

    def from_world(self, first: int) -> Self:
        """Return this for worlds from some world on: those of one process, or that world alone.

        Args:
            first: How many worlds come before.
        """
        given = self.object_set
        if given is None or not first:
            return self
        moved = replace(given, first_world=given.first_world + first)
        return replace(self, objects=moved, scene=replace(self.scene, objects=None))

    def spots(self) -> tuple[tuple[float, float, float], ...]:
        """Return places that a robot must reach beside the random ones [m]: the task does not move them."""
        return ()

    @classmethod
    def preset(cls, name: str) -> Self:
        """Return a named variant of the task; "sim_to_real" is one of every task.

        Raises:
            ConfigError: If there is none of that name.
        """
        if name == "sim_to_real":
            return cls(**SIM_TO_REAL)
        known = {"sim_to_real": None, **cls.presets()}
        if name not in known:
            names = ", ".join(map(repr, known))
            raise ConfigError(f"{cls.__name__} has no preset {name!r}", hint=f"there are: {names}")
        return known[name]

    @classmethod
    def presets(cls) -> Mapping[str, Self]:
        """Return the named variants of the task."""
        return {}
