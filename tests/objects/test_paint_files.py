"""Files of factors are pinned by their content, as the object's own file is."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from softmode.envs import LiftSoftConfig
from softmode.envs.tasks.lift_soft.task import lift_scene
from softmode.errors import AssetError
from softmode.learning.config_values import config_of, located_options, pinned_options, values_of
from softmode.objects import ObjectConfig, load
from softmode.objects.fingerprint import file_fingerprint

BOX = {"shape": "box", "extents": (0.05, 0.05, 0.05), "surface_count": 60}


def write_field(path: Path, factor: float) -> Path:
    """Write a field that is the same everywhere."""
    np.savez(path, points=np.zeros((1, 3)), factors=np.array([factor]))
    return path


@pytest.mark.parametrize("name", ["stiffness", "density"])
def test_other_content_is_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pinned file is found by content in the working folder, and another content at its place is an error."""
    monkeypatch.setenv("SOFTMODE_CACHE", str(tmp_path / "cache"))
    file = write_field(tmp_path / "field.npz", 2.0)
    config = ObjectConfig(**BOX, **{f"{name}_file": file}).pinned()
    assert getattr(config, f"{name}_fingerprint") == file_fingerprint(file)
    assert config.located() == config
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    file.rename(elsewhere / file.name)
    write_field(file, 3.0)
    with pytest.raises(AssetError, match=f"{name}_file .*content has changed.*--{name}-file"):
        load(config)
    monkeypatch.chdir(elsewhere)
    assert getattr(config.located(), f"{name}_file") == str(elsewhere / file.name)
    assert getattr(config.changed(**{f"{name}_file": file}), f"{name}_fingerprint") is None


def test_runs_keep_the_fingerprint(tmp_path: Path) -> None:
    """Options of a run hold it as JSON, and find the file beside a checkpoint that was moved."""
    file = write_field(tmp_path / "field.npz", 2.0)
    scene = dataclasses.replace(lift_scene(), object=ObjectConfig(**BOX, stiffness_file=file))
    pinned = pinned_options("softmode/LiftSoft-v0", {"config": values_of(LiftSoftConfig(scene=scene))})
    kept = config_of(LiftSoftConfig, pinned["config"]).scene.object
    assert kept.stiffness_fingerprint == file_fingerprint(file)
    run = tmp_path / "run"
    run.mkdir()
    file.rename(run / file.name)
    found = config_of(LiftSoftConfig, located_options(pinned, run)["config"]).scene.object
    assert found.stiffness_file == str(run / file.name)
