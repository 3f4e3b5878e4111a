"""The page that prepares a capture: what its gizmos and its button lead to, without a browser."""

from __future__ import annotations

import contextlib
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softmode.cli.main import main
from softmode.objects import ObjectConfig
from softmode.objects.source import object_source
from softmode.splats import make_plush, read_splats, write_splats
from softmode.view.app import ViewOptions, _free_port
from softmode.view.prepare import PreparePage
from tests.faults import signalled
from tests.needs import needs
from tests.view.page_client import PageClient

pytestmark = needs("viser")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a plush whose head points along +x of the file."""
    file = tmp_path_factory.mktemp("capture") / "toy bear.ply"
    write_splats(file, make_plush(count=800), up="+x")
    return file


@pytest.fixture
def page(capture: Path) -> Iterator[PreparePage]:
    """Serve it."""
    with PreparePage(capture, ViewOptions(port=0)) as one:
        yield one


def test_turning_finds_the_axis_that_points_up(page: PreparePage, capture: Path) -> None:
    """Turned to what looks upright, 10 degrees off, the page takes +x; the head is above then."""
    assert page.up == "-y" and page.crop is None
    # What is shown has -y of the file up; a turn that brings the file's +x there makes the bear stand.
    shown = read_splats(capture).oriented("-y").means
    head = shown[read_splats(capture).means[:, 0].argmax()] - shown.mean(axis=0)
    upright = Rotation.align_vectors([[0.0, 0.0, 1.0]], [head])[0]
    page.turn((Rotation.from_euler("x", 10.0, degrees=True) * upright).as_matrix())
    assert page.up == "+x"
    standing = object_source(ObjectConfig(splat=capture, up=page.up)).splats
    np.testing.assert_allclose(standing.bounds()[:, 2], [0.0, np.ptp(standing.bounds(), axis=0).max()], atol=2e-3)


def test_the_box_crops_and_the_command_repeats_it(page: PreparePage, tmp_path: Path) -> None:
    """Half the bear is kept, corners do not pass each other, and the command says the same."""
    page.turn(np.eye(3))
    middle = 0.5 * (page.low + page.high)
    page.move(0, np.array([middle[0], *page.low[1:]]))
    assert page.crop is not None and page.crop[0] == pytest.approx(middle[0], rel=1e-3, abs=1e-6)
    kept = object_source(ObjectConfig(splat=page.file, up=page.up, crop=page.crop)).asset_splats
    assert 0.2 * 800 < kept < 0.8 * 800
    page.move(1, page.low - 1.0)
    assert (page.high > page.low).all()
    words = shlex.split(page.command)
    assert words[:4] == ["softmode", "view", str(page.file), f"--up={page.up}"]
    assert [float(x) for x in words[words.index("--crop") + 1 :]] == list(page.crop)


def test_a_browser_sees_the_page_and_the_button_ends_it(page: PreparePage) -> None:
    """A client is sent splats, box and gizmos; without a press there is nothing to build, with one there is."""
    with PageClient(page.url) as client:
        names: set[str] = set()
        shown = {"/splats", "/box", *(f"/gizmos 1/{name}" for name in ("corner 0", "corner 1", "turn"))}
        for _ in range(20):
            messages, _, _ = client.receive(10.0)
            names |= {str(one.get("name")) for one in messages}
            if shown <= names:
                break
        assert shown <= names
    assert not page.wait(0.05)
    threading.Timer(0.1, page.press).start()
    assert page.wait(20.0)


def test_only_splat_files_are_prepared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing to prepare is an error that says so."""
    assert main(["view", "--prepare", "--port", "0", "--no-open"]) == 2
    assert "Give a splat file" in capsys.readouterr().err


def press(client: PageClient, label: str, ends: float) -> None:
    """Press a button of the page that a client is shown."""
    while time.monotonic() < ends:
        for message in client.receive(10.0)[0]:
            if message["type"] == "GuiButtonMessage" and message["props"]["label"] == label:
                client.send({"type": "GuiUpdateMessage", "uuid": message["uuid"], "updates": {"value": True}})
                return
    raise TimeoutError


def told_until(client: PageClient, ends: float, last: str | None) -> list[str]:
    """Return what the page says from now on, until its server ends or it says `last`."""
    from websockets.exceptions import WebSocketException

    told: list[str] = []
    with contextlib.suppress(WebSocketException):
        while time.monotonic() < ends and not (last and any(last in text for text in told)):
            with contextlib.suppress(TimeoutError):
                told += [str(one.get("updates", "")) for one in client.receive(1.0)[0]]
    return told


def pressed(url: str, label: str, last: str | None = None) -> list[str]:
    """Press a button of the page that is, or soon will be, at an address; viser's own page connects again likewise.

    Returns what the page says from then on, until its server ends or it says `last`.
    """
    from websockets.exceptions import WebSocketException

    ends = time.monotonic() + 120.0
    while time.monotonic() < ends:
        with contextlib.suppress(OSError, WebSocketException, TimeoutError), PageClient(url) as client:
            press(client, label, ends)
            return told_until(client, ends, last)
        time.sleep(0.2)
    raise TimeoutError(f"no button {label!r} at {url}")


@pytest.mark.rest
def test_a_running_page_is_prepared_by_its_button(capture: Path) -> None:
    """A page that shows a capture has a button for the gizmos, at the same address; theirs brings the object back."""
    port = _free_port("127.0.0.1", 0)
    words = ["view", str(capture), "--size", "0.08", "--up=+x", "--port", str(port), "--no-open"]
    with subprocess.Popen(
        [sys.executable, "-m", "softmode", *words],
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a job in the background ignores it
    ) as running:
        try:
            assert running.stdout is not None
            url = next(word for word in running.stdout.readline().split() if word.startswith("http"))
            for label in ("prepare", "build", "prepare"):
                told = pressed(url, label)
                # Chromium would not come back to a server that is gone for as long as a build takes.
                assert any("building" in text for text in told) == (label == "build")
            running.send_signal(signal.SIGINT)
            said, _ = running.communicate(timeout=60.0)
        finally:
            running.kill()  # a page that is still open would keep the test waiting for ever
    assert running.returncode in (0, 130)  # interrupted on the last page, or before it was up
    assert said.count(f"open {url} ") >= 2  # the gizmos, and the object again
    assert f"to do this again: softmode view {shlex.quote(str(capture))} --up=+x --port {port} --no-open" in said
    assert "--size 0.08" in said


def test_a_box_without_splats_is_refused_on_the_page(
    capture: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What cannot be built is said on the page, which goes on, and on the console."""
    port, told, over = _free_port("127.0.0.1", 0), [], threading.Event()
    monkeypatch.setattr("secrets.token_urlsafe", lambda _: "token")

    def visit() -> None:
        try:
            for _ in range(2):
                told.append(pressed(f"http://127.0.0.1:{port}/token/", "build", "no splat"))
        finally:
            over.set()

    visitor = threading.Thread(target=visit)
    visitor.start()
    crop = ["--crop", *"10 10 10 11 11 11".split()]
    with signalled(signal.SIGINT, over.is_set):
        assert main(["view", str(capture), "--prepare", *crop, "--port", str(port), "--no-open"]) == 0
    visitor.join()
    assert len(told) == 2 and all(any("lies inside crop" in text for text in texts) for texts in told)
    assert capsys.readouterr().err.count("no splat") == 2
