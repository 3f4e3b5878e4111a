"""The panel of the page: what a person sets, and what the session tells."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from softmode.view.live_types import LiveParameters

if TYPE_CHECKING:
    import viser

    from softmode.view.session import LiveSession

Command = Callable[["LiveSession"], None]
MouseMode = Literal["drag", "pin", "cut", "slit", "paint"]
MOUSE_HINT = (
    "drag: pull the object. pin: hold the region that is clicked. cut: draw a stroke; the plane of stroke and camera"
    " cuts. slit: only as far as the stroke goes. paint: draw over what shall be stiffer or softer"
)
FOLLOW_PAUSE = 1.0
"""How long a slider that was moved by hand is left alone [s]."""
MODULUS_MARKS = ((3.0, "1 k"), (4.0, "10 k"), (5.0, "100 k"), (6.0, "1 M"), (7.0, "10 M"))
PLOT_POINTS = 150
FUNCTION_COUNTS = (16, 24, 36, 48, 60, 80)
"""Numbers of functions on offer, beside the present one."""


@dataclass(frozen=True, eq=False)
class Slider:
    """One parameter of the session on a slider."""

    label: str
    parameter: str
    """What it sets, by its name in `LiveParameters`."""
    limits: tuple[float, float, float]
    """Lowest value, highest value and step."""
    read: Callable[[Any], float] = float
    """From the parameter to the slider."""
    write: Callable[[float], float] = float
    """From the slider to the parameter."""
    hint: str | None = None
    marks: tuple[tuple[float, str], ...] | None = None

    def set(self, session: LiveSession, value: float) -> None:
        """Give the session what the slider shows."""
        session.set_parameters(**{self.parameter: self.write(value)})

    def shown(self, now: LiveParameters) -> float:
        """Return the value to show, in the slider's range and without the noise of single precision."""
        low, high, _ = self.limits
        return round(min(max(self.read(getattr(now, self.parameter)), low), high), 5)


SLIDERS = (
    Slider("log10 E [Pa]", "youngs_modulus", (3.0, 7.0, 0.05), math.log10, lambda x: 10.0**x, marks=MODULUS_MARKS),
    Slider("nu", "poissons_ratio", (0.0, 0.49, 0.01), hint="Poisson's ratio"),
    Slider("density", "density", (50.0, 3000.0, 10.0), hint="kg/m^3"),
    Slider("viscosity [ms]", "viscosity", (0.0, 50.0, 0.5), lambda x: 1e3 * x, lambda x: 1e-3 * x, "damps deformation"),
    Slider("air drag [1/s]", "mass_damping", (0.0, 10.0, 0.1), hint="damps all motion"),
    Slider("friction", "friction", (0.0, 2.0, 0.05), hint="Coulomb's coefficient"),
    Slider("gravity", "gravity", (0.0, 20.0, 0.01), lambda x: math.hypot(*x), hint="m/s^2, downwards"),
)


class Panel:
    """The controls beside the picture. What they ask for is put into a queue, by viser's threads.

    Args:
        server: Where they are shown.
        session: Whose values they start with.
        submit: Takes what shall be done with the session.
        on_mode: Called with the mode of the mouse when it is chosen, in the thread that runs the session.
        record_path: Names the next recording, or a file of another suffix.
        on_prepare: Called when a person asks to turn and crop the capture; None has no button for it.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: LiveSession,
        *,
        submit: Callable[[Command], None],
        on_mode: Callable[[MouseMode], None],
        record_path: Callable[..., Path],
        on_prepare: Callable[[], None] | None = None,
    ) -> None:
        """Build the controls."""
        self._gui, self._submit, self._on_mode, self._record_path = server.gui, submit, on_mode, record_path
        self.mouse_mode: MouseMode = "drag"
        self._sliders: dict[Slider, Any] = {}
        self._touched: dict[Slider, float] = {}
        self._plot_data: deque[tuple[float, float, float, float]] = deque(maxlen=PLOT_POINTS)
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        if on_prepare is not None:
            self._add_prepare(on_prepare)
        self._add_time()
        self._add_mouse()
        self._add_material(session)
        self._add_readouts()

    def _add_prepare(self, on_prepare: Callable[[], None]) -> None:
        """A button for captures that lie wrong or hold too much."""
        button = self._gui.add_button("prepare", hint="turn the capture upright and crop it, then build it again")

        @button.on_click
        async def _(_: Any) -> None:
            on_prepare()

    def _add_time(self) -> None:
        """Buttons that start, stop and record."""
        gui = self._gui
        buttons = gui.add_button_group("time", ("play", "pause", "step", "reset"))

        @buttons.on_click
        async def _(_: Any) -> None:
            actions: dict[str, Command] = {
                "play": lambda session: session.play(),
                "pause": lambda session: session.pause(),
                "step": lambda session: (session.pause(), session.step(), None)[-1],
                "reset": lambda session: session.reset(),
            }
            self._submit(actions[str(buttons.value)])

        self._record = gui.add_button("record", hint="Starts and stops a recording of the scene")

        @self._record.on_click
        async def _(_: Any) -> None:
            self._submit(self._toggle_recording)

    def _toggle_recording(self, session: LiveSession) -> None:
        """Start a recording, or write the one that is being made."""
        if session.status().recording:
            path = session.stop_recording()
            self.tell(f"wrote {path}")
        else:
            path = self._record_path()
            session.start_recording(path)
            self.tell(f"recording {path}")

    def _add_mouse(self) -> None:
        """What the mouse does on the object, and the way back."""
        gui = self._gui
        modes: dict[str, MouseMode] = {name: name for name in get_args(MouseMode)}
        mode = gui.add_dropdown("mouse", tuple(modes), initial_value="drag", hint=MOUSE_HINT)

        @mode.on_update
        async def _(_: Any) -> None:
            chosen = modes[mode.value]
            self._submit(lambda session: self._set_mode(chosen))

        unpin = gui.add_button_group("unpin", ("last", "all"))

        @unpin.on_click
        async def _(_: Any) -> None:
            only_last = unpin.value == "last"
            self._submit(lambda session: self._unpin(session, only_last))

        with gui.add_folder("brush", expand_by_default=False):
            size = (0.01, 0.5, 0.01)
            self._radius = gui.add_slider("radius", *size, 0.1, hint="over the object's size")
            self._depth = gui.add_slider("depth", *size, 0.2, hint="over the object's size")
            self._factor = gui.add_slider("log10 factor", -3.0, 3.0, 0.1, -1.0, hint="times as stiff as now")
            actions = gui.add_button_group("painted", ("undo", "save"), hint="save writes the body with its splats")

        @actions.on_click
        async def _(_: Any) -> None:
            undo = actions.value == "undo"
            self._submit(lambda session: session.undo_paint() if undo else self._save(session))

        build = gui.add_button("build for pins", hint="builds the object anew for the regions that are pinned")

        @build.on_click
        async def _(_: Any) -> None:
            self._submit(lambda session: session.build_for_pins())

    def _save(self, session: LiveSession) -> None:
        """Write the object beside the recordings."""
        path = self._record_path("npz")
        session.save(path)
        self.tell(f"wrote {path}")

    @property
    def brush(self) -> tuple[float, float, float]:
        """Factor, radius and depth of the brush, lengths over the object's size."""
        return 10.0**self._factor.value, self._radius.value, self._depth.value

    def _set_mode(self, mode: MouseMode) -> None:
        """Change what the mouse does."""
        self.mouse_mode = mode
        self._on_mode(mode)

    @staticmethod
    def _unpin(session: LiveSession, only_last: bool) -> None:
        """Let pins go."""
        for number in sorted(session.pins(), reverse=True)[: 1 if only_last else None]:
            session.unpin(number)

    def _add_material(self, session: LiveSession) -> None:
        """Sliders, at the values that the session has."""
        gui, now = self._gui, session.parameters
        with gui.add_folder("material"):
            for slider in SLIDERS:
                says = {"hint": slider.hint, "marks": slider.marks}
                self._connect(slider, gui.add_slider(slider.label, *slider.limits, slider.shown(now), **says))
        choices = tuple(str(count) for count in sorted({*FUNCTION_COUNTS, now.functions}))
        hint = "functions of the body, chosen by elastic energy; another number builds the object anew"
        functions = gui.add_dropdown("functions", choices, initial_value=str(now.functions), hint=hint)

        @functions.on_update
        async def _(event: Any) -> None:
            if event.client is None:
                return
            count = int(functions.value)
            self._submit(lambda session: self._set_functions(session, count))

        self._functions = functions

    def _set_functions(self, session: LiveSession, count: int) -> None:
        """Build the object with other functions; the picture stands still for as long as that takes."""
        self.tell(f"building with {count} functions ...")
        session.set_functions(count)
        self.tell(f"built with {count} functions")

    def _connect(self, slider: Slider, handle: Any) -> None:
        """Let a slider change the session."""
        self._sliders[slider] = handle
        self._touched[slider] = -math.inf

        async def changed(event: Any) -> None:
            if event.client is None:  # not a person: the slider follows the session
                return
            value = handle.value
            self._touched[slider] = time.monotonic()
            self._submit(lambda session: slider.set(session, value))

        handle.on_update(changed)

    def _follow(self, now: LiveParameters) -> None:
        """Let sliders that nobody moves show what the session has: an environment draws anew in each episode."""
        for slider, handle in self._sliders.items():
            value, idle = slider.shown(now), time.monotonic() - self._touched[slider]
            if abs(handle.value - value) > 0.5 * slider.limits[2] and idle > FOLLOW_PAUSE:
                handle.value = value
        if self._functions.value != str(now.functions) and str(now.functions) in self._functions.options:
            self._functions.value = str(now.functions)

    def _add_readouts(self) -> None:
        """Text and a plot of energies."""
        from viser import uplot

        gui = self._gui
        self._message = gui.add_markdown("")
        self._text = gui.add_markdown("")
        colors = {"kinetic": "#1f77b4", "elastic": "#d62728", "gravity": "#2ca02c"}
        curves = (uplot.Series(label=name, stroke=color, width=2) for name, color in colors.items())
        series, scales = (uplot.Series(label="time"), *curves), {"x": uplot.Scale(time=False)}
        empty = tuple(np.zeros(2) for _ in series)
        self._plot = gui.add_uplot(empty, series=series, scales=scales, title="energy [J]", height=170)

    def tell(self, message: str) -> None:
        """Show a line of text above the readouts."""
        self._message.content = message.replace("`", "'")

    def update(self, session: LiveSession, frame_rate: float, clients: int) -> None:
        """Show what the session tells."""
        status, energies = session.status(), session.energies()
        self._follow(session.parameters)
        rows = [
            ("time", f"{status.time:.2f} s, {'playing' if status.playing else 'paused'}"),
            ("real time", f"{status.realtime_factor:.2f} x"),
            ("pictures", f"{frame_rate:.0f} per second"),
            ("physics step", f"{status.step_milliseconds:.2f} ms"),
            ("solver", ", ".join(status.solver) or "converged"),
            ("energy", f"{energies.kinetic:.2e} kinetic, {energies.elastic:.2e} elastic J"),
        ]
        if status.notice:
            rows += [("notice", status.notice)]
        if status.reward_terms:
            rows += [("reward", ", ".join(f"{name} {value:.2f}" for name, value in status.reward_terms.items()))]
            rows += [("episode", f"{status.episode}{', solved' if status.success else ''}")]
        if clients > 1:
            rows += [("viewers", str(clients))]
        text = "| | |\n|---|---|\n" + "\n".join(f"| {name} | {value} |" for name, value in rows)
        if text != self._text.content:
            self._text.content = text
        label = "stop recording" if status.recording else "record"
        if self._record.label != label:
            self._record.label = label
        if self._plot_data and status.time < self._plot_data[-1][0]:
            self._plot_data.clear()
        if not self._plot_data or status.time > self._plot_data[-1][0]:
            self._plot_data.append((status.time, energies.kinetic, energies.elastic, energies.gravitational))
            if len(self._plot_data) > 1:
                self._plot.data = tuple(np.array(column) for column in zip(*self._plot_data, strict=True))
