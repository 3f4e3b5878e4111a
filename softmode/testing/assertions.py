"""What tests assert of an episode; each names seed, step and figure, and the step goes to the report of the failure."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from softmode.checks import require_number
from softmode.deformables.model.status import REASONS, status_reasons
from softmode.errors import ConfigError
from softmode.testing.episode import Episode


def assert_success(episode: Episode) -> None:
    """Assert that the episode ended in success."""
    if not episode.success:
        last = episode.steps[-1].info
        task = episode.base.task
        figures = ", ".join(f"{name} {float(last[name]):.3g}" for name in task.metric_names)
        why = task.end_reasons(int(last["end_reason"])).name.lower()
        raise episode.failed(len(episode.steps) - 1, f"no success ({why}): {figures}")


def assert_no_flag(episode: Episode, *, allow: Collection[str] = ()) -> None:
    """Assert that no status bit of the solver was set in any step.

    Args:
        episode: The episode.
        allow: Names of bits that may be set, such as "iteration_limit".

    Raises:
        ConfigError: If a name is none of a status bit.
    """
    unknown = sorted(set(allow) - set(REASONS.values()))
    if unknown:
        raise ConfigError(f"allow names {unknown}", hint=f"choose from {', '.join(REASONS.values())}")
    pardoned = sum(bit for bit, name in REASONS.items() if name in allow)
    for number, step in enumerate(episode.steps):
        if bits := int(step.info["solver_status"]) & ~pardoned:
            raise episode.failed(number, f"the solver reports {', '.join(status_reasons(bits, remedies=True))}")


def assert_max_penetration(episode: Episode, mm: float) -> None:
    """Assert that no surface sample was deeper in a rigid shape than so many millimetres, at the end of any step.

    The dent of its contact does not count: there the skin of the body lies outside of what its functions say.
    """
    require_number("mm", mm, at_least=0.0, unit="mm")
    _at_most(episode, [1.0e3 * step.depth for step in episode.steps], mm, "mm deep in a rigid shape")


def assert_max_force(episode: Episode, newton: float) -> None:
    """Assert that the soft objects pressed on no rigid body with more than so many newtons, at the end of any step.

    Links of the robot are bodies; table and fixtures, which are fixed to the world, are none.
    """
    require_number("newton", newton, at_least=0.0, unit="N")
    _at_most(episode, [step.force for step in episode.steps], newton, "N on a rigid body")


def assert_replays(episode: Episode, *, atol: float = 0.0) -> None:
    """Assert that the same actions from the same state give the same observations and rewards.

    Args:
        episode: The episode; its environment plays it again.
        atol: Largest difference of a number; 0 asks for the same bits, which holds on CPU.
    """
    for number, (then, now) in enumerate(zip(episode.steps, episode.replayed(episode.base), strict=True)):
        off = max(float(np.abs(now.observation - then.observation).max()), abs(now.reward - then.reward))
        if not off <= atol:
            raise episode.failed(number, f"played again, it is off by {off:.3g}")


def _at_most(episode: Episode, values: list[float], most: float, what: str) -> None:
    """Fail at the first step with a larger value, and name the largest."""
    over = [number for number, value in enumerate(values) if not value <= most]
    if over:
        raise episode.failed(over[0], f"{values[over[0]]:.3g} {what}, allowed {most:g}; largest {max(values):.3g}")
