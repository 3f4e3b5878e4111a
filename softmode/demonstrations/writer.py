"""Writing demonstrations as a LeRobot dataset that is complete after every episode."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softmode.demonstrations import schema
from softmode.demonstrations.episode import Episode
from softmode.demonstrations.metadata import Metadata, file_of, read_metadata
from softmode.demonstrations.schema import INDEX_FEATURES, Feature, write_json, write_table
from softmode.demonstrations.statistics import Statistics, combine
from softmode.errors import ConfigError
from softmode.files import storage_errors, sync
from softmode.leftovers import Claim, lock

STAGE = ".recording"
"""Folder inside a dataset where files of an unfinished episode are written."""
EPISODES_PER_FILE = 500


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
        if found.features != self.features or found.fps != self._fps:
            raise ConfigError(
                f"{self.folder} holds features {_described(found.features)} at {found.fps} frames per second, not "
                f"{_described(self.features)} at {self._fps}",
                hint="record into another folder",
            )
        self._tasks = {task: number for number, task in enumerate(found.tasks)}
        self.episode_count, self.frame_count = found.episode_count, found.frame_count
        self._robot_type, self._origins = found.robot_type, list(found.origins)
        if not found.rows:
            return
        self._statistics = found.combined()
        last = found.rows[-1]
        file = file_of(last, "data")
        if file_of(last, "meta/episodes") != file or not (table := found.data_table(last)).schema.equals(self._schema):
            raise ConfigError(f"{self.folder} was written by another program", hint="record into another folder")
        self._file = file["chunk_index"] * schema.CHUNK_SIZE + file["file_index"]
        if any(last.get(f"videos/{name}/file_index") is not None for name in self.features):
            self._films_done = self.episode_count - 1
        self._rows = [row for row in found.rows if file_of(row, "data") == file]
        first = self._rows[0]["dataset_from_index"]
        # What a killed recording left behind the last episode is not taken over.
        self._tables = [table.slice(row["dataset_from_index"] - first, row["length"]) for row in self._rows]

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

    def _save(self, task: str, state: bytes | None) -> None:
        """Stage the files of the dataset with the present episode, then put them in place."""
        episode, number, start = self._episode, self.episode_count, self.frame_count
        count = episode.length
        tasks = {**self._tasks}
        tasks.setdefault(task, len(tasks))
        for film in episode.films.values():
            film.close()
        arrays = episode.arrays(number, start, tasks[task])
        table, found = episode.table(arrays, self._schema), episode.statistics(arrays)
        total = {n: combine([self._statistics[n], s]) if n in self._statistics else s for n, s in found.items()}

        rows, tables, file = self._rows, self._tables, self._file
        size = sum(part.nbytes for part in tables)
        if rows and (size + table.nbytes > self._limit or len(rows) >= EPISODES_PER_FILE):
            rows, tables, file = [], [], file + 1
        film_number = self._films_done + 1
        row = self._row(number, task, start, count, file, film_number, found)
        rows, tables = [*rows, row], [*tables, table]

        stage = self._root / STAGE
        stage.mkdir(exist_ok=True)
        where, films = schema.place_of(file), schema.place_of(film_number)
        moves = {schema.VIDEO_PATH.format(video_key=k, **films): film.path for k, film in episode.films.items()}
        moves[schema.DATA_PATH.format(**where)] = write_table(stage / "data.parquet", tables)
        if len(tasks) > len(self._tasks):
            moves[schema.TASKS_PATH] = write_table(stage / "tasks.parquet", [schema.tasks_table(tasks)])
        moves[schema.EPISODES_PATH.format(**where)] = write_table(stage / "episodes.parquet", [schema.rows_table(rows)])
        moves[schema.STATISTICS_PATH] = write_json(stage / "stats.json", schema.listed(total))
        origins, last = self._origins, dict(self._origins[-1]) if self._origins else {}
        last.pop("first_episode", None)
        if self._origin is not None and self._origin != last:
            origins = [*origins, {**self._origin, "first_episode": number}]
            moves[schema.ORIGINS_PATH] = write_json(stage / "softmode.json", {"origins": origins})
        if state is not None:
            moves[schema.STATE_PATH.format(number=number)] = stage / "state.npz"
            (stage / "state.npz").write_bytes(state)
        else:  # one that a killed recording may have left behind
            (self._root / schema.STATE_PATH.format(number=number)).unlink(missing_ok=True)
        info = self._info(number + 1, start + count, tasks)
        moves[schema.CARD_PATH] = stage / "README.md"
        moves[schema.CARD_PATH].write_text(schema.card(info, list(tasks), origins[-1] if origins else {}), "utf-8")
        moves[schema.INFO_PATH] = write_json(stage / "info.json", info)
        for source in moves.values():
            sync(source)
        for target, source in moves.items():
            (self._root / target).parent.mkdir(parents=True, exist_ok=True)
            os.replace(source, self._root / target)
        if self._is_new:
            shutil.rmtree(stage)
            os.rename(self._root, self.folder)  # replaces an empty folder, and fails on any other
            self._root, self._is_new = self.folder, False
            self._drop_claim()
        self._rows, self._tables, self._file = rows, tables, file
        self._tasks, self._statistics, self._origins = tasks, total, origins
        self.episode_count, self.frame_count = number + 1, start + count
        self._films_done = film_number

    def _row(
        self, number: int, task: str, start: int, count: int, file: int, film: int, found: Mapping[str, Statistics]
    ) -> dict[str, Any]:
        """Return the row of an episode."""
        row: dict[str, Any] = {"episode_index": number, "tasks": [task], "length": count}
        row |= {f"data/{key}": value for key, value in schema.place_of(file).items()}
        row |= {"dataset_from_index": start, "dataset_to_index": start + count}
        for name in self._episode.films:
            row |= {f"videos/{name}/{key}": value for key, value in schema.place_of(film).items()}
            row |= {f"videos/{name}/from_timestamp": 0.0, f"videos/{name}/to_timestamp": count / self._fps}
        for name, values in found.items():
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
