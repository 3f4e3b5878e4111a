"""The LeRobot v3.0 dataset format: file layout, features, the schemas of its tables, and how they are written.

A dataset is a folder::

    meta/info.json                                  sizes, frame rate, features, path templates
    meta/stats.json                                 statistics of every feature over all frames
    meta/tasks.parquet                              task sentences and their numbers
    meta/episodes/chunk-000/file-000.parquet        one row per episode: where its frames are, its statistics
    meta/softmode.json                              where the episodes come from; not of the format
    README.md                                       the card by which a hub shows the dataset
    data/chunk-000/file-000.parquet                 one row per frame
    videos/KEY/chunk-000/file-000.mp4               pictures, when they are stored as video

Reference: the format that ``lerobot`` 0.4 (https://github.com/huggingface/lerobot) reads and writes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from softmode.checks import require_choice
from softmode.demonstrations.statistics import Statistics
from softmode.errors import ConfigError, needs_extra

if TYPE_CHECKING:
    import pyarrow as pa

FeatureType = Literal["float32", "float64", "int64", "bool", "image", "video"]

CODEBASE_VERSION = "v3.0"
CHUNK_SIZE = 1000
"""Files per chunk folder."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
INFO_PATH, STATISTICS_PATH, TASKS_PATH = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
ORIGINS_PATH, CARD_PATH = "meta/softmode.json", "README.md"
STATE_PATH = "meta/states/episode-{number:06d}.npz"
IMAGE_NAMES = ("height", "width", "channels")
GOALS = ("achieved_goal", "desired_goal")
"""Keys of the goals in observations of environments with goals; their features begin with ``observation``."""


def place_of(number: int) -> dict[str, int]:
    """Return the chunk of a file and its number within, by their names in the templates of paths."""
    chunk, within = divmod(number, CHUNK_SIZE)
    return {"chunk_index": chunk, "file_index": within}


def card(info: Mapping[str, Any], tasks: Sequence[str], origin: Mapping[str, Any]) -> str:
    """Return the card of a dataset: what a hub reads of it, and what a person wants to know first.

    Args:
        info: What info.json holds.
        tasks: Task sentences.
        origin: Where the last episodes come from; its ``license`` is the dataset's.
    """
    head = ["task_categories:", "- robotics", "tags:", "- LeRobot", "- softmode"]
    head += [f"license: {origin['license']}"] if origin.get("license") else []
    head += ["configs:", "- config_name: default", "  data_files: data/*/*.parquet"]
    films = [name for name, kind in info["features"].items() if kind["dtype"] in ("video", "image")]
    rows = {
        "tasks": "; ".join(tasks),
        "environment": origin.get("env", "not said"),
        "robot": info["robot_type"] or "not said",
        "episodes, frames": f"{info['total_episodes']}, {info['total_frames']}",
        "frames per second": info["fps"],
        "cameras": ", ".join(f"{name} {tuple(info['features'][name]['shape'])}" for name in films) or "none",
    }
    table = [f"| {name} | {value} |" for name, value in rows.items()]
    text = f"Episodes of soft objects, simulated by softmode, in LeRobot's format {CODEBASE_VERSION}."
    return "\n".join(["---", *head, "---", "", text, "", "| | |", "|---|---|", *table, ""])


@dataclass(frozen=True, kw_only=True)
class Feature:
    """One column of a dataset.

    Raises:
        ConfigError: If type and shape do not fit together.
    """

    dtype: FeatureType
    """Type of a number; ``image`` for pictures stored as PNG in the table, ``video`` for pictures stored as film."""
    shape: tuple[int, ...]
    """(D,) for numbers, (height, width, 3) for pictures."""
    names: tuple[str, ...] | None = None
    """Name of every entry of a vector, or of the axes of a picture."""

    def __post_init__(self) -> None:
        """Check the combination."""
        require_choice("feature type", self.dtype, get_args(FeatureType))
        if not all(type(edge) is int and 0 < edge <= 1 << 20 for edge in self.shape):
            raise ConfigError(f"feature shape {self.shape} must hold positive whole numbers")
        if self.is_picture:
            if len(self.shape) != 3 or self.shape[2] != 3:
                raise ConfigError(f"a picture's shape is {self.shape}", hint="use (height, width, 3)")
            if self.dtype == "video" and (self.shape[0] % 2 or self.shape[1] % 2):
                raise ConfigError(f"a video needs even edges, got {self.shape}", hint="store PNG pictures instead")
        elif len(self.shape) != 1:
            raise ConfigError(f"a feature of numbers has shape {self.shape}", hint="use (D,)")
        if self.names is not None:
            count = 3 if self.is_picture else self.shape[0]
            if len(self.names) != count or not all(isinstance(name, str) for name in self.names):
                raise ConfigError(f"feature names {self.names} must be {count} strings")

    @property
    def is_picture(self) -> bool:
        """Whether the column holds pictures."""
        return self.dtype in ("image", "video")


INDEX_FEATURES = {
    "timestamp": Feature(dtype="float32", shape=(1,)),
    **{n: Feature(dtype="int64", shape=(1,)) for n in ("frame_index", "episode_index", "index", "task_index")},
}
"""Columns that every dataset has and that the writer fills in: time within the episode [s], number of the frame within
its episode, of the episode, of the frame within the dataset, and of the task."""


def check_features(features: Mapping[str, Feature]) -> None:
    """Raise ConfigError if a name cannot be a column, or is one that the writer fills in."""
    if not features:
        raise ConfigError("a dataset needs at least one feature", hint="give for example an action")
    for name in features:
        parts = name.split(".")
        if name in INDEX_FEATURES or not all(part.isidentifier() for part in parts):
            raise ConfigError(
                f"feature name {name!r} cannot be used", hint="name it like observation.state, and none of the indices"
            )


def feature_to_json(feature: Feature, fps: int) -> dict[str, Any]:
    """Return how info.json describes a feature."""
    names = IMAGE_NAMES if feature.is_picture and feature.names is None else feature.names
    shape, names = list(feature.shape), None if names is None else list(names)
    entry: dict[str, Any] = {"dtype": feature.dtype, "shape": shape, "names": names}
    if feature.dtype == "video":
        entry["info"] = {"video.height": shape[0], "video.width": shape[1]}
        entry["info"] |= {"video.codec": "h264", "video.pix_fmt": "yuv420p", "video.is_depth_map": False}
        entry["info"] |= {"video.fps": fps, "video.channels": 3, "has_audio": False}
    return entry


def feature_from_json(entry: Mapping[str, Any]) -> Feature:
    """Return the feature that info.json describes; raises ConfigError, KeyError or TypeError if it describes none."""
    names = entry["names"]
    return Feature(
        dtype=entry["dtype"], shape=tuple(entry["shape"]), names=None if names is None else tuple(map(str, names))
    )


def arrow() -> Any:
    """Return pyarrow, or raise MissingExtraError."""
    with needs_extra("data", "datasets need pyarrow"):
        import pyarrow
        import pyarrow.parquet
    return pyarrow


def data_schema(features: Mapping[str, Feature]) -> pa.Schema:
    """Return the schema of a data file, with the description that Hugging Face ``datasets`` keeps in its metadata."""
    pa = arrow()
    fields, described = [], {}
    for name, feature in features.items():
        if feature.dtype == "video":
            continue  # lives in its own file
        if feature.dtype == "image":
            kind, description = pa.struct([("bytes", pa.binary()), ("path", pa.string())]), {"_type": "Image"}
        else:
            kind = {"bool": pa.bool_()}.get(feature.dtype) or getattr(pa, feature.dtype)()
            description = {"dtype": feature.dtype, "_type": "Value"}
            if feature.shape != (1,):
                kind = pa.list_(kind, feature.shape[0])
                description = {"feature": description, "length": feature.shape[0], "_type": "List"}
        fields.append(pa.field(name, kind))
        described[name] = description
    return pa.schema(fields, metadata={"huggingface": json.dumps({"info": {"features": described}})})


def tasks_schema() -> pa.Schema:
    """Return the schema of the table of tasks, a pandas frame whose index is the sentence."""
    pa = arrow()

    def column(name: str | None, field: str | None, kind: str, numpy_kind: str, metadata: Any = None) -> dict[str, Any]:
        kinds = {"pandas_type": kind, "numpy_type": numpy_kind}
        return {"name": name, "field_name": field, **kinds, "metadata": metadata}

    index = "__index_level_0__"
    pandas = {
        "index_columns": [index],
        "column_indexes": [column(None, None, "unicode", "object", {"encoding": "UTF-8"})],
        "columns": [column("task_index", "task_index", "int64", "int64"), column(None, index, "unicode", "object")],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    return pa.schema(
        [pa.field("task_index", pa.int64()), pa.field(index, pa.string())], metadata={"pandas": json.dumps(pandas)}
    )


def tasks_table(tasks: Mapping[str, int]) -> Any:
    """Return the table of tasks."""
    return arrow().table([list(tasks.values()), list(tasks)], schema=tasks_schema())


def rows_table(rows: list[dict[str, Any]]) -> Any:
    """Return the table of episodes."""
    return arrow().table({key: [row[key] for row in rows] for key in rows[0]})


def write_table(path: Path, tables: Sequence[Any]) -> Path:
    """Write tables of one schema as a Parquet file with a row group for each."""
    pq = arrow().parquet
    with pq.ParquetWriter(path, tables[0].schema, compression="snappy", write_page_checksum=True) as writer:
        for table in tables:
            writer.write_table(table)
    return path


def write_json(path: Path, content: Mapping[str, Any]) -> Path:
    """Write a JSON file."""
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False, allow_nan=False), encoding="utf-8")
    return path


def listed(statistics: Mapping[str, Statistics]) -> dict[str, dict[str, Any]]:
    """Return statistics as lists."""
    return {name: {key: value.tolist() for key, value in values.items()} for name, values in statistics.items()}
