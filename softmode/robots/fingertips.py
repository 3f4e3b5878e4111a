"""`Fingertips`: the joint coordinates of a hand whose fingertips are where they shall be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.errors import ConfigError
from softmode.robots.chain import serial_chain
from softmode.robots.description import RobotDescription

Array = NDArray[np.float64]


class Fingertips:
    """Points on the links of a hand, and the inverse kinematics of each finger.

    Each finger has joints of its own, so that fingers do not disturb each other.

    Args:
        hand: The hand.
        tips: By the name of its link, the point of each fingertip in the link's frame [m].

    Raises:
        ConfigError: If the hand has no such link, no joint moves one, or fingers share a joint.
    """

    def __init__(self, hand: RobotDescription, tips: Mapping[str, Sequence[float]]) -> None:
        """Find the chain of every finger."""
        self.hand = hand
        self.chains = {}
        """Chains from the base to each tip, by link."""
        taken: dict[int, str] = {}
        for link, point in tips.items():
            if link not in hand.link_names:
                known = ", ".join(hand.link_names)
                raise ConfigError(f"robot {hand.name!r} has no link {link!r} for a fingertip", hint=f"it has {known}")
            x, y, z = (float(value) for value in point)
            tip = replace(hand, end_effector=link, tool=(x, y, z, 0.0, 0.0, 0.0, 1.0))
            self.chains[link] = serial_chain(tip)
            for joint in self.chains[link].joints:
                if joint in taken:
                    raise ConfigError(
                        f"fingertips {taken[joint]!r} and {link!r} share the joint {hand.joint_names[joint]!r}",
                        hint="name one tip of each finger",
                    )
                taken[joint] = link

    def positions(self, joint_q: ArrayLike) -> dict[str, Array]:
        """Return where the tips are in the base frame [m] at joint coordinates, shape (joint_count,)."""
        q = np.asarray(joint_q, float)
        return {link: chain.forward(q[None, list(chain.joints)])[0][0] for link, chain in self.chains.items()}

    def joint_q(self, points: Mapping[str, ArrayLike], start: ArrayLike) -> tuple[Array, float]:
        """Return joint coordinates that bring tips to points, within the limits.

        Args:
            points: By link, the points in the base frame [m], shape (3,).
            start: Coordinates where the search begins, and of fingers without a point, shape (joint_count,).

        Returns:
            The coordinates, shape (joint_count,), and the largest distance that is left [m].
        """
        q, left = np.array(start, float), 0.0
        for link, point in points.items():
            chain = self.chains[link]
            joints = list(chain.joints)
            place = np.asarray(point, float)[None]
            found, error = chain.inverse(place, np.eye(3)[None], q[joints], length=0.0)  # no rotation is wanted
            q[joints], left = found[0], max(left, float(error[0]))
        return q, left
