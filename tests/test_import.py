"""`import softmode` is cheap: registration and nothing else."""

from __future__ import annotations

import subprocess
import sys

HEAVY = (
    "warp",
    "newton",
    "mujoco",
    "mujoco_warp",
    "torch",
    "tensorboard",
    "pxr",
    "rerun",
    "viser",
    "scipy",
    "trimesh",
    "imageio",
    "pyarrow",
    "tyro",
)

SCRIPT = f"""
import sys
before = set(sys.modules)
import softmode, softmode.cli.main, softmode.errors, softmode.testing
loaded = sorted(set({HEAVY!r}) & {{name.partition(".")[0] for name in set(sys.modules) - before}})
assert not loaded, loaded
import gymnasium
assert set(softmode.ENVIRONMENTS) <= set(gymnasium.registry)
with open("/proc/self/maps") as maps:  # a CUDA context needs the driver's library
    assert "libcuda" not in maps.read()
"""


def test_import_loads_nothing_heavy_and_no_driver() -> None:
    """A fresh process that imports the package and its command line has loaded no simulator and no CUDA driver."""
    run = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
