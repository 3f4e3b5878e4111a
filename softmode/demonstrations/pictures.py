"""Pictures of a dataset: PNG bytes in its table, or films beside it."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.errors import AssetError, needs_extra
from softmode.files import damage_errors, storage_errors

_FREE_PIXELS = 1 << 24
_SPACE, _AGAIN = "free some space", "record the dataset again"


def encode_png(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture of shape (height, width, 3) as the bytes of a PNG file."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG")
    return buffer.getvalue()


def decode_png(data: bytes, shape: tuple[int, ...], what: str) -> NDArray[np.uint8]:
    """Return the picture that PNG bytes hold.

    Args:
        data: The bytes.
        shape: Expected (height, width, 3); anything else is refused before it is decoded.
        what: Names the picture in errors.

    Raises:
        AssetError: If the bytes hold no such picture.
    """
    from PIL import Image

    if shape[0] * shape[1] > max(_FREE_PIXELS, 32 * len(data)):
        raise AssetError(f"{what} is of {shape[1]} x {shape[0]} in {len(data)} bytes, which no picture is", hint=_AGAIN)
    with damage_errors(what, hint=_AGAIN):
        with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
            if (image.height, image.width) != shape[:2] or image.mode != "RGB":
                found = f"{image.width} x {image.height} {image.mode}"
                raise AssetError(f"{what} is a {found} picture, expected {shape[1]} x {shape[0]} RGB", hint=_AGAIN)
            return np.asarray(image, np.uint8)


def ffmpeg() -> Any:
    """Return imageio_ffmpeg, or raise MissingExtraError."""
    with needs_extra("data", "films need imageio-ffmpeg", otherwise=", or store PNG pictures"):
        import imageio_ffmpeg
    return imageio_ffmpeg


class FilmWriter:
    """Encodes the pictures of one episode as H.264 in an mp4 file.

    Every second picture is a key picture and none is predicted from a later one, so that any frame is found fast.

    Args:
        path: The file to write.
        height: Height of a picture [px], even.
        width: Its width [px], even.
        fps: Pictures per second.
    """

    def __init__(self, path: Path, height: int, width: int, fps: int) -> None:
        """Start the encoder."""
        self.path = path
        self._count = 0
        how = {"codec": "libx264", "pix_fmt_out": "yuv420p", "quality": None, "macro_block_size": 2}
        how |= {"output_params": ["-crf", "18", "-g", "2", "-bf", "0"], "ffmpeg_log_level": "error"}
        self._sink: Any = ffmpeg().write_frames(str(path), (width, height), fps=fps, **how)
        self._sink.send(None)

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Encode a picture.

        Raises:
            StorageError: If the encoder stopped, as it does when the disk is full.
        """
        with storage_errors(f"film {self.path}", hint=_SPACE):
            try:
                self._sink.send(np.ascontiguousarray(picture))
            except StopIteration as error:
                raise OSError("the encoder stopped") from error
        self._count += 1

    def close(self) -> None:
        """Finish the file.

        Raises:
            StorageError: If it does not hold every picture.
        """
        with storage_errors(f"film {self.path}", hint=_SPACE):
            try:
                self._sink.close()
                count, _ = ffmpeg().count_frames_and_secs(str(self.path))
            except RuntimeError as error:
                raise OSError(str(error)) from error
            if count != self._count:
                raise OSError(f"it holds {count} of {self._count} pictures")

    def abort(self) -> None:
        """Stop the encoder; whatever it wrote is of no use."""
        with contextlib.suppress(Exception):  # it may have stopped by itself
            self._sink.close()


def read_film(path: Path, shape: tuple[int, ...]) -> Generator[NDArray[np.uint8], None, None]:
    """Yield the pictures of a film one after the other.

    Args:
        path: An mp4 file.
        shape: Expected (height, width, 3) of a picture.

    Raises:
        AssetError: If it cannot be decoded or its pictures have another size.
    """
    frames = None
    try:
        # The container is named, so that a file which only claims to be one cannot make the decoder open others.
        frames = ffmpeg().read_frames(str(path), pix_fmt="rgb24", input_params=["-f", "mov"])
        width, height = next(frames)["size"]
        if (height, width) != shape[:2]:
            raise AssetError(f"film {path} is {width} x {height}, expected {shape[1]} x {shape[0]}", hint=_AGAIN)
        for frame in frames:
            yield np.frombuffer(frame, np.uint8).reshape(shape)
    except (OSError, RuntimeError, KeyError, StopIteration) as error:
        raise AssetError(f"film {path} cannot be decoded: {error}", hint=_AGAIN) from error
    finally:
        if frames is not None:
            frames.close()
