"""What viewers and recorders show of a scene: meshes of its shapes, and a rerun recording."""

from softmode.viz.scene_meshes import SceneMesh, scene_meshes, scene_poses

__all__ = ["SceneMesh", "scene_meshes", "scene_poses"]
