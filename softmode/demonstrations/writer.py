"""Writing demonstrations as a LeRobot dataset that is complete after every episode."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from softmode.demonstrations import schema
from softmode.demonstrations.episode import Episode
from softmode.demonstrations.metadata import Metadata, file_of, read_metadata
from softmode.demonstrations.schema import INDEX_FEATURES, Feature, write_json, write_table
from softmode.demonstrations.statistics import Statistics, combine, number_statistics
from softmode.errors import ConfigError
from softmode.files import storage_errors, sync
from softmode.leftovers import Claim, lock

STAGE = ".recording"
"""Folder inside a dataset where files of an unfinished episode are written."""
EPISODES_PER_FILE = 500


class _Part(NamedTuple):
    """An episode that goes into the dataset."""

    task: str
    table: Any
    statistics: dict[str, Statistics]
    films: dict[str, Path]
    state: bytes | None


class DatasetWriter:
    """Writes episodes as a LeRobot v3.0 dataset.

    The folder appears with its first complete episode and is a complete dataset after every further one: all files of
    an episode are written beside the old ones first and then renamed into place, ``meta/info.json``, which says how
    many episodes there are, last. Whatever interrupts a recording, the episodes before stay readable, and
    ``append=True`` goes on from them::

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
        origin: Where the episodes come from, as JSON values: the environment, its options and objects. Kept in
            ``meta/softmode.json`` with the number of the first episode.
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
        origin: Mapping[str, Any] | None = None,
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
        self._origins: list[dict[str, Any]] = []  # of the episodes before, by their first one
        self._origin = origin
        self._statistics: dict[str, Statistics] = {}
        self.episode_count = 0
        """Episodes in the dataset."""
        self.frame_count = 0
        """Frames in the dataset, those of the present episode not counted."""
        self._films_done = -1  # number of the last film
        self._root, self._is_new, self._lock = self.folder, False, None
        self._claim: Claim | None = None
        self._episode: Episode
        try:
            with storage_errors(f"dataset {self.folder}", hint="choose another folder"):
                exists = self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir()))
                if exists and not append:
                    raise ConfigError(f"{self.folder} exists", hint="choose another folder, or append to it")
                if not exists:
                    self._make_root()
                self._take_lock()
                if exists:
                    self._continue()
                shutil.rmtree(self._root / STAGE, ignore_errors=True)
        except BaseException:
            self._release()
            raise
        self._begin()

    def _make_root(self) -> None:
        """Make the folder under a name of its own; it takes its place, its parents made, with the first episode."""
        self._claim = Claim(self.folder)
        self._root, self._is_new = self._claim.name(), True
        self._root.mkdir()

    def _take_lock(self) -> None:
        """Hold the folder against a second writer."""
        self._lock = os.open(self._root, os.O_RDONLY)
        if not lock(self._lock):
            raise ConfigError(f"{self.folder} is being written by another recording", hint="wait for its end")

    def _continue(self) -> None:
        """Read the state of the dataset that is there."""
        found: Metadata = read_metadata(self.folder)
        self._check_same(found, self.folder)
        self._tasks = {task: number for number, task in enumerate(found.tasks)}
        self.episode_count, self.frame_count = found.episode_count, found.frame_count
        self._robot_type, self._origins = found.robot_type, list(found.origins)
        if not found.rows:
            return
        self._statistics = found.combined()
        last = found.rows[-1]
        file, table = file_of(last, "data"), self._own_table(found, last)
        self._file = file["chunk_index"] * schema.CHUNK_SIZE + file["file_index"]
        if any(last.get(f"videos/{name}/file_index") is not None for name in self.features):
            self._films_done = self.episode_count - 1
        self._rows = [row for row in found.rows if file_of(row, "data") == file]
        first = self._rows[0]["dataset_from_index"]
        # What a killed recording left behind the last episode is not taken over.
        self._tables = [table.slice(row["dataset_from_index"] - first, row["length"]) for row in self._rows]

    def _check_same(self, found: Metadata, folder: Path) -> None:
        """Refuse a dataset with other features or another frame rate."""
        if found.features != self.features or found.fps != self._fps:
            raise ConfigError(
                f"{folder} holds features {_described(found.features)} at {found.fps} frames per second, not "
                f"{_described(self.features)} at {self._fps}",
                hint="record into another folder",
            )

    def _own_table(self, found: Metadata, row: Mapping[str, Any]) -> Any:
        """Return the table with an episode's frames; refuse one that no writer of this kind has written."""
        table = found.data_table(row)
        if file_of(row, "meta/episodes") != file_of(row, "data") or not table.schema.equals(self._schema):
            raise ConfigError(f"{found.folder} was written by another program", hint="record into another folder")
        return table

    # -- frames -------------------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Begin an episode."""
        self._episode = Episode(self.features, self._fps, self._root / STAGE)

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
        self._check_open()
        try:
            self._episode.add(frame)
        except ConfigError:
            raise
        except BaseException:
            self.discard_episode()
            raise

    def _check_open(self) -> None:
        """Raise ConfigError after close."""
        if self._lock is None:
            raise ConfigError(f"the writer of {self.folder} is closed", hint="open it again with append=True")

    def discard_episode(self) -> None:
        """Forget the frames since the last saved episode."""
        self._episode.abort()
        self._begin()

    # -- episodes -----------------------------------------------------------------------------------------------------

    def save_episode(self, task: str, *, state: bytes | None = None) -> int:
        """Add the frames since the last saved episode to the dataset.

        Args:
            task: What was to be done, as a sentence.
            state: The state in which the episode began, ``env.unwrapped.get_state().to_bytes()``; see `Dataset.state`.

        Returns:
            The number of the episode.

        Raises:
            ConfigError: If there is no frame, or the task is empty.
            StorageError: If the files cannot be written; the dataset is what it was before this episode.
        """
        self._check_open()
        if not self._episode.length:
            raise ConfigError("the episode has no frames", hint="add some before saving it")
        if not isinstance(task, str) or not task.strip():
            raise ConfigError(f"the task is {task!r}", hint="describe it in words")
        what = f"another episode of dataset {self.folder}, whose {self.episode_count} are complete,"
        try:
            with storage_errors(what, hint="free some space and append"):
                self._save(task, state)
        except BaseException:
            self.discard_episode()
            raise
        self._begin()
        return self.episode_count - 1

    def take_dataset(self, folder: Path, count: int | None = None) -> None:
        """Add the episodes of a dataset that another writer has written, as if they had been recorded here.

        Its films are moved, so that nothing of it can be used afterwards. Files are in place, but a power failure may
        lose them until the caller has called ``os.sync``: many datasets need one such call.

        Args:
            folder: The dataset, on the same file system.
            count: How many of its episodes, the first ones; all if None.

        Raises:
            AssetError: If it is damaged.
            ConfigError: If it has other features.
            StorageError: If the files cannot be written; the dataset is what it was before.
        """
        self._check_open()
        found = read_metadata(folder)
        self._check_same(found, folder)
        pa, tasks, tables, parts = schema.arrow(), dict(self._tasks), {}, []
        start, end = self.frame_count, 0
        for row, known in list(zip(found.rows, found.statistics, strict=True))[:count]:
            where = str(file_of(row, "data"))
            if where not in tables:
                tables[where] = self._own_table(found, row), row["dataset_from_index"]
            whole, first = tables[where]
            number, length = self.episode_count + len(parts), row["length"]
            task = tasks.setdefault(row["tasks"][0], len(tasks))
            numbers = {"index": start + end + np.arange(length)}
            numbers |= {n: np.full(length, k) for n, k in (("episode_index", number), ("task_index", task))}
            kept = whole.slice(row["dataset_from_index"] - first, length)
            columns = [pa.array(numbers[name]) if name in numbers else kept[name] for name in self._schema.names]
            table = pa.table(columns, schema=self._schema)
            films = {
                name: folder / schema.VIDEO_PATH.format(video_key=name, **file_of(row, f"videos/{name}"))
                for name, kind in self.features.items()
                if kind.dtype == "video"
            }
            state = folder / schema.STATE_PATH.format(number=row["episode_index"])
            known = known | {name: number_statistics(values[:, None]) for name, values in numbers.items()}
            parts.append(_Part(row["tasks"][0], table, known, films, state.read_bytes() if state.exists() else None))
            end += length
        with storage_errors(f"dataset {self.folder}", hint="free some space"):
            self._put(parts, durable=False)

    def _save(self, task: str, state: bytes | None) -> None:
        """Add the present episode."""
        episode = self._episode
        for film in episode.films.values():
            film.close()
        arrays = episode.arrays(self.episode_count, self.frame_count, self._tasks.get(task, len(self._tasks)))
        table, films = episode.table(arrays, self._schema), {name: film.path for name, film in episode.films.items()}
        self._put([_Part(task, table, episode.statistics(arrays), films, state)])

    def _put(self, parts: list[_Part], *, durable: bool = True) -> None:
        """Stage the files of the dataset with further episodes, then put them in place."""
        stage = self._root / STAGE
        stage.mkdir(exist_ok=True)
        tasks, total = dict(self._tasks), dict(self._statistics)
        rows, tables, file, film = self._rows, self._tables, self._file, self._films_done
        number, start = self.episode_count, self.frame_count
        moves: dict[str, Path] = {}
        files: dict[int, tuple[list[dict[str, Any]], list[Any]]] = {}
        for part in parts:
            tasks.setdefault(part.task, len(tasks))
            for name, known in part.statistics.items():
                total[name] = combine([total[name], known]) if name in total else known
            size = sum(table.nbytes for table in tables)
            if rows and (size + part.table.nbytes > self._limit or len(rows) >= EPISODES_PER_FILE):
                rows, tables, file = [], [], file + 1
            film += 1
            rows, tables = [*rows, self._row(number, part, start, file, film)], [*tables, part.table]
            files[file] = rows, tables
            films = schema.place_of(film)
            moves |= {schema.VIDEO_PATH.format(video_key=k, **films): path for k, path in part.films.items()}
            target = schema.STATE_PATH.format(number=number)
            if part.state is not None:
                moves[target] = stage / f"state-{number}.npz"
                moves[target].write_bytes(part.state)
            else:  # one that a killed recording may have left behind
                (self._root / target).unlink(missing_ok=True)
            number, start = number + 1, start + part.table.num_rows
        for k, (listed, written) in files.items():
            where = schema.place_of(k)
            moves[schema.DATA_PATH.format(**where)] = write_table(stage / f"data-{k}.parquet", written)
            rows_table = schema.rows_table(listed)
            moves[schema.EPISODES_PATH.format(**where)] = write_table(stage / f"episodes-{k}.parquet", [rows_table])
        if len(tasks) > len(self._tasks):
            moves[schema.TASKS_PATH] = write_table(stage / "tasks.parquet", [schema.tasks_table(tasks)])
        moves[schema.STATISTICS_PATH] = write_json(stage / "stats.json", schema.listed(total))
        origins, last = self._origins, dict(self._origins[-1]) if self._origins else {}
        last.pop("first_episode", None)
        if self._origin is not None and self._origin != last:
            origins = [*origins, {**self._origin, "first_episode": self.episode_count}]
            moves[schema.ORIGINS_PATH] = write_json(stage / "softmode.json", {"origins": origins})
        info = self._info(number, start, tasks)
        moves[schema.CARD_PATH] = stage / "README.md"
        moves[schema.CARD_PATH].write_text(schema.card(info, list(tasks), origins[-1] if origins else {}), "utf-8")
        moves[schema.INFO_PATH] = write_json(stage / "info.json", info)
        for source in moves.values() if durable else ():
            sync(source)
        for target, source in moves.items():
            (self._root / target).parent.mkdir(parents=True, exist_ok=True)
            os.replace(source, self._root / target)
        if self._is_new:
            shutil.rmtree(stage)
            os.rename(self._root, self.folder)  # replaces an empty folder, and fails on any other
            self._root, self._is_new = self.folder, False
            self._drop_claim()
        self._rows, self._tables, self._file, self._films_done = rows, tables, file, film
        self._tasks, self._statistics, self._origins = tasks, total, origins
        self.episode_count, self.frame_count = number, start

    def _row(self, number: int, part: _Part, start: int, file: int, film: int) -> dict[str, Any]:
        """Return the row of an episode."""
        count = part.table.num_rows
        row: dict[str, Any] = {"episode_index": number, "tasks": [part.task], "length": count}
        row |= {f"data/{key}": value for key, value in schema.place_of(file).items()}
        row |= {"dataset_from_index": start, "dataset_to_index": start + count}
        for name in part.films:
            row |= {f"videos/{name}/{key}": value for key, value in schema.place_of(film).items()}
            row |= {f"videos/{name}/from_timestamp": 0.0, f"videos/{name}/to_timestamp": count / self._fps}
        for name, values in part.statistics.items():
            row |= {f"stats/{name}/{key}": value.tolist() for key, value in values.items()}
        return row | {f"meta/episodes/{key}": value for key, value in schema.place_of(file).items()}

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
        self._episode.abort()
        self._release()

    def _release(self) -> None:
        """Let go of the folder, and remove what was made and not completed."""
        if self._lock is not None:
            shutil.rmtree(self._root / STAGE, ignore_errors=True)
            os.close(self._lock)
            self._lock = None
        self._drop_claim()

    def _drop_claim(self) -> None:
        """Remove what a new folder did not become."""
        if self._claim is not None:
            self._claim.release()

    def __enter__(self) -> DatasetWriter:
        """Return the writer."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it; frames that were not saved are dropped."""
        self.close()


def _described(features: Mapping[str, Feature]) -> str:
    """Return features in a line."""
    return ", ".join(f"{name} {kind.dtype}{list(kind.shape)}" for name, kind in features.items())
