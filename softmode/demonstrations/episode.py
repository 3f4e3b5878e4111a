"""The episode that is being recorded: its frames in memory, its films on the disk."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softmode.demonstrations import schema
from softmode.demonstrations.pictures import FilmWriter, encode_png
from softmode.demonstrations.schema import INDEX_FEATURES, Feature
from softmode.demonstrations.statistics import PictureStatistics, Statistics, number_statistics
from softmode.errors import ConfigError
from softmode.files import storage_errors

if TYPE_CHECKING:
    import pyarrow as pa


class Episode:
    """The frames of an episode.

    Args:
        features: Columns by name, the indices included.
        fps: Frames per second.
        stage: Folder for films, made when there is one.
    """

    def __init__(self, features: Mapping[str, Feature], fps: int, stage: Path) -> None:
        """Begin without a frame."""
        self.length = 0
        self.films: dict[str, FilmWriter] = {}
        self._features, self._fps, self._stage = features, fps, stage
        self._columns: dict[str, list[Any]] = {name: [] for name, kind in features.items() if kind.dtype != "video"}
        self._pictures = {name: PictureStatistics() for name, kind in features.items() if kind.is_picture}

    def add(self, frame: Mapping[str, Any]) -> None:
        """Append a frame; see :meth:`softmode.demonstrations.writer.DatasetWriter.add_frame`."""
        given, expected = set(frame), set(self._features) - set(INDEX_FEATURES)
        if given != expected:
            raise ConfigError(
                f"frame lacks {sorted(expected - given)} and has unknown {sorted(given - expected)}",
                hint="give a value for every feature",
            )
        values = {name: _checked(name, frame[name], self._features[name]) for name in expected}
        for name, value in values.items():
            kind = self._features[name]
            if kind.dtype == "video":
                self._film(name).add(value)
            elif kind.dtype == "image":
                path = f"frame-{self.length:06d}.png"
                self._columns[name].append({"bytes": encode_png(value), "path": path})
            else:
                self._columns[name].append(value)
            if kind.is_picture:
                self._pictures[name].add(value)
        self.length += 1

    def _film(self, name: str) -> FilmWriter:
        """Return the film of a camera."""
        if name not in self.films:
            with storage_errors(self._stage, hint="free some space"):
                self._stage.mkdir(exist_ok=True)
            height, width, _ = self._features[name].shape
            self.films[name] = FilmWriter(self._stage / f"{name}.mp4", height, width, self._fps)
        return self.films[name]

    def abort(self) -> None:
        """Stop and remove the films."""
        for film in self.films.values():
            film.abort()
        shutil.rmtree(self._stage, ignore_errors=True)

    def arrays(self, number: int, start: int, task: int) -> dict[str, NDArray[Any]]:
        """Return the numbers, each of shape (length, D).

        Args:
            number: Number of the episode.
            start: Number of its first frame within the dataset.
            task: Number of its task.
        """
        frames = np.arange(self.length)
        filled = {
            "timestamp": (frames / self._fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(self.length, number),
            "index": start + frames,
            "task_index": np.full(self.length, task),
        }
        arrays = {
            name: np.array(self._columns[name], np.dtype(kind.dtype))
            for name, kind in self._features.items()
            if not kind.is_picture and name not in filled
        }
        return arrays | {name: values[:, None] for name, values in filled.items()}

    def table(self, arrays: Mapping[str, NDArray[Any]], form: pa.Schema) -> pa.Table:
        """Return the episode as a table of a schema."""
        arrow = schema.arrow()
        columns = []
        for field in form:
            if field.name not in arrays:
                columns.append(arrow.array(self._columns[field.name], field.type))
                continue
            flat = arrow.array(arrays[field.name].ravel())
            if arrow.types.is_fixed_size_list(field.type):
                flat = arrow.FixedSizeListArray.from_arrays(flat, type=field.type)
            columns.append(flat)
        return arrow.table(columns, schema=form)

    def statistics(self, arrays: Mapping[str, NDArray[Any]]) -> dict[str, Statistics]:
        """Return the statistics of every feature."""
        return {
            name: self._pictures[name].result() if kind.is_picture else number_statistics(arrays[name])
            for name, kind in self._features.items()
        }


def _checked(name: str, value: object, kind: Feature) -> NDArray[Any]:
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
