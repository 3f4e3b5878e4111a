"""The pytest plug-in: fixtures `softmode_env`, `softmode_episode`, `softmode_golden`, the marker `softmode_episodes`.

``softmode_short_names = true`` among pytest's settings calls them `soft_env`, `episode`, `golden` and `episodes` too.
pytest loads the plug-in in every project of an environment. So it lies beside the package, whose import brings
Gymnasium, and imports nothing of it until a fixture is used; ``-p no:softmode`` leaves it out.
"""

from __future__ import annotations

import inspect
import re
import types
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    import gymnasium as gym

    from softmode.testing.episode import Episode, Player

_PLAYED = pytest.StashKey[list["Episode"]]()
"""Episodes that a test has played, the last one last."""
_RATE = "softmode_episodes"
"""Property of a report: how many episodes succeeded."""
_SHORT = "softmode_short_names"
"""The setting that brings the short names."""
_NAMES = {"soft_env": "softmode_env", "episode": "softmode_episode", "golden": "softmode_golden"}
"""Short names of fixtures, and what they stand for."""
_MARKER = (
    "(count, min_success=1.0, first_seed=0, proven=False): play the test for so many seeds; it fails if the "
    "95 % interval of its success rate (Wilson) lies below min_success, or if proven unless it lies above"
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("softmode", "episodes of softmode")
    group.addoption(
        "--softmode-episodes-dir",
        type=Path,
        help="folder for films, recordings and states of failed episodes (default: beside the file of --junitxml, or "
        "failed-episodes)",
    )
    group.addoption(
        "--softmode-golden",
        choices=("check", "update"),
        default="check",
        help="compare golden episodes, or write them anew",
    )
    parser.addini(_SHORT, "call fixtures and marker soft_env, episode, golden and episodes too", "bool", default=False)


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker, and the short names where they are wanted."""
    config.addinivalue_line("markers", f"softmode_episodes{_MARKER}")
    if config.getini(_SHORT):
        config.addinivalue_line("markers", f"episodes{_MARKER}")
        config.pluginmanager.register(_short_names(), _SHORT)


# -- fixtures ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def softmode_env() -> Iterator[Callable[..., gym.Env]]:
    """Return a function from an id, and options or fields of the configuration, to an environment.

    ``softmode_env("softmode/PushSoft-v0", obs_type="pixels", goal_tolerance=0.01)``. Equal arguments give the same
    environment throughout the session, which an episode resets; ``copy.deepcopy`` gives one of its own.
    """
    made: dict[str, gym.Env] = {}

    def make(env: str, **config: Any) -> gym.Env:
        """Return an environment."""
        import gymnasium as gym

        import softmode  # noqa: F401  (registers the environments)

        key = repr((env, sorted(config.items())))
        if key not in made:
            made[key] = gym.make(env, **config)
        return made[key]

    yield make
    for env in made.values():
        env.close()


class Episodes:
    """The fixture `softmode_episode`: plays episodes and remembers them for the report.

    Args:
        played: Where they are remembered.
    """

    def __init__(self, played: list[Episode]) -> None:
        """Start with seed 0."""
        self.seed = 0
        """Seed of the next episode that names none; the marker counts it up."""
        self._played = played

    def __call__(
        self, env: gym.Env, policy: str | Player = "scripted", seed: int | None = None, **options: Any
    ) -> Episode:
        """Play an episode; see :func:`softmode.testing.play_episode`."""
        from softmode.testing.episode import play_episode

        return play_episode(env, policy, self.seed if seed is None else seed, begun=self._played.append, **options)


@pytest.fixture
def softmode_episode(request: pytest.FixtureRequest) -> Episodes:
    """Return a function that plays an episode: ``softmode_episode(env, policy, seed)``."""
    return Episodes(request.node.stash.setdefault(_PLAYED, []))


@pytest.fixture
def softmode_golden(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Return a function that compares an episode with the golden one: ``softmode_golden(episode, name, atol=0.0)``.

    It lies in the folder ``golden`` beside the test, and is named after the test, and `name` if it has several.
    """
    update = request.config.getoption("--softmode-golden") == "update"

    def check(episode: Episode, name: str = "", *, atol: float = 0.0) -> None:
        """Compare an episode, or write it as the golden one."""
        from softmode.testing.golden import assert_golden, write_golden

        file = _file_name("-".join(part for part in (request.path.stem, request.node.name, name) if part))
        path = request.path.parent / "golden" / f"{file}.npz"
        if update:
            write_golden(episode, path)
        else:
            assert_golden(episode, path, atol=atol)

    return check


def _short_names() -> types.ModuleType:
    """Return a plug-in that has the fixtures by their short names."""

    @pytest.fixture(scope="session")
    def soft_env(softmode_env: Callable[..., gym.Env]) -> Callable[..., gym.Env]:
        return softmode_env

    @pytest.fixture
    def episode(softmode_episode: Episodes) -> Episodes:
        return softmode_episode

    @pytest.fixture
    def golden(softmode_golden: Callable[..., None]) -> Callable[..., None]:
        return softmode_golden

    plugin = types.ModuleType(_SHORT)
    vars(plugin).update(soft_env=soft_env, episode=episode, golden=golden)
    return plugin


# -- the marker -------------------------------------------------------------------------------------------------------


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Call a marked test once for every seed, and judge how many passed."""
    marker = pyfuncitem.get_closest_marker("softmode_episodes")
    if marker is None and pyfuncitem.config.getini(_SHORT):
        marker = pyfuncitem.get_closest_marker("episodes")
    if marker is None:
        return None
    seeds, judge = _rule(*marker.args, **marker.kwargs)
    player = pyfuncitem.funcargs.get("softmode_episode")
    if not isinstance(player, Episodes):
        raise pytest.UsageError(f"{pyfuncitem.nodeid} is marked with {marker.name} and uses no softmode_episode")
    arguments = {name: pyfuncitem.funcargs[name] for name in inspect.signature(pyfuncitem.obj).parameters}
    played = pyfuncitem.stash[_PLAYED]
    failures, shown = {}, []
    for player.seed in seeds:
        played.clear()
        try:
            pyfuncitem.obj(**arguments)
        except (AssertionError, pytest.fail.Exception) as error:
            failures[player.seed] = str(error).partition("\n")[0]
            shown = shown or list(played)
    rate, fine = judge(len(seeds) - len(failures))
    pyfuncitem.user_properties.append((_RATE, rate))
    if not fine:
        played[:] = shown
        pytest.fail("\n".join([rate, *(f"  seed {seed}: {why}" for seed, why in failures.items())]), pytrace=False)
    return True


def _rule(
    count: int, *, min_success: float = 1.0, first_seed: int = 0, proven: bool = False
) -> tuple[range, Callable[[int], tuple[str, bool]]]:
    """Return the seeds of a marker, and what judges a number of successes.

    Raises:
        ConfigError: If a number is out of range, or the count is too small to prove the rate.
    """
    from softmode.checks import require_number
    from softmode.errors import ConfigError
    from softmode.learning.intervals import wilson_interval

    require_number("episodes: count", count, at_least=1)
    require_number("episodes: first_seed", first_seed, at_least=0)
    require_number("episodes: min_success", min_success, at_least=0.0, at_most=1.0)
    if proven and (best := wilson_interval(count, count)[0]) < min_success:
        hint = "give a larger count or a lower min_success"
        raise ConfigError(f"{count} of {count} successes prove {best:.1%}, not {min_success:.1%}", hint=hint)

    def judge(successes: int) -> tuple[str, bool]:
        """Return the rate in words, and whether it is enough."""
        low, high = wilson_interval(successes, count)
        wanted = f"wanted {min_success:.1%}{' proven' if proven else ''}"
        words = f"{successes} of {count} episodes succeeded (95 %: {low:.1%} to {high:.1%}, {wanted})"
        return words, (low if proven else high) >= min_success

    return range(first_seed, first_seed + count), judge


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the success rates."""
    reports = [report for found in terminalreporter.stats.values() for report in found]
    rates = {
        report.nodeid: value
        for report in reports
        for name, value in getattr(report, "user_properties", ())
        if name == _RATE
    }
    if rates:
        terminalreporter.section("softmode: episodes")
    for nodeid, rate in rates.items():
        terminalreporter.line(f"{nodeid}: {rate}")


# -- failures ---------------------------------------------------------------------------------------------------------


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Play the episode of a failure again, and put film, recording and state beside the report.

    Where a fixture is missing whose name was softmode's once, say what it is called now.
    """
    report = yield
    if call.excinfo is not None and isinstance(missing := call.excinfo.value, pytest.FixtureLookupError):
        if missing.argname in _NAMES:
            hint = f"softmode's is called {_NAMES[missing.argname]}; the line `{_SHORT} = true` among pytest's settings"
            report.sections.append(("softmode", f"{hint} brings the short names"))
    played = item.stash.get(_PLAYED, [])
    if call.when == "call" and report.failed and played:
        from softmode.errors import SoftmodeError
        from softmode.testing.failure import save_failure

        shown = next((one for one in played if one.failed_at is not None), played[-1])
        folder = _folder(item.config) / f"{_file_name(item.nodeid)}-seed{shown.seed}"
        try:
            lines = save_failure(shown, folder)
        except (SoftmodeError, OSError) as error:
            lines = [f"the episode could not be saved: {error}"]
        report.sections.append(("Episode", "\n".join([f"seed {shown.seed}", *lines])))
    return report


def _folder(config: pytest.Config) -> Path:
    """Return where failed episodes go."""
    chosen, report = config.getoption("--softmode-episodes-dir"), config.getoption("xmlpath", None)
    if chosen is not None:
        return config.invocation_params.dir / chosen
    if report:
        return config.invocation_params.dir / Path(report).with_suffix("").with_name(f"{Path(report).stem}-episodes")
    return config.rootpath / "failed-episodes"


def _file_name(text: str) -> str:
    """Return a text as the name of a file."""
    return re.sub(r"[^\w.-]+", "_", text).strip("_")
