"""The browser of who looks on."""

from __future__ import annotations

import os
import sys
import threading


def open_browser(url: str) -> None:
    """Open a browser without waiting for it, where there is a display."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return
    import webbrowser

    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
