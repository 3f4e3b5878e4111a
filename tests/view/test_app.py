"""The page of a live session, without a browser: what is sent, what is refused, what messages of the mouse do."""

from __future__ import annotations

import math
import signal
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from softmode.cli.main import main
from softmode.errors import ConfigError, MissingExtraError
from softmode.objects import load, write_object
from softmode.view.app import ViewApp, ViewOptions
from softmode.view.gaussians import GaussianBuffer
from softmode.view.live_types import SplatPicture
from softmode.view.session import LiveSession
from tests import faults
from tests.marks import rest_but
from tests.needs import needs
from tests.view.page_client import PageClient
from tests.view.serving import SAUSAGE, Served, served

pytestmark = needs("viser")

NAME = "/grips"


@pytest.fixture(scope="module")
def view(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Serve a hanging sausage."""
    with served(record_folder=tmp_path_factory.mktemp("recordings")) as one:
        yield one


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Save the sausage, which a command then shows without building anything."""
    file, thing = tmp_path_factory.mktemp("saved") / "toy.npz", load(SAUSAGE)
    write_object(file, thing.body, thing.visible_splats)
    return str(file)


def camera_message(eye: np.ndarray) -> dict[str, Any]:
    """Return a camera at a point on the negative y axis that looks along y, up is z."""
    half = float(np.sqrt(0.5))
    return {
        "type": "ViewerCameraMessage",
        "wxyz": (half, -half, 0.0, 0.0),  # forward, the third axis, is +y
        "position": tuple(eye.tolist()),
        "fov": 0.7,
        "near": 0.01,
        "far": 100.0,
        "image_height": 480,
        "image_width": 640,
        "look_at": (0.0, 0.0, 0.1),
        "up_direction": (0.0, 0.0, 1.0),
    }


def drag_message(phase: str, start: np.ndarray, end: np.ndarray) -> dict[str, Any]:
    """Return what a page sends while the mouse drags from a point on the proxies to another."""
    return {
        "type": "SceneNodeDragMessage",
        "phase": phase,
        "name": NAME,
        "instance_index": 0,
        "start_position": tuple(start.tolist()),
        "start_screen_pos": (0.5, 0.5),
        "end_position": tuple(end.tolist()),
        "end_screen_pos": (0.5, 0.5),
        "button": "left",
        "modifier": None,
        "owner": "",
    }


def picture(count: int = 500) -> SplatPicture:
    """Return splats with standard deviations between 0.1 and 10 mm."""
    rng = np.random.default_rng(3)
    factors = rng.normal(size=(count, 3, 3)) * 10.0 ** rng.uniform(-4, -2.5, size=(count, 1, 1))
    return SplatPicture(
        means=rng.normal(size=(count, 3)).astype(np.float32),
        covariances=(factors @ factors.transpose(0, 2, 1)).astype(np.float32),
        colors=rng.uniform(size=(count, 3)).astype(np.float32),
        opacities=rng.uniform(size=count).astype(np.float32),
    )


def test_buffer_holds_splats_to_half_precision() -> None:
    """Read back, centres are exact, covariances good to 2^-11 of each splat's widest direction, colours to 1/510."""
    shown = picture()
    buffer = GaussianBuffer(shown)
    words = buffer.pack(shown.means, shown.covariances)
    means = words[:, :3].copy().view(np.float32) * buffer.unit
    np.testing.assert_allclose(means, shown.means, rtol=4 * np.finfo(np.float32).eps)
    half = words[:, 4:7].copy().view(np.float16).astype(np.float64) * buffer.unit**2
    upper = shown.covariances.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    widest = np.trace(shown.covariances, axis1=1, axis2=2)[:, None]
    assert (np.abs(half - upper) <= 2.0**-11 * np.abs(upper) + 2.0**-24 * buffer.unit**2 + 1e-6 * widest).all()
    rgba = words[:, 7:].copy().view(np.uint8) / 255.0
    np.testing.assert_allclose(rgba[:, :3], shown.colors, atol=0.5001 / 255.0)
    np.testing.assert_allclose(rgba[:, 3], shown.opacities, atol=0.5001 / 255.0)


def test_buffer_does_not_overflow_when_splats_grow() -> None:
    """Splats that grow by a hundred are cut at the largest half, not infinite."""
    shown = picture()
    words = GaussianBuffer(shown).pack(shown.means, 1e4 * shown.covariances)
    assert np.isfinite(words[:, 4:7].copy().view(np.float16)).all()


def test_every_client_gets_the_same_splats(view: Served) -> None:
    """Two connections receive what the session shows; a paused session sends nothing new."""
    with PageClient(view.app.url) as first, PageClient(view.app.url) as second:
        for client in (first, second):
            client.splats()  # may come with the whole scene
            words, size = client.splats()
            assert len(words) == view.ask(lambda session: len(session.splats().means))
            assert words.nbytes < size < 1.6 * words.nbytes + 20_000
        view.ask(lambda session: session.pause())
        still = [client.splats(2.0)[0] for client in (first, second) if _drain(client)]
        assert not still
        view.ask(lambda session: session.step())
        one, two = first.splats()[0], second.splats()[0]
        np.testing.assert_array_equal(one, two)
        view.ask(lambda session: session.play())


def _drain(client: PageClient) -> bool:
    """Read what is on its way; return whether splats still come after a while."""
    for _ in range(30):
        try:
            client.splats(0.4)
        except TimeoutError:
            return False
    return True


def test_mouse_messages_drag_the_object(view: Served) -> None:
    """A drag to the right pulls the lower end to the right, where the cursor's plane is, and lets it return."""
    view.ask(lambda session: session.reset())
    assert view.wait(lambda session: session.energies().kinetic < 1e-5)
    rest = view.ask(view.lowest)
    size = view.ask(lambda session: session.size)
    eye = rest - np.array([0.0, 6.0 * size, 0.0])
    grip = rest - np.array([0.0, 0.1 * size, 0.0])  # the proxies stand out a little from the object
    with PageClient(view.app.url) as client:
        client.send(camera_message(eye))
        client.send(drag_message("start", grip, grip))
        assert view.wait(lambda session: session.drag() is not None)
        gripped = view.ask(lambda session: session.drag().point)  # type: ignore[union-attr]
        client.send(drag_message("update", grip, grip + np.array([0.5 * size, 0.0, 0.0])))
        moved = view.wait(lambda session: bool(view.lowest(session)[0] > rest[0] + 0.15 * size))
        target = view.ask(lambda session: session.drag().target)  # type: ignore[union-attr]
        client.send(drag_message("end", grip, grip + np.array([0.5 * size, 0.0, 0.0])))
        assert view.wait(lambda session: session.drag() is None)
    assert moved
    assert target[1] == pytest.approx(gripped[1], abs=1e-6)  # in the plane through the grip, parallel to the picture
    far = (gripped[1] - eye[1]) / (grip[1] - eye[1])
    assert target[0] - gripped[0] == pytest.approx(0.5 * size * far, rel=0.05)
    assert view.wait(lambda session: bool(np.linalg.norm(view.lowest(session) - rest) < 0.03 * session.size))


def test_a_second_mouse_waits_and_a_lost_one_lets_go(view: Served) -> None:
    """Another client's drag does not disturb the first one's, whose end is assumed when it disconnects."""
    rest = view.ask(view.lowest)
    size = view.ask(lambda session: session.size)
    eye, right = rest - np.array([0.0, 6.0 * size, 0.0]), np.array([0.2 * size, 0.0, 0.0])
    with PageClient(view.app.url) as second:
        second.send(camera_message(eye))
        with PageClient(view.app.url) as first:
            first.send(camera_message(eye))
            first.send(drag_message("start", rest, rest + right))
            assert view.wait(lambda session: session.drag() is not None)
            second.send(drag_message("start", rest, rest - right))
            second.send(drag_message("update", rest, rest - right))
            second.send(drag_message("end", rest, rest - right))
            first.send(drag_message("update", rest, rest + right))
            for _ in range(5):
                view.ask(lambda session: None)
            assert view.ask(lambda session: session.drag().target)[0] > rest[0] + 0.1 * size  # type: ignore[union-attr]
        assert view.wait(lambda session: session.drag() is None)


def test_a_cursor_beside_the_camera_changes_nothing(view: Served) -> None:
    """A ray along the picture's plane, or behind the camera, meets the plane of the grip nowhere: the target stays."""
    rest = view.ask(view.lowest)
    size = view.ask(lambda session: session.size)
    eye = rest - np.array([0.0, 6.0 * size, 0.0])
    with PageClient(view.app.url) as client:
        client.send(camera_message(eye))
        client.send(drag_message("start", rest, rest))
        assert view.wait(lambda session: session.drag() is not None)
        before = view.ask(lambda session: session.drag().target)  # type: ignore[union-attr]
        for away in ([1.0, 0.0, 0.0], [0.0, -1.0, 0.2], [0.0, 0.0, 0.0]):
            client.send(drag_message("update", rest, eye + np.array(away)))
        for _ in range(5):
            after = view.ask(lambda session: session.drag().target)  # type: ignore[union-attr]
        np.testing.assert_array_equal(after, before)
        client.send(drag_message("end", rest, eye))
        assert view.wait(lambda session: session.drag() is None)


def test_a_slider_beyond_its_end_stays_at_its_end(view: Served) -> None:
    """A page that sends more than the slider has is given the slider's end, and the view goes on."""
    before = view.ask(lambda session: session.parameters.youngs_modulus)
    slider, handle = next((s, h) for s, h in view.app._panel._sliders.items() if s.label.startswith("log10 E"))
    with PageClient(view.app.url) as client:
        client.send({"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": 1e6}})
        assert view.wait(lambda session: session.parameters.youngs_modulus == pytest.approx(10.0 ** slider.limits[1]))
    view.ask(lambda session: session.set_parameters(youngs_modulus=before))


def test_a_drag_beside_the_object_does_nothing(view: Served) -> None:
    """A ray that meets no splat grips nothing."""
    size = view.ask(lambda session: session.size)
    eye = np.array([0.0, -6.0 * size, 0.1])
    with PageClient(view.app.url) as client:
        client.send(camera_message(eye))
        client.send(drag_message("start", np.array([2.0 * size, 0.0, 0.1]), np.array([2.0 * size, 0.0, 0.1])))
        client.send(drag_message("end", np.array([2.0 * size, 0.0, 0.1]), np.array([2.0 * size, 0.0, 0.1])))
        for _ in range(5):
            assert view.ask(lambda session: session.drag()) is None


def test_the_record_button_writes_a_film(view: Served) -> None:
    """Pressed twice, it leaves one .mp4 in the folder for recordings."""
    folder = view.app.options.record_folder
    view.ask(view.app._panel._toggle_recording)
    assert view.ask(lambda session: session.status().recording)
    begun = view.ask(lambda session: session.status().time)
    assert view.wait(lambda session: session.status().time > begun + 0.2)
    view.ask(view.app._panel._toggle_recording)
    (film,) = folder.glob("*.mp4")
    assert film.stat().st_size > 1000
    assert film.name in view.app._panel._message.content


def test_what_cannot_be_done_is_told_and_survived(view: Served, capfd: pytest.CaptureFixture[str]) -> None:
    """A command with a value out of range leaves the session as it was, and the app alive."""
    before = view.ask(lambda session: session.parameters)
    view.app.submit(lambda session: session.set_parameters(poissons_ratio=0.7))
    assert view.ask(lambda session: session.parameters) == before
    assert "poissons_ratio" in capfd.readouterr().err.replace("'s ", "s_").replace("poissons ratio", "poissons_ratio")


def test_a_damaged_drag_ends_nothing(view: Served, capfd: pytest.CaptureFixture[str]) -> None:
    """A vector too short, or not finite, does not reach the session; whatever a command raises, the session goes on."""
    size = view.ask(lambda session: session.size)
    with PageClient(view.app.url) as client:
        client.send(camera_message(np.array([0.0, -6.0 * size, 0.1])))
        client.send(drag_message("start", np.array([0.0, 0.1]), np.zeros(3)))
        client.send(drag_message("start", np.zeros(3), np.array([0.0, np.nan, 0.0])))
        view.app.submit(lambda session: 1 / 0)
        assert view.wait(lambda session: "ZeroDivisionError" in view.app._panel._message.content)
        assert view.ask(lambda session: session.drag()) is None
    told = capfd.readouterr().err
    assert told.count("no page of softmode's sends") == 1 and "ZeroDivisionError" in told


def test_pages_of_others_are_refused(view: Served) -> None:
    """A web page of another origin, open in the same browser, gets no connection; the tool's own page does."""
    from websockets.exceptions import InvalidStatus

    port = urlsplit(view.app.url).port
    for origin in ("https://example.com", "http://127.0.0.1:1", "null"):
        with pytest.raises(InvalidStatus) as caught:
            PageClient(view.app.url, origin=origin)
        assert caught.value.response.status_code == 403
    with PageClient(view.app.url, origin=f"http://127.0.0.1:{port}") as client:
        assert len(client.receive(5.0)[0])


def test_only_this_machine_by_default(view: Served) -> None:
    """The socket is bound to 127.0.0.1."""
    assert ViewOptions().host == "127.0.0.1"
    assert view.app.url.startswith("http://127.0.0.1:")
    port = urlsplit(view.app.url).port
    with socket.socket() as other:  # another address of this machine is not taken
        other.bind(("127.0.0.2", port))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"port": 70000}, "0..65535"),
        ({"frame_rate": 0.0}, "frame_rate"),
        ({"host": "256.1.1.1"}, "256.1.1.1"),
        ({"host": "8.8.8.8"}, "8.8.8.8"),
    ],
)
def test_bad_addresses_are_refused(given: dict[str, Any], words: str) -> None:
    """Values out of range and addresses that are not this machine's raise an error that says so."""
    with pytest.raises(ConfigError, match=words):
        ViewOptions(**given).check()


def test_the_remedy_fits_the_address() -> None:
    """Where the address is wrong, another port is of no use."""
    for host in ("256.1.1.1", "8.8.8.8"):
        with pytest.raises(ConfigError) as caught:
            ViewOptions(host=host, port=0).check()
        assert "--host" in caught.value.hint and "--port" not in caught.value.hint


def test_a_port_that_is_taken_is_an_error(view: Served, capsys: pytest.CaptureFixture[str]) -> None:
    """Not the next free one, as viser would have it: the error names port and remedy, before anything is built."""
    port = str(urlsplit(view.app.url).port)
    assert main(["view", "--port", port, "--no-open", "--duration", "1"]) == 2
    said = capsys.readouterr().err
    assert f"port {port}" in said and "--port" in said


def test_without_viser_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error says what to install."""
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtraError, match=r"softmode\[viz\]"):
        ViewOptions(port=0).check()


def test_the_command_serves_for_a_while(saved: str, capfd: pytest.CaptureFixture[str]) -> None:
    """`softmode view FILE --duration` says where to look, warns about other addresses, and ends by itself."""
    arguments = ["view", saved, "--port", "0", "--no-open", "--duration", "0.5"]
    assert main(arguments) == 0
    said = capfd.readouterr()
    assert "http://127.0.0.1:" in said.out and "warning" not in said.err and "viser" not in said.out
    assert main([*arguments, "--host", "0.0.0.0", "--scene", "drop"]) == 0
    assert "whoever has that address" in capfd.readouterr().err


def test_a_recording_is_kept_when_the_command_ends(
    saved: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was being recorded is written, not thrown away."""
    enter = ViewApp.__enter__

    def press_record(app: ViewApp) -> ViewApp:
        app.submit(app._panel._toggle_recording)
        return enter(app)

    monkeypatch.setattr(ViewApp, "__enter__", press_record)
    folder = tmp_path / "röm 1"
    assert main(["view", saved, "--port", "0", "--no-open", "--duration", "1", "--record-folder", str(folder)]) == 0
    (film,) = folder.glob("*.mp4")
    assert film.stat().st_size > 1000 and str(film) in capfd.readouterr().out


@pytest.mark.parametrize(
    ("number", "code"), rest_but([(signal.SIGTERM, 143)], [(signal.SIGTERM, 143), (signal.SIGINT, 0)])
)
def test_an_interrupted_command_ends_cleanly(saved: str, number: signal.Signals, code: int) -> None:
    """SIGTERM and Ctrl-C while it serves: one line, no traceback."""
    program = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # the background ignores it
        f"from softmode.cli.main import main; sys.exit(main(['view', {saved!r}, '--port', '0', '--no-open']))"
    )
    ended, written = faults.end_at(faults.start(program), lambda line: "http://127.0.0.1:" in line, number)
    assert ended == code, written
    assert "stopped" in written and "Traceback" not in written


def test_an_environment_is_shown_and_followed() -> None:
    """Frames of the robot stand where its links are, the reward is told, sliders follow the next episode's draw."""
    session = LiveSession.from_env("softmode/PushSoft-v0", device="cpu")
    with ViewApp(session, ViewOptions(port=0)) as app, PageClient(app.url):
        while not app._server.get_clients():
            time.sleep(0.01)
        slider = next(handle for one, handle in app._panel._sliders.items() if one.label.startswith("log10 E"))
        for _ in range(2):
            app._told = -math.inf  # readouts are due
            for _ in range(8):
                app.frame(1.0 / 30.0)
            poses = session.poses()
            assert len(app._stage._frames) > 5
            for body, frame in app._stage._frames.items():
                np.testing.assert_allclose(frame.position, poses[body, :3], atol=1e-6)
                np.testing.assert_allclose(frame.wxyz, poses[body, [6, 3, 4, 5]], atol=1e-6)
            assert "reward" in app._panel._text.content
            drawn = session.parameters.youngs_modulus
            assert slider.value == pytest.approx(np.clip(math.log10(drawn), 3.0, 7.0), abs=0.026)
            app.submit(lambda session: session.reset())
            app.frame(1.0 / 30.0)
            assert session.parameters.youngs_modulus != drawn
    session.close()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nothing.ply"], "neither a file nor an environment"),
        (["softmode/Nothing-v0"], "unknown environment"),
        (["--duration", "-1"], "duration"),
        (["a", "b"], "name one"),
        (["softmode/PushSoft-v0", "--hold", "base"], "--hold says nothing about an environment"),
        (["--policy", "zero"], "--policy says nothing about an object"),
    ],
)
def test_the_command_refuses(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Mistakes are one line and exit code 2."""
    assert main(["view", *arguments, "--port", "0", "--no-open"]) == 2
    assert words in capsys.readouterr().err.lower()


def test_a_stroke_of_the_mouse_cuts(tmp_path: Path) -> None:
    """In mode cut a drag across shows a line and cuts at its end; the page gets other splats; a reset heals."""
    with served(record_folder=tmp_path) as view, PageClient(view.app.url) as client:
        client.splats()
        count = view.ask(lambda session: len(session.splats().means))
        centre, size = view.ask(lambda session: session.centre()), view.ask(lambda session: session.size)
        client.send(camera_message(centre - np.array([0.0, 6.0 * size, 0.0])))
        view.ask(lambda session: view.app._panel._set_mode("cut"))
        start, end = centre - np.array([0.2 * size, 0.2 * size, 0.0]), centre + np.array([0.3 * size, -0.2 * size, 0.0])
        for phase, at in (("start", start), ("update", end)):
            client.send(drag_message(phase, start, at))
        stage = view.app._stage
        assert view.wait(lambda session: stage.stroke is not None and stage._line.visible)  # of the second message
        client.send(drag_message("end", start, end))
        assert view.wait(lambda session: len(session.objects) == 2, 60.0)
        assert view.app._stage.stroke is None
        more = view.ask(lambda session: len(session.splats().means))
        assert more > count
        for _ in range(200):
            if len(client.splats()[0]) == more:
                break
        else:
            raise AssertionError("the page kept the splats before the cut")
        view.ask(lambda session: session.reset())
        assert view.ask(lambda session: len(session.splats().means)) == count
