"""Simplicits' networks for the meshes of a folder, trained all at once: `python -m benchmarks.freeform.simplicits`.

Run: ``python -m benchmarks.freeform.simplicits FOLDER OUTPUT.npz [--device cuda:0] [--iterations 10000]``. Training has
1e5 Pa whatever the object's: a stiffer one makes the elastic loss outweigh orthogonality, and weights vanish.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy import FINE_RANK
from benchmarks.baselines.neural_weights import NeuralWeights, NeuralWeightsOptions, train_many
from benchmarks.baselines.reduced import neural_body
from benchmarks.freeform.grips import POISSONS_RATIO
from benchmarks.freeform.meshes import read_folder
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.files import whole_file

MODE_COUNT, YOUNGS_MODULUS = 16, 1.0e5


def stored_body(path: Path, name: str) -> Callable[[Any], ReducedBody] | None:
    """Return what reduces a mesh by the network stored for it, or None."""
    with np.load(path) as file:
        arrays = {key.split("/", 1)[1]: file[key] for key in file.files if key.split("/", 1)[0] == name}
    if not arrays:
        return None
    network = NeuralWeights.of(arrays)
    return lambda thing: neural_body(thing.quadrature, network, MODE_COUNT, thing.name, rank_tolerance=FINE_RANK)


def main() -> None:
    """Train and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--iterations", type=int, default=NeuralWeightsOptions.iterations)
    given = parser.parse_args()
    things = read_folder(given.folder)
    options = NeuralWeightsOptions(mode_count=MODE_COUNT, iterations=given.iterations, unit_cube=False)
    networks = train_many(
        [(thing.quadrature.points, thing.quadrature.volume) for thing in things],
        options,
        youngs_modulus=YOUNGS_MODULUS,
        poissons_ratio=POISSONS_RATIO,
        device=given.device,
        report=lambda iteration: print(f"iteration {iteration}", flush=True),
    )
    arrays = {
        f"{t.name}/{key}": v.astype(np.float32)
        for t, n in zip(things, networks, strict=True)
        for key, v in n.arrays().items()
    }
    with whole_file(given.output) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    print(f"{len(things)} networks, {networks[0].train_seconds:.0f} s", flush=True)


if __name__ == "__main__":
    main()
