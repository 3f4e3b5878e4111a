"""LeRobot's own commands: a dataset of softmode is trained on, and the policy is evaluated in softmode."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path


def run(command: str, *words: str) -> str:
    """Run a command of the environment without the hub or a GPU; return what was said."""
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "CUDA_VISIBLE_DEVICES": ""}
    path = Path(sys.executable).parent / command
    done = subprocess.run([path, *words], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_record_train_evaluate(tmp_path: Path) -> None:
    """Two episodes with films, four steps of ACT, two episodes of evaluation with their films."""
    data, act, found = tmp_path / "lift", tmp_path / "act", tmp_path / "eval"
    run("softmode", "record", "softmode/LiftSoft-v0", "-o", str(data), "--episodes", "2")
    small = ("dim_model=64", "n_heads=2", "dim_feedforward=64", "pretrained_backbone_weights=null", "device=cpu")
    policy = ["--policy.type=act", "--policy.push_to_hub=false", *(f"--policy.{word}" for word in small)]
    steps = ["--steps=4", "--batch_size=2", "--num_workers=0", f"--output_dir={act}"]
    run("lerobot-train", "--dataset.repo_id=me/lift", f"--dataset.root={data}", *policy, *steps)
    env = ["--env.type=softmode", "--env.task=LiftSoft-v0", "--env.episode_length=20"]
    count = ["--eval.n_episodes=2", "--eval.batch_size=2", f"--output_dir={found}"]
    trained = act / "checkpoints" / "last" / "pretrained_model"
    told = run("lerobot-eval", f"--policy.path={trained}", "--policy.device=cpu", *env, *count)
    assert "2 episodes of softmode/LiftSoft-v0: success at the last step" in told
    assert json.loads((found / "eval_info.json").read_text())["overall"]["n_episodes"] == 2
    assert len(list(found.rglob("*.mp4"))) == 2
