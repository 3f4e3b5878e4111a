"""Configuration of ShapeSoft: its scene, goals and reward."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from softmode.checks import require_fields, require_number, require_range
from softmode.deformables.materials.material import Material
from softmode.deformables.reduction.options import BuildOptions
from softmode.envs.presets import RL_SOLVER
from softmode.envs.task_config import TaskConfig
from softmode.errors import ConfigError
from softmode.objects.config import ObjectConfig
from softmode.robots.arm import ArmDescription
from softmode.robots.control import ArmControlOptions
from softmode.scenes.table_scene import TableSceneConfig

POST = ObjectConfig(
    shape="cylinder",
    extents=(0.03, 0.03, 0.12),
    surface_count=240,
    contact_radius=0.0015,
    clamped_height=0.012,
    build=BuildOptions(mode_count=2, response_derivatives=0, cubature_count=96),
)
"""A soft post whose foot is fixed to the table; 0.7 mm (rms) from one of 49 functions when its end is bent by 84 mm."""
POST_MATERIAL = Material(youngs_modulus=2.0e5, density=300.0, friction=0.4)
"""Soft rubber foam."""


def shape_scene() -> TableSceneConfig:
    """Return the scene: the post between the open fingers."""
    return TableSceneConfig(
        object=POST,
        material=POST_MATERIAL,
        solver=RL_SOLVER,
        substeps=4,
        arm=ArmDescription(home_position=(0.45, 0.0, 0.09), home_opening=0.08),
        control=ArmControlOptions(workspace_lower=(0.33, -0.12, 0.08), workspace_upper=(0.57, 0.12, 0.20)),
    )


@dataclass(frozen=True, kw_only=True)
class ShapeSoftConfig(TaskConfig):
    """Goal and success of ShapeSoft."""

    scene: TableSceneConfig = field(default_factory=shape_scene)
    """Objects, robot and physics; the object is a cylinder that stands upright on a clamped foot."""
    position_range: tuple[float, float] = (0.01, 0.01)
    """Half-width of the post's random position in x and y [m]."""
    youngs_modulus_range: tuple[float, float] | None = (5.0e4, 1.0e6)
    """Range of the random Young's modulus [Pa], log-uniform; None keeps the scene's material."""
    strain_limit: float = 0.6
    """Largest principal strain of a safe success; bending the post to its goal takes up to 0.5."""
    goal_displacement: tuple[float, float] = (0.025, 0.06)
    """Range of the displacement of the free end in the target shape [m]."""
    goal_direction: tuple[float, float] = (-np.pi, np.pi)
    """Range of the direction in which it is bent, about z from the x axis [rad]."""
    reward_modes = ("dense", "sparse", "log_mass")
    terms_follow_mode = True
    reward_mode: str = "dense"
    """"dense": 1 - tanh(error / `reward_length`), and 1 more at the target; "sparse": 0 there and -1 elsewhere;
    "log_mass": as dense, with the distance of masses on a grid (:class:`softmode.mpm.MassLoss`), which needs no points
    that correspond."""
    goal_object: ObjectConfig | None = None
    """Another upright, clamped body of the same height, whose bends are the targets; None for the one that is bent.
    Only with "log_mass"."""
    reward_length: float = 0.02
    """Error of the shape that matters to the dense reward [m]."""
    goal_tolerance: float = 0.005
    """Error of the shape, root mean square over the points, that counts as at the target [m]."""
    log_mass_spacing: float = 0.03
    """Spacing of the grid of "log_mass" [m]; what is farther away than four cells is not felt."""
    log_mass_length: float = 0.5
    """Error that matters to its reward: root of the loss over that without a body, 0 at the target."""
    log_mass_tolerance: float = 0.25
    """Error that counts as at the target; points of another body that is bent alike are 0.2 apart."""
    hold_steps: int = 10
    """Control steps in a row at the target that make a success."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        super().__post_init__()
        goal = self.goal_object
        heights = self._heights()
        height = min(heights)
        if self.scale_range is not None:
            raise ConfigError(
                f"scale_range is {self.scale_range}", hint="a clamped object keeps its scale; leave it out"
            )
        if goal is not None and self.reward_mode != "log_mass":
            raise ConfigError(
                f"goal_object needs points that do not correspond, reward_mode is {self.reward_mode!r}",
                hint='take reward_mode="log_mass"',
            )
        if goal is not None and (
            goal.extents is None or any(goal.extents[2] != one for one in heights) or not goal.clamped_height > 0.0
        ):
            raise ConfigError(
                f"goal_object: expected extents of the same height, {heights} m, and clamped_height > 0, got "
                f"{goal.extents} and {goal.clamped_height}"
            )
        require_range("goal_displacement", self.goal_displacement, at_least=0.0, at_most=0.6 * height, unit="m")
        require_number("goal_displacement[1]", self.goal_displacement[1], above=0.0, unit="m")
        require_range("goal_direction", self.goal_direction, at_least=-np.pi, at_most=np.pi, unit="rad")
        require_fields(self, ("reward_length", "goal_tolerance"), above=0.0, at_most=0.1, unit="m")
        require_number("log_mass_spacing", self.log_mass_spacing, above=0.0, at_most=0.1, unit="m")
        require_fields(self, ("log_mass_length", "log_mass_tolerance"), above=0.0, at_most=1.0)
        require_fields(self, ("hold_steps",), at_least=1)

    def _heights(self) -> list[float]:
        """Return how high the post is, or each of the set [m].

        Raises:
            ConfigError: If one is no post.
        """
        given, scene = self.object_set, self.scene
        if given is None:
            things = {"the object of ShapeSoft": scene.object}
        else:
            kinds = given.resolved(scene.object)
            things = {f"objects: {name}": kinds.config(k) for k, name in enumerate(given.names)}
        heights = []
        for name, thing in things.items():
            e = thing.extents
            if thing.shape != "cylinder" or e is None or e[0] != e[1] or not thing.clamped_height > 0.0:
                raise ConfigError(
                    f"{name} is a {thing.shape} {e}, clamped {thing.clamped_height} m high",
                    hint="give a cylinder with two equal horizontal extents and clamped_height > 0",
                )
            heights.append(e[2])
        return heights
