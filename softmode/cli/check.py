"""The command ``softmode check``: a task is held to the rules of environments."""

from __future__ import annotations

import dataclasses

from softmode.cli.common import quiet_warp


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """Check that a task keeps the rules of environments.

    Example: softmode check softmode/PushSoft-v0
    """

    env: str
    """Id of the environment, for example softmode/LiftSoft-v0, or module:id of your own."""
    episodes: int = 5
    """Episodes of the scripted policy."""

    def run(self) -> int:
        """Print a line per check; return 1 if one fails."""
        from softmode.testing import check_task

        with quiet_warp():
            found = check_task(self.env, episodes=self.episodes)
        words = {True: "ok", False: "FAILED", None: "skipped"}
        for check in found:
            print(f"{check.name:28}{words[check.passed]:9}{check.note}")
        return int(any(check.passed is False for check in found))
