"""Checkpoint files: what is refused, and that nothing in them is run."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import pickle
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from softmode.errors import CheckpointError, ConfigError
from softmode.learning.checkpoints import Checkpoint, check_env, read_checkpoint, write_checkpoint
from softmode.learning.hyperparameters import Hyperparameters
from softmode.learning.spaces import Interface
from tests.needs import needs

pytestmark = needs("torch")

INTERFACE = Interface(vectors={"state": 3}, pictures={}, action_low=(-2.0,), action_high=(2.0,))


def checkpoint(interface: Interface = INTERFACE, **changes) -> Checkpoint:
    """Return a checkpoint of an untrained network."""
    import torch

    from softmode.learning.networks import ActorCritic

    options = Hyperparameters(hidden=(4,), features=8)
    torch.manual_seed(0)
    model = ActorCritic(interface, 0, options)
    fields = {
        "env": "Pendulum-v1",
        "env_options": {},
        "interface": interface,
        "privileged": 0,
        "hyperparameters": options,
        "progress": {"iteration": 3},
        "arrays": {name: value.numpy() for name, value in model.state_dict().items()},
    }
    return Checkpoint(**{**fields, **changes})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return a file of an untrained network."""
    write_checkpoint(checkpoint(), tmp_path / "policy.npz")
    return tmp_path / "policy.npz"


def rewrite(path: Path, change) -> None:
    """Write the file again with another header and other arrays."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    header = json.loads(arrays.pop("header").tobytes())
    header, arrays = change(header, arrays) or (header, arrays)
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(path, **arrays)


def test_round_trip(path: Path):
    """Every field and every array come back."""
    found, given = read_checkpoint(path), checkpoint()
    for field in dataclasses.fields(Checkpoint):
        if field.name != "arrays":
            assert getattr(found, field.name) == getattr(given, field.name)
    assert found.arrays.keys() == given.arrays.keys()
    assert all(np.array_equal(found.arrays[name], given.arrays[name]) for name in found.arrays)


def test_a_damaged_file_is_refused_or_read_unharmed(path: Path):
    """Any byte may be wrong and any end missing: a typed error, or the same content."""
    content, whole = path.read_bytes(), read_checkpoint(path)
    rng = np.random.default_rng(0)
    refused = 0
    for k in range(400):
        damaged = bytearray(content)
        if k % 4 == 0:
            damaged = damaged[: rng.integers(len(content))]
        else:
            for at in rng.integers(len(content), size=1 + k % 3):
                damaged[at] ^= rng.integers(1, 256)
        path.write_bytes(damaged)
        try:
            found = read_checkpoint(path)
        except CheckpointError as error:
            assert error.hint
            refused += 1
        else:
            assert all(np.array_equal(found.arrays[name], whole.arrays[name]) for name in whole.arrays)
            assert found.hyperparameters == whole.hyperparameters and found.interface == whole.interface
    assert refused > 300


class Bomb:
    """Runs code when unpickled."""

    path: Path

    def __reduce__(self):
        """Make a folder."""
        return os.mkdir, (str(Bomb.path),)


def test_no_pickle_is_run(tmp_path: Path):
    """A pickle, a torch file and an .npz of objects are refused, and what they would do does not happen."""
    import torch

    from softmode.learning.policy import load_policy

    Bomb.path = tmp_path / "harm"
    (tmp_path / "a.npz").write_bytes(pickle.dumps(Bomb()))
    torch.save({"x": Bomb()}, tmp_path / "b.npz")
    np.savez(tmp_path / "c.npz", header=np.array([Bomb()], dtype=object))
    for name in ("a", "b", "c"):
        with pytest.raises(CheckpointError):
            load_policy(tmp_path / f"{name}.npz")
    assert not Bomb.path.exists()
    pickle.loads((tmp_path / "a.npz").read_bytes())  # the bombs are live
    assert Bomb.path.exists()


def test_foreign_files_are_refused(tmp_path: Path):
    """Missing, empty, text, a folder, an archive of something else."""
    from softmode.learning.policy import load_policy

    (tmp_path / "empty.npz").touch()
    (tmp_path / "text.npz").write_text("not a zip")
    (tmp_path / "folder.npz").mkdir()
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    np.savez(tmp_path / "header.npz", header=np.frombuffer(b'{"format": "other"}', np.uint8))
    for name in ("missing", "empty", "text", "folder", "other", "header"):
        with pytest.raises(CheckpointError) as caught:
            load_policy(tmp_path / f"{name}.npz")
        assert name in str(caught.value) and caught.value.hint


def test_a_compressed_file_is_refused(path: Path):
    """A small file cannot ask for much memory: compressed members, huge shapes and huge layers are refused."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        buffer = io.BytesIO()
        np.save(buffer, np.zeros(10_000_000))
        archive.writestr("header.npy", buffer.getvalue())
    with pytest.raises(CheckpointError, match="compressed"):
        read_checkpoint(path)
    write_checkpoint(checkpoint(), path)
    with zipfile.ZipFile(path, "a") as archive:
        head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }\n"
        archive.writestr("actor.huge.npy", b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head)
    with pytest.raises(CheckpointError, match="another size"):
        read_checkpoint(path)


def _version(header, arrays):
    header["version"] = 99


def _missing(header, arrays):
    arrays.pop("actor.log_std")


def _shape(header, arrays):
    arrays["actor.log_std"] = np.zeros(5, np.float32)


def _type(header, arrays):
    arrays["actor.log_std"] = np.zeros(1, np.float64)


def _infinite(header, arrays):
    arrays["actor.log_std"] = np.full(1, np.nan, np.float32)


def _wide(header, arrays):
    header["hyperparameters"]["hidden"] = [10**12]


def _fields(header, arrays):
    header["hyperparameters"]["momentum"] = 0.9


def _interface(header, arrays):
    header["interface"]["vectors"] = {"state": -3}


def _no_range(header, arrays):
    header["interface"]["action_high"] = [-2.0]


def _env(header, arrays):
    header["env"] = 3


@pytest.mark.parametrize(
    "change", [_version, _missing, _shape, _type, _infinite, _wide, _fields, _interface, _no_range, _env]
)
def test_contradictions_are_refused(path: Path, change):
    """Another version, missing arrays, other shapes and types, numbers that are not finite, a header that lies."""
    from softmode.learning.policy import load_policy

    rewrite(path, change)
    with pytest.raises(CheckpointError) as caught:
        load_policy(path)
    assert caught.value.hint


def test_another_environment_is_refused(path: Path):
    """By its id, by its spaces."""
    from softmode.learning.policy import load_policy

    policy = load_policy(path)
    policy.check(gym.make("Pendulum-v1"))
    with pytest.raises(CheckpointError, match="MountainCarContinuous-v0"):
        policy.check(gym.make("MountainCarContinuous-v0"))
    with pytest.raises(CheckpointError, match="other spaces"):
        other = dataclasses.replace(INTERFACE, vectors={"state": 4})
        check_env(policy.checkpoint, path, "Pendulum-v1", other)
    with pytest.raises(ConfigError, match="shape"):
        policy(np.zeros(7, np.float32))


def test_interfaces_are_read_from_spaces():
    """Vectors and pictures are found; discrete and unbounded actions are refused."""
    box, spaces = gym.spaces.Box, gym.spaces

    class Env:
        observation_space = spaces.Dict(
            pixels=box(0, 255, (64, 64, 3), np.uint8), agent_pos=box(-1, 1, (5,), np.float32)
        )
        action_space = box(-1, 1, (2,), np.float32)

    found = Interface.of(Env())
    assert found.vectors == {"agent_pos": 5} and found.pictures == {"pixels": (64, 64, 3)}
    assert Interface.from_json(json.loads(json.dumps(found.to_json()))) == found
    for action in (spaces.Discrete(3), box(-np.inf, np.inf, (2,), np.float32)):
        Env.action_space = action
        with pytest.raises(ConfigError, match="action space"):
            Interface.of(Env())
