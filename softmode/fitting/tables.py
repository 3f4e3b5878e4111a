"""Tables that are fitted to: markers of a motion capture, and forces over a way."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softmode.errors import AssetError, FitError
from softmode.files import read_file
from softmode.objects.fingerprint import file_fingerprint

Array = NDArray[np.float64]
SHAKEN = 5
"""Frames for which a marker is away from its place once it is let go."""
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
_FORCES = {"N": 1.0, "mN": 1e-3, "kN": 1e3, "gf": 9.80665e-3, "kgf": 9.80665}
_TITLE = re.compile(r"\s*([A-Za-z]+)[\s_]*[\[(]?\s*([A-Za-z]*)\s*[\])]?\s*")


@dataclass(frozen=True, kw_only=True, eq=False)
class Markers:
    """Places of markers over time."""

    times: Array
    """From the first [s], shape (F,)."""
    names: tuple[str, ...]
    """Of the markers (M)."""
    places: Array
    """Where they are [m], shape (F, M, 3)."""
    source: str = "markers"
    """Their file."""
    fingerprint: str = ""
    """Its sha256."""

    @property
    def noise(self) -> float:
        """Standard deviation of a coordinate while nothing moves, at least 20 um [m]."""
        steps = np.diff(self.places, n=2, axis=0)
        quiet = np.sort(np.abs(steps).mean(axis=(1, 2)))[: max(len(steps) // 4, 4)]
        return max(float(quiet.mean()) / np.sqrt(6.0) * 1.25, 2.0e-5)

    def of(self, names: Sequence[str]) -> Markers:
        """Return some of the markers.

        Raises:
            FitError: If there is none of a name.
        """
        gone = [name for name in names if name not in self.names]
        if gone:
            hint = f"the file has {', '.join(self.names)}"
            raise FitError(f"{self.source}: has no marker {', '.join(gone)}", hint=hint)
        places = self.places[:, [self.names.index(name) for name in names]]
        return Markers(times=self.times, names=tuple(names), places=places, source=self.source)

    @property
    def release(self) -> int:
        """The last frame before one of them has moved by ten times the noise and 2 % of its way.

        Raises:
            FitError: If none moves.
        """
        away = np.linalg.norm(self.places - self.places[:5].mean(axis=0), axis=2).max(axis=1)
        if away.max() < 20.0 * self.noise:
            hint = "let the object go, or hang a weight on it"
            raise FitError(f"{self.source}: not observable, because no marker moves", hint=hint)
        moved = away > max(10.0 * self.noise, 0.02 * away.max())
        lasting = np.convolve(moved, np.ones(SHAKEN), "valid") == SHAKEN  # a hand may shake it a little before
        return max(int(lasting.argmax()) - 1, 0)


def _rows(path: Path, what: str) -> tuple[list[str], Array]:
    """Return the titles of a table and its numbers."""
    text = read_file(path, what).decode("utf-8-sig", errors="replace")
    try:
        lines = [row for row in csv.reader(text.splitlines()) if row and not row[0].lstrip().startswith("#")]
    except csv.Error as error:
        raise AssetError(f"{what} {path}: {error}", hint="give numbers separated by commas below the titles") from error
    titles = [word.strip() for word in lines[0]] if lines else []
    if len(lines) < 4:
        raise AssetError(f"{what} {path}: holds {max(len(lines) - 1, 0)} rows", hint="give a title and rows of numbers")
    if any(len(row) != len(titles) for row in lines):
        raise AssetError(f"{what} {path}: rows differ in length", hint="give a number below each title")
    try:
        return titles, np.array([[float(word) if word.strip() else np.nan for word in row] for row in lines[1:]])
    except ValueError as error:
        raise AssetError(f"{what} {path}: {error}", hint="give numbers separated by commas below the titles") from error


def read_markers(path: Path) -> Markers:
    """Read a table of columns ``time`` [s], ``NAME_x``, ``NAME_y``, ``NAME_z`` [m], ...

    Raises:
        AssetError: If it cannot be read.
        FitError: If a marker vanishes, jumps, or lacks a coordinate.
    """
    titles, rows = _rows(path, "marker file")
    if titles[0].lower() not in ("time", "t", "time_s", "time [s]"):
        raise AssetError(f"marker file {path}: its first column is {titles[0]!r}", hint="name it time, in seconds")
    names = list(dict.fromkeys(title[:-2] for title in titles[1:] if title[-2:] in ("_x", "_y", "_z")))
    wanted = [f"{name}_{axis}" for name in names for axis in "xyz"]
    if not names or sorted(titles[1:]) != sorted(wanted):
        odd = sorted(set(titles[1:]) ^ set(wanted)) or titles[1:]
        hint = "give three columns NAME_x, NAME_y, NAME_z [m] for each marker, once"
        raise FitError(f"marker file {path}: columns {', '.join(odd[:6])} make no markers", hint=hint)
    places = rows[:, [titles.index(title) for title in wanted]].reshape(len(rows), -1, 3)
    times = rows[:, 0] - rows[0, 0]
    if not np.isfinite(rows[:, 0]).all() or not (np.diff(times) > 0.0).all() or len(times) < 20:
        raise FitError(f"marker file {path}: times do not increase over 20 rows or more", hint="export it again")
    for k, name in enumerate(names):
        gone = np.flatnonzero(~np.isfinite(places[:, k]).all(axis=1))
        if len(gone):
            what = f"marker file {path}: {name} vanishes at {times[gone[0]]:.3g} s"
            raise FitError(what, hint="fill its gaps in the motion capture, or leave the marker out")
        step = np.linalg.norm(np.diff(places[:, k], axis=0), axis=1)
        change = np.abs(np.diff(step, append=step[-1:]))
        if (jump := int(change.argmax())) >= 0 and change[jump] > max(4.0 * np.sort(step)[-4], 3.0e-3):
            what = f"marker file {path}: {name} jumps at {times[jump + 1]:.3g} s"
            raise FitError(what, hint="markers were swapped or renamed there: label them again, or leave it out")
    return Markers(times=times, names=tuple(names), places=places, source=str(path), fingerprint=file_fingerprint(path))


@dataclass(frozen=True, kw_only=True, eq=False)
class ForceLog:
    """Forces over a way."""

    way: Array
    """Depth or opening [m], shape (K,)."""
    force: Array
    """Force [N], shape (K,)."""
    opening: bool
    """Whether the way is an opening."""
    source: str = "force log"
    """Its file."""
    fingerprint: str = ""
    """Its sha256."""


def holds_forces(path: Path) -> bool:
    """Return whether a table is a force log: it has a column of forces."""
    return any(title.lower().startswith("force") for title in _rows(path, "table")[0])


def read_forces(path: Path) -> ForceLog:
    """Read a table of a column ``depth`` or ``opening`` and a column ``force``, with units, like ``depth [mm]``.

    Raises:
        AssetError: If it cannot be read.
        FitError: If a unit or a column is missing, or nothing presses.
    """
    titles, rows = _rows(path, "force log")
    columns: dict[str, Array] = {}
    for title, column in zip(titles, rows.T, strict=True):
        match = _TITLE.fullmatch(title)
        name, unit = (match[1].lower(), match[2]) if match else (title.lower(), "")
        units: Mapping[str, float] = _FORCES if name == "force" else _LENGTHS
        if name not in ("depth", "opening", "force"):
            continue
        if unit not in units:
            hint = f"name the unit in the title, like {name} [{'N' if name == 'force' else 'mm'}]"
            raise FitError(f"force log {path}: column {title!r} has no unit of {', '.join(units)}", hint=hint)
        columns[name] = units[unit] * column
    way = next((name for name in ("depth", "opening") if name in columns), None)
    if way is None or "force" not in columns:
        hint = "give columns like depth [mm],force [N], or opening [mm],force [N]"
        raise FitError(f"force log {path}: has columns {', '.join(titles)}", hint=hint)
    good = np.isfinite(columns[way]) & np.isfinite(columns["force"])
    told = {"source": str(path), "fingerprint": file_fingerprint(path)}
    log = ForceLog(way=columns[way][good], force=columns["force"][good], opening=way == "opening", **told)
    if len(log.way) < 4 or not log.force.max() > 0.0 or np.ptp(log.way) == 0.0:
        raise FitError(f"force log {path}: nothing presses", hint="give forces > 0 at four depths or more")
    return log
