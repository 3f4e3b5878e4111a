"""The plug-in in pytest runs of its own, in a subprocess: what it loads, its marker, its options and its report."""

from __future__ import annotations

import os
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from tests.documentation.pages import fences

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def installed(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    """Return a folder in which pytest finds the plug-in by its entry point, as after an installation."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]["pytest11"]
    info = pytester.mkdir("site") / "softmode_checkout-0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: softmode-checkout\nVersion: 0\n")
    lines = [f"{name} = {module}" for name, module in scripts.items()]
    (info / "entry_points.txt").write_text("\n".join(["[pytest11]", *lines]))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(info.parent)]))
    return pytester


OTHERS = """
import sys
import pytest

@pytest.fixture
def episode():
    return "theirs"

@pytest.fixture
def golden(episode):
    return episode

@pytest.mark.episodes(3)
def test_episodes(episode, golden, record_property):
    assert episode == golden == "theirs"
    record_property("episodes", "theirs")

def test_light(pytestconfig):
    assert not {"softmode", "gymnasium", "numpy"} & set(sys.modules)
    assert pytestconfig.getoption("--episodes-dir") == "theirs"
"""
ONCE = """
def test_once(episode):
    pass

def test_now(softmode_episode):
    assert softmode_episode.seed == 0
"""
CONFTEST = """
def pytest_addoption(parser):
    parser.addoption("--episodes-dir", default="theirs")
"""


def test_other_projects_do_not_notice_it(installed: pytest.Pytester) -> None:
    """Its import brings nothing; markers, fixtures and options of the short names are theirs, or missing with a hint.

    A project that used the short names once is told the new ones; without the plug-in it has neither.
    """
    installed.makeini("[pytest]\nmarkers = episodes: theirs")
    installed.makeconftest(CONFTEST)
    installed.makepyfile(test_others=OTHERS, test_once=ONCE)
    result = installed.runpytest_subprocess("-W", "error", "--strict-markers", "--strict-config")
    result.assert_outcomes(passed=3, errors=1)
    result.stdout.fnmatch_lines(
        ["*fixture 'episode' not found*", "*called softmode_episode*softmode_short_names = true*"]
    )
    result.stdout.no_fnmatch_line("*softmode: episodes*")
    installed.runpytest_subprocess("-p", "no:softmode").assert_outcomes(passed=2, errors=2)


MARKED = """
import pytest

def coin(episode, bad):
    assert episode.seed not in bad, "tails"

@pytest.mark.softmode_episodes(20, min_success=0.9)
def test_enough(softmode_episode):
    coin(softmode_episode, range(4))

@pytest.mark.episodes(20, min_success=0.9)
def test_too_few(episode):
    coin(episode, range(5))

@pytest.mark.episodes(40, min_success=0.9, proven=True, first_seed=100)
def test_proven(episode):
    assert episode.seed >= 100

@pytest.mark.episodes(40, min_success=0.9, proven=True)
def test_not_proven(episode):
    coin(episode, [7])

def test_short(soft_env, golden):
    pass

@pytest.mark.episodes(3)
def test_all(episode):
    coin(episode, [2])

@pytest.mark.episodes(20, min_success=0.9, proven=True)
def test_cannot_be_proven(episode):
    pass

@pytest.mark.episodes(3)
def test_without_the_fixture():
    pass

@pytest.mark.episodes(3)
def test_an_error_is_no_lost_episode(episode):
    raise RuntimeError("broken")
"""


def test_the_marker_judges_by_wilsons_interval(installed: pytest.Pytester) -> None:
    """16 of 20 (58 to 92 %) leave 90 % open, 15 (53 to 89 %) do not; 40 of 40 (91 to 100 %) prove it, 39 do not.

    One line of the settings makes the short names the same.
    """
    installed.makeini("[pytest]\nsoftmode_short_names = true")
    installed.makepyfile(MARKED)
    result = installed.runpytest_subprocess("--strict-markers", "-W", "error")
    result.assert_outcomes(passed=3, failed=6)
    result.stdout.fnmatch_lines(
        [
            "15 of 20 episodes succeeded (95 %: 53.1% to 88.8%, wanted 90.0%)",
            "  seed 0: tails*",
            "39 of 40 episodes succeeded (95 %: 87.1% to 99.6%, wanted 90.0% proven)",
            "2 of 3 episodes succeeded (95 %: 20.8% to 93.9%, wanted 100.0%)",
            "*20 of 20 successes prove 83.9%, not 90.0%. Give a larger count or a lower min_success*",
            "*marked with episodes and uses no softmode_episode*",
            "*RuntimeError: broken*",
            "*= softmode: episodes =*",
            "*::test_enough: 16 of 20 episodes succeeded (95 %: 58.4% to 91.9%, wanted 90.0%)",
        ],
        consecutive=False,
    )


PLAYED = """
import numpy as np
from softmode.testing import assert_success

def env_of(soft_env):
    return soft_env("softmode/PressSoft-v0", max_episode_steps=12, render_size=64)

def test_press(softmode_env, softmode_episode):
    assert_success(softmode_episode(env_of(softmode_env), "scripted", 1))

def test_policy(softmode_env, softmode_episode):
    def policy(observation):
        if observation[0] and len(seen) == 5:
            raise RuntimeError("the policy is broken")
        seen.append(observation)
        return np.zeros(5, np.float32)
    seen = []
    softmode_episode(env_of(softmode_env), policy)
"""
GOLDEN = """
def test_golden(softmode_env, softmode_episode, softmode_golden):
    env = softmode_env("softmode/PressSoft-v0", max_episode_steps=12, render_size=64)
    softmode_golden(softmode_episode(env, "scripted"))
"""


@pytest.mark.rest
def test_the_page_runs_and_failures_lie_beside_the_report(
    installed: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tests that the documentation shows pass as they stand, the golden one after an update, on two workers.

    These share a new cache, where the body is built once. Of failures there are films, recordings and states.
    """
    cache = installed.path / "cache"
    monkeypatch.setenv("SOFTMODE_CACHE", str(cache))
    page = ROOT / "docs" / "testing_policies.md"
    installed.makepyfile(test_page="\n".join(fence.text for fence in fences(page, "python")), test_played=PLAYED)
    result = installed.runpytest_subprocess("--junitxml=out/report.xml", "-n", "2", "--softmode-golden", "update")
    result.assert_outcomes(passed=3, failed=2)
    kept = installed.path / "out" / "report-episodes"
    for name in ("test_played.py_test_press-seed1", "test_played.py_test_policy-seed0"):
        assert {file.name for file in (kept / name).iterdir()} >= {"film.mp4", "episode.rrd", "before.npz"}
    result.stdout.fnmatch_lines([f"film: {kept}/*/film.mp4"])
    failures = ET.parse(installed.path / "out" / "report.xml").getroot().iter("failure")
    assert sum("RuntimeError: the policy is broken" in (failure.text or "") for failure in failures) == 1
    assert len(list((cache / "bodies").glob("*.npz"))) == 1
    assert len(list((installed.path / "golden").glob("*.npz"))) == 1
    installed.makepyfile(test_golden=GOLDEN)
    result = installed.runpytest_subprocess("-k", "changed or golden")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*there is no golden episode*--softmode-golden update*"])
