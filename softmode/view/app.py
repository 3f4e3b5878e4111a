"""A page in the browser that shows a live session and lets people pull, pin and tune it."""

from __future__ import annotations

import contextlib
import errno
import io
import queue
import secrets
import socket
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from softmode.checks import require_number
from softmode.deformables.reduction.patch import Patch
from softmode.errors import ConfigError, SoftmodeError, needs_extra
from softmode.files import free_name
from softmode.view.live_types import Hit, Vector
from softmode.view.panel import Command, MouseMode, Panel
from softmode.view.stage import Stage

if TYPE_CHECKING:
    import viser

    from softmode.view.session import LiveSession

LOOPBACK = ("127.0.0.1", "localhost", "::1")
READOUT_PERIOD = 0.25
"""Time between two readouts [s]."""


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Where a live session is served and how often it is shown."""

    host: str = "127.0.0.1"
    """Address to listen at. Whoever reaches it, and has the token, may drive the session."""
    port: int = 8080
    """Port to listen at; 0 for any free one."""
    frame_rate: float = 30.0
    """Pictures per second [1/s]."""
    record_folder: Path = Path("out")
    """Where recordings are written."""
    record_as: Literal["mp4", "npz", "usdc"] = "mp4"
    """What a recording is: a video, coordinates to be shown again, or an OpenUSD stage."""
    token: str = field(default_factory=lambda: secrets.token_urlsafe(16), init=False, repr=False)
    """Last part of the page's address, drawn anew for each; without it nothing is answered."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        hint = "give a port like 8080, or 0 for any"
        require_number("port", self.port, at_least=0, at_most=65535, hint=hint)
        require_number("frame_rate", self.frame_rate, at_least=1.0, at_most=120.0, hint="give a rate like 30")

    @property
    def is_local(self) -> bool:
        """Whether only this machine can reach it."""
        return self.host in LOOPBACK

    def check(self) -> None:
        """Make sure that a server can be started here.

        Raises:
            ConfigError: If the address or the port cannot be used.
            MissingExtraError: If viser is not installed.
        """
        _viser()
        _free_port(self.host, self.port)


class ViewApp:
    """A server whose page shows a live session; all browsers that open it see and drive the same one.

    The session is called from the thread that calls `run` or `frame` alone: what browsers ask for waits in a queue.
    A context manager; `close` ends the server, not the session.

    Args:
        session: What to show.
        options: Where, and how often.
        capture: Whether the page has a button that asks to turn and crop the capture which the session shows.

    Raises:
        ConfigError: If the address or the port cannot be used.
        MissingExtraError: If viser is not installed.
    """

    def __init__(self, session: LiveSession, options: ViewOptions | None = None, *, capture: bool = False) -> None:
        """Start the server and build the page."""
        self.session, self.options = session, options or ViewOptions()
        self.asked_to_prepare = False
        """Whether somebody pressed that button, which ends :meth:`run`."""
        self._commands: queue.SimpleQueue[Command] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._drag: _Drag | None = None
        self._touched: list[Hit] = []
        self._sent: deque[float] = deque(maxlen=60)
        self._told = -np.inf
        self._clients = 0
        self._server = start_server(self.options)
        try:
            self._stage = Stage(
                self._server, session, on_drag=self._on_drag, on_click=self._on_click, on_pin=self._on_pin
            )
            self._panel = Panel(
                self._server, session, submit=self.submit, on_mode=self._on_mode, record_path=self._record_path,
                on_prepare=self.prepare if capture else None,
            )  # fmt: skip
            aim(self._server)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> ViewApp:
        """Return the app."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the server."""
        self.close()

    @property
    def url(self) -> str:
        """Where to point the browser."""
        return page_url(self.options, self._server.get_port())

    @property
    def frame_rate(self) -> float:
        """Pictures sent per second, over the last two seconds or so; 0 before there are two."""
        if len(self._sent) < 2 or self._sent[-1] == self._sent[0]:
            return 0.0
        return (len(self._sent) - 1) / (self._sent[-1] - self._sent[0])

    def run(self, duration: float | None = None) -> None:
        """Run until :meth:`stop` is called, or for `duration` seconds of the clock."""
        period = 1.0 / self.options.frame_rate
        begun = due = time.perf_counter()
        while not self._stop.is_set() and (duration is None or time.perf_counter() - begun < duration):
            self.frame(period)
            now = time.perf_counter()
            due = max(due + period, now - period)  # makes up for one late frame, not for a long pause
            self._stop.wait(max(due - now, 0.0))

    def submit(self, command: Command) -> None:
        """Queue something to be done with the session before the next frame; may be called from any thread."""
        self._commands.put(command)

    def stop(self) -> None:
        """Let :meth:`run` return; may be called from any thread."""
        self._stop.set()

    def prepare(self) -> None:
        """Ask to turn and crop the capture, as the button does; may be called from any thread."""
        self.asked_to_prepare = True
        self.stop()

    def close(self) -> None:
        """End the server; may be called twice."""
        self._stop.set()
        with _quiet():
            self._server.stop()

    def frame(self, frame_dt: float) -> None:
        """Do what was asked for, let `frame_dt` seconds pass, show the result."""
        asked = self._obey()
        passed = self.session.advance(frame_dt)
        clients = len(self._server.get_clients())
        arrived, self._clients = clients > self._clients, clients
        now = time.perf_counter()
        if clients and (asked or passed > 0.0 or arrived):
            self._stage.update()
            self._sent.append(time.perf_counter())
        if clients and now - self._told >= READOUT_PERIOD:
            self._told = now
            self._panel.update(self.session, self.frame_rate, clients)

    def _obey(self) -> bool:
        """Do what was asked for since the last frame; what cannot be done is told to the people."""
        asked = False
        with contextlib.suppress(queue.Empty):
            while True:
                command = self._commands.get_nowait()
                asked = True
                try:
                    command(self.session)
                except SoftmodeError as error:
                    self._panel.tell(f"**{error}**")
                    print(f"softmode: {error}", file=sys.stderr)
                except Exception as error:  # one page's message must not end the session of all
                    self._panel.tell(f"**{type(error).__name__}: {error}** (the session goes on)")
                    traceback.print_exc()
        return asked

    # -- what browsers ask for, in viser's thread ---------------------------------------------------------------------

    async def _on_drag(self, event: Any) -> None:
        """Queue one step of a drag of the mouse; async, so that steps stay in order."""
        camera, client, phase = event.client.camera, event.client_id, event.phase
        eye, forward = camera.position, _forward(camera.wxyz)
        start, end = np.array(event.start_position), np.array(event.end_position)
        self.submit(lambda session: self._do_drag(session, client, phase, eye, forward, start, end))

    async def _on_click(self, event: Any) -> None:
        """Queue a click on the object."""
        origin, along = event.ray_origin, event.ray_direction

        def pin(session: LiveSession) -> None:
            hit = session.pick(np.array(origin), np.array(along))
            if hit is not None and self._panel.mouse_mode == "pin":
                session.pin(hit)

        self.submit(pin)

    def _on_pin(self, number: int, position: Vector, wxyz: Vector) -> None:
        """Queue the motion of a gizmo."""

        def move(session: LiveSession) -> None:
            if number in session.pins():
                session.move_pin(number, position, wxyz)

        self.submit(move)

    # -- in the thread of the session ---------------------------------------------------------------------------------

    def _on_mode(self, mode: MouseMode) -> None:
        """Clicks count where they pin."""
        self._stage.set_clickable(mode == "pin")

    def _do_drag(
        self, session: LiveSession, client: int, phase: str, eye: Vector, forward: Vector, start: Vector, end: Vector
    ) -> None:
        """Begin, follow or end a drag; one at a time, the first one's."""
        mode = self._panel.mouse_mode
        if mode in ("cut", "slit") and self._drag is None:
            self._draw_stroke(session, mode, phase, eye, start, end)
            return
        if mode == "paint" and self._drag is None:
            self._draw_brush(session, phase, eye, end)
            return
        if phase == "start":
            if self._drag is not None:
                return
            hit = session.pick(eye, start - eye)
            if hit is None:
                return
            depth = float(forward @ (hit.point - eye))
            if self._panel.mouse_mode == "pin":
                number = session.pin(hit)
                centre = session.pins()[number].position
                self._drag = _Drag(client=client, depth=depth, pin=number, offset=centre - hit.point)
            else:
                session.begin_drag(hit)
                self._drag = _Drag(client=client, depth=depth, pin=None, offset=np.zeros(3))
        drag = self._drag
        if drag is None or drag.client != client:
            return
        # The mouse's ray, cut with the plane through the gripped point that is parallel to the picture.
        ray = end - eye
        ahead = float(forward @ ray)
        if ahead > 1e-6 * float(np.linalg.norm(ray)):  # else it does not meet the plane: the camera has been turned
            cursor = eye + ray * (drag.depth / ahead)
            if drag.pin is None and session.drag() is not None:  # a reset, or another body, ends it
                session.drag_to(cursor)
            elif drag.pin in session.pins():
                session.move_pin(drag.pin, cursor + drag.offset)
                self._stage.move_gizmo(drag.pin, cursor + drag.offset)
        if phase == "end":
            self._drag = None
            if drag.pin is None:
                session.end_drag()

    def _draw_stroke(
        self, session: LiveSession, mode: MouseMode, phase: str, eye: Vector, start: Vector, end: Vector
    ) -> None:
        """Show the stroke of a knife, and cut at its end: by the whole plane of the two rays, or between them alone."""
        self._stage.stroke = None if phase == "end" else (start, end)
        if phase == "end":
            patch = Patch.stroke(eye, start, end)
            session.cut(patch if mode == "slit" else Patch.plane(eye, np.cross(start - eye, end - eye)))

    def _draw_brush(self, session: LiveSession, phase: str, eye: Vector, end: Vector) -> None:
        """Gather where a stroke touches the object, and paint at its end."""
        if phase == "start":
            self._touched.clear()
        hit = session.pick(eye, end - eye)
        if hit is not None:
            self._touched.append(hit)
            self._stage.stroke = (self._touched[0].point, hit.point)
        if phase == "end":
            self._stage.stroke = None
            factor, radius, depth = self._panel.brush
            size = float(np.linalg.norm(np.ptp(session.object.body.bounds, axis=0)))
            session.paint(self._touched, factor, radius=radius * size, depth=depth * size)

    def _record_path(self, kind: str | None = None) -> Path:
        """Name the next recording, or another file beside it of a kind of its own."""
        name = f"{time.strftime('view-%Y%m%d-%H%M%S')}.{kind or self.options.record_as}"
        return free_name(self.options.record_folder / name)


@dataclass(frozen=True, kw_only=True)
class _Drag:
    """What the mouse of one browser holds."""

    client: int
    depth: float
    """Of the gripped point before the camera [m]."""
    pin: int | None
    """The pin that is moved, None for a pull."""
    offset: Vector
    """From the gripped point to the centre of the pin [m]."""


def _forward(wxyz: Vector) -> Vector:
    """Return the direction in which a camera looks, the third axis of its frame."""
    w, x, y, z = wxyz / np.linalg.norm(wxyz)
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def page_url(options: ViewOptions, port: int) -> str:
    """Return where to point the browser."""
    host = "localhost" if options.host in ("0.0.0.0", "::") else options.host
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/{options.token}/"


def _viser() -> Any:
    """Import viser."""
    with needs_extra("viz", "the browser tool needs viser"):
        import viser
    return viser


def start_server(options: ViewOptions) -> viser.ViserServer:
    """Start viser's server where it was told to be, and nowhere else, behind a :class:`Gate`."""
    viser = _viser()
    import websockets.asyncio.server as transport  # viser's own

    from softmode.view.gate import Gate

    port = _free_port(options.host, options.port)
    gate = Gate(options.token, LOOPBACK if options.is_local else None)
    with _quiet(), _replaced(transport, "serve", gate.before(transport.serve)):  # viser has no argument for it
        server = viser.ViserServer(host=options.host, port=port, label="softmode", verbose=False)
    if server.get_port() != port:  # viser takes the next port when one is taken
        with _quiet():
            server.stop()
        raise _port_error(options.host, port)
    gate.server = server
    return server


def aim(server: viser.ViserServer) -> None:
    """Let pages of an earlier server at this address, which connect again, look where a new page does."""
    first = server.initial_camera

    async def look(client: viser.ClientHandle) -> None:  # async, so that it comes before what the page sends next
        camera = client.camera
        camera.fov, camera.near, camera.far = first.fov, first.near, first.far
        camera.position, camera.look_at = first.position, first.look_at

    server.on_client_connect(look)


def _free_port(host: str, port: int) -> int:
    """Return the port, or a free one for 0, after making sure that it can be had: viser tries others, or hangs."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            return int(probe.getsockname()[1])
    except OSError as error:
        raise _port_error(host, port, error) from error


def _port_error(host: str, port: int, error: OSError | None = None) -> ConfigError:
    """Return the error that names the remedy: another port if this one is taken or kept back, else another address."""
    reason = "it was taken in the meantime" if error is None else error.strerror or str(error)
    if error is None or error.errno in (errno.EADDRINUSE, errno.EACCES):
        hint = "give another --port, or 0 for any free one"
    else:
        hint = "give an address of this machine as --host, such as 127.0.0.1"
    return ConfigError(f"cannot listen at {host}, port {port}: {reason}", hint=hint)


@contextlib.contextmanager
def _replaced(module: Any, name: str, value: Any) -> Iterator[None]:
    """Let a module have another attribute for a while."""
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, before)


def _quiet() -> contextlib.AbstractContextManager[Any]:
    """Keep viser's greetings from the terminal."""
    return contextlib.redirect_stdout(io.StringIO())
