"""Processor time of a film of LiftSoft: drawing a picture as films do and as policies see it, and encoding it.

Run: ``OMP_NUM_THREADS=1 python -m benchmarks.film [--edges 256 512]``.
"""

from __future__ import annotations

import argparse
import functools
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym

from softmode.envs import LiftSoftConfig
from softmode.viz.film import Film

FRAMES = 150
"""Pictures of an episode."""


def least(work: Callable[[], object], count: int) -> float:
    """Return the least processor time of some work [s]."""
    work()
    times = []
    for _ in range(count):
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return min(times)


def encoding(pictures: list) -> float:
    """Return the processor time of writing a film, that of the encoder included [s]."""
    begun = time.process_time()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder, Film(Path(folder) / "film.mp4") as film:
        for k in range(FRAMES):
            film.add(pictures[k % len(pictures)], 30)
        film.publish()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() - begun + after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Print a row per size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--edges", type=int, nargs="+", default=[256, 512], help="edge of each of the two views [px]")
    print("two views of | of policies, ms | film, ms | ratio | encoding 150, s | film of 150, s")
    for edge in parser.parse_args().edges:
        config = LiftSoftConfig(render_size=edge, mesh_samples=4)
        env = gym.make("softmode/LiftSoft-v0", render_mode="rgb_array", config=config)
        env.reset(seed=0)
        task, pictures = env.unwrapped.task, []  # type: ignore[attr-defined]
        for _ in range(6):
            env.step(env.action_space.sample())
            pictures.append(env.render())
        seen, drawn = least(functools.partial(task.scene.render, (edge, edge)), 4), least(task.draw_film, 8)
        encoded = encoding(pictures)
        total = FRAMES * drawn + encoded
        print(
            f"{edge} px | {1e3 * seen:.0f} | {1e3 * drawn:.1f} | {seen / drawn:.1f} | {encoded:.1f} | {total:.1f}",
            flush=True,
        )
        env.close()


if __name__ == "__main__":
    main()
