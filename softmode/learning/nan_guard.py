"""The guard against values that are not finite: it finds the worlds and writes what they went through."""

from __future__ import annotations

import numpy as np
import torch

from softmode.errors import TrainingDiverged
from softmode.files import whole_file
from softmode.learning.rollout import Rollout
from softmode.learning.run_folder import RunFolder

MAX_WORLDS = 16
"""Offending worlds that are written at most."""


class NanGuard:
    """Watches rollouts and keeps the steps before the last one.

    Args:
        history: Steps that are written in front of the first bad one.
    """

    def __init__(self, history: int = 32) -> None:
        """Start without a past."""
        self.history = history
        self._past: dict[str, torch.Tensor] = {}

    @staticmethod
    def bad(rollout: Rollout) -> torch.Tensor:
        """Return where a transition is not finite, shape (steps, n), on the device."""
        bad = ~torch.isfinite(rollout.reward) | ~torch.isfinite(rollout.mean).all(-1)
        for value in rollout.observation.values():
            if value.is_floating_point():
                bad |= ~torch.isfinite(value[1:]).flatten(2).all(-1) | ~torch.isfinite(value[:-1]).flatten(2).all(-1)
        return bad

    def keep(self, rollout: Rollout) -> None:
        """Remember the end of a rollout that was fine."""
        for name, value in self._series(rollout).items():
            past = torch.cat([self._past[name], value]) if name in self._past else value
            self._past[name] = past[-self.history :].clone()

    def dump(self, rollout: Rollout, folder: RunFolder, iteration: int, rank: int) -> TrainingDiverged:
        """Write the last steps of the offending worlds; return the error to raise.

        The file holds ``observation_*``, ``next_observation_*``, ``action``, ``reward``, ``terminated`` and
        ``truncated``, shape (steps, worlds, ...), ``world`` (worlds,) and ``first_bad`` (worlds,), the step of the file
        where a value is not finite first.
        """
        bad = self.bad(rollout)
        worlds = torch.nonzero(bad.any(0)).flatten()
        first = bad[:, worlds].int().argmax(0)
        last = int(first.max()) + 1 if len(worlds) else rollout.steps
        chosen = worlds[:MAX_WORLDS]
        content: dict[str, np.ndarray] = {}
        offset = 0
        for name, value in self._series(rollout).items():
            parts = [self._past[name], value[:last]] if name in self._past else [value[:last]]
            joined = torch.cat([part[:, chosen] for part in parts])
            start = max(len(joined) - last - self.history, 0)
            offset = len(joined) - last - start
            content[name] = joined[start:].cpu().numpy()
        content["world"] = chosen.cpu().numpy()
        content["first_bad"] = first[:MAX_WORLDS].cpu().numpy() + offset
        name = f"nonfinite-{iteration:06d}-rank{rank}.npz"
        with folder.writing(name), whole_file(folder.path / name) as file:
            np.savez(file, allow_pickle=False, **content)
        listed = ", ".join(str(world) for world in chosen.tolist())
        more = "" if len(worlds) <= MAX_WORLDS else f" and {len(worlds) - MAX_WORLDS} more"
        return TrainingDiverged(
            f"iteration {iteration}: values of worlds {listed}{more} are not finite",
            hint=f"look at their last steps in {folder.path / name}; earlier checkpoints are intact",
        )

    @staticmethod
    def _series(rollout: Rollout) -> dict[str, torch.Tensor]:
        series = {f"observation_{key}": value[:-1] for key, value in rollout.observation.items()}
        series |= {f"next_observation_{key}": value[1:] for key, value in rollout.observation.items()}
        ends = {"terminated": rollout.terminated, "truncated": rollout.truncated}
        return series | {"action": rollout.sample, "reward": rollout.reward, **ends}
