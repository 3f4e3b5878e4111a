"""What a scene is: a model that runs, with the soft objects in it and the cameras that see them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import newton

from softmode.deformables.solver.solver_base import ReducedSolver
from softmode.deformables.tools.grips import Grips
from softmode.errors import ConfigError
from softmode.objects.soft_object import SoftObject
from softmode.radiance.march import MarchOptions, RadianceMarch
from softmode.scenes.binding import BoundSplats
from softmode.splats.cameras.camera import CameraOptions, Overlay, SplatCamera
from softmode.splats.cameras.camera_randomization import CameraRandomization
from softmode.splats.raster.pinhole import PinholeCamera


class Scene(Protocol):
    """A model with solver, state, objects and cameras, which takes steps.

    :class:`softmode.scenes.SplatScene` and :class:`softmode.scenes.TableScene` are scenes, and so is what a live
    session runs. Recorders and the browser tool read scenes.
    """

    model: newton.Model
    """The model."""
    state: newton.State
    """Where everything is."""
    control: newton.Control
    """What drives joints, pins and regions."""
    objects: tuple[SoftObject, ...]
    """The soft objects of a world, in the order of their instances."""
    grips: tuple[Grips, ...]
    """Grips of each object, that pull and hold it while the scene runs; none if it was made without slots."""
    splats: BoundSplats | None
    """The splats of the objects as cameras see them; None without cameras."""
    cameras: dict[tuple[int, int], SplatCamera]
    """The cameras by the width and height of their pictures [px]."""

    @property
    def solver(self) -> ReducedSolver:
        """What moves it."""
        ...

    def step(self) -> None:
        """Take the physics steps of a frame, as a graph."""
        ...

    def reset(self) -> None:
        """Start over."""
        ...


def marched_fields(
    solver: ReducedSolver, objects: Sequence[SoftObject | Sequence[SoftObject]], march: bool | MarchOptions = False
) -> RadianceMarch | None:
    """Return the fields of objects that cameras are to march through; None if there are none.

    Args:
        solver: What moves the objects.
        objects: The objects of a world in the order of their instances; a list where worlds differ.
        march: Whether all that have a field are marched, and how; else those of `ObjectConfig.march`.

    Raises:
        ConfigError: If an object is to be marched that is not the same in all worlds.
    """
    fields = []
    for index, thing in enumerate(objects):
        if isinstance(thing, SoftObject):
            grid = thing.radiance if march else thing.marched
            fields += [] if grid is None else [(index, grid)]
        elif any(one.marched is not None for one in thing):
            hint = "give all worlds one object, or leave march out"
            raise ConfigError("march: worlds hold different objects", hint=hint)
    options = march if isinstance(march, MarchOptions) else None
    return RadianceMarch.of_bodies(solver, fields, options=options) if fields else None


def cameras_by_size(
    model: newton.Model,
    splats: BoundSplats | None,
    cameras: Sequence[PinholeCamera],
    *,
    options: CameraOptions | None = None,
    randomization: CameraRandomization | None = None,
    overlay: Overlay | None = None,
) -> dict[tuple[int, int], SplatCamera]:
    """Return one :class:`softmode.splats.cameras.camera.SplatCamera` per image size; they share the splats.

    Args:
        model: The model.
        splats: The splats of its objects; None draws none.
        cameras: What to draw.
        options: Light and background.
        randomization: What `randomize` of the cameras draws.
        overlay: What else they draw.
    """
    return {
        size: SplatCamera(
            model,
            None if splats is None else splats.arrays,
            [camera for camera in cameras if (camera.width, camera.height) == size],
            options=options,
            randomization=randomization,
            overlay=overlay,
        )
        for size in sorted({(camera.width, camera.height) for camera in cameras})
    }
