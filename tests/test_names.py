"""Files, modules and functions that docstrings, comments and pages name are there."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("softmode", "tests", "benchmarks", "examples", "docs")
ELSEWHERE = {
    "convert.py": "of antmatter15/splat",
    "newton/tests/test_custom_solver.py": "of Newton",
    "tests/test_press.py": "a reader's own",
    "my_tasks.py": "a reader's own",
    "softmode.envs.tasks.name.task": "any task's",
    "softmode.shop.apples": "made up",
    "observation.images.CAMERA": "a column of data sets",
    "observation.images.front": "a column of data sets",
    "stage.scene.scenery": "stage is a variable",
    "stage.scene.notes": "stage is a variable",
    "other_place_k": "k is a number",
    "other_yaw_k": "k is a number",
    "path_shape_map": "of Newton",
}
"""What is named, but not by its place in this repository."""
PACKAGES = ("kaolin.", "skrl.")
"""Beginnings of other packages' names that a module of softmode shares."""

STRING = re.compile(r'"""(.*?)"""', re.S)
COMMENT = re.compile(r"(?:^|\s)#.*")
FILE = re.compile(r"(?<![\w/.*<>{}-])(?:\./)?((?:[\w-]+/)*\w+\.py)\b")
FOLDER = re.compile(rf"(?<![\w/.-])((?:{'|'.join(ROOMS)})/(?:[\w-]+/)+)(?![\w<*{{])")
DOTTED = re.compile(r"(?<![\w/.@-])(softmode(?:\.\w+)+)(?![\w/-])")
QUOTED = re.compile(r"`[~.]?(\w+(?:\.\w+)+)(?:\([^`]*\))?`")
KERNELS = re.compile(r"(?<![\w/.])(\w+_kernels)\b(?!\.\w)")
WORD = re.compile(r"`([a-z0-9]+(?:_[a-z0-9]+)+)`")
ROLE = re.compile(r":(?:func|class|mod|exc):`[~.]?(\w+)`")
BOUND = re.compile(r"^(?:(?:def|class) (\w+)|(\w[\w, ]*?)(?::[^=\n]*)?=)", re.M)
SUFFIXES = {"py", "npz", "json", "md", "toml", "xml"}


class Code:
    """What Python files define.

    Args:
        sources: Their text, by path.
    """

    def __init__(self, sources: dict[str, str]) -> None:
        """Read the sources."""
        code = {path: COMMENT.sub("", STRING.sub("", text)) for path, text in sources.items()}
        self.files = set(sources)
        self.folders = {folder.as_posix() for path in sources for folder in PurePosixPath(path).parents}
        self.modules: dict[str, list[str]] = {}
        """Paths without suffix, of modules and packages, by their last part."""
        for place in sorted(self.folders | {path.removesuffix(".py") for path in sources}):
            self.modules.setdefault(PurePosixPath(place).name, []).append(place)
        self.names = {path: set(_bound(text)) for path, text in code.items()}
        """What each file defines; of a package all words of its file, which imports by need."""
        own = (names for path, names in self.names.items() if path.startswith("softmode/"))
        self.defined = set(self.modules).union(*own)
        self.names |= {path: set(re.findall(r"\w+", code[path])) for path in code if path.endswith("/__init__.py")}
        self.words = self.defined | {word for text in code.values() for word in re.findall(r"\w+", text)}
        self.pairs = {pair for text in code.values() for pair in re.findall(r"(?=\b_*(\w+\.\w+))", text)}

    def has_file(self, name: str) -> bool:
        """Return whether a path, or the end of one, is that of a file; benchmarks go by their folder's name too."""
        places = self.modules.get(PurePosixPath(name).stem, [])
        known = [f"{place}.py" for place in places if "/" in name or not place.startswith("benchmarks/")]
        return any(path in self.files and f"/{path}".endswith(f"/{name}") for path in known)

    def has_name(self, dotted: str) -> bool:
        """Return whether packages and modules lead to a dotted name, whose first parts may be left out."""
        first, *rest = dotted.split(".")
        return any(self._leads(place, rest) for place in self.modules.get(first, []))

    def _leads(self, place: str, rest: list[str]) -> bool:
        inner = "/".join([place, *rest[:1]])
        if rest and (inner in self.folders or f"{inner}.py" in self.files) and self._leads(inner, rest[1:]):
            return True
        return not rest or any(rest[0] in self.names.get(place + end, ()) for end in (".py", "/__init__.py"))


def _bound(text: str) -> Iterator[str]:
    """Yield the names that a module defines, without what it imports."""
    for name, targets in BOUND.findall(text):
        yield from (part.strip() for part in (name or targets).split(","))


def prose(path: str, text: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of a page, or those of a module's docstrings and comments, with their numbers."""
    if path.endswith(".md"):
        yield from enumerate(text.splitlines(), start=1)
        return
    for match in STRING.finditer(text):
        if not text[text.rfind("\n", 0, match.start()) + 1 : match.start()].strip():
            yield from enumerate(match[1].splitlines(), start=1 + text.count("\n", 0, match.start()))
    for number, line in enumerate(STRING.sub(lambda match: "\n" * match[0].count("\n"), text).splitlines(), start=1):
        yield from ((number, comment) for comment in COMMENT.findall(line))


def missing_names(line: str, code: Code, *, own: bool = True) -> list[str]:
    """Return what a line names that is not there; ``own`` is a line of softmode, where other packages' words are rare.

    A quoted ``solver.status`` may speak of a variable: it counts as a module's if its second part is the name of a
    module, a function or a class, or of nothing at all.
    """
    found = [name for name in FILE.findall(line) if not code.has_file(name)]
    found += [name for name in FOLDER.findall(line) if name.rstrip("/") not in code.folders]
    found += [name for name in (*KERNELS.findall(line), *ROLE.findall(line)) if name not in code.words]
    found += [name for name in WORD.findall(line) if own and name not in code.words]
    for name in (*DOTTED.findall(line), *QUOTED.findall(line)):
        first, second, *_ = name.split(".")
        if first not in code.modules or name.rpartition(".")[2] in SUFFIXES or f"{first}.{second}" in code.pairs:
            continue
        named = first.endswith("_kernels") or first == "softmode" or second in code.defined or second not in code.words
        if named and not code.has_name(name) and not name.startswith(PACKAGES):
            found.append(name)
    return sorted({name for name in found if name not in ELSEWHERE})


def test_what_is_named_is_there() -> None:
    """Every file, module and function that docstrings, comments and pages name exists."""
    paths = [path for room in ROOMS for path in (ROOT / room).rglob("*.py") if path != Path(__file__)]
    files = {path.relative_to(ROOT).as_posix(): path.read_text() for path in paths}
    code = Code(files)
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    files |= {path.relative_to(ROOT).as_posix(): path.read_text() for path in pages}
    found = [
        f"{path}:{number}: {name}"
        for path, text in files.items()
        for number, line in prose(path, text)
        for name in missing_names(line, code, own=path.startswith("softmode/"))
    ]
    assert not found, "\n".join(found)


def test_missing_names_are_seen() -> None:
    """Names are found in docstrings, comments and pages; code, variables and what exists are not."""
    body = '"""See `steps.start`."""\n_C = """\n# `old_steps`\n"""\nx = "# `old_steps`"  # see ``old_kernels``\n'
    code = Code({"softmode/room/steps.py": "def start():\n    steps.begun = flat_place\n", "softmode/room/rows.py": ""})
    lines = [(1, "See `steps.start`."), (5, " # see ``old_kernels``")]
    assert list(prose("softmode/a.py", body)) == lines
    there = "softmode.room.steps softmode/room/ room/steps.py `steps.begun` `room.rows` :func:`start` `flat_place`"
    assert missing_names(there, code) == []
    missing = {
        "softmode.room.stride": "see softmode.room.stride",
        "rows.start": "``rows.start``",
        "steps.stop": "`steps.stop(x)`",
        "room/start.py": "room/start.py",
        "softmode/rooms/": "of softmode/rooms/",
        "step_kernels": "as step_kernels do",
        "stop": ":func:`stop`",
        "steep_place": "`steep_place`",
    }
    assert {name: missing_names(line, code) for name, line in missing.items()} == {name: [name] for name in missing}
