"""What viewers and recorders show of a scene: meshes of its shapes, and recordings for rerun.

Importing this package is cheap; the recorder is in `softmode.viz.rerun_logger`.
"""

from softmode.scenes.meshes import SceneMesh, scene_meshes, scene_poses

__all__ = ["SceneMesh", "scene_meshes", "scene_poses"]
