"""Datasets survive: what is written is read back exactly, damage is an error, an interruption costs one episode."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from softmode.demonstrations import Dataset, DatasetWriter, Feature, read_dataset
from softmode.errors import AssetError, ConfigError, SoftmodeError, StorageError
from tests.demonstrations.episodes import CAMERA, FPS, episode, features, write
from tests.faults import at_every_call, interrupt, run

pq: Any = pytest.importorskip("pyarrow.parquet")
pa: Any = pytest.importorskip("pyarrow")

LENGTHS = (5, 8, 3)


def snapshot(folder: Path) -> dict[str, bytes]:
    """Return the content of all files."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_holds(found: Dataset, episodes: list[list[dict[str, Any]]], *, film: bool = False) -> None:
    """Compare a dataset with the frames that were written, bit by bit; a film within its quality."""
    assert found.episode_count == len(episodes)
    frames = [frame for frames in episodes for frame in frames]
    for name in frames[0]:
        expected = np.array([frame[name] for frame in frames])
        column = found.columns[name]
        if film and name == CAMERA:
            assert column.shape == expected.shape
            assert np.abs(column.astype(float) - expected).mean() < 6.0  # yuv420p halves the colours' resolution
        else:
            assert column.dtype == expected.dtype
            np.testing.assert_array_equal(column, expected.reshape(column.shape))


# -- round trip -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pictures", [None, "image", "video"])
def test_round_trip(tmp_path: Path, pictures: str | None):
    """Numbers and PNG pictures come back exactly, films frame by frame."""
    episodes = write(tmp_path / "d", LENGTHS, pictures)
    found = read_dataset(tmp_path / "d")
    assert_holds(found, episodes, film=pictures == "video")
    assert (found.fps, found.robot_type, found.tasks) == (FPS, "arm", ("lift the toy", "push"))
    assert found.features["observation.state"].names == ("x", "y", "z")
    np.testing.assert_array_equal(found.episode_start, [0, 5, 13])
    np.testing.assert_array_equal(found.episode_stop, [5, 13, 16])
    np.testing.assert_array_equal(found.columns["task_index"], [0] * 13 + [1] * 3)
    part = found.episode(1)
    np.testing.assert_array_equal(part["frame_index"], np.arange(8))
    np.testing.assert_array_equal(part["timestamp"], (np.arange(8) / FPS).astype(np.float32))
    few = read_dataset(tmp_path / "d", keys=["action"])
    assert set(few.columns) == {"action", "timestamp", "frame_index", "episode_index", "index", "task_index"}
    if pictures == "video":  # every picture is nearest to its own frame: none is lost, doubled or out of order
        for e, frames in enumerate(episodes):
            shown = found.episode(e)[CAMERA].astype(float)
            wanted = np.array([frame[CAMERA] for frame in frames], float)
            distance = np.abs(shown[:, None] - wanted[None]).mean(axis=(2, 3, 4))
            np.testing.assert_array_equal(distance.argmin(axis=1), np.arange(len(frames)))


@pytest.mark.parametrize("pictures", [None, "image", "video"])
def test_appending_equals_writing_at_once(tmp_path: Path, pictures: str | None):
    """A dataset continued after every episode has the same content as one written in one go."""
    episodes = write(tmp_path / "once", LENGTHS, pictures)
    for k, length in enumerate(LENGTHS):
        write(tmp_path / "parts", (length,), pictures, first=k, append=True)
    once, parts = read_dataset(tmp_path / "once"), read_dataset(tmp_path / "parts")
    assert_holds(parts, episodes, film=pictures == "video")
    for name, column in once.columns.items():
        np.testing.assert_array_equal(column, parts.columns[name])
    for name, values in once.statistics.items():
        for key, value in values.items():
            np.testing.assert_allclose(parts.statistics[name][key], value, rtol=1e-12)
    info = json.loads((tmp_path / "parts/meta/info.json").read_text())
    assert info == json.loads((tmp_path / "once/meta/info.json").read_text())


@pytest.mark.parametrize("pictures", [None, "image", "video"])
def test_datasets_that_are_taken_over_are_as_if_recorded_here(tmp_path: Path, pictures: str | None):
    """Episodes of two datasets, of the second one the first, give the bytes of one recorded in one go."""
    write(tmp_path / "once", LENGTHS, pictures)
    write(tmp_path / "first", LENGTHS[:2], pictures)
    write(tmp_path / "second", (LENGTHS[2], 4), pictures, first=2)
    with DatasetWriter(tmp_path / "taken", features(pictures), fps=FPS, robot_type="arm") as writer:
        writer.take_dataset(tmp_path / "first")
        writer.take_dataset(tmp_path / "second", 1)
        write(tmp_path / "other", (3,), "image" if pictures is None else None)
        with pytest.raises(ConfigError, match="holds features"):
            writer.take_dataset(tmp_path / "other")
    assert snapshot(tmp_path / "taken") == snapshot(tmp_path / "once")


def test_discarded_frames_leave_no_trace(tmp_path: Path):
    """Frames before discard_episode, and those never saved, are not in the dataset."""
    with DatasetWriter(tmp_path / "d", features("video"), fps=FPS) as writer:
        for frame in episode(7, 4, True):
            writer.add_frame(frame)
        writer.discard_episode()
        frames = episode(0, 5, True)
        for frame in frames:
            writer.add_frame(frame)
        assert writer.save_episode("lift the toy") == 0
        writer.add_frame(frames[0])
    assert [path.name for path in tmp_path.iterdir()] == ["d"]
    assert_holds(read_dataset(tmp_path / "d"), [frames], film=True)
    for act in (lambda: writer.add_frame(frames[0]), lambda: writer.save_episode("lift")):
        with pytest.raises(ConfigError, match="closed"):
            act()
    assert not list((tmp_path / "d").glob(".*"))


# -- what is refused --------------------------------------------------------------------------------------------------


def test_existing_folder_needs_append(tmp_path: Path):
    """A folder with something in it is left alone; an empty one may be used."""
    (tmp_path / "d").mkdir()
    write(tmp_path / "d", (3,))
    before = snapshot(tmp_path)
    with pytest.raises(ConfigError, match="exists"):
        DatasetWriter(tmp_path / "d", features(), fps=FPS)
    with pytest.raises(ConfigError, match="exists"):
        DatasetWriter(tmp_path / "d/meta/info.json", features(), fps=FPS)
    for other in ({"features": features("image")}, {"fps": 10}):
        with pytest.raises(ConfigError, match="frames per second"):
            DatasetWriter(tmp_path / "d", **{"features": features(), "fps": FPS, **other}, append=True)
    assert snapshot(tmp_path) == before
    (tmp_path / "other").mkdir()
    (tmp_path / "other/notes.txt").write_text("mine")
    with pytest.raises(AssetError):
        DatasetWriter(tmp_path / "other", features(), fps=FPS, append=True)
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["notes.txt"]


def test_two_writers_exclude_each_other(tmp_path: Path):
    """A second recording into the same folder is refused while the first is open."""
    write(tmp_path / "d", (3,))
    with DatasetWriter(tmp_path / "d", features(), fps=FPS, append=True):
        with pytest.raises(ConfigError, match="another recording"):
            DatasetWriter(tmp_path / "d", features(), fps=FPS, append=True)
    write(tmp_path / "d", (4,), first=1, append=True)
    assert read_dataset(tmp_path / "d").episode_count == 2


BAD_FRAMES = {
    "missing": lambda frame: frame.pop("action"),
    "unknown": lambda frame: frame.update(extra=1.0),
    "index": lambda frame: frame.update(index=0),
    "shape": lambda frame: frame.update(action=np.zeros(3, np.float32)),
    "nan": lambda frame: frame.update({"next.reward": np.nan}),
    "type": lambda frame: frame.update(action=np.array(["a", "b"])),
    "ragged": lambda frame: frame.update(action=[[1.0], [2.0, 3.0]]),
    "bool": lambda frame: frame.update({"next.done": 0.5}),
    "picture": lambda frame: frame.update({CAMERA: np.zeros((32, 48, 3))}),
}


@pytest.mark.parametrize("change", BAD_FRAMES)
def test_bad_frame_is_refused_and_not_taken(tmp_path: Path, change: str):
    """A frame that does not fit the features raises; the episode goes on without it."""
    frames = episode(0, 4, True)
    with DatasetWriter(tmp_path / "d", features("image"), fps=FPS) as writer:
        for frame in frames:
            writer.add_frame(frame)
            bad = dict(frame)
            BAD_FRAMES[change](bad)
            with pytest.raises(ConfigError):
                writer.add_frame(bad)
        writer.save_episode("lift")
    assert_holds(read_dataset(tmp_path / "d"), [frames])


@pytest.mark.parametrize(
    "make",
    [
        lambda f: DatasetWriter(f, {}, fps=30),
        lambda f: DatasetWriter(f, {"a/b": Feature(dtype="bool", shape=(1,))}, fps=30),
        lambda f: DatasetWriter(f, {"..": Feature(dtype="bool", shape=(1,))}, fps=30),
        lambda f: DatasetWriter(f, {"index": Feature(dtype="int64", shape=(1,))}, fps=30),
        lambda f: DatasetWriter(f, features(), fps=0),
        lambda f: DatasetWriter(f, features(), fps=29.97),  # type: ignore[arg-type]
        lambda f: DatasetWriter(f, features(), fps=30, file_megabytes=0),
        lambda f: Feature(dtype="video", shape=(31, 48, 3)),
        lambda f: Feature(dtype="image", shape=(32, 48, 1)),
        lambda f: Feature(dtype="float32", shape=(2, 2)),
        lambda f: Feature(dtype="float16", shape=(2,)),  # type: ignore[arg-type]
        lambda f: Feature(dtype="float32", shape=(2,), names=("x",)),
        lambda f: Feature(dtype="float32", shape=(0,)),
    ],
)
def test_bad_options(tmp_path: Path, make: Any):
    """Features and rates that the format cannot hold are refused before anything is made."""
    with pytest.raises(ConfigError):
        make(tmp_path / "d")
    assert not list(tmp_path.iterdir())


# -- damage -----------------------------------------------------------------------------------------------------------


def rewrite(path: Path, **columns: Any) -> None:
    """Replace columns of a Parquet file; None removes one."""
    table = pq.read_table(path)
    for name, change in columns.items():
        name = {"start": "dataset_from_index", "file": "data/file_index"}.get(name, name)
        k = table.column_names.index(name)
        table = (
            table.remove_column(k) if change is None else table.set_column(k, name, [change(table[name].to_pylist())])
        )
    pq.write_table(table, path)


def edit(path: Path, **values: Any) -> None:
    """Replace values of a JSON file; None removes one."""
    content = json.loads(path.read_text())
    for name, value in values.items():
        content.pop(name) if value is None else content.update({name: value})
    path.write_text(json.dumps(content))


INFO, TASKS = "meta/info.json", "meta/tasks.parquet"
DATA, ROWS = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
FILM = f"videos/{CAMERA}/chunk-000/file-001.mp4"
DAMAGE = {
    **{f"no {name}": lambda d, name=name: (d / name).unlink() for name in (INFO, TASKS, DATA, ROWS, FILM)},
    **{
        f"half {name}": lambda d, name=name: os.truncate(d / name, (d / name).stat().st_size // 2)
        for name in (INFO, TASKS, DATA, ROWS, FILM)
    },
    **{f"empty {name}": lambda d, name=name: os.truncate(d / name, 0) for name in (INFO, TASKS, DATA, ROWS, FILM)},
    "list": lambda d: (d / INFO).write_text("[]"),
    "deep": lambda d: (d / INFO).write_text("[" * 100_000),
    "binary": lambda d: (d / INFO).write_bytes(b"\xff\x00\xfe"),
    "version": lambda d: edit(d / INFO, codebase_version="v2.1"),
    "no features": lambda d: edit(d / INFO, features=None),
    "features": lambda d: edit(d / INFO, features={"action": {"dtype": "float32"}}),
    "escape": lambda d: edit(d / INFO, data_path="../../{chunk_index}/{file_index}"),
    "escaping camera": lambda d: edit(
        d / INFO, features={**json.loads((d / INFO).read_text())["features"], "../x": {"dtype": "video"}}
    ),
    "huge": lambda d: edit(d / INFO, total_frames=10**12),
    "fewer": lambda d: edit(d / INFO, total_frames=15),
    "more": lambda d: edit(d / INFO, total_episodes=4),
    "fps": lambda d: edit(d / INFO, fps="fast"),
    "infinite fps": lambda d: edit(d / INFO, fps=float("inf")),
    "other fps": lambda d: edit(d / INFO, fps=31),
    "episode order": lambda d: rewrite(d / ROWS, episode_index=lambda v: v[::-1]),
    "negative file": lambda d: rewrite(d / ROWS, file=lambda v: [-1] * len(v)),
    "start": lambda d: rewrite(d / ROWS, start=lambda v: [x + 1 for x in v]),
    "no length": lambda d: rewrite(d / ROWS, length=None),
    "no action": lambda d: rewrite(d / DATA, action=None),
    "shuffled": lambda d: rewrite(d / DATA, index=lambda v: v[::-1]),
    "no task": lambda d: rewrite(d / DATA, task_index=lambda v: [5] * len(v)),
    "gap": lambda d: rewrite(d / DATA, action=lambda v: pa.array([None, *v[1:]], pa.list_(pa.float32(), 2))),
    "other film": lambda d: shutil.copy(d / FILM.replace("001", "002"), d / FILM),
    "text film": lambda d: (d / FILM).write_text("#EXTM3U\nfile:///etc/passwd\n"),
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset with a film; copy it before changing it."""
    folder = tmp_path_factory.mktemp("sound") / "d"
    write(folder, LENGTHS, "video")
    return folder


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_a_typed_error(tmp_path: Path, sound: Path, damage: str):
    """Every kind of damage raises AssetError with a remedy, for the reader and where it matters for the writer."""
    folder = tmp_path / "d"
    shutil.copytree(sound, folder)
    DAMAGE[damage](folder)
    with pytest.raises(AssetError) as caught:
        read_dataset(folder)
    assert caught.value.hint
    before = snapshot(folder)
    try:
        DatasetWriter(folder, features("video"), fps=FPS, append=True).close()
    except SoftmodeError:
        assert snapshot(folder) == before


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_changed_bytes_never_crash_the_reader(tmp_path: Path, sound: Path, data: st.DataObject):
    """Bytes changed anywhere in a table or a description give the dataset or an AssetError, nothing else."""
    folder = tmp_path / "d"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(sound, folder)
    path = folder / data.draw(st.sampled_from([INFO, TASKS, DATA, ROWS]))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        read_dataset(folder, keys=["action", "next.done"])
    except AssetError:
        pass


def test_png_damage_and_size(tmp_path: Path):
    """A broken picture, one of another size, and a dataset beyond the memory limit are refused."""
    write(tmp_path / "d", (3,), "image")
    with pytest.raises(AssetError, match="max_bytes"):
        read_dataset(tmp_path / "d", max_bytes=10_000)
    assert read_dataset(tmp_path / "d", keys=["action"], max_bytes=10_000).frame_count == 3
    small = {CAMERA: Feature(dtype="image", shape=(8, 8, 3))}
    with DatasetWriter(tmp_path / "small", small, fps=FPS) as writer:
        writer.add_frame({CAMERA: np.zeros((8, 8, 3), np.uint8)})
        writer.save_episode("look")
    foreign = pq.read_table(tmp_path / "small" / DATA)[CAMERA].to_pylist()[0]["bytes"]
    for data in (b"", b"\x89PNG\r\n\x1a\n", foreign, None):
        table = pq.read_table(tmp_path / "d" / DATA)
        column = [{"bytes": data, "path": "x"}, *table[CAMERA].to_pylist()[1:]]
        k = table.column_names.index(CAMERA)
        table = table.set_column(k, CAMERA, pa.array(column, table.schema.field(CAMERA).type))
        shutil.copytree(tmp_path / "d", tmp_path / "copy")
        pq.write_table(table, tmp_path / "copy" / DATA)
        with pytest.raises(AssetError, match="picture 0"):
            read_dataset(tmp_path / "copy")
        shutil.rmtree(tmp_path / "copy")


# -- interruption -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pictures", ["image", "video"])
def test_interruption_at_every_step_of_saving(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pictures: str):
    """Wherever saving is cut off, the dataset reads as before or with the episode, and recording goes on."""
    write(tmp_path / "start", LENGTHS[:2], pictures)
    cuts = 0
    for cuts in at_every_call(monkeypatch, os, "replace", interrupt):
        folder = tmp_path / f"d{cuts}"
        shutil.copytree(tmp_path / "start", folder)
        try:
            write(folder, (LENGTHS[2],), pictures, first=2, append=True)
        except KeyboardInterrupt:
            assert read_dataset(folder).episode_count == 2
            write(folder, (LENGTHS[2],), pictures, first=2, append=True)
        whole = [episode(k, length, True) for k, length in enumerate(LENGTHS)]
        assert_holds(read_dataset(folder), whole, film=pictures == "video")
        assert len(pq.read_table(folder / DATA)) == sum(LENGTHS)
        assert len(pq.read_table(folder / ROWS)) == len(LENGTHS)
    assert cuts == 6 + (pictures == "video")  # film, data, tasks, episodes, stats, card, info


KILLED = """
import sys
from pathlib import Path
from softmode.demonstrations import DatasetWriter
from tests.demonstrations.episodes import FPS, episode, features
from tests.faults import die
writer = DatasetWriter(Path(sys.argv[1]), features("video"), fps=FPS)
for number, length in enumerate((5, 8, 3)):
    for k, frame in enumerate(episode(number, length, True)):
        writer.add_frame(frame)
        if (number, k) == (int(sys.argv[2]), 1):
            die()
    writer.save_episode("lift the toy")
"""


@pytest.mark.parametrize("number", [0, 2])
def test_killed_process(tmp_path: Path, number: int):
    """Killed within its third episode a recording leaves two; killed within its first, no folder. Both can go on."""
    assert run(KILLED, tmp_path / "d", number)[0] == -signal.SIGKILL
    assert (tmp_path / "d").exists() == (number == 2)
    if number:
        found = read_dataset(tmp_path / "d")
        assert_holds(found, [episode(k, LENGTHS[k], True) for k in range(2)], film=True)
    write(tmp_path / "d", (3,), "video", first=number, append=True)
    assert read_dataset(tmp_path / "d").episode_count == number + 1
    assert not list((tmp_path / "d").glob(".*")) and [path.name for path in tmp_path.iterdir()] == ["d"]


FULL = """
from pathlib import Path
from softmode.demonstrations import DatasetWriter, Feature
from softmode.errors import StorageError
import numpy as np
kind = sys.argv[2]
wanted = {"picture": Feature(dtype=kind, shape=(256, 256, 3))}
random = np.random.default_rng(0)
with DatasetWriter(Path(sys.argv[1]), wanted, fps=30) as writer:
    writer.add_frame({"picture": np.zeros((256, 256, 3), np.uint8)})
    writer.save_episode("look")
    for attempt in range(2):
        try:
            for _ in range(4):
                writer.add_frame({"picture": random.integers(0, 256, (256, 256, 3), np.uint8)})
            writer.save_episode("look")
        except StorageError as error:
            print(error)
    writer.add_frame({"picture": np.zeros((256, 256, 3), np.uint8)})
    writer.save_episode("look")
"""


@pytest.mark.parametrize("kind", ["image", "video"])
def test_full_disk(tmp_path: Path, kind: str):
    """Where a file cannot grow, saving raises StorageError, the episodes before stay, and smaller ones can follow."""
    code, written = run(FULL, tmp_path / "d", kind, disk=100_000)
    assert code == 0, written
    assert written.lower().count("free some space") == 2
    found = read_dataset(tmp_path / "d")
    assert found.episode_count == 2 and found.frame_count == 2
    assert not list((tmp_path / "d").glob(".*"))


def test_place_that_cannot_be_written(tmp_path: Path):
    """A folder below a file is a StorageError, and nothing is made."""
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError):
        DatasetWriter(tmp_path / "file/d", features(), fps=FPS)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
