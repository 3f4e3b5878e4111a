"""Checks on a robot file before any importer reads it: it is XML, and it refers to nothing outside its folder.

A robot file names others: meshes, textures, included files. An importer follows ``..``, absolute paths and symbolic
links wherever they lead, so every reference is resolved here first and refused if it leaves the asset root.
"""

from __future__ import annotations

import collections
import functools
import os
import re
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

from softmode.errors import AssetError
from softmode.files import read_file
from softmode.foreign.child.layers import inside
from softmode.foreign.child.model import MAX_PARTS, MAX_SHAPES

_SIZE_LIMIT = 64 * 2**20
"""Largest XML file that is read [bytes]."""
_MARK_LIMIT = 500_000
"""Most elements and attributes of a robot file and all that it includes: each takes a hundred bytes and more."""
_MOST = dict.fromkeys(("key", "body", "link"), MAX_PARTS) | dict.fromkeys(("joint", "geom", "site"), MAX_SHAPES)
"""Most elements of a kind, of which MuJoCo takes seconds for some ten thousands."""
_UNBOUND = 27
"""Expat's number of a prefix that nothing declares."""
_DEPTH_LIMIT = 1000
_REFERENCE_LIMIT = 4096
"""Most references to files."""
_NAN = re.compile(r"(?:^|\s)[+-]?nan\b", re.IGNORECASE)
_FILE_ATTRIBUTES = ("file", "filename", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
_TEXTURE_TAGS = ("texture",)
_NESTED_TAGS = ("include", "model")
"""Elements whose file is itself a model."""
_LEVELS = 8
"""How many folders above a robot file its packages are looked for in."""
_MODEL_FOLDERS = {".urdf": ("urdf", "urdfs", "robots"), ".xml": ("mjcf", "xml", "xmls", "robots")}
"""Names of folders of a package that hold robot files of a kind alone; meshes lie beside them."""


def read_xml(path: Path) -> ElementTree.Element:
    """Parse an XML file.

    Args:
        path: The file.

    Returns:
        Its root element.

    Raises:
        AssetError: If the file is missing, too large or no well-formed XML, declares a document type, is nested too
            deeply, or holds NaN.
    """
    return _parse(path, _MARK_LIMIT)[0]


def _parse(path: Path, left: int) -> tuple[ElementTree.Element, int]:
    """Return the root element of a file, and how many elements and attributes it may have at most, `left` or fewer."""
    data = read_file(
        path, "robot file", limit=_SIZE_LIMIT, hint="give an MJCF (.xml) or URDF (.urdf) file that can be read"
    )
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data or b"\0" in data:  # zeros: UTF-16, which may hide the others
        hint = "remove its <!DOCTYPE>; none is needed, and save it as UTF-8"
        raise AssetError(f"robot file {path} declares a document type, or is no UTF-8", hint=hint)
    marks = data.count(b"<") + data.count(b"=")
    if marks > left:
        hint = f"at most {_MARK_LIMIT} elements and attributes are read, of all files together"
        raise AssetError(f"robot file {path} has too many elements", hint=hint)
    try:
        try:
            tree = ElementTree.fromstring(data)
        except ElementTree.ParseError as error:
            if error.code != _UNBOUND or path.suffix.lower() != ".urdf":  # MuJoCo reads an MJCF itself
                raise
            # Attributes of other programs, such as drake:acceleration, whose prefix nothing declares.
            tree = ElementTree.fromstring(re.sub(rb"([\s</])(\w+):(\w[\w.-]*\s*[=\s/>])", rb"\1\2.\3", data))
    except (ElementTree.ParseError, ValueError) as error:
        line = error.position[0] if isinstance(error, ElementTree.ParseError) else 1
        raise AssetError(f"robot file {path}, line {line}: {error}", hint="mend the XML at that line") from error
    level, depth = [tree], 0
    while level:
        level, depth = [child for element in level for child in element], depth + 1
        if depth > _DEPTH_LIMIT:
            raise AssetError(f"robot file {path} is nested deeper than {_DEPTH_LIMIT} levels", hint="flatten it")
    counts = collections.Counter(element.tag for element in tree.iter())
    for tag, most in _MOST.items():
        if counts[tag] > most:
            text = f"robot file {path} has {counts[tag]} <{tag}>, at most {most} are read"
            raise AssetError(text, hint="give the robot alone, without the scene around it")
    for element in tree.iter():
        for name, value in element.attrib.items():
            if "nan" in value.lower() and _NAN.search(value) and "name" not in name:  # MuJoCo reads it as nothing
                text = f"robot file {path}: <{element.tag}> has {name}={value[:80]!r}"
                raise AssetError(text, hint="give a number in place of NaN")
    return tree, marks


def check_references(path: Path, root: Path) -> int:
    """Check that an MJCF file and all that it includes exist and lie in a folder, and so do their assets.

    Args:
        path: The file.
        root: The asset root. Symbolic links are followed before the comparison.

    Returns:
        The size of all files that it refers to [bytes].

    Raises:
        AssetError: If a reference leaves the folder or leads nowhere, or a file is broken.
    """
    trees: list[tuple[Path, ElementTree.Element, int]] = []
    _collect(path, path.parent, root, trees, ())
    files, count = {file for file, _, _ in trees}, 0
    compilers = [element for _, tree, _ in trees for element in tree.iter("compiler")]

    def folders(*names: str) -> list[str]:
        found = [value for name in names for c in compilers if (value := c.get(name)) is not None]
        return found or [""]

    meshes, textures = folders("meshdir", "assetdir"), folders("texturedir", "assetdir", "meshdir")
    strip = any(compiler.get("strippath", "false").lower() == "true" for compiler in compilers)
    for file, tree, _ in trees:
        for element in tree.iter():
            if element.tag in _NESTED_TAGS:
                continue
            for attribute in _FILE_ATTRIBUTES:
                value = element.get(attribute)
                if not value:
                    continue
                if strip:
                    value = PurePosixPath(value.replace("\\", "/")).name
                places = textures if element.tag in _TEXTURE_TAGS else meshes
                joined = [str(PurePosixPath(folder) / value) for folder in dict.fromkeys([*places, ""])]
                count += 1
                check_count(count, path)
                files.add(resolve_inside(joined, [path.parent, file.parent], root, file, f"<{element.tag}>"))
    return sum(file.stat().st_size for file in files)


def check_count(count: int, path: Path) -> None:
    """Refuse a robot file that refers to too many files."""
    if count > _REFERENCE_LIMIT:
        raise AssetError(f"robot file {path} refers to more than {_REFERENCE_LIMIT} files", hint="flatten the model")


def resolve_inside(values: list[str], bases: list[Path], root: Path, file: Path, tag: str) -> Path:
    """Return the file that a reference means, the first spelling that exists from one of the base folders.

    Raises:
        AssetError: If the reference is absolute or a URL, leaves ``root``, or leads nowhere.
    """
    asked = values[-1]
    if any("://" in value for value in values) or asked.startswith("file:"):
        raise AssetError(
            f"{file}: {tag} refers to {asked!r}", hint="refer to files by relative paths; nothing is fetched"
        )
    if any(PurePosixPath(value).is_absolute() or "\\" in value or ":" in value for value in values):
        raise AssetError(f"{file}: {tag} refers to {asked!r}", hint="use a relative path with forward slashes")
    candidates = [(base / value).resolve() for value in values for base in dict.fromkeys(bases)]
    # What an importer would open is the first that exists, whichever rule it follows: none of them may be outside.
    existing = [candidate for candidate in candidates if candidate.exists()]
    outside = [candidate for candidate in existing or candidates if not inside(str(candidate), str(root))]
    if outside:
        hint = (
            f"copy the file into the folder, or pass asset_root={_common(file, outside) or 'the folder of the robot'}"
        )
        raise AssetError(f"{file}: {tag} refers to {asked!r}, which lies outside the asset root {root}", hint=hint)
    if not existing:
        found = next((up for up in list(file.resolve().parents)[:6] for value in values if (up / value).exists()), None)
        hint = f"pass asset_root={found}" if found else "put the file in its place, or pass asset_root= its folder"
        raise AssetError(f"{file}: {tag} refers to {asked!r}, which does not exist in {root}", hint=hint)
    if not existing[0].is_file():
        raise AssetError(f"{file}: {tag} refers to {asked!r}, which is no file", hint="name a file")
    return existing[0]


def resolve_package(whole: str, file: Path, root: Path, given: bool) -> Path:
    """Return the file that a reference `package://NAME/PATH` means.

    It is looked for in the asset root, and in the folder of the package: one above the file or beside what lies above
    it, whose `package.xml` has that name, or which has that name and a `package.xml`.

    Args:
        whole: What stands behind `package://`.
        file: The robot file.
        root: The asset root.
        given: Whether the caller named the asset root: nothing outside is then looked at.

    Raises:
        AssetError: If it leaves its folder or leads nowhere.
    """
    name, _, rest = whole.partition("/")
    folder = package_folder(name, rest, file)
    if folder is not None and not given:
        return resolve_inside([rest], [folder], folder, file, "<mesh>")
    bases = [root]
    if folder is not None and folder.is_relative_to(root.resolve()):
        bases.append(folder)
    return resolve_inside([whole, rest], bases, root, file, "<mesh>")


def package_folder(name: str, rest: str, file: Path) -> Path | None:
    """Return the folder of a package that a robot file names and that holds `rest`; None if there is none."""
    if name in ("", ".", ".."):
        return None
    for up in list(file.resolve().parents)[:_LEVELS]:
        for folder in (up / name, up):
            found = _package_name(folder)
            if (found == name or (found is not None and folder.name == name)) and (folder / rest).exists():
                return folder
    return None


def default_root(file: Path) -> Path:
    """Return the folder that a robot file may refer to: its own, or the one above if its own is for such files alone.

    An MJCF file, which names no packages, may refer to the folder further above that has a `package.xml`.
    """
    folder, urdf = file.parent, file.suffix.lower() == ".urdf"
    if not urdf:
        for up in list(folder.parents)[:_LEVELS]:
            if (up / "package.xml").is_file():
                return up
    return folder.parent if folder.name in _MODEL_FOLDERS[".urdf" if urdf else ".xml"] else folder


def _package_name(folder: Path) -> str | None:
    """Return the name that a folder's package.xml says."""
    file = folder / "package.xml"
    return _named(file, file.stat().st_mtime_ns) if file.is_file() else None


@functools.lru_cache(64)
def _named(file: Path, _: int) -> str | None:
    """Return the name that a package.xml of some time says."""
    try:
        name = read_xml(file).findtext("name")
    except AssetError:
        return None
    return None if name is None else name.strip()


def _common(file: Path, outside: list[Path]) -> Path | None:
    """Return the folder that holds the robot file and what it refers to, unless that is all of the disk."""
    shared = Path(os.path.commonpath([file.resolve().parent, *outside]))
    return shared if len(shared.parts) > 2 else None


def _collect(
    file: Path, main: Path, root: Path, trees: list[tuple[Path, ElementTree.Element, int]], above: tuple[Path, ...]
) -> None:
    """Append a file and what it includes, with their elements."""
    real = file.resolve()
    if real in above:
        raise AssetError(f"{file} includes itself", hint="break the circle of <include> elements")
    tree, marks = _parse(file, _MARK_LIMIT - sum(marks for _, _, marks in trees))
    trees.append((file, tree, marks))
    if len(trees) > 1000:
        raise AssetError(f"{file} includes more than 1000 files", hint="flatten the model")
    for tag in _NESTED_TAGS:
        for element in tree.iter(tag):
            value = element.get("file")
            if value:
                nested = resolve_inside([value], [main, file.parent], root, file, f"<{tag}>")
                _collect(nested, main, root, trees, (*above, real))
