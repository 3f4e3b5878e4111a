"""`fit_film`: what an object is made of that is held by one end and let go, from a film of one fixed camera."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.checks import require_number
from softmode.deformables.materials.material import Material
from softmode.fitting.estimates import Estimate, Fitted, asked_for, floor_of
from softmode.fitting.film import Clip, Image, blurred, cv2, find_mattes
from softmode.fitting.film_residuals import CAMERA, HOLDER, NAMES, START, STEP, FilmResiduals, film_space
from softmode.fitting.kept import KeptStages
from softmode.fitting.least_squares import Solution, Space, cost_of, minimise
from softmode.fitting.pictures import project
from softmode.fitting.tracks import follow
from softmode.fitting.worlds import FREE, PHYSICS, HeldWorlds
from softmode.objects.soft_object import SoftObject
from softmode.splats.raster.pinhole import PinholeCamera

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
SPECIFIC = np.geomspace(8.0, 3.0e4, 20)
"""Young's modulus over density of the starts [m^2/s^2]."""
DAMPED = (5.0e-4, 4.0e-3)
"""Viscosities of the starts [s]."""
LATE = (0.2, -0.3, -0.8)
"""When the starts are let go, in frames from when it is expected: a film may begin after it."""
EARLY = 0.4
"""How much of the motion the starts are compared by [s]: later a stiffness is mistaken for one of another swing."""
BEYOND = 5.0
"""How many of its priors a parameter may need."""
OVERLAP = 0.85
"""Least overlap of object and matte before anything moves, intersection over union: at 0.79 E was 41 % too large."""
FOLLOWED = 0.8
"""Least share of the motion's cost that the twin has to explain, where more than `LEFT` is left."""
LEFT = 0.2
"""Root mean square of the coverage's residuals that is left where a twin may explain less than `FOLLOWED`."""
_POSE = NAMES[CAMERA]
_LASTING = (*_POSE, *NAMES[HOLDER], "edge")


def fit_film(
    thing: SoftObject,
    clip: Clip,
    camera: PinholeCamera,
    *,
    material: Material,
    plate: Image | None = None,
    exposure: float = 0.0,
    free: Sequence[str] = (),
    keep: Path | None = None,
    device: wp.DeviceLike = None,
    progress: Progress | None = None,
) -> tuple[Fitted, FilmResiduals, Array]:
    """Fit Young's modulus and viscosity, with gravity, start, camera, matte and holder free about what is told.

    Args:
        thing: The object with its end held, see `held_object`.
        clip: The film.
        camera: About where the camera is, in the axes of the object's file, for frames of the film's size.
        material: Density and Poisson's ratio; the rest is where the fit begins. `Fitted.unweighed` tells what is known
            where the density is not measured.
        plate: The picture without the object, of the film's size.
        exposure: For how long a frame sees [s], at most as long as it lasts.
        free: What is fitted besides, of `worlds.FREE` and `estimates.UNSEEN`.
        keep: File that keeps the stages that are done until all are; a fit that was cut off goes on with them.
        device: Warp device.
        progress: Told each stage and how far it is, 0..1.

    Returns:
        What was found; what it was fitted with; and all parameters, as `film_residuals.NAMES` has them.

    Raises:
        ConfigError: If the exposure is longer than a frame.
        FitError: If the film does not show it: nothing moves, the object is another one, the motion is not followed;
            it has a picture of the film.
    """
    done: tuple[str, float] = ("", 0.0)

    def tell(stage: str, fraction: float) -> None:
        nonlocal done
        done = (stage, fraction)
        if progress is not None:
            progress(stage, fraction)

    require_number("exposure", exposure, at_least=0.0, at_most=1.01 * clip.interval, hint="give it in seconds")
    pixels = hashlib.sha256(clip.frames.tobytes() + clip.times.tobytes() + (b"" if plate is None else plate.tobytes()))
    kept = KeptStages(keep, pixels.hexdigest(), thing.body.fingerprint, camera, material, exposure, free)
    tell("looking at the film", 0.0)
    mattes = find_mattes(clip, plate)
    tracks = follow(clip, mattes.cover)
    placed = replace(camera, position=tuple(np.subtract(camera.position, thing.body.offset).tolist()))
    names = [name for name in NAMES if name not in FREE or name in free]
    more = sum(name in FREE for name in names)
    residuals = FilmResiduals(thing, material, clip, mattes, placed, exposure=exposure, free=more, device=device)
    residuals.after = lambda: tell(done[0], min(done[1] + 0.01, 0.99))
    every, release = residuals.frames, float(clip.times[mattes.release])
    space = film_space(release - 0.25 * clip.interval, clip.interval, material)

    tell("finding the camera", 0.05)
    residuals.frames = np.unique(np.linspace(0, mattes.release, 3).astype(int))
    posed = replace(space, mean=space.changed(space.mean, "start", clip.times[-1]), high=np.full(len(NAMES), np.inf))
    pose = kept("pose", lambda: minimise(residuals, posed, posed.mean, (*_POSE, "edge"), rounds=6).x)
    mask, overlap, twin = _compared(residuals, pose, mattes.cover[0])
    outlines = {"cover": mattes.cover, "twin": twin}

    def check_needed(x: Array, some: slice, what: str) -> None:
        """Refuse parameters of which some are too far from what is expected."""
        needed = np.abs(x - space.mean)[some] / space.prior[some]
        if needed.max() > BEYOND:
            what += f" {NAMES[some][int(needed.argmax())]} off by {needed.max():.0f} times its prior"
            raise clip.refused(what, hint="check the object, --size, --up, --held and the camera", **outlines)

    check_needed(pose, CAMERA, "another object or size, or another camera: before it is let go they only fit with")
    if overlap < OVERLAP:
        what = f"only {overlap:.0%} of object and picture overlap before it is let go"
        hint = "film it before another background, give --plate, or check --size, --up and the camera"
        raise clip.refused(what, hint=hint, **outlines)
    residuals.mask(mask)
    residuals.frames, residuals.moving = every[clip.times <= release + EARLY], True

    tell("trying stiffnesses", 0.15)
    begin = space.changed(pose, "start", space.mean[START])
    sets = np.tile(begin, (len(SPECIFIC), len(DAMPED), len(LATE), 1))
    sets[..., 0], sets[..., 1] = np.log(SPECIFIC * material.density)[:, None, None], np.log(DAMPED)[:, None]
    sets[..., START] += clip.interval * np.array(LATE)
    sets = sets.reshape(len(SPECIFIC), -1, len(NAMES))
    tried = kept("tried", lambda: cost_of(residuals(sets.reshape(-1, len(NAMES))))).reshape(len(SPECIFIC), -1)
    sets, costs = sets[np.arange(len(sets)), tried.argmin(axis=1)], tried.min(axis=1)
    motion = ("youngs_modulus", "viscosity", "start", *_POSE, "edge")
    narrow = space.changed(space.prior, "viscosity", 0.5)

    def refined(space: Space, start: Array, names: Sequence[str]) -> Array:
        """Return the cost and the parameters near a start."""
        one = minimise(residuals, space, start, names, rounds=8, kept=_LASTING)
        return np.append(one.cost, one.x)

    found: list[Array] = []
    for n, k in enumerate(np.argsort(costs)[:2]):
        tell("fitting", 0.3 + 0.15 * n)
        tight = replace(space, prior=narrow, mean=space.changed(space.mean, "viscosity", sets[k, 1]))
        found.append(kept(f"near start {n}", functools.partial(refined, tight, sets[k], motion)))
    residuals.frames = every
    tell("fitting", 0.6)
    x = min(found, key=lambda one: float(one[0]))[1:]
    unmoved = residuals(space.changed(x, "start", clip.times[-1])[None])[0]
    x = kept("coverage", functools.partial(refined, space, x, [n for n in names if "tilt" not in n]))[1:]
    tell("fitting with tracks", 0.8)
    residuals.anchor(tracks, x)
    best = minimise(residuals, space, x, names, rounds=6, kept=_LASTING)
    cover = best.residuals[: residuals.sizes[0]]
    followed = _followed(cover.reshape(len(every), -1), unmoved)
    if followed < FOLLOWED and np.sqrt((cover**2).mean()) > LEFT:
        hint = "film one object that is held by one end and let go, before a background at rest"
        what = f"not observable, because the twin follows {followed:.0%} of what moves"
        raise clip.refused(what, hint=hint, **outlines)
    check_needed(best.x, slice(2, None), "not observable, because the twin needs")
    tell("the integrator's share", 0.95)
    shift = integrator_shift(thing, material, best.x, float(clip.times[-1] - best.x[START]), device)
    x = best.x - np.pad(shift, (0, len(NAMES) - 2))
    told = _told(residuals, best, x, material, followed, free)
    details = {
        "converged": best.converged,
        "camera": dict(zip(_POSE, best.x[CAMERA].tolist(), strict=True)) | {"nominal": asdict(camera)},
        "start": float(best.x[START]),
        "followed": followed,
        "tracks": len(residuals.tracks),
        "starts": [{"youngs_modulus": float(np.exp(one[1])), "cost": float(one[0])} for one in found],
        "costs": {"at_rest": float(cost_of(unmoved[None])[0]), "tried": np.round(costs, 3).tolist(), "end": best.cost},
        "overlap": overlap,
        "residual_of_frames": np.round(np.sqrt((cover.reshape(len(every), -1) ** 2).mean(axis=1)), 4).tolist(),
        "integrator": {"youngs_modulus": float(np.exp(shift[0])), "viscosity": float(np.exp(shift[1]))},
    }
    kept.done()
    tell("done", 1.0)
    return replace(told, details=details), residuals, best.x


def _check_grip(residuals: FilmResiduals, area: NDArray[np.bool_], twin: NDArray[np.float32]) -> None:
    """Refuse a film in which what is held, an area (H, W), moves about as the rest does."""
    soft = blurred(residuals.cover)
    rim = cv2.dilate((np.hypot(*np.gradient(soft[0])) > 0.1).astype(np.uint8), np.ones((3, 3))) > 0
    moves = []
    for zone in (rim & area, rim & ~area):
        if zone.sum() < 20:
            return
        change = np.abs(soft[:, zone] - soft[0, zone]).mean(axis=1)
        flicker = float(np.quantile(np.abs(np.diff(soft[:, zone], axis=0)).mean(axis=1), 0.25))
        moves.append(float(np.quantile(change, 0.9)) - flicker)
    if moves[0] > max(0.15, 0.6 * moves[1]):
        what = "not observable, because the end that is held moves as the rest does"
        hint = "hold one end still, and let the rest go; what is thrown or poked shows no E"
        raise residuals.clip.refused(what, hint=hint, cover=residuals.cover, twin=twin)


def _told(
    residuals: FilmResiduals, best: Solution, x: Array, material: Material, followed: float, free: Sequence[str]
) -> Fitted:
    """Return what is told of a solution, with bars."""
    thing, clip, space = residuals.thing, residuals.clip, best.space
    deviation = dict(zip((NAMES[k] for k in best.free), best.deviations(residuals.blocks()).tolist(), strict=True))
    bar = float(np.hypot(deviation["youngs_modulus"] / max(followed, 0.01), floor_of(thing)))
    at_end = min(x[0] - space.low[0], space.high[0] - x[0]) < 0.2
    why = "the film looks the same at every stiffness beyond it" if at_end else ""
    modulus = Estimate.of_logarithm(x[0], bar, unit="Pa", reason=why)
    dies = deviation["viscosity"] > 0.5 or best.x[1] > space.high[1] - 0.1
    swings = "its motion dies, or is too small, before a second swing is seen" if dies else ""
    spread = float(np.linalg.norm([deviation["viscosity"], 0.1, 2.0 * floor_of(thing)]))  # thin walls: 1.6 times, once
    viscosity = Estimate.of_logarithm(x[1], spread, unit="s", reason=swings)
    notes = [f"from {len(clip.times)} frames and {len(residuals.tracks)} tracks"]
    frequency = first_frequency(thing, float(np.exp(x[0])), material)
    if frequency > 0.5 / clip.interval:
        notes.append(
            f"the object swings at {frequency:.3g} Hz, beyond half of the film's {1.0 / clip.interval:.3g} frames per"
            " second: film faster, or give --fps-true if it was"
        )
    estimates = {"youngs_modulus": modulus, "viscosity": viscosity} | asked_for(free, material, space, x, deviation)
    return Fitted.of(clip, estimates, material, notes)


def _compared(residuals: FilmResiduals, x: Array, cover: Array) -> tuple[Array, float, Any]:
    """Return where the film is compared (H, W): not on the holder; how far object and matte overlap; and the object."""
    q, poses = residuals.states(x[None])[0, :1], residuals.poses(x[None])[0, :1]
    alpha = residuals.pictures.draw(q, poses)[0]
    near = cv2.dilate((alpha > 0.1).astype(np.uint8), np.ones((9, 9)))
    hand = cv2.dilate(((cover > 0.5) & (near == 0)).astype(np.uint8), np.ones((7, 7))) > 0
    means = residuals.thing.visible_splats.means
    inside = residuals.thing.body.regions.envelope(1.0)
    grip = inside.holds(means) if inside is not None else np.zeros(len(means), bool)
    pixels = np.round(project(residuals.camera, poses[0], means[grip])[0] - 0.5).astype(int)
    spots = np.zeros(cover.shape, np.uint8)
    shown = ((pixels >= 0) & (pixels < np.array(cover.shape[::-1]))).all(axis=1)
    spots[pixels[shown, 1], pixels[shown, 0]] = 1
    grip_area = cv2.dilate(spots, np.ones((5, 5))) > 0
    _check_grip(residuals, grip_area, alpha)
    away = hand | grip_area
    both, one = (alpha > 0.5) & (cover > 0.5) & ~away, ((alpha > 0.5) | (cover > 0.5)) & ~away
    return (~away).astype(np.float64), float(both.sum() / max(one.sum(), 1)), alpha


def _followed(r: Array, unmoved: Array) -> float:
    """Return how much of what moves the twin follows, 0..1.

    What is left holds noise, which is new in each frame, and what is not followed, which is not: the correlation
    between frames tells them apart.

    Args:
        r: Residuals of the coverage that are left, by frames (F, M).
        unmoved: Those of a twin that stays at rest (F M,).
    """
    before, after = cost_of(np.stack([unmoved, r.ravel()]))
    r = r - r.mean(axis=0)
    alike = max(abs(float((r[k:] * r[:-k]).sum())) for k in (1, 2)) / max(float((r * r).sum()), 1e-12)
    signal = max(float(before - after), 0.0)
    return signal / max(signal + alike * float(after), 1e-12)


def first_frequency(thing: SoftObject, youngs_modulus: float, material: Material) -> float:
    """Return about the lowest frequency of an object that one end holds [Hz]: that of a cantilever of its size."""
    span = np.sort(np.ptp(thing.body.bounds, axis=0))
    return 0.1615 * float(span[0]) / float(span[2]) ** 2 * float(np.sqrt(youngs_modulus / material.density))


def integrator_shift(thing: SoftObject, material: Material, x: Array, seconds: float, device: wp.DeviceLike) -> Array:
    """Return by how much ln E and ln viscosity come out too large because of the steps, (2,).

    With steps of a quarter the body moves as it does with these steps and a little more of both; by how much is found
    from their derivatives, along the motion of the surface.
    """
    rows = thing.body.surface.basis[:: max(1, thing.body.surface_count // 60)]

    times = np.arange(0.0, seconds, 4.0 * STEP)

    def motion(sets: Array, step: float) -> Array:
        worlds = HeldWorlds(thing.body, material, len(sets), dt=step, device=device)
        q = worlds.states(sets, np.zeros(len(sets)), times)
        return np.einsum("sk,wtkc->wtsc", rows, q).reshape(len(sets), -1)

    sets = np.repeat(x[None, : len(PHYSICS)], 3, axis=0)
    steps = np.array([0.02, 0.1])
    sets[[1, 2], [0, 1]] += steps
    coarse, fine = motion(sets, STEP), motion(sets[:1], STEP / 4.0)
    slopes = (coarse[1:] - coarse[0]) / steps[:, None]
    return np.linalg.lstsq(slopes.T, fine[0] - coarse[0], rcond=None)[0]
