"""What decides the bits of a built body beside its recipe: the sources that build, libraries, the processor's BLAS."""

from __future__ import annotations

import hashlib
from importlib.metadata import version
from pathlib import Path

ROOMS = (
    *(f"deformables/{part}" for part in ("body", "materials", "quadrature", "reduction")),
    *("objects", "radiance", "splats"),
)
"""Rooms of the package that build a body."""
LIBRARIES = ("numpy", "scipy", "trimesh")


def sources_hash() -> str:
    """Return the hash of it all; the tests keep bodies in a folder of that name, so that none outlives its sources."""
    import scipy.linalg  # noqa: F401  (loads the BLAS that is asked)
    from threadpoolctl import threadpool_info

    package = Path(__file__).resolve().parents[1] / "softmode"
    digest = hashlib.sha256()
    for path in sorted(path for room in ROOMS for path in (package / room).rglob("*.py")):
        digest.update(path.read_bytes())
    processors = sorted(str(pool.get("architecture")) for pool in threadpool_info())
    digest.update(repr([*map(version, LIBRARIES), *processors]).encode())
    return digest.hexdigest()[:16]
