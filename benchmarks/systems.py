"""Factorisation and solve of large systems: by the whole device, by a team of threads for each, and by torch.

Run: ``python -m benchmarks.systems [--device cuda:0] [--sizes 264 528 1536 2352] [--counts 1 16 256]``. Random positive
definite systems of condition 100 with one right-hand side. The floor is N^3 / 3 flops for each at the rate of a large
float32 matrix product in this run. The error is that of the solution against float64, over its norm; that of torch is
its Cholesky's. On a CPU, where one thread takes a system, the code of the panels runs with one thread: slowly.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import warp as wp

from benchmarks.clock import Clock
from benchmarks.step import product_rate
from softmode.deformables.model.lane_kernels import LANES
from softmode.deformables.system.factor import BlockCholesky


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--sizes", type=int, nargs="+", default=[264, 528, 1536, 2352], help="multiples of eight")
    parser.add_argument("--counts", type=int, nargs="+", default=[1])
    parser.add_argument("--repeats", type=int, default=9)
    given = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    rate = product_rate(given.device)
    print(f"{given.device}: float32 matrix product {rate / 1e12:.3f} Tflop/s in this run")
    ways = " | ".join(f"{way}: factor, solve ms, error" for way in ("panels", "team"))
    print(f"unknowns systems | floor ms | {ways} | torch: factor ms, error")
    for size in given.sizes:
        for count in given.counts:
            if count * size * size <= 2**30:
                report(size, count, rate, Clock(given.device, given.repeats))


def report(size: int, count: int, rate: float, clock: Clock) -> None:
    """Print one row."""
    rng = np.random.default_rng(size)
    base = np.linalg.qr(rng.normal(size=(size, size)))[0]
    A = (base * np.geomspace(1.0, 100.0, size)) @ base.T
    b = rng.normal(size=size)
    expected = np.linalg.solve(A, b)
    row = f"{size:8d} {count:7d} | {1e3 * count * size**3 / 3.0 / rate:8.3f} |"
    world = wp.array(np.arange(count), dtype=int, device=clock.device)
    system = BlockCholesky(world, size, 1, clock.device)
    host = np.zeros((size, size + LANES), np.float32)
    host[:, :size], host[:, size] = A, b
    every = np.tile(host.reshape(1, size, -1, LANES), (count, 1, 1, 1))
    full: Any = wp.array(every, dtype=system.matrix.dtype, device=clock.device)
    on = wp.full(count, 1, dtype=int, device=clock.device)
    known = wp.zeros((count, 1), dtype=wp.float64, device=clock.device)

    def restored(run: Callable[[], object]) -> Callable[[], None]:
        def both() -> None:
            wp.copy(system.matrix, full)
            run()

        return both

    copying = clock.replay(restored(lambda: None))
    for by_panels in (True, False):
        system.by_panels = by_panels
        factor = clock.replay(restored(lambda: system.factor(on))) - copying
        solve = clock.replay(lambda: system.solve(on, 0, known, 0))
        error = error_of(system.table.solution.numpy().reshape(count, -1), expected)
        row += f" {factor:8.3f} {solve:7.3f} {error:.1e} |"
    device = torch.device(str(clock.device))
    matrix = torch.tensor(A, dtype=torch.float32, device=device).repeat(count, 1, 1)
    right = torch.tensor(b, dtype=torch.float32, device=device).repeat(count, 1)[:, :, None]
    lower = torch.linalg.cholesky(matrix)

    def factored() -> None:
        torch.linalg.cholesky(matrix)
        if device.type == "cuda":
            torch.cuda.synchronize()

    spent = clock.median(factored)
    found = torch.cholesky_solve(right, lower)[:, :, 0].cpu().numpy()
    print(row + f" {spent:8.3f} {error_of(found, expected):.1e}", flush=True)


def error_of(found: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest error of the solutions over their norm."""
    return float(np.linalg.norm(found - expected, axis=1).max() / np.linalg.norm(expected))


if __name__ == "__main__":
    main()
