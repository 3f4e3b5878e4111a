"""One joint per link: links with several are split, and a free joint of the base is held or becomes six joints."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np

_FREE = ("x", "y", "z", "yaw", "pitch", "roll")
"""Names of the joints that a free joint becomes: three slides, then hinges about z, y and x."""
_LINK = {"mass": "1e-6", "pos": "0 0 0", "diaginertia": "1e-9 1e-9 1e-9"}
"""Inertia of the links between the joints of a link [kg, kg m^2]."""


def hold_base(spec: Any, pose: Sequence[float] | None, *, floating: bool) -> tuple[list[str], list[str]]:
    """Put six joints, or none, in place of a free joint of the robot's first link.

    Args:
        spec: The robot alone.
        pose: Where the base stands, position [m] and quaternion (wxyz); None where it is.
        floating: Whether the base may move: three slides along, then hinges about, the axes it has at home.

    Returns:
        Names of the joints that it became, and notes.
    """
    mujoco = importlib.import_module("mujoco")
    base = spec.worldbody.first_body()
    free = [joint for joint in base.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    if not free:
        return [], []
    name = free[0].name
    spec.delete(free[0])
    if pose is not None:
        base.pos, base.quat = np.array(pose[:3]), np.array(pose[3:])
    if not floating:
        return [], [f"base held: its free joint {name!r} is left out; floating=True keeps it"]
    names = [f"{name}_{part}" for part in _FREE]
    for k, new in enumerate(names):
        kind = mujoco.mjtJoint.mjJNT_SLIDE if k < 3 else mujoco.mjtJoint.mjJNT_HINGE
        axis = np.eye(3)[k if k < 3 else 5 - k]
        base.add_joint(name=new, type=kind, axis=axis, actfrclimited=False, limited=False)
    return names, [f"free joint {name!r}: three slides and three hinges without drives"]


def split_links(text: str) -> tuple[str, list[str]]:
    """Return MJCF in which every link has one joint at most and the first has none, and the names of changed links.

    A link with joints 1 to n follows n - 1 links that weigh next to nothing, each with one of the first joints, in
    their order; coordinates and their order stay. Before the first link stands one without a joint.
    """
    tree = ElementTree.fromstring(text)
    names = []
    for parent in list(tree.iter()):
        if parent.tag not in ("body", "worldbody"):
            continue
        for place, body in enumerate(list(parent)):
            joints = body.findall("joint") if body.tag == "body" else []
            first = parent.tag == "worldbody"
            if len(joints) < (1 if first else 2):
                continue
            names.append(body.get("name", ""))
            outer, inner = _chain(body, [None, *joints] if first else [*joints])
            parent.remove(body)
            parent.insert(place, outer)
            inner.append(body)
    return (ElementTree.tostring(tree, encoding="unicode") if names else text), names


def _chain(
    body: ElementTree.Element, joints: list[ElementTree.Element | None]
) -> tuple[ElementTree.Element, ElementTree.Element]:
    """Return the first and the last of the links that take all joints but the last from a link, and its place.

    One without a joint stands for None.
    """
    links: list[ElementTree.Element] = []
    for k, joint in enumerate(joints[:-1]):
        link = ElementTree.Element("body", {"name": f"{body.get('name')}_{k}"})
        ElementTree.SubElement(link, "inertial", _LINK)
        if joint is not None:
            body.remove(joint)
            link.append(joint)
        if links:
            links[-1].append(link)
        links.append(link)
    for name in ("pos", "quat", "axisangle", "xyaxes", "zaxis", "euler"):
        if name in body.attrib:
            links[0].set(name, body.attrib.pop(name))
    if "childclass" in body.attrib:
        links[0].set("childclass", body.attrib["childclass"])
    return links[0], links[-1]
