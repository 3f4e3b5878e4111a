"""The command ``softmode splat``: what it writes, what it says, how it fails."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from softmode import stages
from softmode.cli.main import main
from softmode.envs.markers import dots
from softmode.splats import Splats, make_plush, read_splats, write_ply, write_splats
from tests.splats.meshes import bumpy_sphere
from tests.test_cli import listing

QUICK = ["--count", "300", "--iterations", "6", "--pixels", "32", "--views", "4"]


@pytest.fixture(scope="module")
def mesh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a textured mesh."""
    file = tmp_path_factory.mktemp("mesh") / "toy.glb"
    bumpy_sphere(48, 24).export(file)
    return file


def test_from_mesh_writes_splats_of_the_wanted_size(
    mesh: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """It writes the file, tells how well the splats do, and shows its progress."""
    out = tmp_path / "toy.ply"
    assert main(["splat", "from-mesh", str(mesh), "--out", str(out), "--size", "0.08", *QUICK]) == 0
    splats = read_splats(out)
    assert splats.count == 300
    assert np.ptp(splats.bounds(), axis=0).max() == pytest.approx(0.08, rel=1e-5)
    said, err = capfd.readouterr()
    for words in ("toy.glb", "1 textures", "dB sampled", "dB fitted", f"wrote 300 splats to {out}"):
        assert words in said
    assert "6/6" in err and "Module" not in said + err
    assert listing(tmp_path) == ["toy.ply"]


def test_from_mesh_names_the_file_itself(mesh: Path) -> None:
    """Without --out the splats lie beside the mesh, which stays as it is."""
    before = mesh.read_bytes()
    assert main(["splat", "from-mesh", str(mesh), *QUICK, "--iterations", "0"]) == 0
    assert listing(mesh.parent) == ["toy.glb", "toy_splats.ply"]
    assert mesh.read_bytes() == before


def test_info_describes_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Count, degree, box and quantiles are those of the splats."""
    plush = make_plush(count=500)
    write_ply(tmp_path / "plush.ply", plush)
    assert main(["splat", "info", str(tmp_path / "plush.ply")]) == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines["splats"] == str(plush.count)
    size = [float(word) for word in lines["size"].split()]
    np.testing.assert_allclose(size, np.ptp(plush.bounds(), axis=0), rtol=1e-3)
    assert float(lines["opacities"].split()[1]) == pytest.approx(np.median(plush.opacities), abs=1e-3)


@pytest.mark.parametrize("kind", [".ply", ".spz"])
def test_convert_keeps_the_splats(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What was read is what is written, to what the kind can hold; a convention turns it from the axis that is up."""
    source, target = tmp_path / "a.ply", tmp_path / f"b{kind}"
    plush = make_plush(count=500)
    write_ply(source, plush)
    assert main(["splat", "convert", str(source), str(target)]) == 0
    assert f"wrote {plush.count} splats" in capsys.readouterr().out
    read = read_splats(target)
    np.testing.assert_allclose(read.means, plush.means, atol=1e-6 if kind == ".ply" else 2.0**-12)
    np.testing.assert_allclose(read.colors(), plush.colors(), atol=0.02)
    turned = ["splat", "convert", str(source), str(target), "--up", "+z", "--convention"]
    assert main([*turned, "spz"]) == 0
    np.testing.assert_allclose(read_splats(target).oriented("+y").means, read.means, atol=2.0**-11)
    assert main([*turned, "trained"]) == 0
    np.testing.assert_allclose(read_splats(target).oriented("-y").means, read.means, atol=2.0**-11)
    assert np.abs(read_splats(target).means[:, 1] + read.means[:, 2]).max() < 2.0**-11


def test_convert_knows_what_is_up_in_the_file_it_reads(tmp_path: Path) -> None:
    """Of OpenUSD to .ply it is z, of .ply to OpenUSD -y, unless told."""
    pytest.importorskip("pxr", reason="the extra usd is not installed")
    plush, stage, file = make_plush(count=200), tmp_path / "a.usda", tmp_path / "b.ply"
    write_splats(stage, plush)
    assert main(["splat", "convert", str(stage), str(file), "--convention", "z-up"]) == 0
    np.testing.assert_allclose(read_splats(file).means, plush.means, atol=1e-6)
    write_splats(file, plush, up="-y")
    assert main(["splat", "convert", str(file), str(stage), "--convention", "z-up"]) == 0
    np.testing.assert_allclose(read_splats(stage).means, plush.means, atol=1e-6)


FAILURES: dict[str, tuple[list[str], str]] = {
    "missing mesh": (["from-mesh", "{folder}/none.glb"], "none.glb"),
    "no mesh": (["from-mesh", "{folder}/text.glb"], "text.glb"),
    "unknown kind": (["from-mesh", "{folder}/text.docx"], "text.docx"),
    "count": (["from-mesh", "{mesh}", "--count", "0"], "count"),
    "size": (["from-mesh", "{mesh}", "--size", "-1"], "size"),
    "iterations": (["from-mesh", "{mesh}", "--iterations", "-1"], "iterations"),
    "seed": (["from-mesh", "{mesh}", "--seed", "-1"], "seed"),
    "device": (["from-mesh", "{mesh}", "--device", "abacus:9"], "abacus:9"),
    "no folder": (["from-mesh", "{mesh}", "--out", "{folder}/deep/toy.ply"], "deep"),
    "other kind": (["from-mesh", "{mesh}", "--out", "{folder}/toy.jpg"], "toy.jpg"),
    "info missing": (["info", "{folder}/none.ply"], "none.ply"),
    "up alone": (["convert", "{folder}/text.ply", "{folder}/b.ply", "--up", "-y"], "--convention"),
    "convert missing": (["convert", "{folder}/none.ply", "{folder}/b.ply"], "none.ply"),
    "convert to other kind": (["convert", "{folder}/none.ply", "{folder}/b.jpg"], "b.jpg"),
}


@pytest.mark.parametrize("case", FAILURES)
def test_expected_errors_are_one_line_and_leave_nothing(
    case: str, mesh: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 2, one line that names the argument and a remedy, no traceback, no new file."""
    (tmp_path / "text.glb").write_text("no mesh")
    (tmp_path / "text.docx").write_text("no mesh")
    before, beside = listing(tmp_path), listing(mesh.parent)
    arguments, name = FAILURES[case]
    arguments = [word.replace("{folder}", str(tmp_path)).replace("{mesh}", str(mesh)) for word in arguments]
    assert main(["splat", *arguments]) == 2
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if line.startswith("softmode: error: ")]
    assert len(lines) == 1 and name in lines[0] and "Traceback" not in error
    assert ". " in lines[0]  # the remedy
    assert listing(tmp_path) == before and listing(mesh.parent) == beside


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a plush on a ground, y down as cameras have it, with a loose block far beside."""
    plush = make_plush(count=3000)
    random = np.random.default_rng(0)
    ground = np.column_stack([random.uniform(-0.15, 0.15, (4000, 2)), np.full(4000, -0.012)])
    block = random.uniform(-0.01, 0.01, (300, 3)) + np.array([0.12, 0.12, 0.05])
    lying = dots(np.concatenate([ground, block]), 0.002, color=(0.4, 0.4, 0.45), opacity=0.9)
    whole = Splats(
        **{
            name: np.concatenate([getattr(plush.with_sh_degree(0), name), getattr(lying, name)])
            for name in ("means", "quats", "scales", "opacities", "sh")
        },
        name="capture",
    )
    file = tmp_path_factory.mktemp("capture") / "toy.ply"
    write_splats(file, whole, up="-y")
    return file


def test_show_draws_what_would_be_taken(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The sheet appears; the plush is taken, ground and block are not; a crop takes the block."""
    monkeypatch.chdir(tmp_path)
    named, begin = [], stages._WATCH.begin
    monkeypatch.setattr(stages._WATCH, "begin", lambda name: (named.append(name), begin(name))[1])
    assert main(["splat", "show", str(capture)]) == 0
    said, err = capfd.readouterr()
    assert listing(tmp_path) == ["toy_sheet.png"] and "Module" not in said + err
    for what in ("finding the object", "filling it", "drawing the sheet"):  # each is told where it takes long
        assert any(name.startswith(what) for name in named)
    first, block, last = (said.splitlines()[k].split() for k in (0, 1, -2))
    assert first[0] == "1:" and first[-1] == "(taken)" and block[0] == "2:" and 280 <= int(block[1]) <= 300
    assert 2700 <= int(last[0]) <= 3000 and last[2] == "7300"
    with Image.open(tmp_path / "toy_sheet.png") as sheet:
        picture = np.asarray(sheet.convert("RGB")).astype(int)
    assert picture.shape[1] == 1600
    green = (picture[..., 1] - picture[..., 0] > 40) & (picture[..., 1] - picture[..., 2] > 20)
    assert green[: len(green) // 2].sum() < 0.5 * green[len(green) // 2 :, :500].sum()  # the block, second candidate
    box = ["--crop", "0.1", "0.1", "0.02", "0.14", "0.14", "0.08"]
    assert main(["splat", "show", str(capture), "--out", str(tmp_path / "block.png"), *box]) == 0
    assert "of 300 splats" in capfd.readouterr().out
    assert main(["splat", "show", str(capture), "--out", str(tmp_path / "two.png"), "--part", "2"]) == 0
    assert capfd.readouterr().out.splitlines()[1].endswith("(taken)")
    assert main(["splat", "show", str(capture), "--part", "1", "7"]) == 2
    assert "part 7: the capture has the candidates 1 to 2" in capfd.readouterr().err


def test_show_says_what_cannot_be_built(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A sheet of splats encloses nothing: the picture appears all the same, and says so; other names are refused."""
    flat = np.column_stack([np.random.default_rng(1).uniform(-0.1, 0.1, (500, 2)), np.zeros(500)])
    write_splats(tmp_path / "flat.ply", dots(flat, 0.004, opacity=0.9))
    arguments = ["splat", "show", str(tmp_path / "flat.ply"), "--up", "+z", "--out"]
    assert main([*arguments, str(tmp_path / "flat.png")]) == 0
    assert "it cannot be built" in capfd.readouterr().out
    assert (tmp_path / "flat.png").stat().st_size > 10_000
    assert main([*arguments, str(tmp_path / "flat.jpg")]) == 2
    assert "flat.jpg" in capfd.readouterr().err and not (tmp_path / "flat.jpg").exists()
