"""`RerunStream`: a recording for the rerun viewer, as a file that appears whole or not at all, or shown live."""

from __future__ import annotations

import contextlib
import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from softmode.errors import ConfigError, StorageError, needs_extra
from softmode.files import PendingFile

if TYPE_CHECKING:
    import rerun as rr
    from rerun.blueprint import Blueprint

LIVE = "rerun+http"
"""How the address of a running viewer begins."""
PORT = 9876
"""Where a viewer listens if its address does not say."""
CONNECT = 5.0
"""Seconds in which a viewer has to answer."""
FLUSH = {"flush_tick": 86400.0, "flush_num_bytes": 2**24}
"""Rows of a file are gathered into chunks of up to 16 MiB for each entity, however long that takes [s]."""


class RerunStream:
    """Takes what is logged and ends in a file, or in a viewer that runs.

    Args:
        target: File to write (.rrd), address of a running viewer, or "spawn", which opens one.
        name: Name of the recording.

    Raises:
        ConfigError: If the file cannot be written there, or no viewer answers at the address.
        MissingExtraError: If rerun is not installed.
    """

    def __init__(self, target: str | Path, name: str) -> None:
        """Open the file or reach the viewer."""
        live = check_target(target)
        import rerun as rr

        self._file = None if live else PendingFile(target, "recording")
        # A file gains from large chunks, a viewer from prompt ones.
        batches = rr.ChunkBatcherConfig.DEFAULT() if live else rr.ChunkBatcherConfig(**FLUSH)
        self._stream: rr.RecordingStream | None = rr.RecordingStream("softmode", batcher_config=batches)
        try:
            self._stream.set_log_time_enabled(False)
            self._stream.set_log_tick_enabled(False)
            if self._file is not None:
                self._stream.save(self._file.temporary)
            else:
                _reach(self._stream, str(target))
            self._stream.send_recording_name(name)
        except BaseException:
            self.discard()
            raise

    @property
    def ended(self) -> bool:
        """Whether the recording was published or discarded."""
        return self._stream is None

    def log(self, path: str, what: rr.AsComponents, *, static: bool = False) -> None:
        """Write one thing.

        Args:
            path: Its entity.
            what: An archetype of rerun.
            static: Whether it holds at all times.
        """
        self._open.log(path, what, static=static)

    def set_moment(self, step: int, time: float) -> None:
        """Set the timelines "step" and "sim_time" [s]."""
        self._open.set_time("step", sequence=step)
        self._open.set_time("sim_time", duration=time)

    def send_blueprint(self, blueprint: Blueprint) -> None:
        """Send the layout of the viewer."""
        self._open.send_blueprint(blueprint)

    @property
    def _open(self) -> rr.RecordingStream:
        if self._stream is None:
            raise ConfigError("the recording has ended", hint="record before publish, inside the with block")
        return self._stream

    def publish(self) -> None:
        """End the recording and put the file in place; does nothing the second time.

        Raises:
            StorageError: If what was written cannot be read back, as on a full disk, or the viewer has gone.
        """
        if self._stream is None:
            return
        try:
            self._end()
        except RuntimeError as error:  # rerun's, of a sink that takes nothing
            if self._file is not None:
                self._file.discard()
            hint = "look whether the viewer still runs" if self._file is None else "check the free space"
            raise StorageError(f"the recording could not be sent: {error}", hint=hint) from error
        if self._file is None:
            return
        try:
            from rerun.chunk import RrdReader

            RrdReader(self._file.temporary).store()  # reads the list of all chunks, which is written last
        except Exception as error:
            self._file.discard()
            raise StorageError(f"recording {self._file.path} is not complete", hint="check the free space") from error
        self._file.publish()

    def discard(self) -> None:
        """End the recording and remove the file unless it was published."""
        if self._stream is not None:
            with contextlib.suppress(RuntimeError):  # of a viewer that has gone, which is no news here
                self._end()
        if self._file is not None:
            self._file.discard()

    def _end(self) -> None:
        """Write out what is still in memory and close."""
        stream, self._stream = self._open, None
        try:
            stream.flush()
        finally:
            stream.disconnect()


def _reach(stream: rr.RecordingStream, target: str) -> None:
    """Open a viewer, or connect to one.

    Raises:
        ConfigError: If none is there.
    """
    try:
        if target == "spawn":
            stream.spawn()
            listens = f"the viewer that rerun opens listens at all addresses, port {PORT}"
            print(f"softmode: {listens}; one of your own can be kept to this machine by --bind", file=sys.stderr)
            return
        place = urlsplit(target)
        if place.hostname:  # rerun itself would try for as long as there is something to send
            socket.create_connection((place.hostname, place.port or PORT), timeout=CONNECT).close()
        stream.connect_grpc(target)
    except (OSError, RuntimeError, ValueError) as error:
        raise ConfigError(f"no rerun viewer answers at {target!r}: {error}", hint="start one with: rerun") from error


def check_target(target: str | Path) -> bool:
    """Return whether a recording is shown live instead of written.

    Raises:
        ConfigError: If it is neither a .rrd file, nor the address of a viewer, nor "spawn".
        MissingExtraError: If rerun is not installed.
    """
    with needs_extra("viz", "recording for rerun needs rerun-sdk"):
        import rerun  # noqa: F401
    live = str(target) == "spawn" or str(target).startswith(LIVE)
    if not live and Path(target).suffix.lower() != ".rrd":
        raise ConfigError(f"recording {target} is no .rrd file", hint="name it like out/lift.rrd")
    return live
