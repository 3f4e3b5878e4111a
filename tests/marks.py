"""Marks of parameters: which of them `make test` runs, and which are left to `make test-rest`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def rest_but(kept: Iterable[Any], values: Iterable[Any]) -> list[Any]:
    """Return the values of a parameter, all marked `rest` but those that are kept; tuples are several parameters."""
    kept = list(kept)

    def marked(value: Any) -> Any:
        """Return a value with its mark."""
        parts = value if isinstance(value, tuple) else (value,)
        return value if value in kept else pytest.param(*parts, marks=pytest.mark.rest)

    return [marked(value) for value in values]
