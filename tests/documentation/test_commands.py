"""Command lines of the pages are such as the programs take; files, modules and names that pages mention exist."""

from __future__ import annotations

import importlib
import importlib.util
import itertools
import re
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.documentation.pages import PAGES, ROOT, command_lines, prose
from tests.needs import needs

pytestmark = needs("tyro")


@pytest.fixture
def parse(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The command line of softmode, which reads its arguments and does nothing."""
    import tyro

    from softmode.cli import main as cli

    real = tyro.cli

    def parse_only(*arguments: Any, **options: Any) -> Any:
        real(*arguments, **options)
        return SimpleNamespace(run=lambda: 0)

    monkeypatch.setattr(tyro, "cli", parse_only)
    return cli.main


def _check(words: list[str], parse: Any) -> None:
    """Check one command line, word by word."""
    while words and re.fullmatch(r"\w+=.*", words[0]):  # variables of the environment
        words = words[1:]
    program, *rest = words
    if program == "torchrun":
        rest = rest[rest.index("-m") :]
        program = "python"
    if program == "python" and rest[:2] in (["-m", "softmode"], ["-m", "softmode.cli.main"]):
        program, rest = "softmode", rest[2:]
    if program == "softmode":
        assert parse(rest) == 0
    elif program == "python" and rest[0] == "-m":
        assert rest[1] in ("pytest", "pip", "venv") or importlib.util.find_spec(rest[1]), f"no module {rest[1]}"
    elif program == "python" and rest[0] != "-c":
        assert (ROOT / rest[0]).is_file(), f"no file {rest[0]}"
    elif program == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M)
        assert all(word in targets or "=" in word for word in rest), f"make has no target {rest}"
    else:
        foreign = ("hf", "lerobot-eval", "lerobot-train", "ray")  # tests of LeRobot and of clusters run them
        assert program in ("pip", "export", "cp", "cd", "git", "source", *foreign), f"unknown program {program!r}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_command_lines(page: Path, parse: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """Every command line of a block parses, and what it runs exists."""
    for line in command_lines(page):
        try:
            _check(shlex.split(line), parse)
        except SystemExit as end:
            assert end.code == 0, f"{line}\n{capsys.readouterr().err}"
        except AssertionError as error:
            raise AssertionError(f"{line}: {error}") from error


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_in_prose(page: Path, parse: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """A command that the text mentions, in part or in full, is one, and has the options that are mentioned with it."""
    for span in re.findall(r"`((?:softmode|python|make) [^`]+)`", prose(page)):
        words = shlex.split(span.replace("[", "").replace("]", ""))
        if words[0] != "softmode":
            _check(words, parse)
            continue
        names = list(itertools.takewhile(re.compile(r"[a-z-]+").fullmatch, words[1:]))
        names = [name for name in names if not name.startswith("-")]
        text = None
        while names and text is None:
            try:
                parse([*names, "--help"])
            except SystemExit as end:
                text = capsys.readouterr().out if end.code == 0 else None
                names.pop()
        assert text is not None, f"{span}: no such command"
        for option in (word.partition("=")[0] for word in words if word.startswith("--")):
            assert re.search(rf"(?<![\w-]){option}(?![\w-])", text), f"{span}: no option {option}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_files_and_names(page: Path) -> None:
    """Paths and dotted names in code spans lead somewhere, and so do relative links."""
    text = prose(page)
    for path in re.findall(r"`((?:softmode|tests|examples|benchmarks|docs|policies)/[\w./]+\.\w+)`", text):
        assert (ROOT / path).exists(), f"{page.name} mentions {path}, which does not exist"
    for name in re.findall(r"`(softmode(?:\.\w+)+)(?:\(\))?`", text):
        assert _resolves(name), f"{page.name} mentions {name}, which does not exist"
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (page.parent / target).exists(), f"{page.name} links to {target}, which does not exist"


def _resolves(name: str) -> bool:
    """Return whether a dotted name is a module or an attribute of one."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            if not hasattr(found, part):
                return part in getattr(found, "__dataclass_fields__", {})
            found = getattr(found, part)
        return True
    return False
