"""`softmode new task`: what it writes installs and passes its own tests untouched; names that cannot be are refused."""

from __future__ import annotations

import compileall
import os
import subprocess
import sys
from pathlib import Path

import pytest

from softmode.cli.main import main
from softmode.cli.new import class_name, package_name

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a new task, written into the working folder."""
    folder = tmp_path_factory.mktemp("new")
    assert "play slide_disc:slide_disc/SlideDisc-v0" in run(folder, "-m", "softmode", "new", "task", "SlideDisc")
    return folder / "slide_disc"


def run(folder: Path, *words: str, path: Path = ROOT) -> str:
    """Run Python in a folder and return what it printed."""
    environment = {**os.environ, "PYTHONPATH": str(path)}
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_new_task_is_whole(package: Path) -> None:
    """Task, configuration, registration, scripted policy, tests and README; nothing of the template is left over."""
    files = {path.relative_to(package).as_posix() for path in package.rglob("*") if path.is_file()}
    modules = {f"slide_disc/{name}.py" for name in ("__init__", "config", "kernels", "scripted", "task")}
    assert files == {"pyproject.toml", "README.md", "tests/test_slide_disc.py", *modules}
    assert all("$" not in (package / name).read_text() for name in files)
    assert compileall.compile_dir(package, quiet=1)


def test_it_reads_as_softmode_does(package: Path) -> None:
    """The linter has nothing to say, with the settings of this repository."""
    pytest.importorskip("ruff")
    run(package, "-m", "ruff", "check", "--config", str(ROOT / "pyproject.toml"), "--ignore", "D107,D104,I001", ".")
    run(package, "-m", "ruff", "format", "--check", "--config", str(ROOT / "pyproject.toml"), ".")


@pytest.mark.rest
def test_it_passes_its_own_tests(package: Path) -> None:
    """In its folder pytest passes: every test passes, none is skipped."""
    told = run(package, "-m", "pytest", "-q", "-p", "no:cacheprovider")
    assert "3 passed" in told and "skipped" not in told


def test_it_installs(package: Path, tmp_path: Path) -> None:
    """It installs without the network, and the id is registered where the folder is not the working one."""
    pytest.importorskip("hatchling")
    pip = ("-m", "pip", "install", "--no-deps", "--no-build-isolation", "--no-index", "--target", str(tmp_path))
    run(package, *pip, ".")
    code = "import gymnasium as gym, slide_disc; print(gym.spec('slide_disc/SlideDisc-v0').entry_point)"
    assert run(tmp_path, "-c", code, path=tmp_path).strip() == "slide_disc.task:SlideDiscEnv"


def test_names() -> None:
    """Names in three spellings are one; the class follows from the package."""
    assert {package_name(name) for name in ("SlideDisc", "slide-disc", "slide_disc")} == {"slide_disc"}
    assert class_name("push2_far") == "Push2Far"


@pytest.mark.parametrize("name", ["", "2fast", "a b", "../up", "class", "numpy", "_x", "x__y", "x" * 70])
def test_names_that_cannot_be_are_refused(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is written, and the line says what a name is like."""
    assert main(["new", "task", name, "--out", str(tmp_path)]) == 2
    assert "like slide_disc" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_folder_that_exists_stays(package: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A second call changes nothing."""
    before = (package / "README.md").stat().st_mtime_ns
    assert main(["new", "task", "slide_disc", "--out", str(package.parent)]) == 2
    assert "exists" in capsys.readouterr().err and (package / "README.md").stat().st_mtime_ns == before
    assert [path.name for path in package.parent.iterdir()] == ["slide_disc"]
