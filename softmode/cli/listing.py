"""The commands ``softmode list-envs`` and ``softmode robots``."""

from __future__ import annotations

import dataclasses
from typing import Literal

from softmode import ENVIRONMENTS
from softmode.errors import ConfigError


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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Robots:
    """List the robots that load by name, or fetch some to the cache.

    Example: softmode robots fetch so101 ur5e
    """

    action: Literal["list", "fetch"]
    """list prints the names, fetch downloads models."""
    names: tuple[str, ...]
    """What to fetch, for example so101 ur5e."""

    def run(self) -> int:
        """Print the names or fetch the models."""
        from softmode.robots.assets import available, fetch

        if self.action == "list":
            print("\n".join(available()))
            return 0
        if not self.names:
            raise ConfigError("robots fetch names no robot", hint="name some, like: softmode robots fetch so101 ur5e")
        for name, folder in zip(self.names, fetch(self.names), strict=True):
            print(f"{name}  {folder}")
        return 0
