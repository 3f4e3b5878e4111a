"""ShapeSoft: bend a soft post into a given shape and hold it there; goal-conditioned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.body.rkpm import sample_farthest
from softmode.deformables.model.structs import filled
from softmode.envs.markers import dots
from softmode.envs.observation import Segment, goal_part
from softmode.envs.parameters import Parameter
from softmode.envs.soft_env import SoftEnv
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.envs.task import Task
from softmode.envs.tasks.shape_soft import kernels
from softmode.envs.tasks.shape_soft.config import ShapeSoftConfig
from softmode.envs.tasks.shape_soft.goals import POINTS, ShapeGoals, reward_rules
from softmode.envs.tasks.shape_soft.targets import Press, ShapeTargets, record_press
from softmode.errors import ConfigError
from softmode.objects.loader import load
from softmode.objects.soft_object import SoftObject
from softmode.scenes.table_scene import Marker, TableScene
from softmode.splats.splats import Splats


class ShapeSoft(Task):
    """Bend the post so that its surface points lie where those of the target shape do, and hold it there.

    The targets are shapes that the arm has made: at construction it presses the post aside once, its surface is
    recorded over the displacement of the free end, and a target is that press turned about the vertical. Static shapes
    under a given displacement depend on stiffness only as far as weight matters, so that one press serves all.

    A state observation is a dict of ``observation``, ``achieved_goal`` and ``desired_goal``, the latter two the points
    [m] relative to the middle of the foot, on the table. The reward is a function of both goals, see
    `GoalMethods.compute_reward`. Terms: ``shape`` (0..1) and ``there`` (0 or 1), or ``there`` (-1 or 0) alone where it
    is sparse. Success: within the tolerance for ``hold_steps`` steps in a row.
    """

    config: ShapeSoftConfig
    config_class = ShapeSoftConfig
    step_kernels = (kernels.observe, kernels.evaluate)
    takes_sets = True
    term_names = tuple(kernels.Term.__members__)
    metric_names = tuple(kernels.Metric.__members__)
    point_count = POINTS
    goal_size = 3 * POINTS

    def build(self) -> None:
        """Record the targets."""
        scene = self.scene
        choices = range(len(scene.occupancy.choices))
        presses = [self._record(c) for c in choices]
        rests = [body.surface.points[chosen] for body, _, chosen in presses]
        self.goal_rests = tuple(rests)
        """Rest points of the targets in the frame of their body [m], one of shape (points, 3) per choice."""
        if scene.splats is not None:  # the marker shows the whole surface
            rests = [
                np.concatenate([rest, body.surface.points]) for rest, (body, *_) in zip(rests, presses, strict=True)
            ]
            shape = (self.world_count, scene.marker_points.shape[1])
            scene.marker_points = wp.zeros(shape, dtype=wp.vec3, device=self.device)
        pressed = [(body, press, rest) for (body, press, _), rest in zip(presses, rests, strict=True)]
        self.targets = ShapeTargets.from_presses(pressed, self.device)
        self.target = filled(kernels.Target, self.targets, choice=scene.occupancy.follow(choices, int))
        self.rules = reward_rules(self.config)

    def _record(self, choice: int) -> tuple[ReducedBody, Press, NDArray[np.intp]]:
        """Press what makes the targets of a choice of the scene; return its body, the press and the points chosen.

        Raises:
            ConfigError: If the arm does not bend it far enough; it names the object of a set.
        """
        scene, goal = self.scene, self.config.goal_object
        if self.config.object_set is not None or goal is not None:  # so that a target depends on its object alone
            alone = replace(
                self.scene_config(),
                object=goal or scene.occupancy.choices[choice].config,
                objects=None,
                material=scene.occupancy.materials[choice],
            )
            scene = TableScene(alone, device=self.device)
        body = scene.soft.body
        points = self.points_of_choices[choice]
        if goal is not None:
            points = sample_farthest(body.surface.points, POINTS, first=0)
        try:
            return body, record_press(scene, self.config.goal_displacement[1]), points
        except ConfigError as error:
            raise ConfigError(f"{self.scene.occupancy.names[choice]}: {error.message}", hint=error.hint) from error

    def parameters(self) -> tuple[Parameter, ...]:
        """Add the goal: displacement of the free end [m] and direction [rad]."""
        config = self.config
        low, high = zip(config.goal_displacement, config.goal_direction, strict=True)
        least, most = (0.0, -2.0 * np.pi), (config.goal_displacement[1], 2.0 * np.pi)
        return (*super().parameters(), Parameter(name="goal", low=low, high=high, least=least, most=most))

    def goal_segments(self) -> tuple[Segment, ...]:
        """The points of the target shape [m]."""
        return (Segment("desired_goal", self.goal_size, -2.0, 2.0),)

    def object_segments(self) -> tuple[Segment, ...]:
        """The points now [m]."""
        return goal_part(self.scene.controller.joint_count, self.goal_size)

    def observe(self) -> None:
        """Write both goals and the error."""
        shape = (self.world_count, self.point_count)
        self.launch(kernels.observe_points, [self.state, self.plan], [self.result], shape)
        super().observe()
        if self.scene.splats is not None:
            points, inputs = self.scene.marker_points, [self.state, self.plan, self.point_count]
            self.launch(kernels.shape_marker, inputs, [points, self.result], points.shape)

    def marker(self) -> Marker:
        """Return the surface of what makes the targets, or what draws that of an object; `observe` bends it."""
        goal = self.config.goal_object
        if goal is not None:
            return _surface(load(goal, material=self.config.scene.material))
        return _surface


def _surface(thing: SoftObject) -> Splats:
    """Return dots on the surface of an object."""
    return dots(thing.body.surface.points, 0.004, opacity=0.35)


class ShapeSoftEnv(ShapeGoals, SoftEnv[ShapeSoft]):
    """One arm, one soft post, one target shape; see :class:`ShapeSoft` and :class:`SoftEnv`."""


class ShapeSoftVectorEnv(ShapeGoals, SoftVectorEnv[ShapeSoft]):
    """Many worlds of it; see :class:`ShapeSoft` and :class:`SoftVectorEnv`."""
