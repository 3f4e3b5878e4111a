"""The numbers of an iteration: read from the device once, averaged over episodes, told in a line."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

import torch

from softmode.learning.distributed import Ranks
from softmode.learning.ppo import PPO
from softmode.learning.rollout import EpisodeStatistics

WINDOW = 200
"""Episodes at least over which returns and success are averaged while training."""


class TrainingLog:
    """Reads the statistics of iterations.

    Args:
        statistics: Of the episodes of this rank.
        ppo: The learner.
        ranks: The processes whose statistics are added up.
        window: Sums over episodes of the iterations before this run went on, the oldest first.
    """

    def __init__(
        self, statistics: EpisodeStatistics, ppo: PPO, ranks: Ranks, window: Iterable[list[float]] = ()
    ) -> None:
        """Start with the episodes of the window."""
        self.statistics, self.ppo, self.ranks = statistics, ppo, ranks
        self.window: deque[list[float]] = deque(window)

    @property
    def episodes(self) -> float:
        """Episodes that the current means are over."""
        return sum(entry[0] for entry in self.window)

    def read(self, losses: torch.Tensor, bad: torch.Tensor, progress: float) -> tuple[dict[str, Any], float, bool]:
        """Wait for the device; return the iteration's row, the first rank's progress, whether any rank is bad.

        Args:
            losses: Means of ``PPO.LOSSES``.
            bad: Whether a transition of this rank is not finite.
            progress: How much of the run is over, 0 to 1, by this rank's clock.
        """
        names = list(self.statistics.term_sums)
        first = float(self.ranks.rank == 0)
        optimizer = self.ppo.optimizer
        std = self.ppo.model.actor.log_std.detach().exp().mean()
        means = torch.cat([losses, torch.stack([optimizer.learning_rate, std])]) / self.ranks.count
        flags = torch.stack([bad.float(), optimizer.skipped, torch.full_like(std, first * progress)])
        values = self.ranks.sum(torch.cat([self.statistics.take(), flags, means]).double()).tolist()
        episodes, total, length, success, valid = values[:5]
        term_sums = values[5 : 5 + len(names)]
        any_bad, skipped, progress = values[5 + len(names) : 8 + len(names)]
        self.window.append([episodes, total, length, success])
        while self.episodes - self.window[0][0] >= WINDOW:
            self.window.popleft()
        count, total, length, success = (sum(column) for column in zip(*self.window, strict=True))
        row: dict[str, Any] = {
            "episodes": int(episodes),
            "return": total / count if count else None,
            "length": length / count if count else None,
            "success": success / count if count and self.statistics.knows_success else None,
        }
        row |= {f"reward/{name}": value / max(valid, 1.0) for name, value in zip(names, term_sums, strict=True)}
        row |= dict(zip((*PPO.LOSSES, "learning_rate", "action_std"), values[8 + len(names) :], strict=True))
        row["skipped_updates"] = int(skipped)
        return row, progress, any_bad > 0


def describe(row: dict[str, Any]) -> str:
    """Return the line of an iteration: steps, speed, return, success, means of the reward's terms per step."""
    line = f"{row['iteration']:5d}  {row['env_steps']:>11,} steps  {row['steps_per_second']:>8,.0f}/s"
    line += f"  {row['seconds']:7.1f} s"
    if row["return"] is not None:
        line += f"  return {row['return']:9.3f}"
    if row["success"] is not None:
        line += f"  success {100.0 * row['success']:5.1f} %"
    terms = [f"{name[7:]} {value:.3g}" for name, value in row.items() if name.startswith("reward/")]
    line += f"  kl {row['divergence']:.4f}  std {row['action_std']:.2f}"
    return line + ("  " + "  ".join(terms) if terms else "")
