"""Target shapes of a post that is bent: one press by the arm, recorded, and turned about the vertical."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.contact.dents import dent_weights
from softmode.errors import ConfigError
from softmode.scenes.table_scene import TableScene

DIRECTIONS = 24
"""Directions of the table; between them points are interpolated in the frame of the press."""
LEVELS = 12
"""Displacements of the table."""
_STEP = 0.0015
"""Tool travel per control step of a recorded press [m]."""
_MOVE, _SETTLE = 4, 6
"""Control steps of travel and of rest between two records."""


@dataclass(frozen=True)
class Press:
    """A press along y, recorded."""

    displacements: NDArray[np.float64]
    """Displacement of the free end [m], rising from 0, shape (records,)."""
    coordinates: NDArray[np.float64]
    """Reduced coordinates with the middle of the foot at x = y = 0 and the table at z = 0 [m], (records, n, 3)."""
    dents: NDArray[np.float64]
    """Dents of the surface samples [m], (records, surface_count, 3)."""


def record_press(scene: TableScene, displacement: float) -> Press:
    """Let the arm press the object of world 0 aside along y, with the fingers as they are; the scene is reset.

    Args:
        scene: A scene just built, its object between the open fingers.
        displacement: How far the free end is to move [m].

    Raises:
        ConfigError: If the arm does not bend it so far.
    """
    config, body = scene.config, scene.soft.body
    gripper, control = config.arm.gripper, config.control
    top = body.evaluate(np.array([[0.0, 0.0, body.surface.points[:, 2].max()]]))[0][0]
    action = np.zeros((scene.world_count, scene.controller.action_size), np.float32)
    action[:, -1] = 2.0 * config.arm.home_opening / gripper.stroke - 1.0
    start, first = (
        int(a.numpy()[0]) for a in (scene.model.softmode.function_start, scene.model.softmode.particle_start)
    )
    place = np.array([*config.object_position, 0.0])
    shift = np.outer(body.linear_coordinates[:, 3], place)

    def coordinates() -> NDArray[np.float64]:
        return scene.state.softmode.q.numpy()[start : start + body.function_count].astype(float) - shift

    def dented() -> NDArray[np.float64]:
        return scene.state.softmode.dent.numpy()[first : first + body.surface_count].astype(float)

    scene.reset()
    records, dents = [coordinates()], [dented()]
    moved, limit = 0.0, gripper.stroke + 1.5 * displacement
    ends = [0.0]
    while ends[-1] < displacement + 0.002:
        if moved > limit:
            raise ConfigError(
                f"the arm bends the object by {ends[-1]:.3f} m at most, not by {displacement} m",
                hint="lower goal_displacement, or start with the object between the fingers",
            )
        for k in range(_MOVE + _SETTLE):
            action[:, 1] = _STEP / control.translation_scale if k < _MOVE else 0.0
            scene.step(action)
        moved += _MOVE * _STEP
        now = coordinates()
        end = float(np.hypot(*(top @ (now - records[0]))[:2]))
        if end > ends[-1] + 1.0e-4:
            records.append(now)
            dents.append(dented())
            ends.append(end)
    scene.reset()
    return Press(np.array(ends), np.array(records), np.array(dents))


@dataclass(frozen=True)
class ShapeTargets:
    """Points of bent objects on the device."""

    points: wp.array
    """vec3, shape (objects, DIRECTIONS, LEVELS, points): where the press moved the rest points that were turned by
    direction j / DIRECTIONS of a turn, at level k / (LEVELS - 1) of the greatest displacement [m]. The last point is
    repeated where an object has fewer than another."""
    displacement_max: wp.array
    """The greatest displacement of each [m], float32, shape (objects,)."""

    @staticmethod
    def from_presses(
        presses: Sequence[tuple[ReducedBody, Press, NDArray[np.float64]]], device: wp.DeviceLike
    ) -> ShapeTargets:
        """Evaluate presses at rest points.

        Args:
            presses: Of each object: its body, what `record_press` returned, and rest points in the body frame [m],
                shape (N, 3).
            device: Warp device.
        """
        most = max(len(rest) for _, _, rest in presses)
        tables = [_bent(body, press, rest) for body, press, rest in presses]
        padded = [np.pad(t, ((0, 0), (0, 0), (0, most - t.shape[2]), (0, 0)), mode="edge") for t in tables]
        greatest = [press.displacements[-1] for _, press, _ in presses]
        points = wp.array(np.stack(padded), dtype=wp.vec3, device=device)
        return ShapeTargets(points, wp.array(greatest, dtype=float, device=device))


def _bent(body: ReducedBody, press: Press, rest: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return rest points where a press moves them, dents in [m], shape (DIRECTIONS, LEVELS, N, 3)."""
    displacement_max = float(press.displacements[-1])
    levels = np.linspace(0.0, displacement_max, LEVELS)
    table = np.empty((DIRECTIONS, LEVELS, len(rest), 3), np.float32)
    # reduced coordinates between two records: the shape between two shapes
    between = np.clip(np.searchsorted(press.displacements, levels, side="right") - 1, 0, len(press.displacements) - 2)
    low, high = press.displacements[between], press.displacements[between + 1]
    share = ((levels - low) / (high - low))[:, None, None]
    q, dents = (
        (1.0 - share) * values[between] + share * values[between + 1] for values in (press.coordinates, press.dents)
    )
    for j in range(DIRECTIONS):
        angle = 2.0 * np.pi * j / DIRECTIONS
        c, s = np.cos(angle), np.sin(angle)
        turned = rest @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        left = dent_weights(body, turned)
        seen = np.einsum("pn,kpnc->kpc", left.weights, dents[:, left.samples])
        table[j] = turned + np.einsum("pn,knc->kpc", body.evaluate(turned)[0], q) + seen
    return table
