"""A morph as a recording for the rerun viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from softmode.viz.morph_film import STRIDE, MorphScene
from softmode.viz.rerun_logger import splat_colors
from softmode.viz.rerun_stream import RerunStream, check_target


def record_morph(target: str | Path, scene: MorphScene, *, stride: int = STRIDE) -> None:
    """Write a morph to a file for the rerun viewer, or show it in one live.

    Entities: ``scene/morph`` (splats, or points where the scene draws particles), ``loss`` (to the target of the
    moment, after each segment) and ``target`` (its number). Timelines: ``step`` and ``sim_time``.

    Args:
        target: File to write (.rrd), which appears complete or not at all; or the address of a running viewer, like
            "rerun+http://127.0.0.1:9876/proxy"; or "spawn", which opens one.
        scene: The morph, in metres of its grid.
        stride: Steps from one frame to the next.

    Raises:
        ConfigError: If no viewer answers at the address.
        StorageError: If the file cannot be written.
        MissingExtraError: If rerun is not installed.
    """
    check_target(target)
    import rerun as rr
    import rerun.blueprint as rrb

    stream = RerunStream(target, "morph")
    run, options = scene.run, scene.options
    try:
        low, high = run.positions.min(axis=(0, 1)), run.positions.max(axis=(0, 1))
        middle, away = 0.5 * (low + high), np.array([0.35, -1.0, 0.62])
        eye = middle + away * float(np.linalg.norm(high - low))
        controls = rrb.EyeControls3D(position=eye, look_target=middle, eye_up=(0.0, 0.0, 1.0))
        view = rrb.Spatial3DView(name="scene", origin="/", contents=["+ /scene/**"], eye_controls=controls)
        curves = rrb.TimeSeriesView(name="loss", origin="/", contents=["+ /loss", "+ /target"])
        stream.send_blueprint(rrb.Blueprint(rrb.Horizontal(view, curves, column_shares=[3, 2])))
        for frame, splats in scene.splat_frames(stride):
            stream.set_moment(frame.step, frame.step * options.mpm.dt)
            if scene.as_particles:
                colors = splat_colors(splats)["colors"]
                stream.log("scene/morph", rr.Points3D(splats.means, radii=splats.scales[:, 0], colors=colors))
            else:
                fields: dict[str, Any] = {
                    "centers": splats.means,
                    "scales": splats.scales,
                    "quaternions": splats.quats,
                    **splat_colors(splats),
                }
                stream.log("scene/morph", rr.GaussianSplats3D.from_fields(**fields))
            if frame.step % options.segment_length == 0:
                stream.log("loss", rr.Scalars(float(run.losses[frame.step // options.segment_length])))
                stream.log("target", rr.Scalars(float(frame.target)))
        stream.publish()
    finally:
        stream.discard()
