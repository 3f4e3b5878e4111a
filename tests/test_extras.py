"""Whatever needs a package that the core does not bring says which extra brings it."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = set(PROJECT["optional-dependencies"])
SOURCES = sorted((ROOT / "softmode").rglob("*.py"))

OPTIONAL = (
    *(
        "torch",
        "tensorboard",
        "stable_baselines3",
        "rsl_rl",
        "skrl",
        "ray",
        "onnxruntime",
        "pyarrow",
        "imageio",
        "imageio_ffmpeg",
        "tyro",
    ),
    *(
        "cv2",
        "pxr",
        "newton_usd_schemas",
        "rerun",
        "viser",
        "matplotlib",
        "mujoco_menagerie",
        "backports",
        "compression",
    ),
)
"""Modules that only extras bring; `compression` is where Python 3.14 keeps Zstandard."""

CASES = {
    "command line": ("demo", "import softmode.cli.main; softmode.cli.main.main(['list-envs'])"),
    "film": ("demo", "from softmode.viz.film import Film; Film(Path('lift.mp4'))"),
    "film to fit": ("fit", "from softmode.fitting.film import cv2; cv2.blur"),
    "tensors": ("rl", "import softmode, gymnasium as g; g.make_vec('softmode/PushSoft-v0', output='torch')"),
    "Stable-Baselines3": ("rl", "from softmode.envs.adapters import StableBaselinesVecEnv"),
    "rsl_rl": ("rsl-rl", "from softmode.envs.adapters import RslRlVecEnv"),
    "skrl": ("skrl", "from softmode.envs.adapters import SkrlWrapper"),
    "cluster": (
        "ray",
        "from softmode.cluster.ray_tasks import _cluster; _cluster('local', None).__enter__()",
    ),
    "training": ("rl", "from softmode.learning.trainer import train"),
    "trained policy": ("rl", "from softmode.learning.policy import load_policy"),
    "policy by file": (
        "rl",
        "from softmode.learning.players import trained_policy as t; t('a.npz', 'softmode/PushSoft-v0')",
    ),
    "policy to play": ("rl", "from softmode.learning.players import policy_factory as f; f(str(Path('a.npz')), None)"),
    "TensorBoard": ("rl", "from softmode.learning.run_folder import RunFolder as R; R.start_tensorboard(None, None)"),
    "autograd of splats": ("rl", "from softmode.splats.raster.rasterizer_torch import _function; _function()"),
    "autograd of steps": ("rl", "from softmode.deformables.gradients.adjoint_torch import _function; _function()"),
    "read OpenUSD": ("usd", "from softmode.splats import read_splats; read_splats('toy.usda')"),
    "write OpenUSD": (
        "usd",
        "from softmode.splats import write_splats, make_plush as m; write_splats('b.usdc', m(200))",
    ),
    "stage in": ("usd", "from softmode.usd import read_usd_scene; read_usd_scene('toy.usda')"),
    "stage to simulate": (
        "usd",
        "import newton as n; from softmode.usd import add_usd as a; a(n.ModelBuilder(), 'toy.usda')",
    ),
    "stage out": ("usd", "from softmode.usd import write_usd; write_usd('out.usdc', [None])"),
    "animation": ("usd", "from softmode.usd import UsdAnimation; UsdAnimation('out.usdc', None, [])"),
    "picture of a body": (
        "viz",
        "from softmode.viz.body_picture import write_body_picture as w; w('toy.png', None, None, None)",
    ),
    "browser": ("viz", "from softmode.view.app import ViewOptions, start_server; start_server(ViewOptions())"),
    "rerun": ("viz", "from softmode.viz.rerun_logger import RerunLogger; RerunLogger('out.rrd', None)"),
    "SPZ version 4": ("spz", "from softmode.splats import read_splats; read_splats('toy.spz')"),
    "robot by name": ("robots", "from softmode import robots; robots.load('so101')"),
    "read dataset": ("data", "from softmode.demonstrations import read_dataset; read_dataset('.')"),
    "write dataset": ("data", "from softmode.demonstrations import DatasetWriter as D; D(Path('new'), {}, fps=30)"),
    "film of a dataset": ("data", "from softmode.demonstrations.pictures import ffmpeg; ffmpeg()"),
}
"""What is tried where all of those are missing: the extra that should be named, and the code."""

CORE = """
import gymnasium, softmode
env = gymnasium.make("softmode/LiftSoft-v0", obs_type="pixels_agent_pos")
observation, _ = env.reset(seed=0)
observation, *_ = env.step(env.action_space.sample())
assert env.observation_space.contains(observation) and observation["pixels"].std() > 10.0
"""
"""What needs none of them: an environment with pictures."""

CHILD = f"""
import json, sys, traceback
from importlib.machinery import PathFinder
from pathlib import Path

class Core(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in {OPTIONAL!r} else super().find_spec(name, path, target)

sys.meta_path = [Core if finder is PathFinder else finder for finder in sys.meta_path]
from softmode.errors import MissingExtraError
Path("a.npz").touch()
found = {{}}
for name, code in json.load(sys.stdin).items():
    try:
        exec(code, {{"Path": Path}})
        found[name] = ["nothing", ""]
    except BaseException as error:
        hint = error.hint if isinstance(error, MissingExtraError) else traceback.format_exc()
        found[name] = [type(error).__name__, hint]
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, str]]:
    """Return type of error and hint of every case, all tried in one process without any optional package."""
    from softmode.splats import make_plush
    from softmode.splats.formats.spz import write_spz

    folder = tmp_path_factory.mktemp("extras")
    write_spz(folder / "toy.spz", make_plush(200), version=4)
    (folder / "toy.usda").write_text("#usda 1.0\n")
    codes = {name: code for name, (_, code) in CASES.items()} | {"core": CORE}
    codes["command line"] = _command_line(codes["command line"])
    done = subprocess.run(
        [sys.executable, "-c", CHILD], input=json.dumps(codes), cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert {path.name for path in folder.iterdir()} == {"toy.spz", "toy.usda", "a.npz"}, "no case leaves a file"
    return json.loads(done.stdout.splitlines()[-1])


def _command_line(code: str) -> str:
    """Return code that raises what the command line prints, since it turns errors into lines and exit codes."""
    return (
        "import contextlib, io\nfrom softmode.errors import MissingExtraError\ntext = io.StringIO()\n"
        f"with contextlib.redirect_stderr(text):\n    {code}\n"
        "raise MissingExtraError('', hint=text.getvalue())"
    )


@pytest.mark.parametrize("name", CASES)
def test_missing_package_names_its_extra(answers: dict[str, tuple[str, str]], name: str) -> None:
    """Every door to an optional package raises MissingExtraError with the command that installs it."""
    kind, hint = answers[name]
    assert kind == "MissingExtraError", hint
    assert f"pip install 'softmode[{CASES[name][0]}]'" in hint


def test_the_core_needs_none(answers: dict[str, tuple[str, str]]) -> None:
    """Without any of them an environment is made, reset, stepped and drawn."""
    assert answers["core"] == ["nothing", ""]


def test_hints_name_extras_that_exist() -> None:
    """Each ``softmode[...]`` in a message or docstring is an extra of pyproject.toml."""
    for path in SOURCES:
        for names in re.findall(r"softmode\[([\w,.-]+)\]", path.read_text()):
            assert set(names.split(",")) <= EXTRAS, f"{path}: softmode[{names}]"


def test_import_errors_become_missing_extra_errors() -> None:
    """There is one way to treat an absent package: no handler of ImportError swallows it or sets a flag."""
    doors = 0
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.With):
                found = re.match(r"needs_extra\('(.+?)'", ast.unparse(node.items[0].context_expr))
                assert found is None or found[1] in EXTRAS, f"{path}:{node.lineno}: softmode[{found[1]}]"
                doors += found is not None
            if not isinstance(node, ast.Try) or _imported(node) <= sys.stdlib_module_names:
                continue
            for handler in node.handlers:
                if handler.type is None or not re.search("ImportError|ModuleNotFound", ast.unparse(handler.type)):
                    continue
                doors += 1
                last = handler.body[-1]
                assert isinstance(last, ast.Raise) and last.exc is not None, f"{path}:{handler.lineno}"
                assert re.match(r"(MissingExtraError|missing)\(", ast.unparse(last.exc)), f"{path}:{handler.lineno}"
    assert doors >= 10


def _imported(node: ast.Try) -> set[str]:
    """Return the top-level names of the packages that are imported inside a try."""
    found = set()
    for part in (part for statement in node.body for part in ast.walk(statement)):
        if isinstance(part, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in part.names}
        elif isinstance(part, ast.ImportFrom):
            found.add((part.module or "").partition(".")[0])
    return found
