"""The tables of a `.ply` file of any kind: ASCII or binary, either byte order, with lists or without."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from softmode.splats.formats.common import check_count, read_exactly, unreadable

_HEADER_LIMIT = 64 * 1024
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass(frozen=True, kw_only=True)
class Element:
    """One element of a header: a table of `count` rows."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    """Name and type of each property; a list's type is that of its entries."""
    lists: dict[str, str] = field(default_factory=dict)
    """The type of the count of each list."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """The columns, without lists."""
        return np.dtype([(name, kind) for name, kind in self.properties if name not in self.lists])

    def in_doubles(self) -> Element:
        """Return this with doubles in place of all types, as text is read."""
        return replace(self, properties=[(n, "f8") for n, _ in self.properties], lists=dict.fromkeys(self.lists, "f8"))


@dataclass(frozen=True)
class Header:
    """What a file says of itself."""

    form: str
    """One of "ascii", "binary_little_endian" and "binary_big_endian"."""
    elements: dict[str, Element]
    """Its tables in their order."""
    offset: int
    """Where the data begin [bytes]."""

    def unread(self, used: tuple[str, ...]) -> list[str]:
        """Return a note on the elements that are not among those used, none if there are none."""
        left = [f"{element.count} {name}" for name, element in self.elements.items() if name not in used]
        left = [name for name in left if not name.startswith("0 ")]
        return [f"elements that are not read: {', '.join(left[:8])}"] if left else []

    @property
    def kind(self) -> str:
        """What it holds: "splats" (scales and rotations), "mesh" (faces) or "points"."""
        columns = [{name for name, _ in element.properties} for element in self.elements.values()]
        if any({"scale_0", "rot_0"} <= names or "packed_position" in names for names in columns):
            return "splats"
        face = self.elements.get("face")
        return "mesh" if face is not None and face.count else "points"


def read_header(file: BinaryIO, name: str) -> Header:
    """Return the header of an open file.

    Raises:
        AssetError: If there is none, or it contradicts itself.
    """
    head = file.read(_HEADER_LIMIT)
    match = re.search(rb"(?:^|\n)end_header\r?\n", head)
    if not head.startswith(b"ply") or match is None:
        raise unreadable(name, f"no PLY header within {_HEADER_LIMIT} bytes")
    elements: list[Element] = []
    form = ""
    for line in head[: match.start()].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3:
            form = words[1]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) <= 12:
            elements.append(Element(name=words[1], count=int(words[2])))
        elif (
            words[0] == "property"
            and elements
            and (len(words) == 3 or (len(words) == 5 and words[1] == "list"))
            and all(word in _TYPES for word in words[1:-1] if word != "list")
        ):
            last = elements[-1]
            if any(words[-1] == known for known, _ in last.properties):
                raise unreadable(name, f"property {words[-1][:80]} is declared twice")
            order = _ORDERS.get(form, "=")
            last.properties.append((words[-1], order + _TYPES[words[-2]]))
            if len(words) == 5:
                last.lists[words[-1]] = order + _TYPES[words[2]]
        else:
            raise unreadable(name, f"unreadable header line {line[:80]!r}")
    if form not in _ORDERS:
        raise unreadable(name, f"format {form or 'missing'!r}, expected {', '.join(_ORDERS)}")
    if any(element.count and not element.properties for element in elements):
        raise unreadable(name, "an element without properties")
    if len({element.name for element in elements}) != len(elements):
        raise unreadable(name, f"elements {[element.name for element in elements][:8]}, one of them twice")
    return Header(form, {element.name: element for element in elements}, match.end())


def read_tables(file: BinaryIO, header: Header, wanted: Sequence[str], path: Path) -> dict[str, NDArray[Any]]:
    """Return the wanted tables without their lists; what stands before them is skipped, what follows is not looked at.

    Args:
        file: The open file.
        header: From `read_header`.
        wanted: Names of elements; one that is not there is left out.
        path: The file, for messages.

    Raises:
        AssetError: If the file is shorter than its header says, or longer where that can be told.
    """
    elements, size = header.elements, os.fstat(file.fileno()).st_size
    if not any(element.lists for element in elements.values()) and header.form != "ascii":
        declared = header.offset + sum(element.count * element.dtype.itemsize for element in elements.values())
        if size != declared:
            counts = ", ".join(f"{element.count} {element.name}" for element in list(elements.values())[:8])
            raise unreadable(path, f"header declares {counts} and {declared} bytes, the file holds {size}")
    file.seek(header.offset)
    data, at, text = read_exactly(file, size - header.offset, path), 0, header.form == "ascii"
    if text:
        data = _numbers(data, path).tobytes()
    left = [name for name in elements if name in wanted]
    tables: dict[str, NDArray[Any]] = {}
    for element in elements.values():
        if left:
            table, at = _take(data, at, element.in_doubles() if text else element, path)
            if element.name in left:
                left.remove(element.name)
                with np.errstate(over="ignore", invalid="ignore"):
                    tables[element.name] = table.astype(element.dtype.newbyteorder("="), copy=False)
    return tables


def _numbers(data: bytes, path: Path) -> NDArray[np.float64]:
    """Return all numbers of a text."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # what older NumPy does about text that is no number
            return np.fromstring(data.decode("ascii", "replace"), sep=" ")
    except (ValueError, DeprecationWarning) as error:
        raise unreadable(path, "holds text that is no number") from error


def _take(data: bytes, at: int, element: Element, path: Path) -> tuple[NDArray[Any], int]:
    """Return the table of an element that begins at some byte, without its lists, and where it ends."""
    short = unreadable(path, f"header declares {element.count} {element.name}, the file holds fewer")
    steps = [(np.dtype(kind), np.dtype(element.lists.get(name, kind))) for name, kind in element.properties]
    if at + element.count * sum(first.itemsize for _, first in steps) > len(data):
        raise short
    if not element.lists:
        return np.frombuffer(data, element.dtype, element.count, at), at + element.count * element.dtype.itemsize
    starts = np.empty((element.count, len(steps)), np.int64)
    is_list = [name in element.lists for name, _ in element.properties]
    for row in range(element.count):
        for column, (kind, first) in enumerate(steps):
            starts[row, column] = at
            at += first.itemsize
            if at > len(data):
                raise short
            if is_list[column]:
                entries = np.frombuffer(data, first, 1, at - first.itemsize)[0]
                if not 0 <= entries <= len(data):
                    raise unreadable(path, f"a list of {entries} entries")
                at += int(entries) * kind.itemsize
    if at > len(data):
        raise short
    table, octets = np.empty(element.count, element.dtype), np.frombuffer(data, np.uint8)
    for column, (name, kind) in enumerate(element.properties):
        if not is_list[column]:
            table[name] = octets[starts[:, column, None] + np.arange(steps[column][0].itemsize)].view(kind)[:, 0]
    return table, at


def check_rows(header: Header, name: str, path: Path) -> Element:
    """Return an element that is needed, whose number of rows may be read.

    Raises:
        AssetError: If it is not there, or empty, or too long.
    """
    if name not in header.elements:
        raise unreadable(
            path,
            f"elements {list(header.elements)[:8]}, expected {name!r}",
            hint="Only .ply files of splats, points and meshes can be read; export it again as one",
        )
    check_count(header.elements[name].count, str(path))
    return header.elements[name]
