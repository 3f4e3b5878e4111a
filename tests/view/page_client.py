"""A page without a browser: connects to a view's websocket as viser's page does, and counts what arrives.

Run: ``python -m tests.view.page_client http://127.0.0.1:8080/TOKEN/ SECONDS``; prints one line of JSON.
"""

from __future__ import annotations

import json
import sys
import time
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, -1.0),
    "fov": 0.7,
    "near": 0.01,
    "far": 100.0,
    "image_height": 480,
    "image_width": 640,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


class PageClient:
    """One connection; a context manager.

    Args:
        url: The page's address, http://host:port/token/.
        origin: The page that a browser would say it comes from; None for a client that is no browser.
    """

    def __init__(self, url: str, *, origin: str | None = None) -> None:
        """Connect and say where the camera is, which is when viser counts a client."""
        import viser
        from websockets.sync.client import connect

        protocol: Any = f"viser-v{viser.__version__}"
        self.socket: ClientConnection = connect(
            url.replace("http://", "ws://"), subprotocols=[protocol], origin=origin, max_size=None, compression=None
        )
        self.send(CAMERA)

    def __enter__(self) -> PageClient:
        """Return the client."""
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect."""
        self.socket.close()

    def send(self, message: dict[str, Any]) -> None:
        """Send one message, "type" and its fields."""
        import msgspec

        self.socket.send(msgspec.msgpack.encode(message))

    def receive(self, timeout: float | None = None) -> tuple[list[dict[str, Any]], list[bytes], int]:
        """Return the messages of the next packet, the arrays that they refer to, and its size [bytes]."""
        import msgspec
        import zstandard

        raw = self.socket.recv(timeout)
        assert isinstance(raw, bytes)
        compressed = int.from_bytes(raw[8:16], "little")
        body = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16 : 16 + compressed]))
        place, arrays = 16 + compressed, []
        for length in body["binaryBufferLengths"]:
            place += -place % 8
            arrays.append(raw[place : place + length])
            place += length
        return list(body["messages"]), arrays, len(raw)

    def splats(self, timeout: float = 10.0) -> tuple[np.ndarray, int]:
        """Wait for splats that have changed; return their words, shape (N, 8), and the size of the packet [bytes]."""
        ends = time.monotonic() + timeout
        while time.monotonic() < ends:
            messages, arrays, size = self.receive(timeout)
            for message in messages:
                if message["type"] == "SceneNodeUpdateMessage" and "buffer" in message["updates"]:
                    place = message["updates"]["buffer"]["__binary_index"]
                    return np.frombuffer(arrays[place], np.uint32).reshape(-1, 8), size
        raise TimeoutError("no splats came")


def main(url: str, seconds: float) -> None:
    """Count pictures for some seconds, after one second to warm up."""
    sizes: list[int] = []
    arrivals: list[float] = []
    with PageClient(url) as client:
        begun = time.monotonic()
        while time.monotonic() < begun + 1.0 + seconds:
            words, size = client.splats()
            if time.monotonic() > begun + 1.0:
                sizes.append(size)
                arrivals.append(time.monotonic())
    gaps = np.diff(arrivals)
    print(
        json.dumps(
            {
                "frame_rate": len(gaps) / (arrivals[-1] - arrivals[0]),
                "bytes": float(np.median(sizes)),
                "splats": len(words),
                "slowest_gap": float(gaps.max()),
            }
        )
    )


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
