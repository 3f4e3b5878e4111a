"""Captures made by code in which hands hold a toy: grips, sleeves, arms that end as a crop or photographs leave them.

A check that looks at colours would be easy on them: arms have one colour, toys have many.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from softmode.splats.splats import SH_DC
from tests.carriers import SHAPES, Made, Solid, blob, render, rod

Array = NDArray[np.float64]
SKIN = ((0.93, 0.76, 0.66), (0.80, 0.60, 0.46), (0.55, 0.38, 0.27), (0.30, 0.20, 0.15))
GRIPS = ("side", "below", "above", "both")
HAND = 4
"""What a splat of a hand shows, beside `tests.carriers`."""


def hand(at: Array, normal: Array, fingers: Array, width: float, reach: float, rng: np.random.Generator) -> list[Solid]:
    """Return a hand of rods with its arm.

    Args:
        at: Middle of its palm, shape (3,).
        normal: Unit vector out of the palm, shape (3,).
        fingers: Unit vector across it, in which the fingers point, shape (3,).
        width: Width of the palm.
        reach: Length of the arm.
        rng: Source of lengths and bends.
    """
    side = np.cross(normal, fingers)
    palm = blob(0.5 * width, 0.45 * width, 0.17 * width, power=3.0, at=at - 0.17 * width * normal)
    palm.turn = np.stack([fingers, side, normal], axis=1)
    found, curl = [palm], rng.uniform(0.35, 0.6)
    for shift in (-0.36, -0.12, 0.12, 0.36):
        start = at + width * (0.45 * fingers + shift * side - 0.15 * normal)
        for k, length in enumerate((0.4, 0.3, 0.22)):
            angle = curl * (k + 0.5)
            end = start + length * width * (np.cos(angle) * fingers + np.sin(angle) * normal)
            found.append(rod(start, end, 0.1 * width))
            start = end
    start = at + width * (-0.15 * fingers + 0.42 * side - 0.1 * normal)
    for way in (side + 0.4 * fingers, normal + 0.5 * fingers):
        end = start + 0.33 * width * way / np.linalg.norm(way)
        found.append(rod(start, end, 0.12 * width))
        start = end
    wrist = at - width * (0.35 * fingers + 0.15 * normal)
    way = -fingers - rng.uniform(0.2, 1.0) * normal + rng.uniform(-0.3, 0.3) * side
    way /= np.linalg.norm(way)
    elbow = wrist + reach * way
    found.append(rod(wrist, elbow, 0.27 * width))
    if rng.random() < 0.5:
        found.append(rod(wrist + rng.uniform(0.5, 1.0) * width * way, elbow, 0.36 * width))
    return found


def held(seed: int, *, count: int | None = None) -> Made:
    """Return a shape in one hand or two; which, the grip, sleeve, skin, size and what cuts the arm by chance."""
    rng = np.random.default_rng(seed)
    shape, grip = SHAPES[seed % len(SHAPES)], GRIPS[int(rng.integers(len(GRIPS)))]
    prims = shape()
    points = np.concatenate([prim.corners for prim in prims])
    low, high = points.min(axis=0), points.max(axis=0)
    middle, size = 0.5 * (low + high), float((high - low).max())
    turn = rng.uniform(0.0, 2.0 * np.pi)
    flat = np.array([np.cos(turn), np.sin(turn), 0.0])
    width, arms = rng.uniform(0.35, 0.6) * size, []
    for way in (flat, -flat) if grip == "both" else (flat,):
        normal, fingers = -way, np.cross([0.0, 0.0, 1.0], way) * rng.choice([-1.0, 1.0])
        tip = rng.uniform(-0.5, 0.6)
        fingers = np.cos(tip) * fingers + np.sin(tip) * np.array([0.0, 0.0, 1.0])
        if grip in ("below", "above"):
            normal, fingers = np.array([0.0, 0.0, 1.0 if grip == "below" else -1.0]), way
        off = (points - middle) @ -normal
        near = np.abs((points - middle) @ fingers) < 0.3 * size
        at = middle - normal * float(off[near].max() if near.any() else off.max())
        arms += hand(at, normal, fingers, width, 2.2 * size, rng)
    for prim in arms:
        prim.label = HAND
    options = {"count": count or int(rng.integers(20, 45)) * 1000, "wide": 3.2, "tilt": float(rng.uniform(0.0, 6.0))}
    made = render([*prims, *arms], f"{shape.__name__} held {grip}", rng, **options)
    x = made.splats.means.astype(np.float64) - middle
    reach, cut = rng.uniform(0.9, 1.5) * size, rng.integers(3)
    if cut == 0:  # a crop
        inside = (np.abs(x) < reach * rng.uniform(0.7, 1.0, 3)).all(axis=1)
    else:  # what photographs around it saw, with a sharp end or one that fades
        away = np.linalg.norm(x, axis=1) + (cut == 2) * rng.normal(0.0, 0.08 * size, len(x))
        inside = away < reach
    sh = made.splats.sh.copy()
    arm = made.label == HAND
    sh[arm, 0] = (np.array(SKIN[int(rng.integers(len(SKIN)))]) + rng.normal(0.0, 0.03, (arm.sum(), 3)) - 0.5) / SH_DC
    return replace(made, splats=replace(made.splats, sh=sh).subset(inside), label=made.label[inside])
