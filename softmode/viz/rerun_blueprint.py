"""How rerun's viewer lays out a recording: the scene, pictures, and curves over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Eye = tuple[tuple[float, float, float], tuple[float, float, float]]


def make_blueprint(worlds: Sequence[str], objects: Sequence[str], cameras: Sequence[str], task: bool, eye: Eye) -> Any:
    """Return the blueprint of a recording.

    Args:
        worlds: Prefix of the entities of each world, "" or like "world_3/".
        objects: Names of the soft bodies.
        cameras: Names of the cameras.
        task: Whether there are rewards.
        eye: Where the 3D view looks from and at [m].
    """
    import rerun.blueprint as rrb

    def curves(name: str, *patterns: str) -> Any:
        contents = [f"+ /{w}{p}" for w in worlds for p in patterns]
        legend = rrb.PlotLegend(rrb.Corner2D.LeftTop)  # what rises towards the end stays in view
        return rrb.TimeSeriesView(name=name, origin="/", contents=contents, plot_legend=legend)

    position, target = eye
    contents = [f"+ /{w}scene/**" for w in worlds]
    # Depth would be drawn as points in space.
    contents += [f"- /{w}scene/camera/{name}/depth" for w in worlds for name in cameras]
    contents += [f"- /{w}scene/soft/{name}/surface" for w in worlds for name in objects]
    controls = rrb.EyeControls3D(position=position, look_target=target, eye_up=(0.0, 0.0, 1.0))
    look: dict[str, Any] = {"background": (28, 30, 34), "line_grid": False}
    scene = rrb.Spatial3DView(name="scene", origin="/", contents=contents, eye_controls=controls, **look)
    shown = [(f"{w}{name}", f"/{w}scene/camera/{name}") for w in worlds for name in cameras]
    pictures = [rrb.Spatial2DView(name=name, origin=path, contents=[f"+ {path}/rgb"]) for name, path in shown]
    views = [curves("energies [J]", "energy/**")]
    if task:
        views = [curves("reward", "reward/**"), *views, curves("success and metrics", "success", "metrics/**")]
    views.append(curves("solver", "solver/**"))
    left = rrb.Vertical(scene, rrb.Horizontal(*pictures), row_shares=[2, 1]) if pictures else scene
    right = rrb.Vertical(*views, rrb.TextLogView(name="log", origin="/", contents=[f"+ /{w}log" for w in worlds]))
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline="sim_time"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )
