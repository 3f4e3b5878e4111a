"""What a live session runs: one object that hangs or falls, or an environment; both take blocks of captured steps.

Both have the same face: a scene, whose grips a person uses; `step` takes a block; `over` says when the next episode is
to begin; `marker_place` where the splats of a goal are.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import warp as wp

from softmode.checks import SEED_MAX, require_choice, require_number
from softmode.deformables.body.rkpm import sample_farthest
from softmode.deformables.materials.material import Material
from softmode.deformables.tools.grips import GripOptions
from softmode.errors import ConfigError, GraspError
from softmode.learning.players import check_policy, policy_factory, trained_policy
from softmode.objects.config import ObjectConfig
from softmode.objects.placed import Placed
from softmode.objects.soft_object import SoftObject
from softmode.scenes.fixture import Fixture
from softmode.scenes.splat_scene import SplatScene
from softmode.scenes.table_scene import TableScene
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.splats import Splats
from softmode.view.live_types import HoldName, LiveOptions, SceneName, Vector
from softmode.view.picture import goal_marker

BLOCK_STEPS = 2
"""Physics steps of a block of an object without an environment; even, there and back between two states."""
HELD_PART = 0.12
"""Part of its height by which a hanging object is held."""


def grips_of(options: LiveOptions) -> dict[str, Any]:
    """Return how many points of an object pins and the drag may need at a time, and how stiff the grips are."""
    slots = (options.pin_max + 1) * options.pin_points + 1  # what it hangs by is a pin more
    return {"grip_slots": slots, "grip_options": grips_strength(options)}


def grips_strength(options: LiveOptions) -> GripOptions:
    """Return how stiff the grips of a session are."""
    return GripOptions(pull_stiffness=options.drag_stiffness, pull_rate=options.drag_rate)


class ObjectScene:
    """One object, or the parts of one, held by a part of it or above a table.

    Args:
        found: The whole object, at the scale that it has.
        objects: What the scene holds instead: another build of the object, or the parts that it was cut into.
        scene: "hang" or "drop".
        hold: Which end a hanging object is held by.
        material: What it is made of.
        options: How the session runs.
        device: Warp device.

    Raises:
        ConfigError: If scene or hold are unknown.
    """

    def __init__(
        self,
        found: Placed,
        objects: Sequence[SoftObject],
        scene: SceneName,
        hold: HoldName,
        material: Material,
        options: LiveOptions,
        device: wp.DeviceLike,
    ) -> None:
        """Build model and solver, capture a block."""
        for name, value, known in (("scene", scene, SceneName), ("hold", hold, HoldName)):
            require_choice(name, value, get_args(known))
        thing, self.source, self._pin_points = found.object, found.object.config, options.pin_points
        stands = self.source is not None and self.source.clamped_height > 0.0  # its functions hold it by its foot
        self._hold: HoldName | None = hold if scene == "hang" and not stands else None
        self.marker: Splats | None = None
        self.viewpoints: Sequence[PinholeCamera] = ()
        self.terms: dict[str, float] = {}
        self.success, self.episode = False, 1
        self.block_steps = BLOCK_STEPS
        self.block_dt = options.substep * BLOCK_STEPS
        table = []
        if scene == "drop":
            half = 3.0 * found.scale * float(np.ptp(thing.body.bounds, axis=0).max())
            below = (0.0, 0.0, -0.1 * half)
            table = [Fixture(label="table", size=(half, half, 0.1 * half), position=below, color=(0.42, 0.48, 0.54))]
        height = float(thing.body.bounds[1, 2] - thing.body.bounds[0, 2])
        position = np.array([0.0, 0.0, found.scale * (thing.height + 0.6 * height)])
        placed = []
        for part in objects or [replace(thing, material=material)]:
            x, y, z = (position + found.scale * (part.body.offset - thing.body.offset)).tolist()
            placed.append(replace(found, object=part, position=(x, y, z)))
        given = {"dt": options.substep, "steps_per_frame": BLOCK_STEPS, **grips_of(options)}
        self.scene = SplatScene(table, placed, device=device, **given)
        self.step()  # compiles
        self.reset()

    def over(self, *, busy: bool) -> bool:
        """An object has no episodes."""
        return False

    def step(self) -> None:
        """Take a block."""
        self.scene.step()

    def reset(self) -> None:
        """Put the object back, and hold it again if it hangs."""
        self.scene.reset()
        if self._hold is not None:
            points = held_points(self.scene.objects[0], self._hold, self._pin_points)
            self.scene.grips[0].take(points, self.scene.state)

    def marker_place(self) -> tuple[Vector, Vector]:
        """Return no centres: there is no marker."""
        return np.zeros((0, 3)), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])

    def close(self) -> None:
        """Nothing is held open."""


def held_points(thing: SoftObject, hold: HoldName, count: int) -> Vector:
    """Return the surface samples by which a hanging object is held, spread over its top or base, shape (n, 3)."""
    sign = 1.0 if hold == "top" else -1.0
    X = thing.body.surface.points
    z = sign * X[:, 2]
    order = np.argsort(-z)
    chosen = order[: max(int((z > z.max() - HELD_PART * np.ptp(z)).sum()), 4)]
    return X[chosen[sample_farthest(X[chosen], count, first=0)]]


class EnvScene:
    """An environment that its policy plays.

    Args:
        name: Id of the environment.
        policy: Who plays; see :data:`softmode.learning.players.POLICIES`.
        config: The task's configuration; None for the default.
        seed: Seed of the first episode.
        options: How the session runs.
        device: Warp device.
        progress: Reports the build of the object.
        source: Another first object than the configuration's.

    Raises:
        ConfigError: If environment or policy are unknown, or the configuration is another task's.
    """

    def __init__(
        self,
        name: str,
        policy: str,
        config: Any,
        seed: int,
        options: LiveOptions,
        device: wp.DeviceLike,
        progress: Any,
        source: ObjectConfig | None = None,
    ) -> None:
        """Make the environment with slots for grips and begin an episode."""
        import gymnasium as gym

        from softmode.envs.catalogue import config_class
        from softmode.learning.config_values import config_of

        kind = config_class(name)
        if config is not None and not isinstance(config, kind):
            raise ConfigError(f"config is a {type(config).__name__}", hint=f"{name} takes a {kind.__name__}")
        require_number("seed", seed, at_least=0, at_most=SEED_MAX)
        check_policy(policy)
        trained = trained_policy(policy, name)
        given = dict(trained.env_options) if trained else {}
        learnt = config_of(kind, given.pop("config", {}))
        base = learnt if config is None else config
        changed = grips_of(options) if source is None else {**grips_of(options), "object": source}
        base = replace(base, scene=replace(base.scene, **changed))
        # with cameras, so that the goal's marker is kept up to date
        given |= {"config": base, "device": device, "progress": progress, "render_mode": "rgb_array"}
        self._env: Any = gym.make(name, **given, disable_env_checker=True)
        task = self._env.unwrapped.task
        self.scene: TableScene = task.scene
        self.block_steps = self.scene.config.substeps
        self.block_dt = 1.0 / self.scene.config.control_hz
        self.marker: Splats | None = goal_marker(task)
        self._ring = self.marker.means.astype(np.float64) if task.goal_ring and self.marker is not None else None
        self.viewpoints: Sequence[PinholeCamera] = task.render_cameras()
        self.config = base
        self._factory = policy_factory(policy, self._env, trained)
        self.seed, self.episode = seed, 0
        self._told = ""
        self.reset()

    @property
    def source(self) -> ObjectConfig | None:
        """What the first object is."""
        return self.config.scene.object

    def over(self, *, busy: bool) -> bool:
        """Return whether the episode has ended; its time limit waits while a person is busy, a failure does not."""
        return self._failed or (self._done and not busy)

    def step(self) -> None:
        """Take a control step."""
        try:
            action = self._policy(self._observation)
        except GraspError as error:  # the arm waits; the object may be pulled to where it can be grasped
            action = np.zeros(self._env.action_space.shape, np.float32)
            if str(error) != self._told:
                self._told = str(error)
                print(f"softmode: {error}", file=sys.stderr)
        self._observation, _, terminated, truncated, info = self._env.step(action)
        self._done, self._failed = terminated or truncated, terminated
        self.terms = dict(info["reward_terms"])
        self.success = bool(info["is_success"])

    def reset(self) -> None:
        """Begin the next episode."""
        self._observation, info = self._env.reset(seed=self.seed if self.episode == 0 else None)
        self._policy = self._factory(self.seed + self.episode)
        self.episode += 1
        self._done = self._failed = False
        self.terms = {name: 0.0 for name in info["reward_terms"]}
        self.success = bool(info["is_success"])

    def marker_place(self) -> tuple[Vector, Vector]:
        """Return the centres of the goal's marker and its pose."""
        if self.marker is None:
            return np.zeros((0, 3)), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        points, place = self.scene.marker_points, self.scene.marker_place
        rest = points.numpy()[0].astype(np.float64) if self._ring is None else self._ring
        return rest, place.numpy()[0].astype(np.float64)

    def close(self) -> None:
        """Close the environment."""
        self._env.close()


LiveScene = ObjectScene | EnvScene
"""What a session runs."""
