"""A served page that is no live session."""

from __future__ import annotations

import contextlib
import io
from typing import Self

from softmode.view.app import ViewOptions, page_url, start_server


class Page:
    """A server with a page; a context manager.

    Args:
        options: Where the page is served.

    Raises:
        ConfigError: If the address or the port cannot be used.
        MissingExtraError: If viser is not installed.
    """

    def __init__(self, options: ViewOptions) -> None:
        """Start the server."""
        self._options = options
        self._server = start_server(options)

    def __enter__(self) -> Self:
        """Return the page."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the server."""
        self.close()

    def close(self) -> None:
        """End the server; may be called twice."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    @property
    def url(self) -> str:
        """Where to point the browser."""
        return page_url(self._options, self._server.get_port())
