"""The files at the door: workflows, forms, citation, and what the page for contributors names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import softmode
from tests.documentation.pages import ROOT

yaml = pytest.importorskip("yaml", reason="needs PyYAML, which pre-commit brings")

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
OWNERS = {"actions", "pypa"}
"""Whose actions the workflows may use."""
DOOR = [
    *(ROOT / name for name in ("CONTRIBUTING.md", "SECURITY.md", "CODE_OF_CONDUCT.md", "CITATION.cff")),
    *WORKFLOWS,
    *FORMS,
    ROOT / ".github" / "pull_request_template.md",
    ROOT / "pyproject.toml",
]


def parsed(path: Path) -> Any:
    """Return the content of a YAML file; YAML 1.1 reads the key `on` as True."""
    return yaml.safe_load(path.read_text())


def steps(workflow: Any) -> list[dict[str, Any]]:
    """Return the steps of all jobs."""
    return [step for job in workflow["jobs"].values() for step in job["steps"]]


def targets(text: str) -> set[str]:
    """Return the words behind `make` in commands."""
    return set(re.findall(r"\bmake ((?:\.venv/)?\.?[a-z][a-z-]*)", text))


def known_targets() -> set[str]:
    """Return the targets of the Makefile, files among them."""
    text = (ROOT / "Makefile").read_text()
    return set(re.findall(r"^([a-z-]+):", text, re.M)) | {
        f".venv/{name}" for name in re.findall(r"^\$\(VENV\)/(\.\w+):", text, re.M)
    }


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows(path: Path) -> None:
    """A workflow parses, says when it runs, reads the repository by default, and runs targets that exist.

    Actions come from known owners and are pinned to a version.
    """
    workflow = parsed(path)
    assert workflow["name"] == path.stem and workflow[True]
    assert workflow["permissions"] == {"contents": "read"}
    for step in steps(workflow):
        assert ("run" in step) != ("uses" in step)
        assert targets(step.get("run", "")) <= known_targets()
        if "uses" in step:
            owner, version = re.fullmatch(r"([\w-]+)/[\w-]+@(v\d+|release/v1)", step["uses"]).groups()  # type: ignore[union-attr]
            assert owner in OWNERS and version


def test_workflows_cover_what_is_promised() -> None:
    """Lint and tests on four versions of Python; a scheduled run of the newest that may fail; a site; a release."""
    found = {path.stem: parsed(path) for path in WORKFLOWS}
    assert set(found) == {"tests", "newest", "docs", "release"}
    assert found["tests"]["jobs"]["test"]["strategy"]["matrix"]["python"] == ["3.11", "3.12", "3.13", "3.14"]
    run = {word for step in steps(found["tests"]) for word in targets(step.get("run", ""))}
    assert run == {"lint", "test", "test-rest"}
    assert found["newest"][True]["schedule"] and found["newest"]["jobs"]["test"]["continue-on-error"] is True
    assert found["release"][True] == {"push": {"tags": ["v*"]}}
    for name in ("docs", "release"):  # the jobs that publish, and no others, get a token
        jobs = found[name]["jobs"]
        assert [job for job in jobs if jobs[job].get("permissions", {}).get("id-token") == "write"] == ["publish"]


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_forms(path: Path) -> None:
    """A form has a name, a description, and fields with labels and identifiers that are unlike."""
    form = parsed(path)
    if path.stem == "config":
        assert set(form) <= {"blank_issues_enabled", "contact_links"}
        return
    assert form["name"] and form["description"]
    fields = [field for field in form["body"] if field["type"] != "markdown"]
    assert len({field["id"] for field in fields}) == len(fields) >= 3
    assert all(field["attributes"]["label"] for field in fields)


def test_citation() -> None:
    """CITATION.cff has what CFF 1.2.0 requires, the version of the package, and the three papers by identifier."""
    citation = parsed(ROOT / "CITATION.cff")
    assert {"cff-version", "message", "title", "authors"} <= set(citation) and citation["cff-version"] == "1.2.0"
    assert citation["authors"] == [{"name": "softmode developers"}]
    assert citation["version"] == softmode.__version__
    assert len(citation["references"]) == 3
    for reference in citation["references"]:
        assert reference["title"] and reference["authors"] and reference["type"]
        (identifier,) = reference["identifiers"]
        assert re.fullmatch(r"arXiv:\d{4}\.\d{5}", identifier["value"])
        assert reference["url"].endswith(identifier["value"].removeprefix("arXiv:"))


def test_changelog_names_the_version() -> None:
    """The newest release of the changelog is the version of the package, and its date that of the citation."""
    text = (ROOT / "CHANGELOG.md").read_text()
    version, date = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d{2}-\d{2})$", text, re.M)[0]
    assert version == softmode.__version__
    assert date == str(parsed(ROOT / "CITATION.cff")["date-released"])


@pytest.mark.parametrize("path", DOOR, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_no_invented_addresses(path: Path) -> None:
    """No e-mail address, no placeholder, and no address but those of the papers; the marked one is a comment."""
    text = path.read_text()
    assert not re.search(r"\b[\w.+-]+@[\w-]+\.(?!yml)[a-z]{2,}\b", text)
    assert not re.search(r"example\.(?:com|org)|your[-_](?:org|name|repo)|\bTODO\b|<owner>", text, re.I)
    assert all(address.startswith("arxiv.org/abs/") for address in re.findall(r"https?://(\S+?)[\"')\s]", text))
    if path.name == "pyproject.toml":
        (line,) = re.findall(r"^.*\[project\.urls\]$", text, re.M)
        assert line.startswith("# ") or not re.search(r'^\w+ = ""$', text.partition(line)[2], re.M)


def test_contributing_names_what_exists() -> None:
    """Files that CONTRIBUTING.md names exist: by path, or by name where no folder stands before it; so do targets."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    names = {path.name for folder in ("softmode", "tests") for path in (ROOT / folder).rglob("*.py")}
    spans = re.findall(r"`([\w./<>-]+)`", text)
    paths = [span for span in spans if re.search(r"\.(?:py|md|toml)$", span) or span.endswith("/")]
    assert len(paths) > 30
    absent = [
        span
        for span in paths
        if span not in names  # <task> and <format> stand for any
        and not any(list(base.glob(re.sub(r"<\w+>", "*", span))) for base in (ROOT, ROOT / "softmode"))
    ]
    assert not absent, absent
    assert targets(text) <= known_targets()
