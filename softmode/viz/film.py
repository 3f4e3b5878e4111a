"""A video with its contact sheet, written whole or not at all."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softmode.errors import ConfigError, needs_extra
from softmode.files import PendingFile, storage_errors

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


GIF_RATE = 20
"""Most pictures per second of a GIF, which counts time in hundredths of a second."""
GIF = f"fps={GIF_RATE},split[a][b];[a]palettegen=max_colors=200:stats_mode=full[p];[b][p]paletteuse=dither=none"
"""How ffmpeg makes a GIF: one palette for the whole film, so that still parts do not flicker."""


class Film:
    """A video and its contact sheet that appear complete or not at all.

    Args:
        path: The video to write (.mp4), or a .gif that loops.

    Raises:
        ConfigError: If it has another suffix.
        StorageError: If it cannot be written there.
        MissingExtraError: If what encodes it is not installed.
    """

    SHEET_FRAMES = 12

    def __init__(self, path: Path) -> None:
        """Claim a temporary file beside ``path``."""
        with needs_extra("demo", "writing a video needs imageio-ffmpeg"):
            import imageio_ffmpeg  # noqa: F401
        if path.suffix.lower() not in (".mp4", ".gif"):
            raise ConfigError(f"video {path} is no .mp4 or .gif file", hint="name it like out/lift.mp4")
        self.path = path
        self.sheet_path = path.with_suffix(".png")
        if self.sheet_path.is_dir():
            raise ConfigError(f"contact sheet {self.sheet_path} is a folder", hint="name the video otherwise")
        self._file = PendingFile(path, "video")
        self._sheet = self._file.temporary.with_suffix(".png")
        self._writer: Any = None
        self._frames: list[NDArray[np.uint8]] = []
        self._count, self._stride = 0, 1

    def __enter__(self) -> Film:
        """Return the film."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove what was not published."""
        self.discard()

    def add(self, frame: NDArray[np.uint8], fps: int) -> None:
        """Append a frame.

        Raises:
            StorageError: If the encoder stopped, as it does when the disk is full.
        """
        import numpy as np

        if self._writer is None:
            from imageio_ffmpeg import write_frames

            how: dict[str, Any] = {"codec": "libx264", "quality": 8, "macro_block_size": 2}
            how["output_params"] = ["-preset", "superfast", "-threads", "1"]  # most of a small film's time otherwise
            if self.path.suffix.lower() == ".gif":
                how = {"codec": "gif", "quality": None, "macro_block_size": 1, "pix_fmt_out": "pal8"}
                how["output_params"] = ["-vf", GIF, "-loop", "0"]
            size = (frame.shape[1], frame.shape[0])
            self._writer = write_frames(self._file.temporary, size, fps=fps, **how)
            self._writer.send(None)
        with storage_errors(f"video {self.path}"):
            try:
                self._writer.send(np.ascontiguousarray(frame))
            except StopIteration as error:
                raise OSError("the encoder stopped") from error
        if self._count % self._stride == 0:
            self._frames.append(frame)
        self._count += 1
        if len(self._frames) >= 8 * self.SHEET_FRAMES:  # a long film keeps every second of them
            self._frames, self._stride = self._frames[::2], 2 * self._stride

    def publish(self) -> None:
        """Put video and contact sheet in place.

        Raises:
            StorageError: If they cannot be written.
        """
        with storage_errors(f"video {self.path}"):
            self._publish()

    def _publish(self) -> None:
        """Finish the video, draw the sheet, put both in place."""
        import numpy as np
        from PIL import Image

        self._writer.close()
        if self._file.temporary.stat().st_size == 0:
            raise OSError(f"the encoder wrote nothing to {self._file.temporary}")
        # Equal steps in what changed, so that a long rest at the end does not fill the sheet.
        coarse = np.array([frame[::4, ::4] for frame in self._frames], np.float32)
        change = np.abs(np.diff(coarse, axis=0)).mean(axis=(1, 2, 3))
        done = np.append(0.0, np.cumsum(change + 0.2 * change.mean() + 1.0e-6)) if len(change) else np.zeros(1)
        chosen = np.abs(done - np.linspace(0.0, done[-1], self.SHEET_FRAMES)[:, None]).argmin(axis=1)
        rows = [np.concatenate([self._frames[i] for i in chosen[k : k + 3]], axis=1) for k in range(0, len(chosen), 3)]
        Image.fromarray(np.concatenate(rows, axis=0)).save(self._sheet, compress_level=2)
        os.replace(self._sheet, self.sheet_path)
        self._file.publish()

    def discard(self) -> None:
        """Remove what was not published."""
        if self._writer is not None:
            with contextlib.suppress(Exception):  # an encoder that was interrupted too has nothing left to say
                self._writer.close()
        self._file.discard()
