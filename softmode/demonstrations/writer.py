"""Writing demonstrations as a LeRobot dataset that is complete after every episode."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.demonstrations import schema
from softmode.demonstrations.metadata import Metadata, read_metadata
from softmode.demonstrations.pictures import FilmWriter, encode_png
from softmode.demonstrations.schema import INDEX_FEATURES, Feature
from softmode.demonstrations.statistics import PictureStatistics, Statistics, combine, number_statistics
from softmode.errors import ConfigError, StorageError

STAGE = ".recording"
"""Folder inside a dataset where files of an unfinished episode are written."""
EPISODES_PER_FILE = 500


class DatasetWriter:
    """Writes episodes as a LeRobot v3.0 dataset.

    The folder appears with its first complete episode and is a complete dataset after every further one: all files of
    an episode are written beside the old ones first and then renamed into place, ``meta/info.json``, which says how
    many episodes there are, last. Whatever interrupts a recording, the episodes before stay readable, and ``append=True``
    goes on from them::

        features = {"observation.state": Feature(dtype="float32", shape=(7,)), "action": Feature(...)}
        with DatasetWriter("out/lift", features, fps=30) as writer:
            for observation, action in episode:
                writer.add_frame({"observation.state": observation, "action": action})
            writer.save_episode("lift the toy")

    Table files hold several episodes and are written anew with each of them, so ``file_megabytes`` bounds the work per
    episode; a film holds one episode.

    Args:
        folder: The dataset's folder; its parents are made.
        features: Columns by name, without the indices of :data:`~softmode.demonstrations.schema.INDEX_FEATURES`.
        fps: Frames per second.
        robot_type: Name of the robot.
        append: Add to the dataset that is there, if there is one.
        file_megabytes: Size at which the next table file is begun.

    Raises:
        ConfigError: If the folder exists and ``append`` is false, if what is there has other features or another frame
            rate, or if another writer is at work there.
        AssetError: If the dataset to append to is damaged.
        StorageError: If the folder cannot be made.
        MissingExtraError: If pyarrow, or for films imageio-ffmpeg, is not installed.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        features: Mapping[str, Feature],
        *,
        fps: int,
        robot_type: str | None = None,
        append: bool = False,
        file_megabytes: int = 20,
    ) -> None:
        """Make or open the folder."""
        schema.arrow()
        schema.check_features(features)
        if type(fps) is not int or not 0 < fps <= 10_000:
            raise ConfigError(f"fps must be a whole number of frames per second, got {fps!r}", hint="give it like 30")
        if type(file_megabytes) is not int or not 0 < file_megabytes <= 1000:
            raise ConfigError(f"file_megabytes must lie in 1..1000, got {file_megabytes!r}")
        if any(feature.dtype == "video" for feature in features.values()):
            from softmode.demonstrations.pictures import ffmpeg

            ffmpeg()
        self.folder = Path(folder).absolute()
        self.features = {**features, **INDEX_FEATURES}
        self._schema = schema.data_schema(self.features)
        self._fps, self._robot_type, self._limit = fps, robot_type, file_megabytes << 20
        self._rows: list[dict[str, Any]] = []  # episodes of the present table file
        self._tables: list[Any] = []  # and their frames
        self._file = 0
        self._tasks: dict[str, int] = {}
        self._statistics: dict[str, Statistics] = {}
        self._episode_count = self._frame_count = 0
        self._films_done = -1  # number of the last film
        self._root, self._is_new, self._lock = self.folder, False, None
        self._made: list[Path] = []
        try:
            exists = self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir()))
            if exists and not append:
                raise ConfigError(f"{self.folder} exists", hint="choose another folder, or append to it")
            if not exists:
                self._make_root()
            self._take_lock()
            if exists:
                self._continue()
            shutil.rmtree(self._root / STAGE, ignore_errors=True)
        except OSError as error:
            if isinstance(error, StorageError):
                raise
            self.close()
            raise StorageError(
                f"dataset {self.folder} cannot be written: {error.strerror or error}", hint="choose another folder"
            ) from error
        except BaseException:
            self.close()
            raise
        self._begin()

    def _make_root(self) -> None:
        """Make the folder under a name of its own; it takes its place with the first episode."""
        self._made = [parent for parent in self.folder.parents if not parent.exists()]
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        root = self.folder.with_name(f".{self.folder.name}.{secrets.token_hex(6)}.tmp")
        root.mkdir()
        self._root, self._is_new = root, True

    def _take_lock(self) -> None:
        """Hold the folder against a second writer."""
        self._lock = os.open(self._root, os.O_RDONLY)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigError(
                f"{self.folder} is being written by another recording", hint="wait for its end"
            ) from error

    def _continue(self) -> None:
        """Read the state of the dataset that is there."""
        found: Metadata = read_metadata(self.folder)
        if found.features != self.features or found.fps != self._fps:
            raise ConfigError(
                f"{self.folder} holds features {_described(found.features)} at {found.fps} frames per second, not "
                f"{_described(self.features)} at {self._fps}",
                hint="record into another folder",
            )
        self._tasks = {task: number for number, task in enumerate(found.tasks)}
        self._episode_count, self._frame_count = found.episode_count, found.frame_count
        self._robot_type = found.robot_type
        if not found.rows:
            return
        self._statistics = {name: combine([row[name] for row in found.statistics]) for name in found.statistics[0]}
        last = found.rows[-1]
        if (last["meta/episodes/chunk_index"], last["meta/episodes/file_index"]) != (
            last["data/chunk_index"],
            last["data/file_index"],
        ):
            raise ConfigError(f"{self.folder} was written by another program", hint="record into another folder")
        self._file = last["data/chunk_index"] * schema.CHUNK_SIZE + last["data/file_index"]
        videos = [row for row in (last.get(f"videos/{name}/file_index") for name in self.features) if row is not None]
        if videos:
            self._films_done = self._episode_count - 1
        table = found.data_table(last)
        if not table.schema.equals(self._schema):
            raise ConfigError(f"{self.folder} was written by another program", hint="record into another folder")
        here = [row for row in found.rows if row["data/file_index"] == last["data/file_index"]]
        here = [row for row in here if row["data/chunk_index"] == last["data/chunk_index"]]
        first = here[0]["dataset_from_index"]
        for row in here:  # what a killed recording left behind the last episode is not taken over
            self._rows.append({key: value for key, value in row.items()})
            self._tables.append(table.slice(row["dataset_from_index"] - first, row["length"]))

    # -- frames -------------------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Begin an episode."""
        self._frames = 0
        self._columns: dict[str, list[Any]] = {
            name: [] for name, kind in self.features.items() if kind.dtype != "video"
        }
        self._pictures = {name: PictureStatistics() for name, kind in self.features.items() if kind.is_picture}
        self._films: dict[str, FilmWriter] = {}

    @property
    def episode_count(self) -> int:
        """Episodes in the dataset."""
        return self._episode_count

    @property
    def frame_count(self) -> int:
        """Frames in the dataset, those of the present episode not counted."""
        return self._frame_count

    def add_frame(self, frame: Mapping[str, Any]) -> None:
        """Append a frame to the present episode.

        Args:
            frame: A value for every feature: numbers of shape (D,), or a scalar where D is 1; pictures uint8 of shape
                (height, width, 3).

        Raises:
            ConfigError: If a feature is missing, unknown, of another shape or type, or not finite; the frame is not
                taken then.
            StorageError: If a film cannot be written; the episode is lost then, those before it are not.
        """
        given = set(frame)
        expected = set(self.features) - set(INDEX_FEATURES)
        if given != expected:
            raise ConfigError(
                f"frame lacks {sorted(expected - given)} and has unknown {sorted(given - expected)}",
                hint="give a value for every feature",
            )
        if self._lock is None:
            raise ConfigError(f"the writer of {self.folder} is closed", hint="open it again with append=True")
        values = {name: _checked(name, frame[name], self.features[name]) for name in expected}
        for name, value in values.items():
            kind = self.features[name]
            if kind.dtype == "video":
                try:
                    self._film(name).add(value)
                except BaseException:
                    self.discard_episode()
                    raise
            elif kind.dtype == "image":
                path = f"frame-{self._frames:06d}.png"
                self._columns[name].append({"bytes": encode_png(value), "path": path})
            else:
                self._columns[name].append(value)
            if kind.is_picture:
                self._pictures[name].add(value)
        self._frames += 1

    def _film(self, name: str) -> FilmWriter:
        """Return the film of the present episode."""
        if name not in self._films:
            stage = self._root / STAGE
            try:
                stage.mkdir(exist_ok=True)
            except OSError as error:
                raise StorageError(f"{stage} cannot be made: {error.strerror}", hint="free some space") from error
            height, width, _ = self.features[name].shape
            self._films[name] = FilmWriter(stage / f"{name}.mp4", height, width, self._fps)
        return self._films[name]

    def discard_episode(self) -> None:
        """Forget the frames since the last saved episode."""
        for film in self._films.values():
            film.abort()
        shutil.rmtree(self._root / STAGE, ignore_errors=True)
        self._begin()

    # -- episodes -----------------------------------------------------------------------------------------------------

    def save_episode(self, task: str) -> int:
        """Add the frames since the last saved episode to the dataset.

        Args:
            task: What was to be done, as a sentence.

        Returns:
            The number of the episode.

        Raises:
            ConfigError: If there is no frame, or the task is empty.
            StorageError: If the files cannot be written; the dataset is what it was before this episode.
        """
        if not self._frames:
            raise ConfigError("the episode has no frames", hint="add some before saving it")
        if not isinstance(task, str) or not task.strip():
            raise ConfigError(f"the task is {task!r}", hint="describe it in words")
        try:
            self._save(task)
        except OSError as error:
            self.discard_episode()
            if isinstance(error, StorageError):
                raise
            raise StorageError(
                f"dataset {self.folder} cannot take another episode: {error.strerror or error}; its "
                f"{self._episode_count} episodes are complete",
                hint="free some space and append",
            ) from error
        except BaseException:
            self.discard_episode()
            raise
        self._begin()
        return self._episode_count - 1

    def _save(self, task: str) -> None:
        """Stage the files of the dataset with the present episode, then put them in place."""
        number, count, start = self._episode_count, self._frames, self._frame_count
        tasks = {**self._tasks}
        tasks.setdefault(task, len(tasks))
        for film in self._films.values():
            film.close()
        arrays = self._arrays(number, tasks[task])
        table = self._table(arrays)
        found: dict[str, Statistics] = {}
        for name, kind in self.features.items():
            found[name] = self._pictures[name].result() if kind.is_picture else number_statistics(arrays[name])
        total = {n: combine([self._statistics[n], s]) if n in self._statistics else s for n, s in found.items()}

        rows, tables, file = self._rows, self._tables, self._file
        size = sum(part.nbytes for part in tables)
        if rows and (size + table.nbytes > self._limit or len(rows) >= EPISODES_PER_FILE):
            rows, tables, file = [], [], file + 1
        film = self._films_done + 1
        row = self._row(number, task, start, count, file, film, found)
        rows, tables = [*rows, row], [*tables, table]

        stage = self._root / STAGE
        stage.mkdir(exist_ok=True)
        moves: list[tuple[Path, str]] = []
        for name, writer in self._films.items():
            path = schema.VIDEO_PATH.format(
                video_key=name, chunk_index=film // schema.CHUNK_SIZE, file_index=film % schema.CHUNK_SIZE
            )
            moves.append((writer.path, path))
        where = {"chunk_index": file // schema.CHUNK_SIZE, "file_index": file % schema.CHUNK_SIZE}
        moves.append((_write_table(stage / "data.parquet", tables), schema.DATA_PATH.format(**where)))
        if len(tasks) > len(self._tasks):
            moves.append((_write_table(stage / "tasks.parquet", [_tasks_table(tasks)]), schema.TASKS_PATH))
        moves.append(
            (_write_table(stage / "episodes.parquet", [_rows_table(rows)]), schema.EPISODES_PATH.format(**where))
        )
        moves.append((_write_json(stage / "stats.json", _listed(total)), schema.STATISTICS_PATH))
        moves.append((_write_json(stage / "info.json", self._info(number + 1, start + count, tasks)), schema.INFO_PATH))
        for source, _ in moves:
            _sync(source)
        for source, target in moves:
            (self._root / target).parent.mkdir(parents=True, exist_ok=True)
            os.replace(source, self._root / target)
        if self._is_new:
            shutil.rmtree(stage)
            os.rename(self._root, self.folder)  # replaces an empty folder, and fails on any other
            self._root, self._is_new, self._made = self.folder, False, []
        self._rows, self._tables, self._file = rows, tables, file
        self._tasks, self._statistics = tasks, total
        self._episode_count, self._frame_count = number + 1, start + count
        self._films_done = film

    def _arrays(self, number: int, task: int) -> dict[str, NDArray[Any]]:
        """Return the numbers of the present episode, each of shape (frames, D)."""
        frames = np.arange(self._frames)
        filled = {
            "timestamp": (frames / self._fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(self._frames, number),
            "index": self._frame_count + frames,
            "task_index": np.full(self._frames, task),
        }
        arrays = {
            name: np.array(self._columns[name], np.dtype(kind.dtype))
            for name, kind in self.features.items()
            if not kind.is_picture and name not in filled
        }
        return arrays | {name: values[:, None] for name, values in filled.items()}

    def _table(self, arrays: Mapping[str, NDArray[Any]]) -> Any:
        """Return the present episode as a table."""
        pa = schema.arrow()
        columns = []
        for field in self._schema:
            if field.name not in arrays:
                columns.append(pa.array(self._columns[field.name], field.type))
                continue
            flat = pa.array(arrays[field.name].ravel())
            if pa.types.is_fixed_size_list(field.type):
                flat = pa.FixedSizeListArray.from_arrays(flat, type=field.type)
            columns.append(flat)
        return pa.table(columns, schema=self._schema)

    def _row(
        self, number: int, task: str, start: int, count: int, file: int, film: int, found: Mapping[str, Statistics]
    ) -> dict[str, Any]:
        """Return the row of an episode."""
        chunk, within = divmod(file, schema.CHUNK_SIZE)
        row: dict[str, Any] = {
            "episode_index": number,
            "tasks": [task],
            "length": count,
            "data/chunk_index": chunk,
            "data/file_index": within,
            "dataset_from_index": start,
            "dataset_to_index": start + count,
        }
        for name in self._films:
            row[f"videos/{name}/chunk_index"], row[f"videos/{name}/file_index"] = divmod(film, schema.CHUNK_SIZE)
            row[f"videos/{name}/from_timestamp"] = 0.0
            row[f"videos/{name}/to_timestamp"] = count / self._fps
        for name, values in found.items():
            row.update({f"stats/{name}/{key}": value.tolist() for key, value in values.items()})
        return row | {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": within}

    def _info(self, episodes: int, frames: int, tasks: Mapping[str, int]) -> dict[str, Any]:
        """Return the content of info.json."""
        has_video = any(kind.dtype == "video" for kind in self.features.values())
        return {
            "codebase_version": schema.CODEBASE_VERSION,
            "robot_type": self._robot_type,
            "total_episodes": episodes,
            "total_frames": frames,
            "total_tasks": len(tasks),
            "chunks_size": schema.CHUNK_SIZE,
            "data_files_size_in_mb": self._limit >> 20,
            "video_files_size_in_mb": self._limit >> 20,
            "fps": self._fps,
            "splits": {"train": f"0:{episodes}"},
            "data_path": schema.DATA_PATH,
            "video_path": schema.VIDEO_PATH if has_video else None,
            "features": {name: schema.feature_to_json(kind, self._fps) for name, kind in self.features.items()},
        }

    # -- end ----------------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Drop what belongs to no saved episode and let go of the folder; harmless twice."""
        for film in getattr(self, "_films", {}).values():
            film.abort()
        if self._lock is not None:
            shutil.rmtree(self._root if self._is_new else self._root / STAGE, ignore_errors=True)
            os.close(self._lock)
            self._lock = None
        elif self._is_new:
            shutil.rmtree(self._root, ignore_errors=True)
        for parent in self._made:
            with contextlib.suppress(OSError):
                parent.rmdir()
        self._made = []

    def __enter__(self) -> DatasetWriter:
        """Return the writer."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it; frames that were not saved are dropped."""
        self.close()


def _described(features: Mapping[str, Feature]) -> str:
    """Return features in a line."""
    return ", ".join(f"{name} {kind.dtype}{list(kind.shape)}" for name, kind in features.items())


def _checked(name: str, value: Any, kind: Feature) -> NDArray[Any]:
    """Return a value of a frame as an array of its feature's shape and type."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{name} is no array: {error}") from error
    if kind.is_picture:
        if array.dtype != np.uint8 or array.shape != kind.shape:
            raise ConfigError(f"{name} is {array.dtype}{list(array.shape)}, expected uint8{list(kind.shape)}")
        return array
    if array.ndim == 0 and kind.shape == (1,):
        array = array.reshape(1)
    wanted = np.dtype(kind.dtype)
    if array.shape != kind.shape or not (np.can_cast(array.dtype, wanted, "same_kind")):
        raise ConfigError(f"{name} is {array.dtype}{list(array.shape)}, expected {wanted}{list(kind.shape)}")
    array = array.astype(wanted)
    if not np.isfinite(array).all():
        raise ConfigError(f"{name} holds NaN or infinity", hint="discard the episode")
    return array


def _tasks_table(tasks: Mapping[str, int]) -> Any:
    """Return the table of tasks."""
    return schema.arrow().table([list(tasks.values()), list(tasks)], schema=schema.tasks_schema())


def _rows_table(rows: list[dict[str, Any]]) -> Any:
    """Return the table of episodes."""
    return schema.arrow().table({key: [row[key] for row in rows] for key in rows[0]})


def _write_table(path: Path, tables: list[Any]) -> Path:
    """Write tables of one schema as a Parquet file with a row group for each."""
    pq = schema.arrow().parquet
    with pq.ParquetWriter(path, tables[0].schema, compression="snappy", write_page_checksum=True) as writer:
        for table in tables:
            writer.write_table(table)
    return path


def _write_json(path: Path, content: Any) -> Path:
    """Write a JSON file."""
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False, allow_nan=False), encoding="utf-8")
    return path


def _listed(statistics: Mapping[str, Statistics]) -> dict[str, dict[str, Any]]:
    """Return statistics as lists."""
    return {name: {key: value.tolist() for key, value in values.items()} for name, values in statistics.items()}


def _sync(path: Path) -> None:
    """Make sure that a file's bytes are on the disk before it is renamed."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
