"""Points of a film that OpenCV follows from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softmode.fitting.film import Clip, cv2

Array = NDArray[np.float64]
MOST = 40
"""Points that are followed at a time."""


@dataclass(frozen=True, eq=False)
class Track:
    """A point of the object in successive frames."""

    frames: NDArray[np.intp]
    """Indices of the frames (K,)."""
    places: Array
    """Where it is in them [px], shape (K, 2)."""


def follow(clip: Clip, cover: Array) -> list[Track]:
    """Follow corners of the object; one that does not come back to its place by less than 0.3 px is left.

    Args:
        clip: The film.
        cover: What is the object, 0..1, shape (F, H, W).
    """
    grey = [cv2.GaussianBlur(cv2.cvtColor(f, cv2.COLOR_RGB2GRAY), (0, 0), 0.7) for f in clip.frames]
    how = {"winSize": (11, 11), "maxLevel": 3, "criteria": (3, 30, 0.01)}
    live: list[tuple[list[int], list[Array]]] = []
    done: list[tuple[list[int], list[Array]]] = []
    for k, image in enumerate(grey):
        if live:
            start = np.array([places[-1] for _, places in live], np.float32)[:, None]
            end, good, _ = cv2.calcOpticalFlowPyrLK(grey[k - 1], image, start, None, **how)
            back, also, _ = cv2.calcOpticalFlowPyrLK(image, grey[k - 1], end, None, **how)
            error, still = np.linalg.norm((back - start)[:, 0], axis=1), []
            for one, place, fine in zip(live, end[:, 0], (good & also)[:, 0] & (error < 0.3), strict=True):
                x, y = (int(v) for v in np.clip(place, 0, np.array(image.shape[::-1]) - 1))
                if fine and cover[k, y, x] > 0.5:
                    one[0].append(k)
                    one[1].append(place)
                    still.append(one)
                else:
                    done.append(one)
            live = still
        if len(live) < MOST:
            inner = cv2.erode((cover[k] > 0.5).astype(np.uint8), np.ones((5, 5)))
            for _, places in live:
                cv2.circle(inner, (int(places[-1][0]), int(places[-1][1])), 3, 0, -1)
            fresh = cv2.goodFeaturesToTrack(image, MOST - len(live), 0.03, 3, mask=inner)
            live += [] if fresh is None else [([k], [place]) for place in fresh.reshape(-1, 2)]
    return [Track(np.array(at), np.array(places, float) + 0.5) for at, places in done + live if len(at) >= 4]
