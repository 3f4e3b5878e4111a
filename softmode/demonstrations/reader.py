"""Reading demonstrations into arrays."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softmode.demonstrations import schema
from softmode.demonstrations.metadata import REMEDY, Metadata, file_of, member, read_metadata
from softmode.demonstrations.pictures import decode_png, read_film
from softmode.demonstrations.schema import INDEX_FEATURES, Feature
from softmode.demonstrations.statistics import Statistics
from softmode.errors import AssetError, ConfigError
from softmode.files import reader

if TYPE_CHECKING:
    from softmode.envs.env_state import EnvState


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """A dataset in memory."""

    fps: int
    """Frames per second."""
    robot_type: str | None
    """Name of the robot."""
    features: dict[str, Feature]
    """All features of the dataset by name."""
    tasks: tuple[str, ...]
    """Task sentences by number."""
    columns: dict[str, NDArray[Any]]
    """What was read: numbers of shape (frames, D), indices of shape (frames,), pictures uint8 (frames, h, w, 3)."""
    episode_start: NDArray[np.int64]
    """First frame of every episode, shape (episodes,)."""
    episode_stop: NDArray[np.int64]
    """Frame behind the last one of every episode, shape (episodes,)."""
    statistics: dict[str, Statistics]
    """Statistics of every feature over all frames."""
    origins: tuple[dict[str, Any], ...] = ()
    """Where the episodes come from, each from its ``first_episode`` on: environment and options; empty if not said."""
    folder: Path | None = None
    """Where it lies."""

    @property
    def episode_count(self) -> int:
        """Episodes."""
        return len(self.episode_start)

    @property
    def frame_count(self) -> int:
        """Frames of all episodes."""
        return int(self.episode_stop[-1]) if self.episode_count else 0

    def episode(self, number: int) -> dict[str, NDArray[Any]]:
        """Return the columns of one episode, views of those of the dataset."""
        if not 0 <= number < self.episode_count:
            raise ConfigError(f"episode {number} is not in 0..{self.episode_count - 1}")
        part = slice(self.episode_start[number], self.episode_stop[number])
        return {name: column[part] for name, column in self.columns.items()}

    def observations(self) -> dict[str, NDArray[np.float32]]:
        """Return the vectors observed in all frames by their keys: ``state``, or those of an environment with goals.

        Raises:
            ConfigError: If none were read.
        """
        given = self.columns
        parts = [given[key] for key in ("observation.state", "observation.environment_state") if key in given]
        if not parts:
            raise ConfigError("no observation.state was read", hint="record with obs_type 'state', and read that key")
        goals = {key: given[f"observation.{key}"] for key in schema.GOALS if f"observation.{key}" in given}
        return {"observation" if goals else "state": np.concatenate(parts, axis=1), **goals}

    def state(self, number: int) -> EnvState:
        """Return the state in which an episode began, for ``reset(options={"state": state})``.

        Raises:
            ConfigError: If there is no such episode, or it was recorded without its state.
            StateError: If the state is damaged or of another version.
        """
        from softmode.envs.env_state import EnvState

        self.episode(number)
        path = None if self.folder is None else member(self.folder, schema.STATE_PATH.format(number=number))
        if path is None or not path.exists():
            raise ConfigError(f"episode {number} has no state", hint="record with --states, or states=True")
        return EnvState.load(path)


@reader("dataset")
def read_dataset(
    folder: str | os.PathLike[str], *, keys: Collection[str] | None = None, max_bytes: int = 4 << 30
) -> Dataset:
    """Read a LeRobot v3.0 dataset into arrays.

    Args:
        folder: The dataset's folder.
        keys: Features to read, all if omitted; the indices are always read.
        max_bytes: Memory that the arrays may take, checked before any is reserved.

    Raises:
        AssetError: If the folder holds no such dataset, a damaged one, or one that takes more than ``max_bytes``.
        ConfigError: If a key is none of the dataset's features.
        MissingExtraError: If pyarrow, or for films imageio-ffmpeg, is not installed.
    """
    schema.arrow()
    found = read_metadata(Path(folder))
    wanted = list(found.features) if keys is None else [*keys, *(n for n in INDEX_FEATURES if n not in keys)]
    unknown = sorted(set(wanted) - set(found.features))
    if unknown:
        raise ConfigError(f"the dataset has no features {unknown}", hint=f"use some of {', '.join(found.features)}")
    kinds = {name: found.features[name] for name in wanted}
    size = found.frame_count * sum(int(np.prod(kind.shape)) * _type(kind).itemsize for kind in kinds.values())
    if size > max_bytes:
        raise AssetError(
            f"{found.folder} takes {size} bytes in memory, more than {max_bytes}",
            hint="read fewer keys, or raise max_bytes",
        )
    starts = np.array([row["dataset_from_index"] for row in found.rows], np.int64)
    stops = np.array([row["dataset_to_index"] for row in found.rows], np.int64)
    columns = _read_data(found, {name: kind for name, kind in kinds.items() if kind.dtype != "video"})
    _check_indices(found, columns, starts, stops)
    for name, kind in kinds.items():
        if kind.dtype == "video":
            columns[name] = _read_video(found, name, kind)
    for name in INDEX_FEATURES:
        columns[name] = columns[name][:, 0]
    return Dataset(
        **{name: getattr(found, name) for name in ("fps", "robot_type", "features", "tasks", "origins")},
        columns={name: columns[name] for name in wanted},
        episode_start=starts,
        episode_stop=stops,
        statistics=found.combined(),
        folder=found.folder,
    )


def _read_data(found: Metadata, kinds: Mapping[str, Feature]) -> dict[str, NDArray[Any]]:
    """Return the columns that the data files hold."""
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in kinds}
    for file, group in itertools.groupby(found.rows, lambda row: tuple(file_of(row, "data").values())):
        rows = list(group)
        count = rows[-1]["dataset_to_index"] - rows[0]["dataset_from_index"]
        table = found.data_table(rows[0], list(kinds))
        if table.num_rows < count:
            raise AssetError(f"{found.folder}: data file {file} holds {table.num_rows} of {count} frames", hint=REMEDY)
        table = table.slice(0, count)
        for name, kind in kinds.items():
            parts[name].append(_column(table, name, kind, found.folder))
    empty = {name: np.empty((0, *kind.shape), _type(kind)) for name, kind in kinds.items()}
    return {name: np.concatenate([empty[name], *values]) for name, values in parts.items()}


def _type(kind: Feature) -> np.dtype:
    """Return the type of a feature's entries in memory."""
    return np.dtype(np.uint8 if kind.is_picture else kind.dtype)


def _column(table: Any, name: str, kind: Feature, folder: Path) -> NDArray[Any]:
    """Return a column of a data file as an array of shape (rows, *shape)."""
    pa = schema.arrow()
    expected = schema.data_schema({name: kind}).field(0).type
    if name not in table.column_names or not table.schema.field(name).type.equals(expected):
        raise AssetError(f"{folder}: the data have no column {name} of type {expected}", hint=REMEDY)
    column = table[name].combine_chunks()
    if isinstance(column, pa.ChunkedArray):
        column = column.chunk(0) if column.num_chunks else pa.array([], expected)
    if kind.dtype == "image":
        pictures = np.empty((len(column), *kind.shape), np.uint8)
        for k, data in enumerate(column.field("bytes")):
            if not data.is_valid:
                raise AssetError(f"{folder}: picture {k} of {name} is not in the table", hint=REMEDY)
            pictures[k] = decode_png(data.as_py(), kind.shape, f"{folder}: picture {k} of {name}")
        return pictures
    flat = column.flatten() if pa.types.is_fixed_size_list(expected) else column
    if column.null_count or flat.null_count or len(flat) != len(column) * kind.shape[0]:
        raise AssetError(f"{folder}: column {name} has gaps", hint=REMEDY)
    return flat.to_numpy(zero_copy_only=False).reshape(-1, *kind.shape)


def _check_indices(
    found: Metadata, columns: Mapping[str, NDArray[Any]], starts: NDArray[np.int64], stops: NDArray[np.int64]
) -> None:
    """Raise AssetError unless every frame is the one that it should be."""
    lengths = stops - starts
    frame = np.arange(found.frame_count) - np.repeat(starts, lengths)
    expected = {
        "index": np.arange(found.frame_count),
        "frame_index": frame,
        "episode_index": np.repeat(np.arange(len(starts)), lengths),
    }
    for name, values in expected.items():
        if not np.array_equal(columns[name][:, 0], values):
            raise AssetError(f"{found.folder}: column {name} does not count the frames", hint=REMEDY)
    if not np.allclose(columns["timestamp"][:, 0], frame / found.fps, rtol=1e-6, atol=1e-4):
        raise AssetError(f"{found.folder}: the times are not those of {found.fps} frames per second", hint=REMEDY)
    task = columns["task_index"]
    if task.size and not (task.min() >= 0 and task.max() < len(found.tasks)):
        raise AssetError(f"{found.folder}: a task has no sentence", hint=REMEDY)


def _read_video(found: Metadata, name: str, kind: Feature) -> NDArray[np.uint8]:
    """Return the pictures of a camera whose films are files of their own."""
    pictures = np.empty((found.frame_count, *kind.shape), np.uint8)
    for file, rows in itertools.groupby(found.rows, lambda row: file_of(row, f"videos/{name}")):
        path, shown = member(found.folder, schema.VIDEO_PATH.format(video_key=name, **file)), 0
        with contextlib.closing(read_film(path, kind.shape)) as film:
            for row in rows:
                first = round(row[f"videos/{name}/from_timestamp"] * found.fps)
                for frame in range(shown, first + row["length"]):
                    picture = next(film, None)
                    if picture is None:
                        raise AssetError(f"{path} ends before frame {frame}", hint=REMEDY)
                    shown += 1
                    if frame >= first:
                        pictures[row["dataset_from_index"] + frame - first] = picture
    return pictures
