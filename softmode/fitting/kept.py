"""`KeptStages`: stages of a fit that are done, in a file, so that a fit that was cut off goes on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softmode import __version__
from softmode.errors import AssetError
from softmode.files import PendingFile, read_json

Array = NDArray[np.float64]


class KeptStages:
    """Arrays of stages by their names; those of another fit are dropped.

    Args:
        path: The file; None keeps nothing.
        key: All that the stages depend on; its text tells one fit from another.
    """

    def __init__(self, path: Path | None, *key: object) -> None:
        """Read what is there."""
        self._path = path
        self._key = hashlib.sha256(repr((__version__, *key)).encode()).hexdigest()
        self._stages: dict[str, list[float]] = {}
        if path is not None and path.exists():
            try:
                told = read_json(path, "stages of a fit")
            except AssetError:  # of a fit that another version kept, or another file: begin anew
                return
            if isinstance(told, dict) and told.get("key") == self._key:
                self._stages = told["stages"]

    def __call__(self, name: str, make: Callable[[], Array]) -> Array:
        """Return the array of a stage, which is made if it is not there yet."""
        if name not in self._stages:
            self._stages[name] = np.asarray(make()).tolist()
            if self._path is not None:
                with PendingFile(self._path, "stages of a fit") as file:
                    file.temporary.write_text(json.dumps({"key": self._key, "stages": self._stages}))
        return np.array(self._stages[name])

    def done(self) -> None:
        """Remove the file."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)
