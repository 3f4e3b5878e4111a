"""Library use prints nothing, and what Warp says of the user's own modules stays."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.test_layers import imports

ROOT = Path(__file__).resolve().parents[1]
NO_DRIVER = "Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. GPU execution will not be available.\n"
"""What Warp's native code writes where there is none, whatever its settings."""

SCRIPT = """
import gymnasium as gym
import softmode
import warp as wp

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
    assert done.stderr.replace(NO_DRIVER, "") == ""


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
