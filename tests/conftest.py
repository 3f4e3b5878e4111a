"""Settings of the whole test run: where compiled kernels are kept, which tests need a GPU, a trained capture."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# Before the first import of warp: the cache lies in the checkout, so that a run leaves nothing outside it.
ROOT = Path(__file__).resolve().parents[1]
_CACHE = ROOT / ".cache"
os.environ.setdefault("WARP_CACHE_PATH", str(_CACHE / "warp"))
os.environ.setdefault("SOFTMODE_CACHE", str(_CACHE / "softmode"))

PLAYBOT = ROOT.parent / "shared" / "data" / "splats" / "playbot" / "4_0" / "meta.json"
"""A trained capture, SOG v2: a robot hovering over a patch of ground, with two loose hands. PLAYBOT by Stephane Agullo,
CC-BY-4.0."""


@pytest.fixture(scope="session")
def playbot() -> Path:
    """Return the trained capture, or skip."""
    if not PLAYBOT.is_file():
        pytest.skip(f"the trained capture {PLAYBOT} is not there")
    return PLAYBOT


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests marked `gpu` where no CUDA device is found."""
    marked = [item for item in items if item.get_closest_marker("gpu")]
    if not marked:
        return
    import warp as wp

    if not wp.is_cuda_available():
        for item in marked:
            item.add_marker(pytest.mark.skip(reason="no CUDA device"))
