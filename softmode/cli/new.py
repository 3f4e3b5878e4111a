"""The command ``softmode new``: a package with a task of one's own, from templates."""

from __future__ import annotations

import dataclasses
import importlib.util
import keyword
import re
import string
from pathlib import Path
from typing import Annotated, Literal

from softmode import __version__
from softmode.cli.common import short_name
from softmode.errors import ConfigError
from softmode.files import storage_errors
from softmode.leftovers import Claim

TEMPLATES = Path(__file__).parent / "templates" / "task"
"""Files of a package, ``package`` in their names for its name."""
_LONGEST = 60


@dataclasses.dataclass(frozen=True, kw_only=True)
class New:
    """Write a package with a task of your own.

    Example: softmode new task slide_disc
    """

    what: Literal["task"]
    """What to write."""
    name: str
    """Name of the task, for example slide_disc."""
    out: Annotated[Path, short_name("-o")] = Path()
    """Folder in which the package's folder is made."""

    def run(self) -> int:
        """Write the package and say what to do next."""
        folder = write_task(self.name, self.out)
        package = folder.name
        print(f"{folder} is a package with the task {env_id(package)}. Next:\n")
        print(f"  cd {folder}\n  pip install -e '.[dev]'\n  python -m pytest")
        print(f"  softmode play {package}:{env_id(package)} --video out/{package}.mp4")
        return 0


def package_name(name: str) -> str:
    """Return the name of the package of a task: slide_disc for SlideDisc, slide-disc and slide_disc.

    Raises:
        ConfigError: If the name is no such name, or the package would hide another one.
    """
    package = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).replace("-", "_").lower()
    if not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", package) or len(package) > _LONGEST:
        raise ConfigError(f"name is {name!r}", hint="use letters, digits and single underscores, like slide_disc")
    if keyword.iskeyword(package) or importlib.util.find_spec(package) is not None:
        raise ConfigError(f"name is {name!r}: Python has {package} already", hint="choose another, like slide_disc")
    return package


def class_name(package: str) -> str:
    """Return the name of a package's task: SlideDisc."""
    return "".join(part.capitalize() for part in package.split("_"))


def env_id(package: str) -> str:
    """Return the id of a package's environment: slide_disc/SlideDisc-v0."""
    return f"{package}/{class_name(package)}-v0"


def write_task(name: str, parent: Path) -> Path:
    """Write the package of a task, whole or not at all.

    Args:
        name: Name of the task.
        parent: Folder in which its folder is made.

    Returns:
        The folder of the package, which has its name.

    Raises:
        ConfigError: If the name cannot be used, or there is such a folder.
        StorageError: If it cannot be written.
    """
    package = package_name(name)
    folder = parent / package
    if folder.exists():
        raise ConfigError(f"{folder} exists", hint="choose another name, or another folder with --out")
    words = {
        "package": package,
        "project": package.replace("_", "-"),
        "Task": class_name(package),
        "id": env_id(package),
        "version": __version__,
    }
    with storage_errors(folder):
        claim = Claim(folder)
        pending = claim.name()
        try:
            for template in sorted(TEMPLATES.rglob("*.txt")):
                place = template.relative_to(TEMPLATES).with_suffix("").as_posix().replace("package", package)
                path = pending / place
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(string.Template(template.read_text("utf-8")).substitute(words), "utf-8")
            pending.rename(folder)
        finally:
            claim.release()
    return folder
