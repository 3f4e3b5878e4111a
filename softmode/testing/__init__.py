"""Episodes in pytest: a plug-in with fixtures and a marker, and assertions on what was played.

pytest finds the plug-in, a module beside this package, by itself; ``-p no:softmode`` leaves it out. Names are imported
when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.testing.assertions import assert_max_force as assert_max_force
    from softmode.testing.assertions import assert_max_penetration as assert_max_penetration
    from softmode.testing.assertions import assert_no_flag as assert_no_flag
    from softmode.testing.assertions import assert_replays as assert_replays
    from softmode.testing.assertions import assert_success as assert_success
    from softmode.testing.episode import Episode as Episode
    from softmode.testing.episode import play_episode as play_episode
    from softmode.testing.golden import assert_golden as assert_golden
    from softmode.testing.task_check import TaskCheck as TaskCheck
    from softmode.testing.task_check import check_task as check_task

__getattr__, __dir__ = lazy_names(__name__)
