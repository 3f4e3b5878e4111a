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

LIMITS: dict[str, dict[str, float]] = {
    "action_delay": {"at_least": 0.0, "at_most": 30.0},
    "observation_delay": {"at_least": 0.0, "at_most": 30.0},
    "observation_noise": {"at_least": 0.0, "at_most": 100.0},
    "observation_bias": {"at_least": 0.0, "at_most": 100.0},
    "gain": {"at_least": 0.1, "at_most": 10.0},
    "drive_friction": {"at_least": 0.0, "at_most": 0.9},
    "effort": {"at_least": 0.05, "at_most": 10.0},
}
"""What the ranges of the disturbances may hold, by the names of the parameters; all of them are off by default."""
SIM_TO_REAL: dict[str, tuple[float, float]] = {
    "action_delay_range": (0.0, 2.0),
    "observation_delay_range": (0.0, 1.0),
    "observation_noise_range": (0.0, 1.0),
    "observation_bias_range": (0.0, 1.0),
    "gain_range": (0.8, 1.25),
    "drive_friction_range": (0.0, 0.02),
    "effort_range": (0.8, 1.2),
}
"""Fields of the preset "sim_to_real"."""
_DELAYS = ("action_delay", "observation_delay")
_KEPT = 3
"""Actions in the observation where something is delayed."""
_EXACT = ("goal", "desired_goal", "command_lead", "command_turn", "command_opening", "object_one_hot", "other_present")
"""Segments that nothing measures: neither noise nor bias."""
_SCALES = {"tool_position": 1e-3, "tool_heading": 5e-3, "opening": 5e-4, "finger_force": 0.2, "joint_angles": 2e-3}
_SCALES |= {"object_velocity": 0.02, "arm": 1e-3}
"""Standard deviations at noise or bias 1 in the unit of the segment; 2 mm for those that are not named."""


def disturbed(config: Any) -> dict[str, tuple[float, float]]:
    """Return the ranges of the disturbances that a configuration has, by the names of the parameters."""
    given = {name: getattr(config, f"{name}_range") for name in LIMITS}
    return {name: limits for name, limits in given.items() if limits is not None}


def disturbance_parameters(config: Any) -> tuple[Parameter, ...]:
    """Return what is drawn for the disturbances that are on; a reset may set delays up to the longest of the range."""
    made = []
    for name, (low, high) in disturbed(config).items():
        most = high if name in _DELAYS else LIMITS[name]["at_most"]
        made.append(
            Parameter(name=name, low=(low,), high=(high,), least=(LIMITS[name]["at_least"],), most=(most,))
        )
    return tuple(made)


def last_actions(config: Any, action_size: int) -> tuple[Segment, ...]:
    """Return the segment of the last three actions, the newest first, where something is delayed."""
    if not set(_DELAYS) & set(disturbed(config)):
        return ()
    return (Segment("last_actions", _KEPT * action_size, -1.0, 1.0),)


class Disturbances:
    """Delays, noise, bias and drives of all worlds; every method but the constructor is capturable.

    Args:
        config: Configuration of the task.
        scene: The scene.
        table: The parameters, those of `disturbance_parameters` among them.
        layout: The observation.
        limit: Control steps per episode, 0 for no limit.

    Raises:
        ConfigError: If a delay is as long as the episode.
    """

    def __init__(
        self, config: Any, scene: TableScene, table: ParameterTable, layout: ObservationTable, limit: int
    ) -> None:
        """Keep the default drives and allocate what is remembered."""
        on, worlds, model = disturbed(config), scene.world_count, scene.model
        longest = [int(np.ceil(on.get(name, (0.0, 0.0))[1])) for name in _DELAYS]
        if limit and max(longest) >= limit:
            hint = f"give delays of less than {limit} steps, or longer episodes"
            raise ConfigError(f"a delay of {max(longest)} control steps is as long as the episode", hint=hint)
        self._table, self._layout, self._actions, self._rigid = table, layout, scene.actions, scene.solver.rigid
        self._device, self._worlds = scene.device, worlds
        columns = {name: table.column(name) if name in on else -1 for name in LIMITS}
        scale = np.zeros(len(layout.low), np.float32)
        for name, (where, _) in layout.segments.items():
            scale[where] = 0.0 if name in _EXACT else -1.0 if name == "last_actions" else _SCALES.get(name, 2e-3)
        size, seen = scene.actions.shape[1], longest[1] + 1
        zeros = {
            "actions": (worlds, max(longest[0] + 1, _KEPT), size),
            "seen": (worlds, seen, len(scale)),
        }
        kept = {name: wp.zeros(shape, dtype=float, device=self._device) for name, shape in zeros.items()}
        kept |= {name: wp.zeros(worlds, dtype=int, device=self._device) for name in ("age", "recorded")}
        self._kept = kept
        last = layout.column("last_actions") if "last_actions" in layout.segments else -1
        scales = wp.array(scale, dtype=float, device=self._device)
        self._given = filled(kernels.Disturbance, last_actions=last, scale=scales, **columns, **kept)
        self._stride = model.joint_dof_count // worlds if {"gain", "drive_friction", "effort"} & set(on) else 0
        own = ("joint_target_ke", "joint_target_kd", "joint_friction", "joint_effort_limit")
        named = zip(("stiffness", "damping", "own_friction", "effort"), own, strict=True)
        self._drives = filled(kernels.Drives, model, **{name: wp.clone(getattr(model, of)) for name, of in named})

    def state_arrays(self) -> dict[str, wp.array]:
        """Return what an episode goes on from."""
        return {f"disturbance.{name}": array for name, array in self._kept.items()}

    def delay_actions(self) -> None:
        """Put the actions that arrive now in the place of those that were sent; once per control step."""
        launch(self._device, kernels.delay_actions, self._worlds, self._table.values, self._given, self._actions)

    def disturb(self) -> None:
        """Put what is seen in the place of what is."""
        drawn = (self._table.values, self._table.seed, self._table.episode)
        launch(
            self._device, kernels.disturb_observation, self._worlds, *drawn, self._given, self._layout.values
        )

    def begin(self, world_mask: wp.array) -> None:
        """Begin the episodes of the masked worlds."""
        launch(self._device, kernels.begin_disturbance, self._worlds, world_mask, self._given)
        self.set_drives()

    def set_drives(self) -> None:
        """Give the drives of all worlds what their parameters say."""
        if self._stride:
            dim = (self._worlds, self._stride)
            launch(self._device, kernels.set_drives, dim, self._table.values, self._stride, self._given, self._drives)
            self._rigid.notify_model_changed(newton.ModelFlags.JOINT_DOF_FORCE_PROPERTIES)
