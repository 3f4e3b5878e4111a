"""Reading what a dataset says about itself, with every claim checked before it is used."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softmode import files
from softmode.demonstrations import schema
from softmode.demonstrations.schema import INDEX_FEATURES, Feature
from softmode.demonstrations.statistics import QUANTILES, Statistics, combine
from softmode.errors import AssetError, ConfigError
from softmode.foreign import process
from softmode.foreign.child.layers import inside

REMEDY = "restore the folder from a copy, or record it again"


@dataclass(frozen=True, kw_only=True)
class Metadata:
    """What a dataset says about itself."""

    folder: Path
    """Its folder."""
    fps: int
    """Frames per second."""
    robot_type: str | None
    """Name of the robot."""
    features: dict[str, Feature]
    """Columns by name, the indices last."""
    tasks: tuple[str, ...]
    """Task sentences by number."""
    episode_count: int
    """Episodes."""
    frame_count: int
    """Frames of all episodes."""
    rows: list[dict[str, Any]]
    """The row of every episode."""
    statistics: list[dict[str, Statistics]]
    """Statistics of every episode by feature."""
    origins: tuple[dict[str, Any], ...]
    """Where the episodes come from, each from its ``first_episode`` on: environment and options; empty if not said."""

    def data_table(self, row: Mapping[str, Any], columns: list[str] | None = None) -> Any:
        """Return the table that holds an episode's frames, or some columns; raises AssetError if it does not."""
        return read_table(member(self.folder, schema.DATA_PATH.format(**file_of(row, "data"))), columns)

    def combined(self) -> dict[str, Statistics]:
        """Return the statistics over all episodes by feature."""
        names = self.statistics[0] if self.statistics else {}
        return {name: combine([part[name] for part in self.statistics]) for name in names}


def file_of(row: Mapping[str, Any], kind: str) -> dict[str, int]:
    """Return the place of a file that an episode's row names; see :func:`softmode.demonstrations.schema.place_of`."""
    return {key: row[f"{kind}/{key}"] for key in ("chunk_index", "file_index")}


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; raises AssetError if there is none."""
    content = files.read_json(path, "dataset file", hint=REMEDY)
    if not isinstance(content, dict):
        raise AssetError(f"{path} holds no JSON object", hint=REMEDY)
    return content


def member(folder: Path, name: str) -> Path:
    """Return a file of a dataset; raises AssetError if links lead out of its folder, or it is no file.

    Hugging Face's cache has a dataset as `snapshots/REVISION` of links to the files in `blobs` beside `snapshots`.
    """
    path, home = folder / name, folder.absolute().parent
    cached = home.name == "snapshots" and (home.parent / "blobs").is_dir()
    if not inside(str(path), str(home.parent if cached else folder)):
        hint = "copy the dataset with its links followed, as cp -rL does"
        raise AssetError(f"{path} leads out of the dataset's folder", hint=hint)
    if path.exists() and not path.is_file():
        raise AssetError(f"{path} is no file", hint=REMEDY)
    return path


@files.reader("table")
def read_table(path: Path, columns: list[str] | None = None) -> Any:
    """Return a Parquet file's table, or of its columns those that are named and there.

    Raises:
        AssetError: If it is damaged, or takes more than 8 bytes for each of the file and 256 MB.
    """
    pa, name = schema.arrow(), str(path)
    with tempfile.TemporaryDirectory() as folder:
        copy = f"{folder}/table.arrow"
        process.read("table", path, name=name, columns=columns, copy=copy)
        # Windows removes no file that is mapped; elsewhere the table needs no copy of its bytes.
        with (pa.OSFile if os.name == "nt" else pa.memory_map)(copy) as source:
            return pa.ipc.open_file(source).read_all()


def _rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a small table; a cell takes many times as much memory as in the table."""
    table = read_table(path)
    size = path.stat().st_size
    if table.nbytes > 4 * size + (16 << 20) or table.num_rows * table.num_columns > size + (1 << 20):
        raise AssetError(f"{path} holds {table.num_rows} rows, too many for {size} bytes", hint=REMEDY)
    return table.to_pylist()


@files.reader("dataset")
def read_metadata(folder: str | Path) -> Metadata:
    """Return what the dataset in a folder says about itself.

    Rows behind those that ``info.json`` counts are left out: a recording that was killed while it put its files in
    place leaves them.

    Raises:
        AssetError: If the folder holds no dataset of version 3.0, or a damaged one.
    """
    folder = Path(folder).absolute()
    path = member(folder, schema.INFO_PATH)
    info = read_json(path)
    try:
        version = info["codebase_version"]
        if version != schema.CODEBASE_VERSION:
            raise AssetError(f"{folder} has format {version!r}", hint="convert it to v3.0 with LeRobot's own tool")
        fps = info["fps"]
        if not isinstance(fps, int | float) or fps != int(fps) or not 0 < fps <= 10_000:
            raise AssetError(f"{path}: fps is {fps!r}", hint=REMEDY)
        features = {str(name): schema.feature_from_json(entry) for name, entry in info["features"].items()}
        schema.check_features({n: f for n, f in features.items() if n not in INDEX_FEATURES})
        for name, kind in INDEX_FEATURES.items():
            if features.get(name) != kind:
                raise AssetError(f"{path}: feature {name} is {features.get(name)}, expected {kind}", hint=REMEDY)
        episodes, frames = info["total_episodes"], info["total_frames"]
        if not (type(episodes) is int and type(frames) is int and 0 <= episodes <= frames):
            raise AssetError(f"{path}: {episodes!r} episodes of {frames!r} frames", hint=REMEDY)
        if info["data_path"] != schema.DATA_PATH or info["video_path"] not in (None, schema.VIDEO_PATH):
            raise AssetError(f"{path} places the data elsewhere than format v3.0 does", hint=REMEDY)
        robot = info["robot_type"]
    except (KeyError, TypeError, AttributeError, OverflowError, ConfigError) as error:
        raise AssetError(f"{path} describes no dataset: {error!r}", hint=REMEDY) from error
    rows, statistics = _read_episodes(folder, features, episodes, frames)
    return Metadata(
        folder=folder,
        fps=int(fps),
        robot_type=robot if isinstance(robot, str) else None,
        features=_ordered(features),
        tasks=_read_tasks(folder),
        episode_count=episodes,
        frame_count=frames,
        rows=rows,
        statistics=statistics,
        origins=_read_origins(folder, episodes),
    )


def _ordered(features: dict[str, Feature]) -> dict[str, Feature]:
    """Return the features with the indices last, and without the names that a picture's axes have anyway."""
    plain = {
        name: Feature(dtype=kind.dtype, shape=kind.shape) if kind.names == schema.IMAGE_NAMES else kind
        for name, kind in features.items()
    }
    return {n: f for n, f in plain.items() if n not in INDEX_FEATURES} | INDEX_FEATURES


def _read_origins(folder: Path, episodes: int) -> tuple[dict[str, Any], ...]:
    """Return where the episodes come from; what a killed recording left behind the last one is left out."""
    path = member(folder, schema.ORIGINS_PATH)
    if not path.exists():
        return ()
    origins = read_json(path).get("origins")
    if not isinstance(origins, list) or not all(
        isinstance(origin, dict) and type(origin.get("first_episode")) is int for origin in origins
    ):
        raise AssetError(f"{path} does not say where the episodes come from", hint=REMEDY)
    return tuple(origin for origin in origins if origin["first_episode"] < episodes)


def _read_tasks(folder: Path) -> tuple[str, ...]:
    """Return the task sentences by number."""
    path = member(folder, schema.TASKS_PATH)
    rows = _rows(path)
    names = [name for name in (rows or [{"task_index": 0, "task": ""}])[0] if name != "task_index"]
    if len(names) != 1 or not all("task_index" in row for row in rows):
        raise AssetError(f"{path} has columns {names}", hint=REMEDY)
    numbers, tasks = [row["task_index"] for row in rows], [row[names[0]] for row in rows]
    if numbers != list(range(len(numbers))) or not all(isinstance(task, str) for task in tasks):
        raise AssetError(f"{path} does not number its tasks 0, 1, 2 ...", hint=REMEDY)
    return tuple(tasks)


def _read_episodes(
    folder: Path, features: Mapping[str, Feature], episodes: int, frames: int
) -> tuple[list[dict[str, Any]], list[dict[str, Statistics]]]:
    """Return row and statistics of every episode, checked to lie one behind the other."""
    rows: list[dict[str, Any]] = []
    for path in sorted((folder / "meta" / "episodes").glob("chunk-*/file-*.parquet")):
        if len(rows) >= episodes:
            break
        rows += _rows(member(folder, str(path.relative_to(folder))))
    rows = rows[:episodes]
    statistics, end = [], 0
    try:
        for number, row in enumerate(rows):
            start, stop = row["dataset_from_index"], row["dataset_to_index"]
            whole = [row["data/chunk_index"], row["data/file_index"]]
            for name, kind in features.items():
                if kind.dtype == "video":
                    whole += [row[f"videos/{name}/chunk_index"], row[f"videos/{name}/file_index"]]
                    if not 0.0 <= row[f"videos/{name}/from_timestamp"] < row[f"videos/{name}/to_timestamp"] < np.inf:
                        raise ValueError(f"episode {number} has no time in its film")
            if row["episode_index"] != number or start != end or not start < stop or row["length"] != stop - start:
                raise ValueError(f"row {number} is episode {row['episode_index']}, frames {start} to {stop}")
            if not all(type(value) is int and 0 <= value < 1_000_000 for value in whole):
                raise ValueError(f"episode {number} names files {whole}")
            end = stop
            told = [name for name in features if f"stats/{name}/count" in row]
            statistics.append({name: {key: np.array(row[f"stats/{name}/{key}"]) for key in _KEYS} for name in told})
    except (KeyError, TypeError, ValueError) as error:
        raise AssetError(f"{folder / 'meta' / 'episodes'} is damaged: {error!r}", hint=REMEDY) from error
    if (len(rows), end) != (episodes, frames):
        raise AssetError(
            f"{folder} counts {episodes} episodes of {frames} frames and lists {len(rows)} of {end}", hint=REMEDY
        )
    return rows, statistics


_KEYS = ("min", "max", "mean", "std", "count", *QUANTILES)
