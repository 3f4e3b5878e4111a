"""Scenes: a model with its solver, state, objects and cameras, and a captured step.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.scenes.binding import BoundSplats as BoundSplats
    from softmode.scenes.binding import SplatFrame as SplatFrame
    from softmode.scenes.binding import splats_of_states as splats_of_states
    from softmode.scenes.capture import capture_graph as capture_graph
    from softmode.scenes.capture import capture_step as capture_step
    from softmode.scenes.fixture import Fixture as Fixture
    from softmode.scenes.fixture import add_fixture as add_fixture
    from softmode.scenes.meshes import SceneMesh as SceneMesh
    from softmode.scenes.meshes import scene_meshes as scene_meshes
    from softmode.scenes.meshes import scene_poses as scene_poses
    from softmode.scenes.motion import Motion as Motion
    from softmode.scenes.motion import motion_of as motion_of
    from softmode.scenes.motion import set_motion as set_motion
    from softmode.scenes.recording import Recording as Recording
    from softmode.scenes.scene import Scene as Scene
    from softmode.scenes.splat_scene import Record as Record
    from softmode.scenes.splat_scene import SplatScene as SplatScene
    from softmode.scenes.table_scene import TableScene as TableScene
    from softmode.scenes.table_scene import TableSceneConfig as TableSceneConfig

__getattr__, __dir__ = lazy_names(__name__)
