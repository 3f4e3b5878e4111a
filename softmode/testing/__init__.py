"""Episodes in pytest: a plug-in with fixtures and a marker, and assertions on what was played.

pytest finds the plug-in, a module beside this package, by itself; ``-p no:softmode`` leaves it out. Names are imported
when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.testing.assertions import (
        assert_max_force,
        assert_max_penetration,
        assert_no_flag,
        assert_replays,
        assert_success,
    )
    from softmode.testing.episode import Episode, play_episode
    from softmode.testing.golden import assert_golden
    from softmode.testing.task_check import TaskCheck, check_task

__all__ = [
    "Episode",
    "TaskCheck",
    "assert_golden",
    "assert_max_force",
    "assert_max_penetration",
    "assert_no_flag",
    "assert_replays",
    "assert_success",
    "check_task",
    "play_episode",
]

__getattr__, __dir__ = lazy_names(__name__)
