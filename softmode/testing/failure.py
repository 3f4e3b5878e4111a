"""What lies beside the report of a failure: the film, the recording, and the state some steps before."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

from softmode.errors import SoftmodeError
from softmode.testing.episode import Episode

if TYPE_CHECKING:
    from softmode.viz.film import Film
    from softmode.viz.rerun_logger import RerunLogger

BEFORE = 10
"""Control steps from the saved state to the failure."""


def save_failure(episode: Episode, folder: Path) -> list[str]:
    """Play a failed episode again, from its start, and write film.mp4 with its sheet, episode.rrd and before.npz.

    It is drawn in an environment of its own, so that episodes that pass draw nothing.

    Args:
        episode: The episode; its last step counts as the failure where no assertion named another.
        folder: Where the files go; made if it is not there.

    Returns:
        A line per file: where it is, or why it is left out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    last = len(episode.steps) - 1 if episode.failed_at is None else episode.failed_at
    before, lines = max(last + 1 - BEFORE, 0), []
    with contextlib.ExitStack() as stack:
        twin = episode.base.twin(render_mode="rgb_array")
        stack.callback(twin.close)
        twin.set_state(episode.start)
        film, log = None, None
        try:
            film = stack.enter_context(_film(folder))
        except SoftmodeError as error:
            lines.append(f"no film: {error}")
        try:
            log = stack.enter_context(_log(folder, twin))
            log.record()
        except SoftmodeError as error:
            lines.append(f"no recording: {error}")
        state = twin.get_state()
        for number, _ in enumerate(episode.replayed(twin)):
            if film is not None and (frame := twin.render()) is not None:
                film.add(frame, twin.metadata["render_fps"])
            if log is not None:
                log.record()
            if number + 1 == before:
                state = twin.get_state()
        state.save(folder / "before.npz")
        lines.append(f"state before step {before}: {folder / 'before.npz'}")
        if film is not None and episode.steps:
            film.publish()
            lines.append(f"film: {film.path}")
        if log is not None:
            log.publish()
            lines.append(f"recording: {folder / 'episode.rrd'}")
    return lines


def _film(folder: Path) -> Film:
    """Return the film to write."""
    from softmode.viz.film import Film

    return Film(folder / "film.mp4")


def _log(folder: Path, twin: object) -> RerunLogger:
    """Return the recording to write."""
    from softmode.viz.rerun_logger import RerunLogger

    return RerunLogger(folder / "episode.rrd", twin)
