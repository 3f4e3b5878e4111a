"""What is built and installed: the archives, their metadata, and a first step where nothing else is installed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

import softmode

ROOT = Path(__file__).resolve().parents[1]
CORE = {"newton", "mujoco", "warp-lang", "gymnasium", "numpy", "scipy", "trimesh", "tqdm", "pillow", "threadpoolctl"}
"""What an installation without extras asks for."""
STEP = """
import sys
import gymnasium as gym, softmode
env = gym.make("softmode/LiftSoft-v0", obs_type="pixels_agent_pos")
observation, _ = env.reset(seed=0)
for _ in range(5):
    observation, *_ = env.step(env.action_space.sample())
assert env.observation_space.contains(observation) and observation["pixels"].std() > 10.0
optional = {"torch", "pxr", "rerun", "viser", "matplotlib", "pyarrow", "imageio", "tyro"}
assert not optional & {name.partition(".")[0] for name in sys.modules}
for name in optional:
    try:
        __import__(name)
    except ImportError:
        continue
    raise AssertionError(f"{name} is installed")
print(softmode.__file__)
"""


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build sdist and wheel; return their folder."""
    folder = tmp_path_factory.mktemp("dist")
    _build(ROOT, folder, "-t", "sdist", "-t", "wheel")
    return folder


def _build(source: Path, folder: Path, *targets: str) -> None:
    """Build archives of a source tree."""
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(folder), *targets]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(command, cwd=source, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def _contents(wheel: Path) -> dict[str, bytes]:
    """Return the files of a wheel by name."""
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_wheel_holds_the_package_and_nothing_else(dist: Path) -> None:
    """Package and plug-in of pytest: all modules, templates, the marker of types, the licence; no tests or caches."""
    (wheel,) = dist.glob("*.whl")
    names = set(_contents(wheel))
    info = f"softmode-{softmode.__version__}.dist-info"
    assert {name.partition("/")[0] for name in names} == {"softmode", "pytest_softmode.py", info}
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "softmode").rglob("*.py")}
    captured = {str(path.relative_to(ROOT)) for path in (ROOT / "softmode/objects/captures/playbot").iterdir()}
    templates = {str(path.relative_to(ROOT)) for path in (ROOT / "softmode/cli/templates").rglob("*.txt")}
    assert {name for name in names if name.startswith("softmode/")} == modules | templates | captured | {
        "softmode/py.typed"
    }
    assert templates and "softmode/objects/captures/playbot/ATTRIBUTION.txt" in captured
    assert f"{info}/licenses/LICENSE" in names
    assert b"PLAYBOT by Stephane Agullo" in _contents(wheel)[f"{info}/licenses/NOTICE"]
    assert wheel.stat().st_size < 2_000_000


def test_metadata(dist: Path) -> None:
    """One version everywhere; the core asks for nothing that an extra should bring; Python 3.11 or later."""
    (wheel,) = dist.glob("*.whl")
    found = _contents(wheel)
    text = next(content for name, content in found.items() if name.endswith("METADATA")).decode()
    metadata = Parser().parsestr(text)
    assert metadata["Version"] == softmode.__version__ and metadata["Requires-Python"] == ">=3.11"
    required = metadata.get_all("Requires-Dist") or []
    assert {re.split(r"[^\w-]", line)[0] for line in required if "extra ==" not in line} == CORE


def test_sdist_builds_the_same_wheel(dist: Path, tmp_path: Path) -> None:
    """The wheel made of the source archive has the same bytes; tests, examples and documentation are in the archive."""
    (archive,) = dist.glob("*.tar.gz")
    with tarfile.open(archive) as file:
        file.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    for name in ("tests/test_packaging.py", "examples/drop_a_splat.py", "docs/notation.md", "policies", "Makefile"):
        assert (source / name).exists(), name
    assert not [path for path in source.rglob("*") if path.suffix in (".pyc", ".mp4") or path.name == "__pycache__"]
    _build(source, tmp_path / "again", "-t", "wheel")
    (first,), (second,) = dist.glob("*.whl"), (tmp_path / "again").glob("*.whl")
    assert _contents(first) == _contents(second)


@pytest.mark.rest
def test_wheel_steps_in_an_environment_of_its_own(dist: Path, tmp_path: Path) -> None:
    """Installed with its own requirements and nothing else, it makes an environment with pictures, resets and steps."""
    uv = shutil.which("uv") or str(Path(sys.executable).with_name("uv"))
    if not Path(uv).exists():
        pytest.skip("uv is not installed")
    (wheel,), place = dist.glob("*.whl"), tmp_path / "venv"
    python = str(place / "bin" / "python")
    pinned = ["--quiet", "--python", python, "--constraint", str(ROOT / "constraints.txt")]
    subprocess.run([uv, "venv", "--quiet", "--python", sys.executable, str(place)], check=True)
    fetched = subprocess.run(
        [uv, "pip", "install", *pinned, *sorted(CORE), "newton[sim]"], capture_output=True, text=True
    )
    if fetched.returncode:
        pytest.skip(f"no package index can be reached: {fetched.stderr.strip().splitlines()[-1]}")
    subprocess.run([uv, "pip", "install", "--quiet", "--offline", "--python", python, str(wheel)], check=True)
    subprocess.run([uv, "pip", "check", "--quiet", "--python", python], check=True)
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        [python, "-c", STEP], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1].startswith(str(place))


@pytest.mark.slow
@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13", "3.14"])
def test_all_extras_resolve_to_wheels(version: str) -> None:
    """Every supported Python has a set of versions of all extras together, without building anything."""
    uv = shutil.which("uv") or str(Path(sys.executable).with_name("uv"))
    command = [uv, "pip", "compile", "--quiet", "--only-binary", ":all:", "--python-version", version, "--all-extras"]
    done = subprocess.run([*command, "pyproject.toml"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert {"newton", "torch", "rerun-sdk"} <= {line.partition("==")[0] for line in done.stdout.splitlines()}
