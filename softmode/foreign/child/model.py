"""Read and compile a robot file with MuJoCo, to see that it ends and what it takes; the caller then does the same."""

from __future__ import annotations

import importlib
from typing import Any

from .answer import Arrays
from .limits import Budget, Refused

MAX_PARTS = 512
"""Most bodies, joints, actuators, tendons, equalities or key frames of a robot file."""
MAX_SHAPES = 16384
"""Most shapes, sites, meshes and the like."""


def read(budget: Budget, request: dict[str, Any], arrays: Arrays) -> dict[str, Any]:
    """Compile a file; nothing is sent.

    Args:
        budget: Allowed for the file and what it refers to already, see `size`.
        request: `text`: MJCF or URDF in place of that of the file, or None; `size`: of all that it refers to [bytes].
        arrays: Not used.
    """
    try:
        spec = open_spec(request["file"], request["text"])
        try:
            spec.compile()
        except ValueError as error:
            if "mjMINVAL" not in str(error):
                raise
            spec.compiler.boundmass = spec.compiler.boundinertia = 1.0e-4  # links without mass: the caller gives some
            spec.compile()
    except (ValueError, RuntimeError) as error:
        text = "; ".join(line.strip() for line in str(error).splitlines() if line.strip())
        if "unknown exception" in text or "allocate memory" in text:
            raise MemoryError(text) from error
        hint = "convert that mesh to .stl or .obj" if "no decoder found" in text else "mend the file at that line"
        raise Refused(text, hint) from error
    return {}


def open_spec(path: str, text: str | None) -> Any:
    """Return the specification of a file, or of a text in its place, without textures: robots do without them.

    Raises:
        Refused: If it has too many parts.
        ValueError: If it cannot be read.
    """
    mujoco = importlib.import_module("mujoco")
    spec = mujoco.MjSpec.from_file(path) if text is None else mujoco.MjSpec.from_string(text)
    for texture in list(spec.textures):
        spec.delete(texture)
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    check_parts(spec)
    return spec


def check_parts(spec: Any) -> None:
    """Refuse a specification of too many parts.

    Raises:
        Refused: If it has more than robots have.
    """
    few = {
        name: len(getattr(spec, name)) for name in ("bodies", "joints", "actuators", "tendons", "equalities", "keys")
    }
    many = {name: len(getattr(spec, name)) for name in ("geoms", "sites", "meshes", "materials", "sensors")}
    for counts, most in ((few | {"keys": max(few["keys"], spec.nkey)}, MAX_PARTS), (many, MAX_SHAPES)):
        for name, count in counts.items():
            if count > most:
                raise Refused(
                    f"has {count} {name}, at most {most}", "give the robot alone, without the scene around it"
                )
