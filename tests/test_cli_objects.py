"""An object of one's own in every command: what it becomes, what is said about it, how a policy finds it again."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import trimesh

from softmode.cli import main as cli
from softmode.cli.common import finding_line
from softmode.cli.main import main
from softmode.cli.object_options import ObjectOptions, stiffer_box
from softmode.deformables.reduction.options import BuildOptions
from softmode.deformables.reduction.report import Finding
from softmode.demonstrations import read_dataset
from softmode.envs.tasks.lift_soft.task import LiftSoftConfig
from softmode.envs.tasks.place_in_bin.task import PlaceInBinConfig
from softmode.errors import AssetError, ConfigError
from softmode.learning.config_values import config_of, joined_config, located_options, pinned_options, values_of
from softmode.objects import ObjectConfig, load
from softmode.objects.config import PAINTED, StifferBox
from softmode.objects.fingerprint import file_fingerprint
from softmode.objects.paint import StifferColor
from softmode.splats import make_plush, write_ply
from tests.marks import rest_but
from tests.test_cli_body import QUICK, merged

ID = "softmode/LiftSoft-v0"
UP = ["--up", "+z"]
POLICY = Path(__file__).parents[1] / "policies" / "lift_soft.npz"


@pytest.fixture(scope="module")
def assets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a plush with a floater beside it, and a box without a lid."""
    folder = tmp_path_factory.mktemp("assets")
    plush = make_plush(1000)
    speck = plush.subset(np.arange(40)).transformed(scale=0.1, translation=(0.12, 0.0, 0.05))
    write_ply(folder / "floater.ply", merged(plush, speck))
    box = trimesh.creation.box((0.05, 0.04, 0.04))
    trimesh.Trimesh(box.vertices, box.faces[2:], process=False).export(folder / "open.obj")
    return folder


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make episodes two steps long."""
    monkeypatch.setattr(gym.spec(ID), "max_episode_steps", 2)


def commands(folder: Path) -> dict[str, list[str]]:
    """Return command lines that build an object, without the object."""
    train = ["--num-envs", "1", "--total-steps", "4", "--eval-episodes", "0", "--processes", "1", "--run-dir"]
    return {
        "play": ["play", ID, "--policy", "zero"],
        "record": [
            "record",
            ID,
            "-o",
            str(folder / "data"),
            "--policy",
            "zero",
            "--episodes",
            "1",
            "--obs-type",
            "state",
        ],
        "train": ["train", ID, *train, str(folder / "run"), "--set", "rollout_steps=4", "hidden=[8]", "epochs=1"],
        "evaluate": ["evaluate", ID, str(POLICY), "--episodes", "1", "--num-envs", "1", "--device", "cpu"],
        "bench": ["bench", ID, "--num-envs", "1", "--steps", "1", "--warmup", "0", "--device", "cpu"],
        "view": ["view", ID, "--policy", "zero", "--duration", "0.2", "--port", "0", "--no-open"],
        "view object": ["view", "--duration", "0.2", "--port", "0", "--no-open"],
        "body check": ["body", "check", *QUICK],
        "body build": ["body", "build", *QUICK, "-o", str(folder / "toy.npz")],
        "body show": ["body", "show", *QUICK, "-o", str(folder / "toy.png")],
    }


GIVEN = {
    "splat": (["--splat", "floater.ply", *UP], "left out: 40 of 1040 splats", "--crop"),
    "object": (["--object", "open.obj", "--size", "0.06"], "open mesh: the mesh is not closed", "fill_holes"),
}
LOADING = ("play", "view object", "body check")
"""One command of each way from the options to a loaded object: by an environment, by a session, for a report."""
SAID = [(command, "object") for command in commands(Path())] + [(command, "splat") for command in LOADING]


@pytest.mark.parametrize(
    ("command", "given"),
    rest_but({("play", "object"), ("body check", "object"), ("body check", "splat")}, SAID),
)
def test_every_command_takes_an_object_and_says_what_matters(
    command: str,
    given: str,
    assets: Path,
    tmp_path: Path,
    short: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The same options name the object in each, and its defect is told once, with the remedy."""
    extras = {"train": "torch", "evaluate": "torch", "record": "pyarrow", "body show": "matplotlib"}
    pytest.importorskip(extras.get(command, "numpy"))
    monkeypatch.chdir(assets)
    options, finding, remedy = GIVEN[given]
    assert main([*commands(tmp_path)[command], *options]) == (1 if command == "body check" else 0)
    out, err = capsys.readouterr()
    said = out if command.startswith("body") else err
    (line,) = [line for line in (out + err).splitlines() if finding in line]
    assert line in said and "warning: " in line and remedy in line


def test_check_hands_the_object_on(assets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The task that is checked has the object of the options."""
    found: list[dict[str, Any]] = []
    monkeypatch.setattr("softmode.testing.check_task", lambda env, episodes, **options: found.append(options) or [])
    file = assets / "open.obj"
    assert main(["check", ID, "--object", str(file), "--size", "0.06", "--density", "200"]) == 0
    scene = found[0]["config"].scene
    assert scene.object.file == ("mesh", file) and (scene.object.size, scene.material.density) == (0.06, 200.0)


@pytest.mark.rest
def test_a_policy_finds_its_object_again(
    tmp_path: Path, short: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From another folder, and moved beside the policy; gone or changed it is refused by name, with a remedy."""
    pytest.importorskip("torch")
    home, away = tmp_path / "home", tmp_path / "away"
    home.mkdir()
    away.mkdir()
    monkeypatch.chdir(home)
    write_ply(Path("toy.ply"), make_plush(900))
    train = [*commands(tmp_path)["train"], "--splat", "toy.ply", *UP, "--size", "0.07", "--youngs-modulus", "1e5"]
    assert main([*train, "--friction", "0.7"]) == 0
    stored = json.loads((tmp_path / "run" / "config.json").read_text())["env_options"]["config"]
    assert stored["scene"]["object"]["splat"] == str(home / "toy.ply")
    assert stored["scene"]["object"]["fingerprint"] == file_fingerprint(Path("toy.ply"))
    assert stored["youngs_modulus_range"] is None and stored["scene"]["material"]["friction"] == 0.7

    monkeypatch.chdir(away)
    policy = str(tmp_path / "run" / "latest.npz")
    assert main(["play", ID, "--policy", policy]) == 0
    assert "body 'toy.ply'" in (said := capsys.readouterr().out) and "E 1e+05 Pa" in said
    shutil.move(home / "toy.ply", tmp_path / "run" / "toy.ply")
    assert main(["evaluate", ID, policy, "--episodes", "1", "--num-envs", "1"]) == 0
    assert "1 episodes" in capsys.readouterr().out
    (tmp_path / "run" / "toy.ply").unlink()
    assert main(["play", ID, "--policy", policy]) == 2
    assert f"object file {home / 'toy.ply'}: no such file any more" in (said := capsys.readouterr().err)
    assert "put it back, or name another object" in said.replace("Put", "put")
    write_ply(home / "toy.ply", make_plush(800))
    assert main(["record", ID, "--policy", policy, "-o", "data", "--episodes", "1"]) == 2
    assert "the content has changed since it was recorded" in capsys.readouterr().err
    again = ["--splat", str(home / "toy.ply"), *UP, "--size", "0.07"]
    assert main(["play", ID, "--policy", policy, *again]) == 0


def test_a_dataset_says_what_was_recorded(assets: Path, tmp_path: Path, short: None) -> None:
    """From which episode on which object; an appended recording of another one is told apart."""
    pytest.importorskip("pyarrow")
    record = [*commands(tmp_path)["record"], "--append"]
    toy = ["--object", str(assets / "open.obj"), "--size", "0.06"]
    for more in ([], [], toy):
        assert main([*record, *more]) == 0
    found = read_dataset(tmp_path / "data")
    first, second = found.origins
    assert first == {"env": ID, "env_options": {"obs_type": "state"}, "first_episode": 0}
    assert second["first_episode"] == 2 and found.episode_count == 3
    thing = second["env_options"]["config"]["scene"]["object"]
    assert thing["fingerprint"] == file_fingerprint(assets / "open.obj")
    assert config_of(LiftSoftConfig, second["env_options"]["config"]).scene.object.file == (
        "mesh",
        Path(thing["mesh"]),
    )


# -- the options ------------------------------------------------------------------------------------------------------


EVERYWHERE = (-np.inf,) * 3 + (np.inf,) * 3
CHOSEN: dict[str, tuple[Any, dict[str, Any]]] = {
    "splat": (Path("toy.ply"), {"splat": Path("toy.ply")}),
    "object": (Path("sponge"), {}),
    "march": (False, {}),  # splats have no field
    "size": (0.07, {"size": 0.07}),
    "up": ("+z", {"up": "+z"}),
    "crop": ((0.0, -1.0, 0.0, 1.0, 2.0, 3.0), {"crop": (0.0, -1.0, 0.0, 1.0, 2.0, 3.0)}),
    "part": ("tallest", {"part": "tallest"}),
    "pose": ("captured", {"pose": "captured"}),
    "resolution": (48, {"resolution": 48}),
    "youngs_modulus": (1e5, {}),
    "density": (250.0, {}),
    "friction": (0.7, {}),
    "stiffness": (
        ("all=-inf,-inf,-inf,inf,inf,inf,10", "tip=0,0,0,1,1,1,2"),
        {"stiffness": (StifferBox(box=EVERYWHERE, factor=10.0), StifferBox(box=(0, 0, 0, 1, 1, 1), factor=2.0))},
    ),
    "stiffness_by_color": (("#ff0000:4",), {"stiffness_colors": (StifferColor(color=(1.0, 0.0, 0.0), factor=4.0),)}),
    "stiffness_file": (Path("stiff.npz"), {"stiffness_file": Path("stiff.npz")}),
    "density_by_color": (("#0000ff:2",), {"density_colors": (StifferColor(color=(0.0, 0.0, 1.0), factor=2.0),)}),
    "density_file": (Path("dense.npz"), {"density_file": Path("dense.npz")}),
    "material_file": (Path("made.npz"), {"material_file": Path("made.npz")}),
}
"""A value of every option, and what it becomes in `ObjectConfig`; a splat file goes before a preset here."""


def parsed(words: list[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the command of a command line, which is not run."""
    import tyro

    real, found = tyro.cli, []

    def parse_only(*arguments: Any, **options: Any) -> Any:
        found.append(real(*arguments, **options))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(tyro, "cli", parse_only)
        assert main(words) == 130
    return found[0]


def test_every_command_takes_the_same_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every option, without a prefix, of each command that takes an object arrives in its `ObjectOptions`.

    Other commands have no such option: a class with one has the field that takes them all.
    """
    assert [field.name for field in dataclasses.fields(ObjectOptions)] == [*CHOSEN]
    toy, words = ObjectOptions(**{name: value for name, (value, _) in CHOSEN.items()}), []
    for name, (value, _) in CHOSEN.items():
        words += ["--no-march"] if value is False else [f"--{name.replace('_', '-')}"]
        words += [] if value is False else map(str, value if isinstance(value, tuple) else (value,))
    taking = set()
    for line in (*commands(tmp_path).values(), ["check", ID], ["body", "cut"], ["fit", "film.mp4"]):
        command = parsed([*line, *words], monkeypatch)
        assert command.toy == toy
        taking.add(type(command))
    alone = {"splat", "object", "youngs_modulus", "density", "friction", *PAINTED}
    for kind in vars(cli).values():
        if dataclasses.is_dataclass(kind):
            names = {field.name for field in dataclasses.fields(kind)}
            assert ("toy" in names) == (kind in taking) and not names & alone, kind


def test_every_option_reaches_the_object() -> None:
    """Each becomes one field of `ObjectConfig`, those of the material none; the task's own build is kept."""
    base = ObjectConfig(surface_count=123, build=BuildOptions(mode_count=3), size=0.05)
    values = {name: value for name, (value, _) in CHOSEN.items() if name != "object"}
    expected = {name: value for _, fields in CHOSEN.values() for name, value in fields.items()}
    config = ObjectOptions(**values).object_of(base)
    assert config == ObjectConfig(surface_count=base.surface_count, build=base.build, **expected)
    preset = ObjectOptions(object=Path("sponge"), size=0.1).object_of(base)
    assert preset == ObjectConfig(surface_count=base.surface_count, build=base.build, preset="sponge", size=0.1)
    assert ObjectOptions(size=0.1).object_of(base) == dataclasses.replace(base, size=0.1)
    assert ObjectOptions().object_of(base) == base
    field = ObjectConfig(radiance="toy.nvdb")
    assert ObjectOptions(march=True).object_of(field) == dataclasses.replace(field, march=True)


@pytest.mark.parametrize(
    ("base", "refused"),
    [
        (ObjectConfig(splat="toy.ply"), ""),
        (ObjectConfig(mesh="toy.obj"), "crop part resolution"),
        (ObjectConfig(preset="sponge"), "crop part resolution"),
        (ObjectConfig(radiance="toy.nvdb"), "part"),
        (ObjectConfig(shape="box", extents=(0.1, 0.1, 0.1)), "size up crop part pose resolution"),
        (
            ObjectConfig(body="toy.npz"),
            "size up crop part pose resolution stiffness stiffness_by_color stiffness_file density_by_color "
            "density_file material_file",
        ),
    ],
    ids=["splats", "mesh", "preset", "field", "shape", "body"],
)
def test_options_that_say_nothing_about_an_object_are_refused(base: ObjectConfig, refused: str) -> None:
    """Which options a kind of object takes, one by one; another is refused by its name."""
    for name, (value, fields) in CHOSEN.items():
        if name in ("splat", "object"):
            continue
        options = ObjectOptions(**{name: value})
        if name in refused.split():
            with pytest.raises(ConfigError, match=f"--{name.replace('_', '-')} given for"):
                options.object_of(base)
        else:
            assert options.object_of(base) == dataclasses.replace(base, **fields)


def test_options_become_configurations_and_back(assets: Path) -> None:
    """Object, material and stiffer parts reach the task; as JSON and back it is the same configuration."""
    part = "core=-0.01,-inf,-inf,0.01,inf,inf,20"
    toy = ObjectOptions(
        splat=assets / "floater.ply", up="+z", size=0.07, resolution=48, density=120.0, stiffness=(part,)
    )
    config = toy.configured(LiftSoftConfig())
    thing = config.scene.object
    assert (thing.size, thing.resolution, thing.up) == (0.07, 48, "+z")
    assert thing.stiffness == (stiffer_box(part),) and thing.build == LiftSoftConfig().scene.object.build
    assert config.scene.material.density == 120.0 and config.density_range is None
    assert config.youngs_modulus_range == LiftSoftConfig().youngs_modulus_range
    options = joined_config(ID, config, {"obs_type": "state"})
    again = json.loads(json.dumps(options))
    assert again == options and config_of(LiftSoftConfig, again["config"]) == config
    assert pinned_options(ID, again) == again
    bins = dataclasses.replace(PlaceInBinConfig(), image_size=64)
    assert values_of(bins) == {"image_size": 64}
    scene = dataclasses.replace(bins.scene, others=(bins.scene.object, thing), fixtures=bins.scene.fixtures[:2])
    bins = dataclasses.replace(bins, scene=scene)
    assert config_of(PlaceInBinConfig, json.loads(json.dumps(values_of(bins)))) == bins
    with pytest.raises(ConfigError, match=r"Splats\.means"):
        values_of(ObjectConfig(splat=make_plush(400)))


def test_a_stiffer_part_is_in_the_body(assets: Path) -> None:
    """Points of the half x > 0 of the loaded object are ten times as stiff."""
    config = ObjectConfig(mesh=assets / "open.obj", size=0.06, build=LiftSoftConfig().scene.object.build)
    body = load(config, stiffness=[stiffer_box("half=0,-inf,-inf,inf,inf,inf,10")]).body
    right = body.cubature.points[:, 0] > body.bounds[:, 0].mean()  # The bounding box is centred over the origin.
    assert set(body.cubature.stiffness_scale[right]) == {10.0} and set(body.cubature.stiffness_scale[~right]) == {1.0}


def test_a_body_file_says_what_it_is_made_of(assets: Path, tmp_path: Path) -> None:
    """What is given when it is built is what a task takes, unless the command says otherwise."""
    out = tmp_path / "toy.npz"
    build = ["body", "build", str(assets / "open.obj"), *QUICK, "-o", str(out)]
    assert main([*build, "--youngs-modulus", "3e5", "--friction", "0.9"]) == 0
    config = ObjectOptions(object=out, friction=0.4).configured(LiftSoftConfig())
    material = config.scene.material
    assert (material.youngs_modulus, material.friction) == (3e5, 0.4) and config.youngs_modulus_range is None
    assert material.density == LiftSoftConfig().scene.material.density
    found = load(out).material
    assert found is not None and found.youngs_modulus == 3e5


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["play", ID, "--splat", "floater.ply", "--object", "open.obj"], "exclude each other"),
        (["record", ID, "--object", "open.obj", "--crop", "0", "0", "0", "1", "1", "1"], "--crop given for the mesh"),
        (["train", ID, "--density", "-1"], "density"),
        (["train", ID, "--resume", "--run-dir", "run", "--splat", "floater.ply"], "--resume"),
        (["evaluate", ID, "policy.npz", "--friction", "nan"], "friction"),
        (["bench", ID, "--splat", "none.ply"], "none.ply"),
        (["bench", ID, "--stiffness", "core=1,2"], "core=1,2"),
        (["train", "Pendulum-v1", "--splat", "floater.ply"], "Pendulum-v1"),
        (["play", "softmode/PushSoft-v0", "--size", "0.1"], "--size given for a cylinder"),
        (["view", "floater.ply", "--object", "open.obj", "--no-open"], "two objects"),
        (["body", "check"], "no file is given"),
        (["body", "check", "floater.ply", "--splat", "open.obj"], "2 files are given"),
    ],
)
def test_mistakes_are_named(
    arguments: list[str],
    named: str,
    assets: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One line that names the option and a remedy, exit code 2, nothing on the disk."""
    monkeypatch.chdir(tmp_path)
    for file in assets.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    before = sorted(path.name for path in tmp_path.iterdir())
    if "policy.npz" in arguments:
        arguments[2] = str(Path(__file__).resolve().parents[1] / "policies" / "lift_soft.npz")
    assert main(arguments) == 2
    err = capsys.readouterr().err
    lines = [line for line in err.splitlines() if line.startswith("softmode: error: ")]
    assert len(lines) == 1 and named in lines[0] and ". " in lines[0] and "Traceback" not in err
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_fingerprints_are_of_the_content(tmp_path: Path) -> None:
    """A name does not matter, a byte does; a meta.json counts with the files that it names."""
    one, other = tmp_path / "one.ply", tmp_path / "other.ply"
    one.write_bytes(b"ply")
    other.write_bytes(b"ply")
    assert file_fingerprint(one) == file_fingerprint(other)
    other.write_bytes(b"plz")
    assert file_fingerprint(one) != file_fingerprint(other)
    (tmp_path / "meta.json").write_text(json.dumps({"means": {"files": ["means.webp", "../one.ply"]}}))
    (tmp_path / "means.webp").write_bytes(b"a")
    before = file_fingerprint(tmp_path)
    os.utime(tmp_path / "meta.json", ns=(0, 0))
    assert file_fingerprint(tmp_path / "meta.json") == before
    (tmp_path / "means.webp").write_bytes(b"b")
    os.utime(tmp_path / "meta.json", ns=(1, 1))
    assert file_fingerprint(tmp_path) != before
    with pytest.raises(AssetError, match="none"):
        file_fingerprint(tmp_path / "none.ply")
    pinned = {"config": {"scene": {"object": {"splat": "/gone/one.ply", "fingerprint": file_fingerprint(one)}}}}
    assert located_options(pinned, tmp_path)["config"]["scene"]["object"]["splat"] == str(one)


# -- what is said -----------------------------------------------------------------------------------------------------


def test_colour_is_for_terminals(monkeypatch: pytest.MonkeyPatch) -> None:
    """The severity is coloured on a terminal, unless NO_COLOR is set to something, and plain elsewhere."""

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    finding = Finding(severity="warning", name="thin", what="it is thin", remedy="thicken it")
    monkeypatch.delenv("NO_COLOR", raising=False)
    plain = "warning: thin: it is thin. Thicken it."
    assert finding_line(finding, io.StringIO()) == plain
    assert finding_line(finding, Terminal()) == plain.replace("warning", "\x1b[33mwarning\x1b[0m")
    monkeypatch.setenv("NO_COLOR", "1")
    assert finding_line(finding, Terminal()) == plain


COMMANDS = (
    "play",
    "train",
    "evaluate",
    "export",
    "bench",
    "fit",
    "record",
    "view",
    "morph",
    "new",
    "check",
    "list-envs",
    "robots",
    "splat show",
    "splat from-mesh",
    "splat info",
    "splat convert",
    "body build",
    "body show",
    "body check",
    "body cut",
    "radiance info",
    "radiance bake",
    "radiance sample",
    "objects list",
    "objects show",
    "objects export",
)
SCREEN = 53
"""Lines of 80 columns of a screen."""


def help_of(words: list[str], capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Return the lines of a help page."""
    with pytest.raises(SystemExit) as end:
        main([*words, "--help"])
    assert end.value.code == 0
    return capsys.readouterr().out.splitlines()


def listed(lines: list[str]) -> list[str]:
    """Return the commands that a help page lists."""
    return [found[1] for line in lines if (found := re.match(r"\W*• ([a-z-]+) ", line))]


def test_help_of_groups_fits_a_screen_and_lists_what_is_tested(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All commands and each group's fit a screen; a group's have an example each; no command is left untested."""
    monkeypatch.setenv("COLUMNS", "80")
    top, groups = help_of([], capsys), {command.split()[0] for command in COMMANDS if " " in command}
    names = [name for name in listed(top) if name not in groups]
    assert groups <= set(listed(top)) and len(top) <= SCREEN, len(top)
    for group in sorted(groups):
        lines = help_of([group], capsys)
        assert len(lines) <= SCREEN
        names += [f"{group} {name}" for name in listed(lines)]
        assert sum(f"Example: softmode {group} " in line for line in lines) == len(listed(lines))
    assert sorted(names) == sorted(COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_fits_a_screen_and_has_an_example(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every group of options is at most a screen high; the example is a command line of this command that parses."""
    monkeypatch.setenv("COLUMNS", "80")
    said = help_of(command.split(), capsys)
    titles = [k for k, line in enumerate(said) if re.match(r"\W*(positional arguments|((toy|arm) )?options)\W*$", line)]
    heights = np.diff([*titles, len(said)])
    assert len(titles) and heights.max() <= SCREEN, heights
    (example,) = [line for line in said if line.startswith("Example: ")]
    assert example.startswith(f"Example: softmode {command}")
    assert parsed(example.removeprefix("Example: softmode ").split(), monkeypatch)


def test_without_arguments_the_first_steps_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    """Commands that begin, and where the rest is found."""
    with pytest.raises(SystemExit) as end:
        main([])
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert "softmode play softmode/LiftSoft-v0" in said and "softmode --help" in said
