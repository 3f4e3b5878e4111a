"""What the arm looks like: the primitives of each link, which also give it its inertia."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import newton
import warp as wp

_WHITE = (0.90, 0.91, 0.92)
_GRAPHITE = (0.16, 0.17, 0.19)
_ACCENT = (0.95, 0.42, 0.10)
_STEEL = (0.62, 0.64, 0.67)
_RUBBER = (0.10, 0.10, 0.11)


@dataclass(frozen=True, kw_only=True)
class Part:
    """One primitive of a link: centre in the link's frame, long axis y or z, and what it is for."""

    kind: Literal["capsule", "cylinder", "box"]
    center: tuple[float, float, float]
    size: tuple[float, ...]
    """Capsule and cylinder: radius, half length without caps. Box: half sizes. [m]"""
    color: tuple[float, float, float] = _WHITE
    axis: Literal["y", "z"] = "z"
    touch: bool = False
    name: str = ""

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        if self.kind == "box":
            return 8.0 * self.size[0] * self.size[1] * self.size[2]
        radius, half = self.size
        tube = 2.0 * math.pi * radius**2 * half
        return tube + 4.0 / 3.0 * math.pi * radius**3 if self.kind == "capsule" else tube


_PEDESTAL_HEIGHT = 0.14
"""Height of the first axis' bearing above the mounting plane [m]."""


def base_parts() -> list[Part]:
    """Return the shapes of the static base."""
    middle = 0.5 * (0.025 + _PEDESTAL_HEIGHT)
    return [
        Part(kind="box", center=(0.0, 0.0, 0.0125), size=(0.105, 0.095, 0.0125), color=_GRAPHITE, name="plate"),
        _cylinder(middle, 0.078, middle - 0.025, name="pedestal"),
        _cylinder(_PEDESTAL_HEIGHT + 0.004, 0.074, 0.004, _ACCENT, name="ring"),
    ]


def arm_links(
    shoulder_height: float, upper_arm_length: float, forearm_length: float, flange_length: float
) -> tuple[list[float], list[tuple[float, float, float]], list[list[Part]]]:
    """Return, per joint, its offset along the parent's z [m], its axis, and the shapes of the link behind it.

    Args:
        shoulder_height: Height of the second axis above the mounting plane [m].
        upper_arm_length: Shoulder to elbow [m].
        forearm_length: Elbow to wrist [m].
        flange_length: Wrist to flange [m].

    Returns:
        Offsets and axes of seven joints, and the shapes of the six links before the hand.
    """
    along_z, along_y = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
    half_upper, half_fore = 0.5 * upper_arm_length, 0.5 * forearm_length
    neck = shoulder_height - _PEDESTAL_HEIGHT
    offsets = [_PEDESTAL_HEIGHT, neck, half_upper, half_upper, half_fore, half_fore, flange_length]
    axes = [along_z, along_y, along_z, along_y, along_z, along_y, along_z]

    def sleeve(length: float, radius: float) -> Part:
        """A tube from the link's origin along z, without caps."""
        return _cylinder(0.5 * length, radius, 0.5 * length)

    def hub(z: float, radius: float, half: float) -> list[Part]:
        """A joint housing across the arm with coloured end caps."""
        cap = _cylinder(z, 0.8 * radius, 0.006, _ACCENT, axis="y")
        caps = [replace(cap, center=(0.0, side * (half + 0.006), z)) for side in (1.0, -1.0)]
        return [_cylinder(z, radius, half, _GRAPHITE, axis="y"), *caps]

    links = [
        [sleeve(neck, 0.068), *hub(neck, 0.070, 0.068)],
        [_capsule_along_z(0.0, half_upper, 0.058), _cylinder(half_upper, 0.056, 0.004, _STEEL)],
        [_capsule_along_z(0.0, half_upper, 0.054), *hub(half_upper, 0.060, 0.060)],
        [_capsule_along_z(0.0, half_fore, 0.050), _cylinder(half_fore, 0.048, 0.004, _STEEL)],
        [_capsule_along_z(0.0, half_fore, 0.046), *hub(half_fore, 0.050, 0.050)],
        [_capsule_along_z(0.0, 0.4 * flange_length, 0.042), sleeve(flange_length - 0.004, 0.040)],
    ]
    return offsets, axes, links


def hand_parts(length: float, stroke: float) -> list[Part]:
    """Return the shapes of the hand, `length` [m] long, for fingers of a `stroke` [m]; the last one is the palm."""
    half_width = 0.5 * stroke + 0.022
    half_height, middle = max(0.5 * (length - 0.026), 0.005), 0.5 * (length + 0.026)
    side = _cylinder(middle, 0.026, half_height, _GRAPHITE, name="side")
    palm = (0.026, half_width, half_height)
    return [
        _cylinder(0.010, 0.040, 0.010, _STEEL, name="flange"),
        _cylinder(0.024, 0.036, 0.006, _ACCENT, name="ring"),
        *(replace(side, center=(0.0, sign * half_width, middle)) for sign in (1.0, -1.0)),
        Part(kind="box", center=(0.0, 0.0, middle), size=palm, touch=True, name="palm"),
    ]


def finger_parts(pad_size: tuple[float, float, float], length: float, side: float) -> list[Part]:
    """Return the shapes of one finger, its pad first; at zero the pad's face lies in the plane y = 0.

    Args:
        pad_size: Size of the pad [m]: across the finger, thickness, along the finger.
        length: Length of the finger [m].
        side: 1 for the left finger, -1 for the right one.
    """
    width, thickness, height = pad_size
    half, back = 0.5 * length - 0.001, 0.009

    def box(name: str, y: float, z: float, size: tuple[float, ...], color: tuple[float, float, float]) -> Part:
        """A box beside the plane in which the fingers meet; soft bodies touch it, but for the carriage."""
        touch = name != "carriage"
        return Part(kind="box", center=(0.0, side * y, z), size=size, color=color, touch=touch, name=name)

    pad = (0.5 * width, 0.5 * thickness, 0.5 * height)
    return [
        box("pad", 0.5 * thickness, length - 0.5 * height, pad, _RUBBER),
        box("finger", thickness + 0.5 * back, half, (0.46 * width, 0.5 * back, half), _STEEL),
        box("carriage", thickness + 0.010, 0.006, (0.6 * width, 0.014, 0.006), _GRAPHITE),
    ]


def _cylinder(
    z: float,
    radius: float,
    half: float,
    color: tuple[float, float, float] = _WHITE,
    *,
    axis: Literal["y", "z"] = "z",
    name: str = "",
) -> Part:
    """Return a cylinder whose centre lies on the link's z axis."""
    return Part(kind="cylinder", center=(0.0, 0.0, z), size=(radius, half), color=color, axis=axis, name=name)


def _capsule_along_z(start: float, end: float, radius: float) -> Part:
    """Return a capsule whose end points lie on the link's z axis."""
    return Part(kind="capsule", center=(0.0, 0.0, 0.5 * (start + end)), size=(radius, 0.5 * (end - start)))


def add_part(
    builder: newton.ModelBuilder,
    body: int,
    part: Part,
    config: newton.ModelBuilder.ShapeConfig,
    xform: wp.transform,
    label: str,
) -> int:
    """Add one primitive to a body and return its shape index."""
    # Newton's capsules and cylinders lie along their local z; a quarter turn about x lays them along y.
    half = math.sqrt(0.5)
    turn = wp.quat(half, 0.0, 0.0, half) if part.axis == "y" else wp.quat_identity()
    pose = xform * wp.transform(wp.vec3(*part.center), turn)
    common = {"xform": pose, "cfg": config, "color": part.color, "label": label}
    if part.kind == "box":
        return builder.add_shape_box(body, hx=part.size[0], hy=part.size[1], hz=part.size[2], **common)
    add = builder.add_shape_capsule if part.kind == "capsule" else builder.add_shape_cylinder
    return add(body, radius=part.size[0], half_height=part.size[1], **common)
