"""Library use prints nothing, and what Warp says of the user's own modules stays."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
import warp as wp
from tqdm import tqdm

from softmode import stages
from softmode.cli.common import quiet_warp
from softmode.quiet import quieten_warp
from softmode.stages import KERNELS
from tests.test_layers import imports

ROOT = Path(__file__).resolve().parents[1]
NO_DRIVER = "Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. GPU execution will not be available.\n"
"""What Warp's native code writes where there is none, whatever its settings."""

SCRIPT = """
import gymnasium as gym
import softmode
import warp as wp
from softmode import stages

named, begin = [], stages._WATCH.begin
stages._WATCH.begin = lambda name: (named.append(name), begin(name))[1]

@wp.kernel
def mine(x: wp.array[float]):
    x[wp.tid()] = 1.0

env = gym.make("softmode/PushSoft-v0", render_mode="rgb_array", obs_type="pixels")
env.reset(seed=0)
env.step(env.action_space.sample())
env.render()
print("-- mine --", flush=True)
wp.launch(mine, 1, outputs=[wp.zeros(1, device="cpu")], device="cpu")
print("-- all --", flush=True)
wp.set_logger(None)
again = gym.make("softmode/LiftSoft-v0")
print("-- stages --", named, sep="\\n", flush=True)
"""


def test_an_environment_prints_nothing(tmp_path: Path) -> None:
    """Made, stepped and drawn it is silent on both streams; a kernel of the user's is told of, as without softmode."""
    file = tmp_path / "script.py"
    file.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, str(file)], capture_output=True, text=True, env=environment, check=True)
    before, _, rest = done.stdout.partition("-- mine --\n")
    mine, _, after = rest.partition("-- all --\n")
    assert before == ""
    assert mine.startswith("Module __main__ ") and mine.count("\n") == 1
    assert "Module softmode.envs.tasks.lift_soft.kernels" in after
    said = re.sub(r"softmode: .+, \d+ s\n", "", done.stderr)  # of what takes longer than three seconds
    assert said.replace(NO_DRIVER, "") == ""
    named = set(ast.literal_eval(after.rpartition("-- stages --\n")[2]))
    assert {"making the environment", KERNELS} <= named and any(name.startswith("reading ") for name in named)


def test_a_long_stage_is_named_again_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The innermost stage is told while nothing else moves; kernels are compiled only where a module was."""
    told: list[str] = []
    heard = threading.Event()

    def listen(name: str, seconds: float) -> None:
        told.append(name)
        heard.set()

    def wait() -> str:
        """Return what is told next."""
        heard.clear()
        assert heard.wait(20.0)
        return told[-1]

    monkeypatch.setattr(stages, "PERIOD", 0.02)
    monkeypatch.setattr(stages, "_print", listen)
    with stages.stage("making"):
        assert wait() == "making"
        with stages.stage(KERNELS):
            while wait() != KERNELS:
                pass
            stages.compiled()
            while "compiling kernels" not in wait():
                pass
        while wait() != "making":
            pass


def test_a_stage_is_told_above_the_bars(capsys: pytest.CaptureFixture[str]) -> None:
    """One line on stderr, with a bar and without one, also while another process holds the lock of the bars."""
    stages._print("making", 4.2)
    with tqdm(total=2, file=sys.stderr), tqdm.get_lock():
        speaker = threading.Thread(target=stages._print, args=("filling", 5.0), daemon=True)
        speaker.start()
        speaker.join(20.0)
        assert not speaker.is_alive()
    err = capsys.readouterr().err
    assert "softmode: making, 4 s\n" in err and "softmode: filling, 5 s\n" in err


def test_every_module_that_launches_is_quiet() -> None:
    """What launches kernels has imported the module that quietens Warp before."""
    arrows = imports()

    def reached(name: str, seen: set[str]) -> set[str]:
        for target in arrows[name] - seen:
            seen.add(target)
            reached(target, seen)
        return seen

    files = {name: ROOT / f"{name.replace('.', '/')}.py" for name in arrows}
    launching = [name for name, path in files.items() if path.is_file() and "wp.launch(" in path.read_text()]
    assert len(launching) > 3
    assert not [name for name in launching if "softmode.quiet" not in reached(name, {name})]


class Kept:
    """A logger that keeps what it is told."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def info(self, message: str) -> None:
        """Keep a line."""
        self.lines.append(message)

    debug = info

    def warning(self, message: str, category: type[Warning] | None = None, stacklevel: int = 1) -> None:
        """Keep a warning."""
        self.lines.append(message)

    error = info


def test_a_logger_of_the_users_gets_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """What softmode calls is left out, unless it names a module of the user's or Warp is to tell all; warnings stay."""
    before = wp.get_logger()
    kept = Kept()
    wp.set_logger(kept)
    try:
        logger = quieten_warp()
        assert quieten_warp() is logger is wp.get_logger()
        within: dict[str, Any] = {"__name__": "softmode.anything", "logger": logger}
        exec("def load(line): logger.info(line)", within)
        load = within["load"]
        load("Module softmode.anything 12ab load on device 'cpu' took 1.00 ms (cached)")
        load("Module _inner_kernel_0f load on device 'cpu' took 1.00 ms (compiled)")
        assert kept.lines == []
        load(f"Module {__name__} 12ab load on device 'cpu' took 1.00 ms (cached)")
        logger.info("Module _inner_kernel_0f load on device 'cpu' took 1.00 ms (cached)")
        logger.warning("careful")
        assert len(kept.lines) == 3
        monkeypatch.setattr(wp.config, "log_level", wp.LOG_DEBUG)
        load("Module softmode.anything 12ab load on device 'cpu' took 1.00 ms (cached)")
        assert len(kept.lines) == 4
    finally:
        wp.set_logger(before)


def test_commands_say_once_what_takes_so_long(capsys: pytest.CaptureFixture[str]) -> None:
    """Modules from the cache are not worth a line; the first that is compiled is, where no terminal shows a bar."""
    line = "Module softmode.anything 12ab load on device 'cpu' took 9.00 ms"
    with quiet_warp():
        wp.get_logger().info(f"{line} (cached)")
        assert "compiling" not in capsys.readouterr().err
        for _ in range(3):
            wp.get_logger().info(f"{line} (compiled)")
    out, err = capsys.readouterr()
    assert out == "" and err.count("compiling kernels (first run only, a minute or two)") == 1
