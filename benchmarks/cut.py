"""What a cut costs: plush and bar cut in two and slit; the parts, wall and process time, what is conserved.

OMP_NUM_THREADS=1 python -m benchmarks.cut [--record]
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from benchmarks.record import add_record_option, record
from softmode.deformables import Patch, carry_over
from softmode.objects import BEAM, ObjectConfig, cut_object, load

CASES = (
    ("plush", ObjectConfig(), Patch.plane((0.0, 0.0, 0.04), (0.2, 0.1, 1.0))),
    ("plush, a slit", ObjectConfig(), Patch.stroke((0.0, -1.0, 0.03), (-1.0, 0.0, 0.03), (0.0, 0.0, 0.03))),
    ("beam", BEAM, Patch.plane((0.0, 0.0, 0.0), (1.0, 0.3, 0.0))),
)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_record_option(parser)
    options = parser.parse_args()
    seconds: dict[str, float | str] = {}
    print("| object | parts of the volume | functions | points | wall [s] | process [s] | momentum | kinetic energy |")
    print("|---|---|---|---|---|---|---|---|")
    for name, config, patch in CASES:
        toy = load(config)
        body = toy.body
        wall, process = time.perf_counter(), time.process_time()
        parts, _ = cut_object(toy, patch)
        wall, process = time.perf_counter() - wall, time.process_time() - process
        seconds[name.replace(", a ", "_")] = process
        fade = 1.0 / (1.0 + np.arange(body.function_count))[:, None]
        qd = fade * np.random.default_rng(0).normal(size=(body.function_count, 3))
        rates = [carry_over(body, part.body, 0.0 * qd, qd)[1] for part in parts]
        volumes = [part.body.volume for part in parts]
        before = body.volume * body.mean_basis @ qd
        after = sum(v * part.body.mean_basis @ r for v, part, r in zip(volumes, parts, rates, strict=True))
        kinetic = sum(v * (r**2).sum() for v, r in zip(volumes, rates, strict=True)) / (body.volume * (qd**2).sum())
        shares = " + ".join(f"{v / body.volume:.4f}" for v in volumes)
        error = float(np.linalg.norm(after - before) / np.linalg.norm(before))
        counts = "+".join(str(part.body.function_count) for part in parts)
        points = "+".join(str(part.body.point_count) for part in parts)
        print(f"| {name} | {shares} | {counts} | {points} | {wall:.2f} | {process:.2f} | {error:.0e} | {kinetic:.4f} |")
    if options.record:
        record("cut", seconds)


if __name__ == "__main__":
    main()
