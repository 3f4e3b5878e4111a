"""Launches beside others: on a CUDA stream of their own, so that neither waits for the other."""

from types import TracebackType
from typing import Any

import warp as wp


class Beside:
    """A stream beside the current one; on a CPU there is none, and launches run in the order of the code.

    Use it as a context: what is launched within waits for all that was launched before, what is launched behind it does
    not wait for it until :meth:`join`. The two must write nothing that the other reads or writes. While a graph is
    captured, no loop and no branch of it (``wp.capture_while``, ``wp.capture_if``) may begin before :meth:`join`: Warp
    pauses the capture for those, and a capture cannot be paused while streams are apart.

    Args:
        device: Where.
        first: Whether its blocks of threads are started before those of the stream beside which it is.
    """

    def __init__(self, device: wp.Device, *, first: bool = True) -> None:
        """Make the stream."""
        self._stream: Any = wp.Stream(device, priority=-int(first)) if device.is_cuda else None
        self._apart = False

    def __enter__(self) -> None:
        """Let what follows go to the stream of its own."""
        self._scope = wp.ScopedStream(self._stream, sync_enter=True)
        self._scope.__enter__()
        self._apart = True

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Go back to the stream before."""
        self._scope.__exit__(kind, error, trace)

    def join(self) -> None:
        """Let what follows wait for what was launched within the context; without any, do nothing."""
        if self._stream is not None and self._apart:
            wp.get_stream(self._stream.device).wait_stream(self._stream)
        self._apart = False
