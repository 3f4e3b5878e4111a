"""The ranges of tested versions, and the warning beyond them."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest

from softmode import versions

ROOT = Path(__file__).resolve().parents[1]
INSIDE = {"newton": "1.8.3", "warp-lang": "1.17.0", "mujoco": "3.17.9", "mujoco-warp": "3.17.0", "usd-core": "26.3"}


@pytest.fixture(autouse=True)
def unwarned() -> Iterator[None]:
    """No warning has been given before a test, nor is one left to be given after it."""
    versions.warn_untested.cache_clear()
    yield
    versions.warn_untested.cache_clear()


def install(monkeypatch: pytest.MonkeyPatch, found: dict[str, str]) -> None:
    """Replace the metadata of installed packages."""

    def version(name: str) -> str:
        if name not in found:
            raise metadata.PackageNotFoundError(name)
        return found[name]

    monkeypatch.setattr(versions.metadata, "version", version)


def test_inside_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Versions in the tested ranges give no warning, an absent optional package neither."""
    install(monkeypatch, {name: version for name, version in INSIDE.items() if name != "usd-core"})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        versions.warn_untested()
    assert versions.untested() == {}
    assert "not installed" in versions.report()


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("newton", "1.7.9"),  # below
        ("newton", "1.9"),  # beyond: the end is not in the range
        ("newton", "1.9.0.dev3"),
        ("newton", "1.10.0"),  # by number, not by letter
        ("warp-lang", "1.16.1"),
        ("warp-lang", "1.20.0rc1"),
        ("mujoco", "4.0.0"),
        ("mujoco-warp", "3.18.0"),
        ("usd-core", "25.11"),
        ("usd-core", "27.2"),
    ],
)
def test_outside_warns_once(monkeypatch: pytest.MonkeyPatch, name: str, version: str) -> None:
    """One warning names the version, the tested range and the command that mends it; a second call is silent."""
    install(monkeypatch, {**INSIDE, name: version})
    with pytest.warns(versions.UntestedVersionWarning) as caught:
        versions.warn_untested()
        versions.warn_untested()
    (warning,) = caught
    text = str(warning.message)
    tested = versions.TESTED[name]
    assert f"{name} {version}" in text and f">={tested.first},<{tested.end}" in text
    assert f"pip install '{name}>={tested.first},<{tested.end}'" in text
    assert not any(f"{other} {INSIDE[other]}" in text for other in INSIDE if other != name)


@pytest.mark.parametrize(
    ("text", "release"), [("1.8.0", (1, 8)), ("1.8.0rc1", (1, 8)), ("26.11.post1", (26, 11)), ("1!2.0", (2,))]
)
def test_release_numbers(text: str, release: tuple[int, ...]) -> None:
    """The release number alone is compared, and 1.8 equals 1.8.0."""
    assert versions._release(text) == release


def test_pinned_versions_are_tested_ones() -> None:
    """What constraints.txt pins, and so what the tests run with, lies in the ranges."""
    pins = dict(re.findall(r"^([a-z-]+)==([\w.]+)", (ROOT / "constraints.txt").read_text(), re.M))
    for name, tested in versions.TESTED.items():
        assert versions._inside(pins[name], tested), f"{name} {pins[name]}"


def test_requirements_have_no_upper_bound_of_their_own() -> None:
    """pyproject.toml starts where the tested range starts and does not end: beyond it there is a warning."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [*project["dependencies"], *project["optional-dependencies"]["usd"]]
    for name in ("newton", "warp-lang", "usd-core"):
        (line,) = (line for line in lines if re.match(rf"{name}(?:\[\w+\])?[<>=]", line))
        bounds = re.findall(r"([<>=~!]+)([\d.]+)", line.partition(";")[0])
        assert bounds == [(">=", versions.TESTED[name].first)]


def test_asking_loads_nothing() -> None:
    """The check reads metadata: a fresh process that runs it has loaded neither Newton nor Warp nor MuJoCo."""
    script = (
        "import sys, softmode.versions as v; v.warn_untested()\n"
        "assert not {'newton', 'warp', 'mujoco', 'pxr'} & {name.partition('.')[0] for name in sys.modules}"
    )
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
