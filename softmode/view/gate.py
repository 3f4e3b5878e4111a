"""What reaches the server of a page: requests with its token, and messages whose fields a page has, in their sizes."""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import hmac
import logging
import math
import operator
import re
import sys
import time
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Annotated, Any, Literal
from urllib.parse import urlsplit

import msgspec
from msgspec import Meta
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosedError

if TYPE_CHECKING:
    import viser

MESSAGE_BYTES = 2**14
"""Most that a message may have; a page sends some hundred bytes."""
MESSAGE_RATE = 300.0
"""Messages of a page that are taken per second, after a first burst of as many; others wait in its connection."""
_Text = Annotated[str, Meta(max_length=256)]
_Number = Annotated[float, Meta(ge=-1e9, le=1e9)]  # neither infinite nor NaN
_Pixel = tuple[float, float]  # beside the picture it may be anywhere
_Point = tuple[_Number, _Number, _Number]
_Turn = tuple[_Number, _Number, _Number, _Number]
_Value = msgspec.defstruct("_Value", [("value", bool | _Number | _Text)], forbid_unknown_fields=True)
_NODE = {"name": _Text, "owner": _Text}
_PICKED = _NODE | {"instance_index": int | None, "modifier": _Text | None}  # pyright: ignore[reportOperatorIssue]
_FIELDS: dict[str, dict[str, Any]] = {
    "ViewerCameraMessage": {"wxyz": _Turn}
    | dict.fromkeys(("fov", "near", "far", "image_height", "image_width"), _Number)
    | dict.fromkeys(("position", "look_at", "up_direction"), _Point),
    "GuiUpdateMessage": {"uuid": _Text, "updates": _Value},
    "SceneNodeClickMessage": _PICKED | {"ray_origin": _Point, "ray_direction": _Point, "screen_pos": _Pixel},
    "SceneNodeDragMessage": _PICKED
    | {"phase": Literal["start", "update", "end"], "button": _Text}
    | dict.fromkeys(("start_position", "end_position"), _Point)
    | dict.fromkeys(("start_screen_pos", "end_screen_pos"), _Pixel),
    "TransformControlsUpdateMessage": _NODE | {"wxyz": _Turn, "position": _Point},
    "TransformControlsDragStartMessage": _NODE,
    "TransformControlsDragEndMessage": _NODE,
}
"""What a page of softmode's sends, by viser's names; whatever else viser would take is refused, uploads among it."""
_STRICT: dict[str, Any] = {"tag_field": "type", "forbid_unknown_fields": True, "kw_only": True}
_KINDS = (  # as viser has it, the owner of what names none is the server
    msgspec.defstruct(
        kind, [(x, what, "") if x == "owner" else (x, what) for x, what in fields.items()], tag=kind, **_STRICT
    )
    for kind, fields in _FIELDS.items()
)
_DECODER = msgspec.msgpack.Decoder(functools.reduce(operator.or_, _KINDS))


class Gate:
    """Stands before viser's server: it refuses what no page of softmode's sends, and says so once for each kind.

    Args:
        token: First part of the path of every request.
        hosts: Names of this machine by which pages may reach it; None for any.
    """

    def __init__(self, token: str, hosts: Collection[str] | None) -> None:
        """Begin with a server that has no controls yet."""
        self._token, self._hosts = token, hosts
        self._told: set[str] = set()
        self.server: viser.ViserServer | None = None
        """The server, once there is one."""

    def before(self, serve: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function with which websockets starts a server, with the gate before it."""
        gate = self

        class Gated(ServerConnection):
            """A connection of which only messages arrive that the gate lets through."""

            due = 0.0
            """When the next message is taken [s]."""

            async def recv(self, decode: bool | None = None) -> Any:
                """Return the next message."""
                while True:
                    try:
                        raw = await super().recv(decode)
                    except ConnectionClosedError as error:
                        if error.sent is not None and error.sent.code == 1009:
                            gate.tell(f"a message of more than {MESSAGE_BYTES} bytes, and closed its connection")
                        raise
                    now = time.monotonic()
                    self.due = max(self.due, now - 1.0) + 1.0 / MESSAGE_RATE
                    if self.due > now:
                        gate.tell(f"to take more than {MESSAGE_RATE:g} messages per second from a page")
                        await asyncio.sleep(self.due - now)
                    if (message := gate.checked(raw)) is not None:
                        return message

        def line(record: logging.LogRecord) -> None:
            error = record.exc_info[0] if record.exc_info else None
            gate.tell(f"a connection: {record.getMessage()}{f' ({error.__name__})' if error else ''}")

        logger = logging.Logger("softmode.view", logging.WARNING)
        logger.addFilter(line)  # type: ignore[arg-type]  # which lets nothing through to a handler
        limits = {"max_size": MESSAGE_BYTES, "logger": logger, "create_connection": Gated}

        def gated(*where: Any, process_request: Any, **given: Any) -> Any:
            admit = functools.partial(self._admit, process_request)
            return serve(*where, process_request=admit, **{**given, **limits})

        return gated

    def tell(self, kind: str) -> None:
        """Say what is refused, the first time."""
        if kind not in self._told:
            self._told.add(kind)
            print(f"softmode: refused {kind}; that is said once", file=sys.stderr)

    def _admit(self, answer: Callable[..., Any], connection: ServerConnection, request: Any) -> Any:
        """Answer a request with the token in its path, which a page of this server makes, or no page."""
        token = re.split("[/?]", request.path[1:], maxsplit=1)[0]
        if not hmac.compare_digest(token.encode("ascii", "replace"), self._token.encode()):
            self.tell("a request without the token")
            return connection.respond(403, "Open the address that softmode has printed: it ends in a token.\n")
        origin, host = request.headers.get("Origin"), request.headers.get("Host", "")
        known = self._hosts is None or urlsplit(f"//{host}").hostname in self._hosts
        if not known or origin not in (None, f"http://{host}", f"https://{host}"):
            self.tell("a request of a page that is not its own")
            return connection.respond(403, "Only this server's own page may ask for that.\n")
        rest = request.path[1 + len(token) :]
        response = answer(connection, dataclasses.replace(request, path=f"/{rest.removeprefix('/')}"))
        if response is not None:
            response.headers["Referrer-Policy"] = "no-referrer"  # it would hold the token
        return response

    def checked(self, raw: bytes | str) -> bytes | None:
        """Return a message as viser may have it, None for one that it may not."""
        try:
            message: Any = _DECODER.decode(raw if isinstance(raw, bytes) else b"")
        except (msgspec.MsgspecError, UnicodeError, RecursionError):
            return self.tell("a message that no page of softmode's sends")
        if hasattr(message, "updates"):
            # viser has no public way from a message to its control.
            handle = self.server and self.server.gui._gui_input_handle_from_uuid.get(message.uuid)
            if handle is None:  # it is gone
                return None
            message.updates.value = _fitting(handle, message.updates.value)
            if message.updates.value is None:
                return self.tell("a value that its control does not take")
        elif math.hypot(*getattr(message, "wxyz", (1.0,))) < 1e-6:
            return self.tell("a quaternion of length zero")
        return msgspec.msgpack.encode(message)


def _fitting(handle: Any, value: bool | float | str) -> bool | float | str | None:
    """Return a value as its control takes it, a number in its range; None for another, and for one that only shows."""
    if getattr(handle, "disabled", False):
        return None
    if isinstance(value, str):
        return value if value in getattr(handle, "options", ()) else None
    if isinstance(value, bool) or isinstance(handle.value, bool | str):
        return value if isinstance(handle.value, bool) and isinstance(value, bool) else None
    return min(max(value, handle.min), handle.max)
