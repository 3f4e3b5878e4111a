"""What separates a robot from its simulation: delays, noise and bias of what is seen, drives that differ."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import warp as wp

from softmode.deformables.model.declare import launch
from softmode.deformables.model.structs import filled
from softmode.envs import disturbance_kernels as kernels
from softmode.envs.observation import ObservationTable, Segment
from softmode.envs.parameters import Parameter, ParameterTable
from softmode.errors import ConfigError
from softmode.scenes.table_scene import TableScene

LIMITS = {
    "action_delay": (0.0, 30.0),
    "observation_delay": (0.0, 30.0),
    "observation_noise": (0.0, 100.0),
    "observation_bias": (0.0, 100.0),
    "gain": (0.1, 10.0),
    "drive_friction": (0.0, 0.9),
    "effort": (0.05, 10.0),
}
"""What the ranges of the disturbances may hold, by the names of the parameters, in the order of `Disturbed`."""
SIM_TO_REAL: dict[str, Any] = {
    "action_delay_range": (0.0, 2.0),
    "observation_delay_range": (0.0, 1.0),
    "observation_noise_range": (0.0, 1.0),
    "observation_bias_range": (0.0, 1.0),
    "gain_range": (0.8, 1.25),
    "drive_friction_range": (0.0, 0.02),
    "effort_range": (0.8, 1.2),
}
"""Fields of the preset "sim_to_real"."""
_EXACT = ("goal", "desired_goal", "command_lead", "command_turn", "command_opening", "object_one_hot", "other_present")
"""Segments that nothing measures: neither noise nor bias."""
_SCALES = {"tool_position": 1e-3, "tool_heading": 5e-3, "opening": 5e-4, "finger_force": 0.2, "joint_angles": 2e-3}
_SCALES |= {"object_velocity": 0.02, "arm": 1e-3, **dict.fromkeys(_EXACT, 0.0)}
"""Standard deviations at noise or bias 1 in the unit of the segment; 2 mm for those that are not named."""


def neutral(name: str) -> float:
    """Return the value of a disturbance that changes nothing."""
    return 1.0 if name in ("gain", "effort") else 0.0


def disturbance_parameters(config: Any) -> tuple[Parameter, ...]:
    """Return what is drawn for the disturbances if any is on; a reset may set delays up to the longest of the range."""
    given = {name: getattr(config, f"{name}_range") for name in LIMITS}
    if not any(given.values()):
        return ()
    made = []
    for name, (least, most) in LIMITS.items():
        low, high = given[name] or (neutral(name),) * 2
        most = high if "delay" in name else most
        made.append(Parameter(name=name, low=(low,), high=(high,), least=(least,), most=(most,)))
    return tuple(made)


def last_actions(config: Any, action_size: int) -> tuple[Segment, ...]:
    """Return the segment of the last three actions, the newest first, where something is delayed."""
    on = config.action_delay_range or config.observation_delay_range
    return (Segment("last_actions", 3 * action_size, -1.0, 1.0),) if on else ()


class Disturbances:
    """Delays, noise, bias and drives of all worlds; every method but the constructor is capturable.

    Args:
        scene: The scene.
        table: The parameters, those of `disturbance_parameters` among them.
        layout: The observation.
        limit: Control steps per episode, 0 for no limit.

    Raises:
        ConfigError: If a delay is as long as the episode.
    """

    def __init__(self, scene: TableScene, table: ParameterTable, layout: ObservationTable, limit: int) -> None:
        """Keep the default drives and allocate what is remembered."""
        model, worlds, device = scene.model, scene.world_count, scene.device
        acted, seen = (int(np.ceil(table.parameters[f"{what}_delay"].high[0])) for what in ("action", "observation"))
        if limit and max(acted, seen) >= limit:
            hint = f"give delays of less than {limit} steps, or longer episodes"
            raise ConfigError(f"a delay of {max(acted, seen)} control steps is as long as the episode", hint=hint)
        self._table, self._layout, self._scene_actions, self._rigid = table, layout, scene.actions, scene.solver.rigid
        self._device, self._worlds = device, worlds
        scale = np.zeros(len(layout.low), np.float32)
        for name, (columns, _) in layout.segments.items():
            scale[columns] = _SCALES.get(name, 2e-3)
        shapes = {"actions": (max(acted + 1, 3), scene.actions.shape[1]), "seen": (seen + 1, len(scale))}
        self._kept = {name: wp.zeros((worlds, *shape), dtype=float, device=device) for name, shape in shapes.items()}
        self._kept |= {name: wp.zeros(worlds, dtype=int, device=device) for name in ("age", "recorded")}
        self._given = filled(
            kernels.Disturbance,
            first=table.column("action_delay"),
            last_actions=layout.column("last_actions") if "last_actions" in layout.segments else -1,
            scale=wp.array(scale, dtype=float, device=device),
            **self._kept,
        )
        self._drives = (model.joint_target_ke, model.joint_target_kd, model.joint_friction, model.joint_effort_limit)
        self._own = wp.array(np.stack([array.numpy() for array in self._drives]), dtype=float, device=device)

    def state_arrays(self) -> dict[str, wp.array]:
        """Return what an episode goes on from."""
        return {f"disturbance.{name}": array for name, array in self._kept.items()}

    def delay_actions(self) -> None:
        """Put the actions that arrive now in the place of those that were sent; once per control step."""
        given = (self._table.values, self._given, self._scene_actions)
        launch(self._device, kernels.delay_actions, self._worlds, *given)

    def disturb(self) -> None:
        """Put what is seen in the place of what is."""
        given = (self._table.values, self._table.seed, self._table.episode, self._given, self._layout.values)
        launch(self._device, kernels.disturb_observation, self._worlds, *given)

    def begin(self, world_mask: wp.array) -> None:
        """Begin the episodes of the masked worlds."""
        launch(self._device, kernels.begin_disturbance, self._worlds, world_mask, self._given)
        self.set_drives()

    def set_drives(self) -> None:
        """Give the drives of all worlds what their parameters say."""
        given = (self._table.values, self._given.first, self._own, *self._drives)
        launch(self._device, kernels.set_drives, self._own.shape[1], *given)
        self._rigid.notify_model_changed(newton.ModelFlags.JOINT_DOF_FORCE_PROPERTIES)
