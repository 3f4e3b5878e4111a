"""Where robots come from: names, the cache of downloaded models, and the file that a name stands for.

Models with a name come from the MuJoCo Menagerie through the package ``mujoco-menagerie`` (extra ``[robots]``). The
package holds a registry of names with the checksums of their archives and downloads a model once into its cache:
``MENAGERIE_CACHE_DIR``, else the user's cache folder. ``MENAGERIE_ROOT`` names a checkout to use instead.
"""

from __future__ import annotations

import difflib
import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softmode.errors import AssetError, ConfigError, MissingExtraError
from softmode.foreign.tokens import SUFFIXES

if TYPE_CHECKING:
    from collections.abc import Sequence

ALIASES = {
    "fr3": "franka_fr3",
    "franka_panda": "franka_emika_panda",
    "iiwa14": "kuka_iiwa_14",
    "kinova_gen3": "kinova_gen3",
    "panda": "franka_emika_panda",
    "robotiq_2f85": "robotiq_2f85",
    "sawyer": "rethink_robotics_sawyer",
    "so100": "trs_so_arm100",
    "so101": "robotstudio_so101",
    "ur10e": "universal_robots_ur10e",
    "ur5e": "universal_robots_ur5e",
    "vx300s": "trossen_vx300s",
    "wx250s": "trossen_wx250s",
    "xarm7": "ufactory_xarm7",
    "yam": "i2rt_yam",
}
"""Short names of Menagerie models."""

ALOHA_ARM = "aloha_arm"
"""The left ViperX 300 of an ALOHA station, from the test data of the installed mujoco-warp: needs no download."""

_CATEGORIES = ("arm", "dual_arm", "end_effector")
"""Categories of the Menagerie that stand on a fixed base."""


@dataclass(frozen=True, kw_only=True)
class RobotAsset:
    """A model on disk and what is known about it."""

    name: str
    """Name of the robot."""
    path: Path
    """The MJCF, URDF or OpenUSD file."""
    root: str | None = None
    """Body whose subtree is the robot, or None for the only one."""
    end_effector: str | None = None
    """Site or body that carries the tool, or None if it is not known."""
    tool_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Tool point in the frame of the end effector [m]."""
    asset_root: Path
    """Folder outside which the file may refer to nothing."""
    root_given: bool = True
    """Whether that was said; otherwise a URDF may also refer to the packages it names."""
    trusted: bool = False
    """Whether it comes from an installed package or from the Menagerie's archives, whose checksums are known."""


def available() -> tuple[str, ...]:
    """Return the names that :func:`softmode.robots.load` knows here, sorted; nothing is downloaded.

    Without the extra ``[robots]`` these are only the models that other installed packages ship.
    """
    names = {ALOHA_ARM} if _aloha_path() is not None else set()
    registry = _registry()
    if registry is not None:
        robots = {robot.name for category in _CATEGORIES for robot in registry.robots(category)}
        names |= robots | {alias for alias, name in ALIASES.items() if name in robots}
    return tuple(sorted(names))


def fetch(names: str | Sequence[str]) -> tuple[Path, ...]:
    """Download models into the cache, so that they load without a network from then on.

    Args:
        names: One name or several.

    Returns:
        The folder of each model.

    Raises:
        AssetError: If a model cannot be downloaded.
        ConfigError: If a name is unknown.
        MissingExtraError: If the extra ``[robots]`` is not installed.
    """
    wanted = (names,) if isinstance(names, str) else tuple(names)
    return tuple(find(name).path.parent for name in wanted)


def names_file(source: str) -> bool:
    """Return whether a text means an MJCF, URDF or OpenUSD file, not a robot by name."""
    return "/" in source or source.lower().endswith((".xml", ".mjcf", ".urdf", *SUFFIXES))


def find(name: str, *, download: bool = True) -> RobotAsset:
    """Return the model that a name stands for, downloading it if it is not in the cache.

    Args:
        name: One of :func:`available`.
        download: Whether a model that is not in the cache may be downloaded.

    Raises:
        AssetError: If the model is neither in the cache nor can be downloaded.
        ConfigError: If the name is unknown.
        MissingExtraError: If the name needs the extra ``[robots]`` and it is not installed.
    """
    if name == ALOHA_ARM:
        return _aloha_arm()
    registry = _registry()
    if registry is None:
        if name in ALIASES or name in ALIASES.values():
            raise MissingExtraError(
                f"robot {name!r} comes from the MuJoCo Menagerie, which is not installed",
                hint="install it with: pip install 'softmode[robots]'",
            )
        raise _unknown(name, available())
    full = ALIASES.get(name, name)
    if full not in registry.names():
        raise _unknown(name, available())
    robot = registry.get(full)
    if robot.category not in _CATEGORIES:
        raise ConfigError(
            f"robot {name!r} is a {robot.category.replace('_', ' ')}, not an arm or a hand on a fixed base",
            hint="softmode.robots.available() lists the names that can be loaded",
        )
    cache = registry.Cache()
    path = _resolve(registry, robot, cache, download) / robot.entry(robot.default_model).file
    # The Panda's hand has no site for its tool point, which lies between the finger pads.
    panda = {"end_effector": "hand", "tool_offset": (0.0, 0.0, 0.1034)} if full == "franka_emika_panda" else {}
    return RobotAsset(name=full, path=path, asset_root=path.parent, trusted=True, **panda)


def _resolve(registry: Any, robot: Any, cache: Any, download: bool) -> Path:
    """Return the folder of a Menagerie model."""
    where = f"MENAGERIE_ROOT={cache.root}" if cache.root else f"the cache {cache.dir}"
    hint = (
        f"run `softmode robots fetch {robot.name}` where there is a network and copy that machine's cache folder here "
        "(or name it in MENAGERIE_CACHE_DIR), set MENAGERIE_ROOT to a checkout of the Menagerie, or give the path of "
        "an MJCF, URDF or OpenUSD file"
    )
    if not cache.root and not cache.is_cached(robot) and not download:
        raise AssetError(f"robot {robot.name!r} is not in {where} and download is off", hint=hint)
    try:
        return cache.resolve(robot)
    except (registry.MenagerieError, OSError) as error:
        raise AssetError(f"robot {robot.name!r} is not in {where} and cannot be fetched: {error}", hint=hint) from error


def _unknown(name: str, known: Sequence[str]) -> ConfigError:
    """Return the error for a name that nobody knows, with the nearest ones."""
    # A part of a name counts as near: "aloha" for "aloha_arm", "panda" for "franka_emika_panda".
    near = [other for other in known if name and name.lower() in other]
    near += [other for other in difflib.get_close_matches(name.lower(), known, n=5, cutoff=0.5) if other not in near]
    hint = f"did you mean {', '.join(repr(other) for other in near[:3])}? " if near else ""
    hint += "softmode.robots.available() lists the names; a file is given as a path that ends in .xml, .urdf or .usd"
    if _registry() is None:
        hint += "; more names come with: pip install 'softmode[robots]'"
    return ConfigError(f"robot {name!r} is unknown", hint=hint)


def _registry() -> Any:
    """Return the module mujoco_menagerie, or None if it is not installed."""
    if importlib.util.find_spec("mujoco_menagerie") is None:
        return None
    import mujoco_menagerie

    return mujoco_menagerie


def _aloha_path() -> Path | None:
    """Return the ALOHA station in the test data of mujoco-warp, or None if this version does not ship it."""
    spec = importlib.util.find_spec("mujoco_warp")
    for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
        path = Path(folder) / "test_data" / "aloha_pot" / "scene.xml"
        if path.is_file():
            return path
    return None


def _aloha_arm() -> RobotAsset:
    """Return the left arm of the ALOHA station."""
    path = _aloha_path()
    if path is None:
        hint = "load 'vx300s', which is the same arm, or give the path of an MJCF, URDF or OpenUSD file"
        raise AssetError(f"robot {ALOHA_ARM!r} is not in the installed mujoco-warp", hint=hint)
    root, end = "left\\base_link", "left\\gripper"
    return RobotAsset(name=ALOHA_ARM, path=path, root=root, end_effector=end, asset_root=path.parent, trusted=True)
