"""Time of importing OpenUSD stages: a robot, a prop and two soft bodies, and a large set of splats.

Times are processor time of this process and of the one that opens files, the least of five.

Run: ``python -m benchmarks.usd_import``
"""

import tempfile
from pathlib import Path

import newton
import numpy as np
import warp as wp

from benchmarks.usd import seconds
from softmode.splats import Splats
from softmode.splats import write_usd as write_splats
from softmode.usd import add_usd, read_usd_scene
from tests.usd.test_import_newton import SMALL, everything


def main() -> None:
    """Print the table."""
    wp.config.log_level = wp.LOG_WARNING
    rng, count = np.random.default_rng(0), 300_000
    quats, scales, opacities = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), np.full((count, 3), 0.01), np.full(count, 0.9)
    with tempfile.TemporaryDirectory() as folder:
        stage, splats = everything(Path(folder) / "a.usda"), Path(folder) / "b.usdc"
        write_splats(
            splats,
            Splats(
                means=rng.normal(size=(count, 3)),
                quats=quats,
                scales=scales,
                opacities=opacities,
                sh=rng.normal(size=(count, 16, 3)),
            ),
        )
        print("| what | size [MB] | time [s] |\n|---|---|---|")
        for name, path, work in (
            ("read_usd_scene, robot, prop, two bodies", stage, lambda: read_usd_scene(stage)),
            (
                "add_usd, the same, bodies cached",
                stage,
                lambda: add_usd(newton.ModelBuilder(), stage, build_options=SMALL),
            ),
            ("read_usd_scene, 300,000 splats of degree 3", splats, lambda: read_usd_scene(splats)),
        ):
            print(f"| {name} | {path.stat().st_size / 1e6:.2f} | {seconds(work, 5):.2f} |", flush=True)


if __name__ == "__main__":
    main()
