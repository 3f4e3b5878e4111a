"""Settings of the whole test run: where compiled kernels are kept, and which tests need a GPU."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# Before the first import of warp: the cache lies in the checkout, so that a run leaves nothing outside it.
_CACHE = Path(__file__).resolve().parents[1] / ".cache"
os.environ.setdefault("WARP_CACHE_PATH", str(_CACHE / "warp"))
os.environ.setdefault("SOFTMODE_CACHE", str(_CACHE / "softmode"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests marked `gpu` where no CUDA device is found."""
    marked = [item for item in items if item.get_closest_marker("gpu")]
    if not marked:
        return
    import warp as wp

    if not wp.is_cuda_available():
        for item in marked:
            item.add_marker(pytest.mark.skip(reason="no CUDA device"))
