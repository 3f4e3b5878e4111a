"""Golden episodes: what was played once, kept in a file, and compared with what is played now."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from softmode.files import read_archive, write_archive
from softmode.testing.episode import Episode

_KIND, _VERSION = "softmode-golden-episode", 1
_REMEDY = "pytest --softmode-golden update"


def write_golden(episode: Episode, path: Path) -> None:
    """Write an episode as the golden one.

    Raises:
        StorageError: If the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"format": _KIND, "version": _VERSION, "seed": episode.seed, "owner": episode.start.owner}
    arrays = {"actions": episode.actions, "observations": episode.observations, "rewards": episode.rewards}
    write_archive(path, header, arrays, "golden episode")


def assert_golden(episode: Episode, path: Path, *, atol: float = 0.0) -> None:
    """Assert that an episode is the one in a file: its actions, observations and rewards.

    Args:
        episode: The episode.
        path: What :func:`write_golden` wrote.
        atol: Largest difference of a number; 0 asks for the same bits.

    Raises:
        AssetError: If the file is damaged or of another version.
    """
    if not path.is_file():
        raise AssertionError(f"there is no golden episode {path}; make it with: {_REMEDY}")
    hint = f"make it anew with: {_REMEDY}"
    header, golden = read_archive(path, _KIND, _VERSION, what="golden episode", hint=hint)
    before = {"seed": header["seed"], **header["owner"]}
    for name, value in {"seed": episode.seed, **episode.start.owner}.items():
        if before[name] != value:
            raise AssertionError(f"the golden episode {path} has {name} {before[name]}, this one {value}; {hint}")
    segments = {name: columns for name, (columns, _) in episode.base.task.segments.items()}
    for number, step in enumerate(episode.steps[: len(golden["actions"])]):
        now = {"actions": step.action, "observations": step.observation, "rewards": np.array(step.reward)}
        for name, value in now.items():
            off = np.abs(value - golden[name][number])
            if off.max() <= atol:
                continue
            if name == "observations":
                name = next(part for part, columns in segments.items() if not (off[columns] <= atol).all())
            raise episode.failed(number, f"{name} off by {off.max():.3g} from {path.name}; if that is meant: {_REMEDY}")
    if len(episode.steps) != len(golden["actions"]):
        last = min(len(episode.steps), len(golden["actions"])) - 1
        raise episode.failed(last, f"{path.name} has {len(golden['actions'])} steps; if that is meant: {_REMEDY}")
