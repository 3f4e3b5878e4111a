"""softmode: mesh-free reduced soft bodies with robots in Newton, as Gymnasium environments seen by a splat camera.

Importing the package registers its environments and loads nothing heavy::

    import gymnasium as gym, softmode
    env = gym.make("softmode/LiftSoft-v0", obs_type="pixels_agent_pos", render_mode="rgb_array")
"""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

__version__ = "0.1.0"

ENVIRONMENTS = {"softmode/LiftSoft-v0": "Pick a soft object from a table and hold it at a goal height."}
"""Ids of the registered environments and what their task is."""


def _register() -> None:
    """Register every environment once."""
    if "softmode/LiftSoft-v0" not in registry:
        register(
            id="softmode/LiftSoft-v0",
            entry_point="softmode.envs.lift_soft:LiftSoftEnv",
            max_episode_steps=150,
        )


_register()
