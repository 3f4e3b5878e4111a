"""A policy learns to lift a toy that is a splat file, with the commands of the shell: check, train, evaluate, film.

The file is a swimming ring of 4,000 splats, 66 mm across, which this script paints; --splat takes your own. On a GPU,
with --device cuda:0 --num-envs 4096, it learns in minutes; on a CPU this shows the way only.

Run: ``python examples/train_own_toy.py [--splat toy.ply --size 0.066] [--device cuda:0 --num-envs 4096] [--short]``
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from softmode.splats import Splats, splats_from_points, write_splats

TASK = "softmode/LiftSoft-v0"


def swimming_ring(count: int = 4000) -> Splats:
    """Return the splats of a striped ring, 66 mm across and 22 mm high: a golden spiral, even by area."""
    around = np.pi * (np.sqrt(5.0) - 1.0) * np.arange(count)
    angles = np.linspace(0.0, 2.0 * np.pi, 1000)
    section = np.interp((np.arange(count) + 0.5) / count, (angles + 0.5 * np.sin(angles)) / (2.0 * np.pi), angles)
    out = np.stack([np.cos(around), np.sin(around), np.zeros(count)], axis=1)
    normals = np.cos(section)[:, None] * out + np.sin(section)[:, None] * [0.0, 0.0, 1.0]
    stripes = np.sin(6.0 * around)[:, None] > 0.0
    colors = np.where(stripes, [0.85, 0.2, 0.15], [0.93, 0.9, 0.85]) * (0.75 + 0.25 * normals[:, 2:])
    return splats_from_points(0.022 * out + 0.011 * normals, colors=colors, normals=normals)


def run(*words: object) -> None:
    """Run a command of the shell and show it; the check of a body ends with 1 where it has warnings."""
    line = [str(word) for word in words]
    print("softmode", *line, flush=True)
    assert subprocess.run([sys.executable, "-m", "softmode", *line], check=False).returncode < 2


def test_final(folder: Path, succeeded: float | None) -> None:
    """The run knows its object by fingerprint, and its policy was evaluated on it; on a GPU it lifts in nine of ten."""
    result = json.loads((folder / "evaluation.json").read_text())
    print(f"{result['env_steps']} steps, success in {result['success_rate']:.2f} of {result['episodes']} episodes")
    assert '"fingerprint": "' in (folder / "config.json").read_text()
    assert result["episodes"] > 0 and np.isfinite(result["mean_return"])
    assert succeeded is None or result["success_rate"] >= succeeded


def main(arguments: list[str] | None = None) -> None:
    """Check, train, evaluate, film."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--splat", type=Path, help="splat file of a toy; the ring if not given")
    parser.add_argument("--up", default="+z", help="axis of the file that points up")
    parser.add_argument("--size", type=float, default=0.066, help="its longest edge [m]")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--time-limit", type=float, default=240.0, help="seconds of training")
    parser.add_argument("--out", type=Path, default=Path("out/own_toy"))
    parser.add_argument("--no-film", action="store_true", help="where imageio-ffmpeg is not installed")
    parser.add_argument("--short", action="store_true", help="a few seconds of everything")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    file, folder = given.splat or given.out / "ring.ply", given.out / "run"
    if given.splat is None:
        write_splats(file, swimming_ring())
    toy = ("--splat", file, "--up", given.up, "--size", given.size)
    worlds = ("--num-envs", 4 if given.short else given.num_envs, "--device", given.device)
    limit = ("--total-steps", 64, "--eval-episodes", 4) if given.short else ("--time-limit", given.time_limit)
    run("body", "check", file, "--up", given.up, "--size", given.size)
    run("train", TASK, *toy, *worlds, *limit, "--run-dir", folder)
    best = folder / "best.npz"
    run("evaluate", TASK, best, "--episodes", 2 if given.short else 200, *worlds)
    if not given.no_film:
        film = ("--video", given.out / "lift.mp4", "--width", 192 if given.short else 640)
        run("play", TASK, "--policy", best, "--seed", 1, *film, "--device", given.device)
    test_final(folder, 0.9 if given.device != "cpu" and not given.short else None)


if __name__ == "__main__":
    main()
