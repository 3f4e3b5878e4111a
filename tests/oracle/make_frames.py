"""Run the oracle and store its frames: `python -m tests.oracle.make_frames [scene ...]` (all scenes by default)."""

from __future__ import annotations

import argparse
import time

import numpy as np
from threadpoolctl import threadpool_limits

from tests.oracle.fem import simulate
from tests.oracle.frames import save
from tests.oracle.scenes import SCENES


def main() -> None:
    """Store the frames of the named scenes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", nargs="*", metavar="scene", help=", ".join(SCENES))
    names = parser.parse_args().scene or list(SCENES)
    for name in names:
        if name not in SCENES:
            parser.error(f"unknown scene {name!r}; there are {', '.join(SCENES)}")
    for name in names:
        scene, start, iterations = SCENES[name], time.perf_counter(), []
        with threadpool_limits(limits=1):
            solid, displacement = simulate(scene, progress=lambda step, count, log=iterations: log.append(count))
            path, error, rank = save(scene, displacement)
        print(
            f"{name}: {len(solid.mesh.elements)} elements, {solid.size} unknowns, {scene.steps} steps, "
            f"{np.mean(iterations):.1f} Newton iterations (most {max(iterations)}), "
            f"{time.perf_counter() - start:.0f} s; {rank} shapes, rms error {error:.1e} m "
            f"(nMSE {(error / scene.edge) ** 2:.0e}), "
            f"{path.stat().st_size / 1e3:.0f} kB",
            flush=True,
        )


if __name__ == "__main__":
    main()
