"""What commands write: no escapes from the files and names of others."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Iterator
from typing import Any

_OWN = r"\x1b\[(?:0|31|33)m|\x1b\[A|^\r"
"""What softmode and tqdm write: three colours, a line up, the begin of a line."""
_CONTROL = re.compile(rf"({_OWN})|[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")
"""All controls but tabs and ends of lines, and what turns the direction of text round."""


class _Plain:
    """A stream that writes ? for controls, which leaves the rest of an escape readable."""

    def __init__(self, stream: Any) -> None:
        """Keep the stream."""
        self._stream = stream

    def write(self, text: str) -> int:
        """Write a text; return its length."""
        return self._stream.write(_CONTROL.sub(lambda found: found[1] or "?", text))

    def __getattr__(self, name: str) -> Any:
        """Return anything else of the stream."""
        return getattr(self._stream, name)


@contextlib.contextmanager
def plain_output() -> Iterator[None]:
    """Let nothing that is written in a block move the cursor, change the terminal or hide other text."""
    out: Any = _Plain(sys.stdout)
    errors: Any = _Plain(sys.stderr)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        yield
