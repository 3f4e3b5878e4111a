"""Marks of parameters: which `make test` runs, and which are left to `make test-rest` and `make test-slow`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def rest_but(kept: Iterable[Any], values: Iterable[Any], slow: Iterable[Any] = ()) -> list[Any]:
    """Return the values of a parameter, all but the kept marked `rest` or `slow`; tuples are several parameters."""
    kept, slow = list(kept), list(slow)

    def marked(value: Any) -> Any:
        """Return a value with its mark."""
        parts = value if isinstance(value, tuple) else (value,)
        mark = pytest.mark.slow if value in slow else pytest.mark.rest
        return value if value in kept else pytest.param(*parts, marks=mark)

    return [marked(value) for value in values]
