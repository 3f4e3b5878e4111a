"""`Held`: which end of an object is held, and the object with that end held."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from softmode.deformables.body.regions import Region
from softmode.deformables.reduction.cache import cached_body
from softmode.deformables.reduction.hold import hold
from softmode.errors import BasisError, ConfigError
from softmode.objects.frame import laid_down
from softmode.objects.soft_object import SoftObject

_ENDS = {"top": "+z", "bottom": "-z"}
NAME = "held"
"""Name of the region that is held."""


@dataclass(frozen=True)
class Held:
    """What is held: all within a width of one end of the object, in the axes of its file as `splat show` draws them."""

    axis: int
    """0, 1 or 2 for x, y or z."""
    upper: bool
    """Whether it is the end of the largest coordinate."""
    width: float
    """How far the holder reaches over it [m]."""

    @classmethod
    def parse(cls, text: str) -> Held:
        """Return what a word like ``top:0.03`` or ``-x:0.01`` says.

        Raises:
            ConfigError: If it says nothing.
        """
        end, _, width = text.partition(":")
        end = _ENDS.get(end, end)
        try:
            found = float(width)
        except ValueError:
            found = 0.0
        if len(end) != 2 or end[0] not in "+-" or end[1] not in "xyz" or not 0.0 < found < 10.0:
            hint = "give an end and how many metres of it are held, like --held top:0.03 or --held=-x:0.01"
            raise ConfigError(f"held is {text!r}", hint=hint)
        return cls("xyz".index(end[1]), end[0] == "+", found)

    def region(self, thing: SoftObject) -> Region:
        """Return the part of an object that is held, in asset coordinates.

        Raises:
            ConfigError: If it is all of the object.
        """
        low, high = thing.body.bounds + thing.body.offset
        if self.width > 0.8 * (high - low)[self.axis]:
            hint = "hold less of it: what is free has to swing"
            size = (high - low)[self.axis]
            raise ConfigError(f"held: {self.width} m of an object that is {size:.3g} m long there", hint=hint)
        box = np.array([[-np.inf] * 3, [np.inf] * 3])
        if self.upper:
            box[0, self.axis] = high[self.axis] - self.width
        else:
            box[1, self.axis] = low[self.axis] + self.width
        wide = 2.0 * float((high - low).max())
        return Region(name=NAME, box=np.clip(box, low - wide, high + wide))


def held_object(thing: SoftObject, held: Held) -> SoftObject:
    """Return an object with one end held, in the cache of bodies.

    Args:
        thing: The object as its file has it: loaded with ``pose="captured"`` where `load` would lay it down.
        held: Its end.

    Raises:
        ConfigError: If it was laid on a stable side, or the end holds too little.
    """
    if laid_down(thing.body):
        raise ConfigError("the object was laid on its stable side", hint='load it with pose="captured"')
    region = held.region(thing)
    key = ("held", thing.body.fingerprint, held)
    try:
        body = cached_body(key, lambda: hold(thing.body, region))
    except BasisError as error:
        hint = "the holder touches too little of the object: hold more of it, or another end"
        raise ConfigError(f"held: {error.message}", hint=hint) from error
    splats = None if thing.splats is None else thing.splats.transformed(translation=thing.body.offset - body.offset)
    return replace(thing, body=body, splats=splats)
