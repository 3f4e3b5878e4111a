"""The command ``softmode list-envs``."""

from __future__ import annotations

import dataclasses

from softmode import ENVIRONMENTS


@dataclasses.dataclass(frozen=True, kw_only=True)
class ListEnvs:
    """List the environments and their tasks.

    Example: softmode list-envs
    """

    def run(self) -> int:
        """Print one line per environment."""
        for name, task in ENVIRONMENTS.items():
            print(f"{name}  {task}")
        return 0
