"""Pictures in the forms that rerun takes: compressed colours, depth in steps of 0.1 mm."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import rerun as rr


def encoded(pixels: NDArray[np.uint8], jpeg_quality: int | None) -> rr.Image | rr.EncodedImage:
    """Return a picture, shape (height, width, 3), compressed unless it shall be exact (quality None)."""
    import rerun as rr

    if jpeg_quality is None:
        return rr.Image(pixels)
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=jpeg_quality)
    return rr.EncodedImage(contents=buffer.getvalue(), media_type="image/jpeg")


def encoded_depth(depth: NDArray[np.float32]) -> rr.EncodedDepthImage:
    """Return a depth picture [m], shape (height, width): 16 bit PNG in steps of 0.1 mm, which reach 6.5 m."""
    import rerun as rr
    from PIL import Image

    buffer, steps = io.BytesIO(), np.round(np.clip(1e4 * depth, 0.0, 65535.0)).astype(np.uint16)
    Image.fromarray(steps).save(buffer, "PNG", compress_level=1)
    return rr.EncodedDepthImage(blob=buffer.getvalue(), media_type="image/png", meter=1e4)
