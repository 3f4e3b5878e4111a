"""Recording launches as a graph: a picture, or the step of a scene, which leaves the scene as it was."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import warp as wp

from softmode.deformables.model.compile_ahead import compile_launches
from softmode.errors import ConfigError
from softmode.scenes.recording import Recording
from softmode.stages import KERNELS, stage

if TYPE_CHECKING:
    from softmode.scenes.scene import Scene


def capture_graph(launches: Callable[[], None], device: wp.DeviceLike) -> Recording:
    """Return launches as a recording, whose `launch` repeats them.

    They run once before, which compiles kernels and allocates what they need.

    Args:
        launches: Launches, without anything that reads from the device.
        device: Warp device.
    """
    with stage(KERNELS):
        launches()
    return Recording(launches, device)


def capture_step(scene: Scene, step: Callable[[], None]) -> Recording:
    """Return the step of a scene as a recording; its state stays as it was, and the solver forgets the trial.

    Args:
        scene: The scene.
        step: Moves `scene.state` on by launches alone; it ends where it began, in `scene.state`.
    """
    before = scene.model.state()
    before.assign(scene.state)
    compile_launches(step, scene.model.device)
    graph = capture_graph(step, scene.model.device)
    scene.solver.reset(scene.state)
    scene.state.assign(before)
    return graph


def require_even(name: str, count: int) -> None:
    """Raise unless a number of steps is even and at least 2, so that steps between two states end where they began.

    Raises:
        ConfigError: If it is not.
    """
    if count < 2 or count % 2:
        raise ConfigError(f"{name} must be even and at least 2, got {count}")
