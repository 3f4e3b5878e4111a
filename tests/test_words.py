"""Words that the code used for itself alone, and that the field's words have replaced, do not come back."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
REPLACED = {
    "judge_world": "check_convergence",
    "begin_world_search": "start_line_search",
    "finish_world": "accept_step",
    "kept_for": "the key of the cached Hessian",
    "hessian_recipe": "the key of the cached Hessian",
}
"""Words of the past, and what to write instead."""


def replaced_words(text: str) -> list[str]:
    """Return the words of the past that a text has, alone or as parts of longer names."""
    words = {part for name in re.findall(r"\w+", text) for part in (name, name.strip("_"))}
    return sorted(word for word in REPLACED if any(re.search(rf"(^|_){word}(_|$)", name) for name in words))


def test_no_replaced_word_comes_back() -> None:
    """Neither code nor pages use a word that was replaced."""
    files = [path for room in ("softmode", "tests", "benchmarks", "examples") for path in (ROOT / room).rglob("*.py")]
    files += [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    found = {
        path.relative_to(ROOT).as_posix(): [f"{word}: write {REPLACED[word]}" for word in words]
        for path in files
        if path != Path(__file__) and (words := replaced_words(path.read_text()))
    }
    assert not found


def test_replaced_words_are_seen() -> None:
    """A word is found as a name, as a part of one, and in prose, and not inside another word."""
    assert replaced_words("_judge_world(x); kept_for_all = 1  # a hessian_recipe") == [
        "hessian_recipe",
        "judge_world",
        "kept_for",
    ]
    assert not replaced_words("judge_worlds, unkept_form")
