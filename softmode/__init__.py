"""softmode: mesh-free reduced soft bodies with robots in Newton, as Gymnasium environments seen by a splat camera.

Importing the package registers its environments and loads nothing heavy::

    import gymnasium as gym, softmode
    env = gym.make("softmode/LiftSoft-v0", obs_type="pixels_agent_pos", render_mode="rgb_array")
    envs = gym.make_vec("softmode/LiftSoft-v0", num_envs=1024, device="cuda:0", output="torch")
"""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

__version__ = "0.2.0"

ENVIRONMENTS = {
    "softmode/LiftSoft-v0": "Pick a soft object from a table and hold it at a goal.",
    "softmode/PushSoft-v0": "Push a soft object over the table to a goal.",
    "softmode/PressSoft-v0": "Press on a soft pad of unknown stiffness and hold a contact force.",
    "softmode/PlaceInBin-v1": "Put a soft toy into a bin with other soft objects in it.",
    "softmode/RopeRoute-v0": "Lead a soft rope around pegs, each on its side, to a goal.",
    "softmode/ShapeSoft-v0": "Bend a soft post into a given shape and hold it there.",
    "softmode/PushSoftGoal-v0": "PushSoft, goal-conditioned: for hindsight experience replay.",
    "softmode/LiftSoftGoal-v0": "LiftSoft, goal-conditioned: for hindsight experience replay.",
}
"""Ids of the registered environments and what their task is."""
_EPISODE_STEPS = {
    "LiftSoft": 150,
    "PushSoft": 120,
    "PressSoft": 120,
    "PlaceInBin": 180,
    "RopeRoute": 160,
    "ShapeSoft": 100,
    "PushSoftGoal": 120,
    "LiftSoftGoal": 150,
}
"""Control steps of an episode."""


def _register() -> None:
    """Register every environment once; ``softmode.envs.tasks.name.task`` has NameEnv and NameVectorEnv of task Name."""
    for name in ENVIRONMENTS:
        task = name.removeprefix("softmode/").rpartition("-v")[0]
        folder = "".join(f"_{c.lower()}" if c.isupper() else c for c in task).lstrip("_")
        module = f"softmode.envs.tasks.{folder}.task"
        if name not in registry:
            register(
                id=name,
                entry_point=f"{module}:{task}Env",
                vector_entry_point=f"{module}:{task}VectorEnv",
                max_episode_steps=_EPISODE_STEPS[task],
            )


_register()
