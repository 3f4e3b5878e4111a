"""What stands before the page's server: a real client that sends what no page sends, beside one that does."""

from __future__ import annotations

import http.client
import random
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

import pytest

from softmode.view import app, gate
from softmode.view.app import ViewOptions, start_server
from tests.needs import needs
from tests.view.page_client import CAMERA, PageClient

pytestmark = needs("viser")
UPLOAD = {
    "type": "FileTransferStartUpload",
    "transfer_uuid": "1",
    "filename": "toy.ply",
    "mime_type": "",
    "part_count": 2,
    "size_bytes": 2000,
}
PART = {"type": "FileTransferPart", "transfer_uuid": "1", "part_index": 0, "content": bytes(1000)}
CLICK = {
    "type": "SceneNodeClickMessage",
    "name": "/grips",
    "instance_index": 0,
    "ray_origin": (0.0, 0.0, 0.0),
    "ray_direction": (0.0, 1.0, 0.0),
    "screen_pos": (0.5, 0.5),
    "modifier": None,
    "owner": "",
}


class Controls:
    """A page with a control of each sort that softmode's pages have."""

    def __init__(self) -> None:
        """Serve it."""
        options = ViewOptions(port=0)
        self.server = start_server(options)
        self.url = app.page_url(options, self.server.get_port())
        gui = self.server.gui
        self.slider = gui.add_slider("slider", min=0.0, max=2.0, step=0.1, initial_value=1.0)
        self.choice = gui.add_dropdown("choice", ("a", "b"), initial_value="a")
        self.box = gui.add_checkbox("box", initial_value=False)
        self.text = gui.add_text("text", "told")
        self.button = gui.add_button("button", disabled=True)
        self.presses: list[Any] = []
        self.button.on_click(self.presses.append)


@pytest.fixture
def page() -> Iterator[Controls]:
    """Serve the controls."""
    one = Controls()
    yield one
    one.server.stop()


def update(handle: Any, **updates: Any) -> dict[str, Any]:
    """Return the message that changes a control."""
    return {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": updates}


def until(client: PageClient, handle: Any, value: Any) -> list[dict[str, Any]]:
    """Return all changes of controls that a client is told, until one has a value."""
    found: list[dict[str, Any]] = []
    ends = time.monotonic() + 30.0
    while time.monotonic() < ends:
        found += [one for one in client.receive(30.0)[0] if one["type"] == "GuiUpdateMessage"]
        if any(one["uuid"] == handle._impl.uuid and one["updates"].get("value") == value for one in found):
            return found
    raise TimeoutError(value)


def test_one_client_cannot_spoil_the_page_of_another(
    page: Controls, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """Garbage, foreign fields, values, uploads, turns go nowhere, with a line for each kind; values that fit go on."""
    from websockets.exceptions import ConnectionClosed

    taken: list[float] = []
    page.slider.on_update(lambda _: taken.append(page.slider.value))
    with PageClient(page.url) as watching, PageClient(page.url) as other:
        for _ in range(3):
            other.socket.send("text")
            for raw in (b"", b"\xc1", b"\x91" * 10_000, b"\x81\xa4type", random.Random(0).randbytes(1000)):
                other.socket.send(raw)
            for message in (
                update(page.slider, label="spoilt"),
                update(page.slider, value=1.5, disabled=True),
                update(page.slider, visible=False),
                {**update(page.slider, value=1.5), "excluded_self_client": 0},
                {"type": "GuiRemoveMessage", "uuid": page.slider._impl.uuid},
                {"type": "ShareUrlRequest"},
                {**UPLOAD, "source_component_uuid": page.slider._impl.uuid},
                {**PART, "source_component_uuid": page.slider._impl.uuid},
                {**CAMERA, "position": (0.0, float("nan"), 0.0)},
                {**CLICK, "name": "x" * 1000},
                update(page.slider, value=float("inf")),
            ):
                other.send(message)
            for message in (
                update(page.slider, value="1.5"),
                update(page.slider, value=True),
                update(page.choice, value="c"),
                update(page.choice, value=1),
                update(page.box, value="yes"),
                update(page.text, value="rm -rf"),
                update(page.button, value=True),
            ):
                other.send(message)
            other.send({**CAMERA, "wxyz": (0.0, 0.0, 0.0, 0.0)})
        other.send(update(page.box, value=True))
        other.send(update(page.choice, value="b"))
        other.send(update(page.slider, value=1e6))
        changes = until(watching, page.slider, 2.0)
        values = {one["uuid"]: one["updates"] for one in changes}
        handles = (page.box, page.choice, page.slider)
        assert values == {one._impl.uuid: {"value": one.value} for one in handles} and len(changes) == 3
        assert [one.value for one in handles] == [True, "b", 2.0] and taken == [2.0]
        other.socket.send(bytes(1_000_000))
        with pytest.raises(ConnectionClosed) as caught:
            while True:
                other.socket.recv(30.0)
        assert caught.value.rcvd is not None and caught.value.rcvd.code == 1009
        page.slider.value = 0.5
        until(watching, page.slider, 0.5)
    assert page.slider.label == "slider" and page.text.value == "told" and not page.presses
    assert not page.server.gui._current_file_upload_states and page.server._share_tunnel is None
    told = sorted(capfd.readouterr().err.splitlines())
    kinds = ("quaternion", "message of more than", "message that no page", "value that its control")
    assert len(told) == len(kinds) and all(sum(kind in line for line in told) == 1 for kind in kinds), told
    assert not caplog.records  # asyncio's tracebacks


def test_nothing_is_answered_without_the_token(page: Controls, capfd: pytest.CaptureFixture[str]) -> None:
    """Neither the page nor its websocket, whoever asks; with it, the page comes, and sends its address nowhere."""
    from websockets.exceptions import InvalidStatus

    place = urlsplit(page.url)
    token, port = place.path.strip("/"), place.port
    assert len(token) > 20 and ViewOptions().token != ViewOptions().token and token not in repr(ViewOptions())
    assert port is not None
    with socket.create_connection(("127.0.0.1", port)) as garbage:
        garbage.sendall(b"\xff" * 100 + b"\r\n\r\n")
        with suppress(ConnectionResetError):
            while garbage.recv(4096):
                pass

    def get(path: str, **headers: str) -> tuple[int, http.client.HTTPResponse]:
        """Ask for a page."""
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer

    for path in ("/", "/index.html", f"/?token={token}", f"/{token[:-1]}/", f"/{token}x/", f"//{token}/", "/%ff/"):
        assert get(path)[0] == 403, path
        with pytest.raises(InvalidStatus, match="403"):
            PageClient(f"http://127.0.0.1:{port}{path}")
    assert get(f"/{token}/", Host="evil.example:80")[0] == 403
    for path in (f"/{token}", f"/{token}/", f"/{token}/?fixedDpr=1", f"/{token}/index.html"):
        status, answer = get(path)
        assert status == 200 and b"<html" in answer.read() and answer.headers["Referrer-Policy"] == "no-referrer"
    assert get(f"/{token}/../../app.py")[0] == 404
    told = sorted(capfd.readouterr().err.splitlines())
    kinds = ("not its own", "request without the token", "connection: ")
    assert len(told) == len(kinds) and all(sum(kind in line for line in told) == 1 for kind in kinds), told


def test_a_flood_waits_and_arrives(
    page: Controls, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """More messages than a page may send are taken later, in order, and another page does not wait for them."""
    monkeypatch.setattr(gate, "MESSAGE_RATE", 40.0)
    order: list[float] = []
    page.slider.on_update(lambda _: order.append(page.slider.value))
    with PageClient(page.url) as flooding, PageClient(page.url) as other:
        send = threading.Thread(target=lambda: [flooding.send(update(page.slider, value=0.02 * k)) for k in range(71)])
        send.start()
        other.send(update(page.box, value=True))
        until(other, page.slider, pytest.approx(1.4))
        send.join()
    assert page.box.value
    assert "more than 40 messages per second" in capfd.readouterr().err


def test_what_is_let_through_can_be_read() -> None:
    """Of damaged messages none raises in the gate, and viser reads every one that goes through (3,000, seeded)."""
    import msgspec
    from viser._messages import Message

    door, random_ = gate.Gate("token", None), random.Random(1)
    sound = [msgspec.msgpack.encode(one) for one in (CAMERA, CLICK)]
    for message in sound:
        assert Message.deserialize(door.checked(message) or b"")
    through = 0
    for _ in range(3000):
        raw = bytearray(random_.choice(sound))
        for _ in range(random_.randrange(1, 4)):
            raw[random_.randrange(len(raw))] = random_.randrange(256)
        if (passed := door.checked(bytes(raw[: random_.choice([None, len(raw) - 1])]))) is not None:
            through += 1
            Message.deserialize(passed)
    assert 300 < through < 2700
