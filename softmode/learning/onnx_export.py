"""Policies as ONNX files, which run without softmode: raw observations in, the environment's actions out."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from softmode.errors import CheckpointError, needs_extra
from softmode.files import whole_file
from softmode.learning.policy import Policy

TOLERANCE = 1.0e-5
"""Largest difference between the actions of the file and of the policy, relative to half of the action's range."""


class _Graph(nn.Module):
    """A policy as a function of the parts of the observation, in the order of their names."""

    def __init__(self, policy: Policy, names: list[str]) -> None:
        """Take the policy's networks."""
        super().__init__()
        self.policy, self.actor, self.names = policy, policy.actor, names

    def forward(self, *parts: Tensor) -> Tensor:
        """Return actions, shape (n, action)."""
        return self.policy.act(dict(zip(self.names, parts, strict=True)))


def export_onnx(policy: Policy, path: Path) -> None:
    """Write a policy on the CPU as an ONNX graph, checked against the policy on random observations.

    Inputs have the names of the observation's parts, ``state`` or ``pixels`` where it has one, worlds first; the output
    is ``action``.

    Args:
        policy: The policy.
        path: The file; it appears complete or not at all.

    Raises:
        MissingExtraError: If onnx, onnxscript or onnxruntime is not installed.
        CheckpointError: If the actions of the graph differ from the policy's by more than `TOLERANCE`.
        StorageError: If the file cannot be written.
    """
    with needs_extra("onnx", f"{path.name} needs onnx, onnxscript and onnxruntime"):
        import onnxruntime
        import onnxscript  # noqa: F401
    random, seen = np.random.default_rng(0), policy.interface
    given: dict[str, Tensor] = {}
    for name, size in seen.vectors.items():
        given[name] = torch.from_numpy(random.normal(size=(7, size)).astype(np.float32))
    for name, shape in seen.pictures.items():
        given[name] = torch.from_numpy(random.integers(0, 256, (7, *shape), np.uint8))
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # says what else could be installed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter, about itself
        program = torch.onnx.export(
            _Graph(policy, list(given)),
            tuple(given.values()),
            input_names=list(given),
            output_names=["action"],
            dynamic_shapes=(tuple({0: torch.export.Dim("worlds")} for _ in given),),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    content = program.model_proto.SerializeToString()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    for count in (7, 1):
        parts = {name: value[:count] for name, value in given.items()}
        action = session.run(None, {name: value.numpy() for name, value in parts.items()})[0]
        apart = float(np.abs(action - policy(parts).numpy()).max())
        if not apart <= TOLERANCE:
            raise CheckpointError(
                f"the actions of the ONNX graph differ by {apart:.1e} from the policy's",
                hint="export to .npz, and tell us which policy it was",
            )
    with whole_file(path) as file:
        file.write(content)
