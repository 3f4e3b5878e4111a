"""A view that runs in a thread, for tests that play the browser."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np

from softmode.deformables.reduction.options import BuildOptions
from softmode.objects import ObjectConfig
from softmode.view.app import ViewApp, ViewOptions
from softmode.view.session import LiveSession

T = TypeVar("T")
SAUSAGE = ObjectConfig(
    shape="capsule",
    extents=(0.04, 0.04, 0.12),
    colors=((0.95, 0.45, 0.1), (0.85, 0.25, 0.1)),
    splat_count=1200,
    build=BuildOptions(mode_count=4),
)
"""A soft capsule on end."""


class Served:
    """An app whose session lives in a thread of its own."""

    def __init__(self, app: ViewApp, low: np.ndarray) -> None:
        """Remember the app and which surface samples are the lowest tenth at the start."""
        self.app, self._low = app, low

    def lowest(self, session: LiveSession) -> np.ndarray:
        """Return the mean of the lowest tenth of the object, where it is now [m]."""
        return session.surface()[self._low].mean(axis=0)

    def ask(self, what: Callable[[LiveSession], T]) -> T:
        """Return what a function of the session says, in the session's thread."""
        answer: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.app.submit(lambda session: answer.put(what(session)))
        return answer.get(timeout=30.0)

    def wait(self, what: Callable[[LiveSession], bool], seconds: float = 20.0) -> bool:
        """Wait until a function of the session says yes; return whether it did."""
        pause = threading.Event()
        for _ in range(int(seconds / 0.05)):
            if self.ask(what):
                return True
            pause.wait(0.05)
        return False


@contextlib.contextmanager
def served(config: ObjectConfig = SAUSAGE, *, frame_rate: float = 30.0, **given: Any) -> Iterator[Served]:
    """Serve a session with a hanging object on a free port."""
    ready: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def work() -> None:
        try:
            session = LiveSession.from_object(config, device="cpu")
            session.set_parameters(viscosity=0.02, mass_damping=2.0)
            with ViewApp(session, ViewOptions(port=0, frame_rate=frame_rate, **given)) as app:
                height = session.surface()[:, 2]
                ready.put(Served(app, height <= np.quantile(height, 0.1)))
                app.run()
            session.close()
        except BaseException as error:
            ready.put(error)
            raise

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    one = ready.get(timeout=180.0)
    if isinstance(one, BaseException):
        raise one
    try:
        yield one
    finally:
        one.app.stop()
        thread.join(timeout=30.0)
        assert not thread.is_alive()
