"""Films by code: other functions, steps and light than a fit uses, seen by a worse camera than it is told.

Builds objects of more functions than a fit takes, with an end held: the truth of a film.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import newton
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.deformables import Material, SolverReduced, SolverReducedOptions, add_reduced_body
from softmode.deformables.model.namespaces import soft
from softmode.objects import SoftObject
from softmode.scenes import BoundSplats
from softmode.splats import CameraOptions, PinholeCamera, SplatCamera

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Trouble:
    """What is wrong with a film; 0 for nothing."""

    light: float = 1.0
    """Changes of light, gain and gamma."""
    noise: float = 0.02
    """Standard deviation of the noise, of 1."""
    pose: float = 1.0
    """Camera off by so many centimetres and degrees."""
    colors: float = 1.0
    """Other colours than those of the splats."""
    background: float = 1.0
    """Texture behind the object, and another sky."""
    late: float = 1.0
    """Start up to so many frames late."""
    blur: float = 0.3
    """Exposure over the time of a frame."""


NONE = Trouble(light=0.0, noise=0.005, pose=0.0, colors=0.0, background=0.0, late=0.0, blur=0.0)
"""A film without trouble."""


def film_camera(thing: SoftObject, size: int, azimuth: float = 0.0) -> PinholeCamera:
    """Return a camera that sees an object and where it may sag, in the axes of its file, turned about it [rad]."""
    low, high = thing.body.bounds + thing.body.offset
    span, middle = float((high - low).max()), 0.5 * (low + high)
    target = (float(middle[0]), float(middle[1]), float(middle[2]) - 0.15 * span)
    d = 2.2 * span
    c, s = np.cos(azimuth), np.sin(azimuth)
    aside = d * (0.25 * c + 0.95 * s), d * (0.25 * s - 0.95 * c)
    place = (target[0] + aside[0], target[1] + aside[1], target[2] + 0.25 * d)
    return PinholeCamera.look_at("film", position=place, target=target, width=size, height=size, fov_y=0.75)


def motion(thing: SoftObject, material: Material, seconds: float, dt: float) -> tuple[Array, newton.Model]:
    """Return the coordinates of a held body that is let go, at every second step, (T, n, 3); and its model."""
    builder = newton.ModelBuilder()
    add_reduced_body(builder, thing.body, material=material)
    model = builder.finalize(device="cpu")
    solver = SolverReduced(model, [thing.body], options=SolverReducedOptions(integrator="bdf2", tolerance=1e-6))
    states = [model.state(), model.state()]
    found = [soft(states[0]).q.numpy().copy()]  # on CPU it is a view
    for _ in range(round(seconds / dt / 2)):
        solver.step(states[0], states[1], None, None, dt)
        solver.step(states[1], states[0], None, None, dt)
        found.append(soft(states[0]).q.numpy().copy())
    return np.array(found, np.float64), model


def make_film(
    thing: SoftObject,
    material: Material,
    trouble: Trouble,
    seed: int,
    *,
    seconds: float = 0.9,
    fps: int = 30,
    size: int = 128,
    azimuth: float = 0.0,
    dt: float = 1.0 / 960.0,
    moved: tuple[Array, newton.Model] | None = None,
    carry: Callable[[Array], tuple[Array, Array]] | None = None,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], PinholeCamera]:
    """Return frames (F, H, W, 3), the plate (H, W, 3), and the camera as it is told, in the axes of the file.

    Args:
        thing: The object with its end held, of the truth's functions.
        material: The truth.
        trouble: What is wrong with the film.
        seed: Of all that is random.
        seconds: How long [s].
        fps: Frames per second.
        size: Width and height [px].
        azimuth: Turn of the camera about the object [rad].
        dt: Steps of the truth [s].
        moved: The truth's motion at every second step, where it is another one's.
        carry: Gives means and covariances (S, 3, 3) of the splats for a motion that is not one of the body's functions.
    """
    r = np.random.default_rng(seed)
    q, model = moved or motion(thing, material, seconds + 0.1, dt)
    told = film_camera(thing, size, azimuth)
    axis, move = r.normal(size=3), r.normal(size=3)
    turn = Rotation.from_rotvec(np.deg2rad(trouble.pose) * axis / np.linalg.norm(axis)) * Rotation.from_quat(told.quat)
    place = np.add(told.position, 0.01 * trouble.pose * move / np.linalg.norm(move)) - thing.body.offset
    true = replace(told, position=tuple(place), quat=tuple(turn.as_quat()))
    b, li = trouble.background, trouble.light
    options = CameraOptions(
        sky=(tuple(0.6 + b * r.uniform(-0.3, 0.3, 3)), tuple(0.5 + b * r.uniform(-0.3, 0.3, 3))),
        light_color=tuple(np.array([0.72, 0.7, 0.66]) * (1.0 + li * r.uniform(-0.4, 0.4))),
    )
    splats = thing.visible_splats
    sh = splats.sh.copy()
    mixed = (sh[:, 0] * 0.2820948 + 0.5) @ (np.eye(3) + trouble.colors * 0.15 * r.normal(size=(3, 3))).T
    mixed += trouble.colors * 0.06 * np.sin(40.0 * splats.means @ r.normal(size=(3, 3)))
    sh[:, 0] = (np.clip(mixed, 0.02, 0.98) - 0.5) / 0.2820948
    shown = replace(thing, splats=replace(splats, sh=sh))
    bound = BoundSplats(model, [shown])
    camera = SplatCamera(model, bound.arrays, [true], options=options)
    state = model.state()
    yy, xx = np.mgrid[0:size, 0:size] / size
    texture = np.zeros((size, size, 3))
    for _ in range(6):
        k = 14.0 * r.normal(size=2)
        texture += r.normal(size=3) * np.sin(k[0] * xx + k[1] * yy + r.uniform(0, 6))[..., None]
    gain, gamma = 1.0 + li * r.uniform(-0.2, 0.2, 3), np.exp(li * r.uniform(-0.25, 0.25))

    def shot(time: float) -> Array:
        k = np.clip(time / (2.0 * dt), 0.0, len(q) - 1.001)
        a = k - int(k)
        now = (1.0 - a) * q[int(k)] + a * q[int(k) + 1]
        if carry is None:
            soft(state).q.assign(now)
            bound.update(state)
        else:
            means, covariances = carry(now)
            bound.arrays.means.assign(means[None])
            bound.arrays.covariances.assign(covariances[None, :, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)])
        return picture()

    def picture() -> Array:
        camera.render(state)
        alpha = camera.images("film", "alpha").numpy()[0][..., None]
        return camera.images("film").numpy()[0] / 255.0 + (1.0 - alpha) * b * 0.05 * texture

    def sensor(image: Array) -> NDArray[np.uint8]:
        seen = np.clip(gain * np.clip(image, 0, 1) ** gamma, 0, 1) + trouble.noise * r.normal(size=image.shape)
        return (np.clip(seen, 0, 1) * 255.0 + 0.5).astype(np.uint8)

    late = trouble.late * r.uniform(0.0, 1.0) / fps
    exposure = np.linspace(-0.5, 0.5, 3) * trouble.blur / fps if trouble.blur else np.zeros(1)
    times = np.arange(int(seconds * fps)) / fps + late
    frames = np.array([sensor(np.mean([shot(max(t + s, 0.0)) for s in exposure], axis=0)) for t in times])
    soft(state).q.assign(thing.body.affine(np.eye(3), (0, 0, -50.0)))
    bound.update(state)
    empty = picture()
    plate = np.mean([sensor(empty) for _ in range(15)], axis=0)
    return frames, (plate + 0.5).astype(np.uint8), told
