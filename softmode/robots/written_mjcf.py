"""What MuJoCo writes of a robot, completed so that Newton reads what MuJoCo means."""

from __future__ import annotations

import importlib
from typing import Any
from xml.etree import ElementTree

_SOLVER_DEFAULTS = {"solref": ("0.02", "1"), "solimp": ("0.9", "0.95", "0.001", "0.5", "2")}
"""MuJoCo's own parameters of constraints, by the first letters of the attributes that hold them."""


def written_mjcf(spec: Any, model: Any) -> str:
    """Return a robot as MJCF.

    - Principal inertias keep the triangle inequality, which the digits of a written file may break.
    - Parameters of limits and constraints are complete: MuJoCo leaves out those that are its defaults, and Newton takes
      what is not there for zeros, which switches limits off.
    - Materials have a colour: white is MuJoCo's default and left out too, for which Newton takes a dark grey.
    - Where some links have shapes that are only seen, and a link has none, what collides there is seen as well: Newton
      hides all that collides then, MuJoCo does not.

    Args:
        spec: The specification.
        model: What it compiles to.
    """
    tree = ElementTree.fromstring(spec.to_xml())
    _balance(tree)
    for element in tree.iter():
        for name, value in element.attrib.items():
            default, given = _SOLVER_DEFAULTS.get(name[:6], ()), value.split()
            if 0 < len(given) < len(default):
                element.set(name, " ".join((*given, *default[len(given) :])))
    for material in tree.iterfind("asset/material"):
        material.set("rgba", _text(model.material(material.get("name")).rgba))
    _show(tree, spec, model)
    return ElementTree.tostring(tree, encoding="unicode")


def _balance(tree: ElementTree.Element) -> None:
    """Make the largest principal inertia of a link less than the sum of the others."""
    for element in tree.iter("inertial"):
        inertia = [float(value) for value in element.get("diaginertia", "0 0 0").split()]
        k = max(range(3), key=lambda i: inertia[i])
        others = sum(inertia) - inertia[k]
        if inertia[k] > others * (1.0 - 1.0e-7) > 0.0:
            inertia[k] = others * (1.0 - 1.0e-5)
            element.set("diaginertia", " ".join(f"{value:.9g}" for value in inertia))


def _show(tree: ElementTree.Element, spec: Any, model: Any) -> None:
    """Add what is seen to links that have nothing but shapes that collide, if other links have some."""
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    if collides.all():
        return  # then Newton hides nothing
    for body in tree.iter("body"):
        link = model.body(body.get("name"))
        geoms = range(int(link.geomadr[0]), int(link.geomadr[0]) + int(link.geomnum[0]))
        if geoms and all(collides[k] for k in geoms):
            owned = zip(geoms, body.findall("geom"), spec.body(body.get("name")).geoms, strict=True)
            body.extend([_seen(model, *one) for one in owned])


def _seen(model: Any, k: int, written: ElementTree.Element, geom: Any) -> ElementTree.Element:
    """Return a geom that looks like geom k of a model and collides with nothing; it has no class, which says both."""
    kind = importlib.import_module("mujoco").mjtGeom(int(model.geom_type[k]))
    attributes = {"type": kind.name.removeprefix("mjGEOM_").lower(), "contype": "0", "conaffinity": "0", "mass": "0"}
    pose = {"pos": model.geom_pos[k], "quat": model.geom_quat[k]}
    mesh = int(model.geom_dataid[k])
    if mesh >= 0:  # what is compiled is the pose of the mesh's own inertia
        attributes["mesh"] = model.mesh(mesh).name
        pose = {"pos": geom.pos, "quat": geom.quat}
    else:
        attributes["size"] = _text(model.geom_size[k])
    attributes |= {name: written.get(name, _text(value)) if mesh >= 0 else _text(value) for name, value in pose.items()}
    return ElementTree.Element("geom", {**attributes, "group": "2", "rgba": _text(_color(model, k))})


def _color(model: Any, k: int) -> Any:
    """Return the colour of a geom, which its material may say."""
    material = int(model.geom_matid[k])
    return model.geom_rgba[k] if material < 0 else model.mat_rgba[material]


def _text(values: Any) -> str:
    return " ".join(f"{value:.9g}" for value in values)
