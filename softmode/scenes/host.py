"""What the device holds, on the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray


def host(array: wp.array | None) -> NDArray[Any]:
    """Return what an array of a model or a state holds, on the host; nothing for one that is not there."""
    return np.zeros(0) if array is None else array.numpy()
