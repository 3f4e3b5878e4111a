"""Scenes: a model with its solver, state, objects and cameras, and a captured step.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.scenes.binding import BoundSplats, SplatFrame, splats_of_states
    from softmode.scenes.capture import capture_graph, capture_step
    from softmode.scenes.fixture import Fixture, add_fixture
    from softmode.scenes.meshes import SceneMesh, scene_meshes, scene_poses
    from softmode.scenes.motion import Motion, motion_of, set_motion
    from softmode.scenes.recording import Recording
    from softmode.scenes.scene import Scene
    from softmode.scenes.splat_scene import Record, SplatScene
    from softmode.scenes.table_scene import TableScene, TableSceneConfig

__all__ = [
    "BoundSplats",
    "Fixture",
    "Motion",
    "Record",
    "Recording",
    "Scene",
    "SceneMesh",
    "SplatFrame",
    "SplatScene",
    "TableScene",
    "TableSceneConfig",
    "add_fixture",
    "capture_graph",
    "capture_step",
    "motion_of",
    "scene_meshes",
    "scene_poses",
    "set_motion",
    "splats_of_states",
]

__getattr__, __dir__ = lazy_names(__name__)
