"""Policies as ONNX graphs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softmode.errors import CheckpointError
from softmode.learning.checkpoints import write_checkpoint
from tests.learning.test_checkpoints import checkpoint
from tests.needs import needs

pytestmark = needs("torch", "onnx", "onnxscript", "onnxruntime")


def test_a_graph_gives_the_actions_of_the_policy(tmp_path: Path) -> None:
    """Raw observations in, actions of the environment's range out, for any number of worlds; far ones are clipped.

    A graph that differs is refused, and nobody takes one for a checkpoint.
    """
    import onnxruntime
    import torch

    from softmode.learning.onnx_export import export_onnx
    from softmode.learning.policy import load_policy

    write_checkpoint(checkpoint(), tmp_path / "p.npz")
    policy, path = load_policy(tmp_path / "p.npz"), tmp_path / "p.onnx"
    export_onnx(policy, path)
    session = onnxruntime.InferenceSession(path)
    for count in (1, 3):
        seen = np.random.default_rng(1).normal(scale=30.0, size=(count, 3)).astype(np.float32)
        np.testing.assert_allclose(session.run(["action"], {"state": seen})[0], policy(seen), atol=1e-5)
    with pytest.raises(CheckpointError, match="ONNX"):
        load_policy(path)

    act = policy.act
    policy.act = lambda observation: act(observation) + 1e-3 * (not torch.compiler.is_exporting())
    with pytest.raises(CheckpointError, match=r"differ by 1\.0e-03"):
        export_onnx(policy, tmp_path / "other.onnx")
    assert not (tmp_path / "other.onnx").exists()
