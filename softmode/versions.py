"""The versions of Newton, Warp, MuJoCo and OpenUSD that softmode is tested with, and a warning beyond them.

Requirements in pyproject.toml have lower bounds only: Newton is released monthly, and an upper bound would keep users
from a version that works. This module is the one place that says which versions were tested. `python -m
softmode.versions` prints them beside the installed ones.
"""

from __future__ import annotations

import functools
import re
import warnings
from importlib import metadata
from typing import NamedTuple


class Tested(NamedTuple):
    """Versions of one package that the tests have run with."""

    first: str
    """The oldest tested version."""
    end: str
    """The first version beyond the tested ones: ``first <= version < end``."""

    @property
    def requirement(self) -> str:
        """The range as pip takes it, like ``>=1.8,<1.9``."""
        return f">={self.first},<{self.end}"


TESTED = {
    "newton": Tested("1.8", "1.9"),
    "warp-lang": Tested("1.17", "1.20"),
    "mujoco": Tested("3.17", "3.18"),
    "mujoco-warp": Tested("3.17", "3.18"),
    "usd-core": Tested("26.3", "26.12"),
}
"""Tested versions by the name of the distribution; constraints.txt pins one version in each range."""


class UntestedVersionWarning(UserWarning):
    """An installed package lies outside the versions that softmode is tested with."""


def installed() -> dict[str, str]:
    """Return the installed versions of the packages in `TESTED`, by name; absent packages are left out."""
    found = {}
    for name in TESTED:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def untested() -> dict[str, str]:
    """Return the installed versions that lie outside the tested ranges, by name of the package."""
    return {name: version for name, version in installed().items() if not _inside(version, TESTED[name])}


@functools.cache
def warn_untested() -> None:
    """Warn if an installed package lies outside the versions that softmode is tested with; later calls do nothing.

    Only the metadata of the packages are read; none of them is imported. To silence it, filter the category
    `UntestedVersionWarning`.
    """
    found = untested()
    if not found:
        return
    listed = "; ".join(f"{name} {version} (tested: {TESTED[name].requirement})" for name, version in found.items())
    wanted = " ".join(f"'{name}{TESTED[name].requirement}'" for name in found)
    warnings.warn(
        f"softmode is not tested with {listed}. If something fails, install a tested version: pip install {wanted}",
        UntestedVersionWarning,
        stacklevel=3,
    )


def report() -> str:
    """Return a table of the installed and the tested versions, a line for each package."""
    found = installed()
    rows = [
        f"{name:12} {found.get(name, 'not installed'):14} tested: {tested.requirement}"
        for name, tested in TESTED.items()
    ]
    return "\n".join(rows)


def _inside(version: str, tested: Tested) -> bool:
    """Return whether a version lies in the tested range, by its release number: 1.9.0.dev3 counts as 1.9."""
    return _release(tested.first) <= _release(version) < _release(tested.end)


def _release(version: str) -> tuple[int, ...]:
    """Return the release number of a version, without trailing zeros: 1.8.0rc1 is (1, 8)."""
    match = re.match(r"v?(?:\d+!)?(\d+(?:\.\d+)*)", version)
    numbers = [int(part) for part in match[1].split(".")] if match else []
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return tuple(numbers)


if __name__ == "__main__":
    print(report())
