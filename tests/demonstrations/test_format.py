"""What a written dataset looks like on the disk: the LeRobot v3.0 format, field by field."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from softmode.demonstrations import read_dataset
from softmode.errors import AssetError
from tests.demonstrations.episodes import CAMERA, FPS, episode, features, write

pq: Any = pytest.importorskip("pyarrow.parquet")
pa: Any = pytest.importorskip("pyarrow")

LENGTHS = (5, 8, 3, 7)
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


def listing(folder: Path) -> list[str]:
    """Return the names of all files, hidden ones included."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_folder_holds_the_files_of_the_format_and_no_others(tmp_path: Path):
    """Table files of several episodes, one film per episode, nothing hidden."""
    write(tmp_path / "png", LENGTHS, "image")
    tables = [
        "README.md",
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    ]
    assert listing(tmp_path / "png") == tables
    write(tmp_path / "video", LENGTHS, "video")
    films = [f"videos/{CAMERA}/chunk-000/file-{k:03d}.mp4" for k in range(len(LENGTHS))]
    assert listing(tmp_path / "video") == tables + films
    card = (tmp_path / "video/README.md").read_text().splitlines()
    assert card[0] == card[card.index("---", 1)] == "---" and "| robot | arm |" in card
    assert any(line.startswith(f"| cameras | {CAMERA} (") for line in card)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["png", "video"]


@pytest.mark.parametrize("pictures", [None, "image", "video"])
def test_info(tmp_path: Path, pictures: str | None):
    """info.json holds the fields that LeRobot reads, with shapes, types and names of all features."""
    write(tmp_path / "d", LENGTHS, pictures)
    info = json.loads((tmp_path / "d/meta/info.json").read_text())
    described = info.pop("features")
    assert info == {
        "codebase_version": "v3.0",
        "robot_type": "arm",
        "total_episodes": 4,
        "total_frames": 23,
        "total_tasks": 2,
        "chunks_size": 1000,
        "data_files_size_in_mb": 20,
        "video_files_size_in_mb": 20,
        "fps": FPS,
        "splits": {"train": "0:4"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        if pictures == "video"
        else None,
    }
    assert described["observation.state"] == {"dtype": "float32", "shape": [3], "names": ["x", "y", "z"]}
    assert described["next.done"] == {"dtype": "bool", "shape": [1], "names": None}
    assert described["timestamp"] == {"dtype": "float32", "shape": [1], "names": None}
    for name in ("frame_index", "episode_index", "index", "task_index"):
        assert described[name] == {"dtype": "int64", "shape": [1], "names": None}
    assert set(described) == {*features(pictures), *("timestamp frame_index episode_index index task_index".split())}
    if pictures:
        camera = described[CAMERA]
        assert (camera["dtype"], camera["shape"]) == (pictures, [32, 48, 3])
        assert camera["names"] == ["height", "width", "channels"]
        assert ("info" in camera) == (pictures == "video")
        if pictures == "video":
            assert camera["info"]["video.fps"] == FPS and camera["info"]["video.codec"] == "h264"


def test_data_table(tmp_path: Path):
    """Types of the columns, their description for Hugging Face datasets, indices, values; a row group per episode."""
    episodes = write(tmp_path / "d", LENGTHS, "image")
    path = tmp_path / "d/data/chunk-000/file-000.parquet"
    file = pq.ParquetFile(path)
    assert [file.metadata.row_group(k).num_rows for k in range(file.metadata.num_row_groups)] == list(LENGTHS)
    table = file.read()
    types = {
        "observation.state": pa.list_(pa.float32(), 3),
        "observation.environment_state": pa.list_(pa.float64(), 2),
        "action": pa.list_(pa.float32(), 2),
        "next.reward": pa.float32(),
        "next.done": pa.bool_(),
        "next.success": pa.bool_(),
        CAMERA: pa.struct([("bytes", pa.binary()), ("path", pa.string())]),
        "timestamp": pa.float32(),
        "frame_index": pa.int64(),
        "episode_index": pa.int64(),
        "index": pa.int64(),
        "task_index": pa.int64(),
    }
    assert {field.name: field.type for field in table.schema} == types
    described = json.loads(table.schema.metadata[b"huggingface"])["info"]["features"]
    assert list(described) == table.column_names
    assert described["action"] == {"feature": {"dtype": "float32", "_type": "Value"}, "length": 2, "_type": "List"}
    assert described["next.done"] == {"dtype": "bool", "_type": "Value"}
    assert described[CAMERA] == {"_type": "Image"}

    rows = table.to_pylist()
    assert [row["index"] for row in rows] == list(range(sum(LENGTHS)))
    frames = [(e, k, frame) for e, frames in enumerate(episodes) for k, frame in enumerate(frames)]
    for row, (e, k, frame) in zip(rows, frames, strict=True):
        assert (row["episode_index"], row["frame_index"], row["task_index"]) == (e, k, e == 2)
        assert row["timestamp"] == np.float32(k / FPS)
        assert row["action"] == frame["action"].tolist()
        assert row["next.done"] is frame["next.done"]
        assert row[CAMERA]["path"] == f"frame-{k:06d}.png"
        with Image.open(io.BytesIO(row[CAMERA]["bytes"])) as image:
            assert image.format == "PNG" and np.array_equal(np.asarray(image), frame[CAMERA])


@pytest.mark.parametrize("pictures", ["image", "video"])
def test_episodes_table(tmp_path: Path, pictures: str):
    """Ranges lie one behind the other, name the files, and every feature has its statistics."""
    episodes = write(tmp_path / "d", LENGTHS, pictures)
    rows = pq.read_table(tmp_path / "d/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    ends = np.cumsum(LENGTHS).tolist()
    assert [row["episode_index"] for row in rows] == [0, 1, 2, 3]
    assert [row["tasks"] for row in rows] == [["lift the toy"], ["lift the toy"], ["push"], ["lift the toy"]]
    assert [row["length"] for row in rows] == list(LENGTHS)
    assert [row["dataset_from_index"] for row in rows] == [0, *ends[:-1]]
    assert [row["dataset_to_index"] for row in rows] == ends
    for e, row in enumerate(rows):
        for name in ("data/chunk_index", "data/file_index", "meta/episodes/chunk_index", "meta/episodes/file_index"):
            assert row[name] == 0
        if pictures == "video":
            assert (row[f"videos/{CAMERA}/chunk_index"], row[f"videos/{CAMERA}/file_index"]) == (0, e)
            times = row[f"videos/{CAMERA}/from_timestamp"], row[f"videos/{CAMERA}/to_timestamp"]
            assert times == (0.0, LENGTHS[e] / FPS)
        actions = np.array([frame["action"] for frame in episodes[e]], np.float64)
        for key, value in {"min": actions.min(0), "mean": actions.mean(0), "std": actions.std(0)}.items():
            np.testing.assert_allclose(row[f"stats/action/{key}"], value, rtol=1e-12, atol=1e-15)
        for key, q in QUANTILES.items():
            np.testing.assert_allclose(row[f"stats/action/{key}"], np.quantile(actions, q, axis=0), rtol=1e-12)
        bytes_ = np.array([frame[CAMERA] for frame in episodes[e]]).reshape(-1, 3) / 255.0
        np.testing.assert_allclose(np.squeeze(row[f"stats/{CAMERA}/mean"]), bytes_.mean(0), rtol=1e-12)
        np.testing.assert_allclose(np.squeeze(row[f"stats/{CAMERA}/std"]), bytes_.std(0), rtol=1e-9)
        quantile = np.quantile(bytes_, 0.9, axis=0, method="inverted_cdf")
        np.testing.assert_allclose(np.squeeze(row[f"stats/{CAMERA}/q90"]), quantile, rtol=1e-12)
        assert row[f"stats/{CAMERA}/count"] == [LENGTHS[e]]
        for name in (*features(pictures), "timestamp", "frame_index", "episode_index", "index", "task_index"):
            for key in ("min", "max", "mean", "std", "count", *QUANTILES):
                shape = (3, 1, 1) if name == CAMERA else features(pictures)[name].shape if "." in name else (1,)
                shape = (2,) if name == "action" else shape
                assert np.shape(row[f"stats/{name}/{key}"]) == ((1,) if key == "count" else shape), (name, key)


def test_statistics_of_the_dataset_equal_those_of_all_its_frames(tmp_path: Path):
    """Least, largest, mean, standard deviation and count are numpy's; quantiles average the episodes' by length."""
    episodes = write(tmp_path / "d", LENGTHS, "image")
    stats = json.loads((tmp_path / "d/meta/stats.json").read_text())
    frames = [frame for frames in episodes for frame in frames]
    for name in features():
        values = np.array([np.reshape(frame[name], -1) for frame in frames]).astype(np.float64)
        found = {key: np.array(value, np.float64) for key, value in stats[name].items()}
        np.testing.assert_array_equal(found["min"], values.min(0))
        np.testing.assert_array_equal(found["max"], values.max(0))
        np.testing.assert_allclose(found["mean"], values.mean(0), rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(found["std"], values.std(0), rtol=1e-12)
        assert found["count"] == [len(frames)]
        parts = [np.array([np.reshape(f[name], -1) for f in e]).astype(np.float64) for e in episodes]
        weighted = sum(np.quantile(part, 0.9, axis=0) * len(part) for part in parts) / len(frames)
        np.testing.assert_allclose(found["q90"], weighted, rtol=1e-12)
    pixels = np.array([frame[CAMERA] for frame in frames]).reshape(-1, 3) / 255.0
    np.testing.assert_allclose(np.squeeze(stats[CAMERA]["mean"]), pixels.mean(0), rtol=1e-12)
    np.testing.assert_allclose(np.squeeze(stats[CAMERA]["std"]), pixels.std(0), rtol=1e-9)
    np.testing.assert_array_equal(np.squeeze(stats[CAMERA]["max"]), pixels.max(0))


def test_tasks_table_is_a_frame_indexed_by_sentence(tmp_path: Path):
    """The columns and the pandas description that LeRobot's reader makes a data frame of."""
    write(tmp_path / "d", LENGTHS)
    table = pq.read_table(tmp_path / "d/meta/tasks.parquet")
    assert table.to_pydict() == {"task_index": [0, 1], "__index_level_0__": ["lift the toy", "push"]}
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]


def test_a_snapshot_of_hugging_face_is_read_and_its_links_stay_in_the_cache(tmp_path: Path):
    """The cache has a dataset as links to blobs beside it; a link that leads out of both is refused."""
    snapshot, blobs = tmp_path / "datasets--me--toy/snapshots/0a1b", tmp_path / "datasets--me--toy/blobs"
    write(snapshot, (2,))
    blobs.mkdir()
    for number, path in enumerate(sorted(path for path in snapshot.rglob("*") if path.is_file())):
        path.rename(blobs / str(number))
        path.symlink_to(blobs / str(number))
    assert read_dataset(snapshot).columns["action"].shape[0] == 2
    info = snapshot / "meta/info.json"
    info.resolve().rename(tmp_path / "info.json")
    info.unlink()
    info.symlink_to(tmp_path / "info.json")
    with pytest.raises(AssetError, match="leads out of the dataset's folder"):
        read_dataset(snapshot)


def test_large_datasets_are_spread_over_files(tmp_path: Path):
    """Beyond the size limit a new table file begins, and reading gives one dataset all the same."""
    from softmode.demonstrations import DatasetWriter, Feature

    wide = {"action": Feature(dtype="float64", shape=(20_000,))}
    values = np.random.default_rng(0).normal(size=(7, 3, 20_000))
    for part in (values[:4], values[4:]):
        with DatasetWriter(tmp_path / "d", wide, fps=10, append=True, file_megabytes=1) as writer:
            for frames in part:
                for frame in frames:
                    writer.add_frame({"action": frame})
                writer.save_episode("move")
    assert len(list((tmp_path / "d/data/chunk-000").iterdir())) == 4  # two episodes of 0.48 MB fit into a file
    assert len(list((tmp_path / "d/meta/episodes/chunk-000").iterdir())) == 4
    found = read_dataset(tmp_path / "d")
    np.testing.assert_array_equal(found.columns["action"], values.reshape(21, -1))
    np.testing.assert_allclose(found.statistics["action"]["mean"], values.reshape(21, -1).mean(0), atol=1e-14)


def test_rerun_reads_it(tmp_path: Path, pictures: str = "image"):
    """Rerun's LeRobot reader finds the episodes, their numbers, tasks and pictures."""
    module = pytest.importorskip("rerun.experimental")
    if not hasattr(module, "LeRobotReader"):
        pytest.skip("this version of rerun has no LeRobot reader in Python")
    for pictures in ("image", "video"):
        folder = tmp_path / pictures
        episodes = write(folder, LENGTHS, pictures)
        reader = module.LeRobotReader(folder)
        assert reader.version == "v3" and reader.episodes() == [0, 1, 2, 3]
        for e, frames in enumerate(episodes):
            columns: dict[tuple[str, str], list[Any]] = {}
            for chunk in reader.stream(e).to_chunks():
                batch = chunk.to_record_batch()
                for name in batch.schema.names:
                    columns.setdefault((chunk.entity_path, name), []).extend(batch.column(name).to_pylist())
            assert columns["/action", "Scalars:scalars"] == [f["action"].astype(float).tolist() for f in frames]
            assert columns["/action", "frame_index"] == list(range(len(frames)))
            assert columns["/observation.state", "SeriesLines:names"] == [["x", "y", "z"]]
            assert columns["/task", "TextDocument:text"] == [["push" if e == 2 else "lift the toy"]] * len(frames)
            component = "EncodedImage:blob" if pictures == "image" else "VideoStream:sample"
            assert len(columns[f"/{CAMERA}", component]) == len(frames)
            if pictures == "image":
                first = columns[f"/{CAMERA}", component][0][0]
                with Image.open(io.BytesIO(bytes(first))) as image:
                    assert np.array_equal(np.asarray(image), episode(e, len(frames), True)[0][CAMERA])
