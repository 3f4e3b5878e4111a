"""Meshes of a URDF: the file that a reference means, and a copy of it that MuJoCo and Newton read."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from softmode.deformables.reduction.cache import cache_directory, fingerprint_of, is_trusted, writable_cache
from softmode.errors import AssetError, MissingExtraError, needs_extra
from softmode.files import damage_errors, whole_file
from softmode.foreign import process
from softmode.robots.assets import RobotAsset
from softmode.robots.references import check_count, resolve_inside, resolve_package

_READ = (".stl", ".obj", ".msh")
"""Suffixes that MuJoCo reads."""
_CONVERTED = (".dae", ".ply", ".glb", ".off", ".stl")
"""Suffixes that are read here, and written as one that MuJoCo reads."""
_STL_FACES = 200_000
"""Most triangles that MuJoCo reads from an STL file."""


def use_meshes(tree: ElementTree.Element, asset: RobotAsset) -> list[str]:
    """Put whole paths of files that MuJoCo reads in place of the meshes that a URDF refers to.

    A mesh of another kind is converted once and kept in the cache. What is only there to be seen and cannot be read is
    left out.

    Args:
        tree: The URDF, which is changed.
        asset: Where it lies.

    Returns:
        Notes: what was left out.

    Warns:
        UserWarning: If something was left out; it names the files.

    Raises:
        AssetError: If a reference leaves the asset root, a mesh is missing, or one that collides cannot be read.
        MissingExtraError: If a mesh that collides is a Collada file, and the package that reads those is missing.
    """
    left: dict[str, str] = {}
    found: dict[str, str] = {}

    def place(mesh: ElementTree.Element) -> None:
        """Put the path of a file that MuJoCo reads into a mesh."""
        name = mesh.get("filename", "")
        if name not in found:
            check_count(len(found) + 1, asset.path)
            found[name] = str(_readable(_resolve(name, asset), asset))
        mesh.set("filename", found[name])

    for link in tree.iter("link"):
        for mesh in link.findall("collision/geometry/mesh"):
            place(mesh)
        for visual in link.findall("visual"):
            mesh = visual.find("geometry/mesh")
            if mesh is None:
                continue
            name = mesh.get("filename", "")
            try:
                place(mesh)
            except (AssetError, MissingExtraError) as error:
                if name.lower().endswith(_READ) and not isinstance(error, _UnreadableError):
                    raise
                left[name] = error.hint if isinstance(error, MissingExtraError) else error.message
                link.remove(visual)
    if not left:
        return []
    names = ", ".join(Path(name).name for name in left)
    note = f"left out, as they are only seen and cannot be read: {names}; of the first: {next(iter(left.values()))}"
    warnings.warn(f"robot file {asset.path}: meshes {note}", stacklevel=6)
    return [note]


class _UnreadableError(AssetError):
    """A mesh that is there and cannot be read."""


def _resolve(value: str, asset: RobotAsset) -> Path:
    """Return the file that a mesh of a URDF means."""
    if value.startswith("package://"):
        return resolve_package(value.removeprefix("package://"), asset.path, asset.asset_root, asset.root_given)
    return resolve_inside([value], [asset.path.parent], asset.asset_root, asset.path, "<mesh>")


def _readable(file: Path, asset: RobotAsset) -> Path:
    """Return a file that MuJoCo reads: the one that is given, or what it was converted into."""
    suffix = file.suffix.lower()
    if suffix in _READ and not (suffix == ".stl" and _needs_conversion(file)):
        return file
    if suffix not in _CONVERTED:
        hint = f"convert it to .stl or .obj; read are {', '.join(sorted({*_READ, *_CONVERTED}))}"
        raise _UnreadableError(f"robot file {asset.path}: mesh {file} is of an unknown kind", hint=hint)
    name = fingerprint_of("robot mesh 1", suffix, file)
    folder = cache_directory() / "robot_meshes"
    for made in (folder / f"{name}.stl", folder / f"{name}.obj"):
        if is_trusted(made):
            return made
    mesh = _read(file, asset)
    made = writable_cache(folder) / f"{name}{'.stl' if len(mesh.faces) <= _STL_FACES else '.obj'}"
    data = mesh.export(file_type=made.suffix[1:])
    with whole_file(made, "mesh") as target:
        target.write(data if isinstance(data, bytes) else data.encode())
    return made


def _needs_conversion(file: Path) -> bool:
    """Return whether an STL file is text, or larger than what MuJoCo reads."""
    size = file.stat().st_size
    with file.open("rb") as source:
        head = source.read(84)
    count = int.from_bytes(head[80:84], "little")
    return len(head) == 84 and (count > _STL_FACES or size < 84 + 50 * count) and size > 84


def _read(file: Path, asset: RobotAsset) -> Any:
    """Return all surfaces of a file as one mesh, in the unit and the axes that robots take: metres, as they are."""
    import trimesh

    if file.suffix.lower() == ".dae":
        with needs_extra("robots", f"robot file {asset.path}: mesh {file} is a Collada file, which pycollada reads"):
            import collada  # noqa: F401  # pyright: ignore[reportMissingImports]
    name = f"robot file {asset.path}: mesh {file}"
    try:
        with damage_errors(name):
            points, faces = process.read("mesh", file, name=name, want="surface").arrays
            mesh = trimesh.Trimesh(points, faces, process=False)
    except AssetError as error:
        raise _UnreadableError(error.message, hint="export it again, or convert it to .stl or .obj") from error
    if not len(faces):
        raise _UnreadableError(f"{name} holds no surface", hint="export it again")
    return mesh
