"""How often `softmode view` shows a deforming object, and what a picture costs.

A plush of 20,000 splats hangs and is pulled in a circle, as by a mouse; physics, skinning and sending share the
process, a client in a process of its own reads the websocket as a page does. The rate is the client's. Medians of runs.

Run: ``python -m benchmarks.view [--splats 20000] [--seconds 8] [--runs 3] [--clients 1] [--frame-rate 30]``
"""

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from softmode.splats import make_plush, write_ply
from softmode.view.app import ViewApp, ViewOptions
from softmode.view.session import LiveSession


def shake(session: LiveSession, seconds: float, app: ViewApp) -> threading.Thread:
    """Begin a drag at the lowest surface sample and move the cursor in a circle; return the thread that does."""
    foot = session.surface()[session.surface()[:, 2].argmin()]
    reach = 0.2 * session.size

    def begin(session: LiveSession) -> None:
        eye = foot + np.array([0.0, -10.0 * session.size, 0.0])
        hit = session.pick(eye, session.surface()[session.surface()[:, 1].argmin()] - eye)
        if hit is None:
            raise RuntimeError("nothing to pull")
        session.begin_drag(hit)

    def move() -> None:
        app.submit(begin)
        for k in range(int(20 * seconds)):
            angle = 2.0 * np.pi * k / 20.0
            place = foot + reach * np.array([np.sin(angle), np.cos(angle), 0.0])
            app.submit(lambda session, place=place: session.drag_to(place) if session.drag() else None)
            time.sleep(0.05)

    thread = threading.Thread(target=move, daemon=True)
    thread.start()
    return thread


def stop_after(app: ViewApp, readers: list[subprocess.Popen[str]], factors: list[float]) -> None:
    """Note how fast simulated time goes while the clients read, then stop."""
    while any(reader.poll() is None for reader in readers):
        app.submit(lambda session: factors.append(session.status().realtime_factor))
        time.sleep(0.25)
    app.stop()


def measure(splats: Path, seconds: float, clients: int, frame_rate: float) -> dict[str, Any]:
    """Serve for some seconds; return what the clients and the session saw."""
    session = LiveSession.from_object(splats, size=0.12)
    with ViewApp(session, ViewOptions(port=0, frame_rate=frame_rate)) as app:
        command = [sys.executable, "-m", "tests.view.page_client", app.url, str(seconds)]
        readers = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(clients)]
        shake(session, seconds + 6.0, app)
        factors: list[float] = []
        watch = threading.Thread(target=stop_after, args=(app, readers, factors), daemon=True)
        watch.start()
        clock, cpu = time.perf_counter(), time.process_time()
        app.run()
        cores = (time.process_time() - cpu) / (time.perf_counter() - clock)
        seen = [json.loads(reader.communicate()[0]) for reader in readers]
        skinning, sending = [], []
        for _ in range(31):
            session.step()
            start = time.perf_counter()
            session.splats()
            middle = time.perf_counter()
            app._stage.update()  # takes the splats that were just made
            skinning.append(1e3 * (middle - start))
            sending.append(1e3 * (time.perf_counter() - middle))
    result = {
        "frame_rate": min(one["frame_rate"] for one in seen),
        "bytes": seen[0]["bytes"],
        "gap": max(one["slowest_gap"] for one in seen),
        "real_time": float(np.median(factors[len(factors) // 2 :])),
        "step": session.status().step_milliseconds,
        "cores": cores,
        "frame_cpu": 1e3 * cores / min(one["frame_rate"] for one in seen),
        "splats_ms": float(np.median(skinning)),
        "send_ms": float(np.median(sending)),
    }
    session.close()
    return result


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--splats", type=int, nargs="+", default=[20_000])
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--clients", type=int, default=1)
    parser.add_argument("--frame-rate", type=float, default=30.0)
    options = parser.parse_args()
    columns = (
        "splats, pictures/s, bytes, longest gap, real time, physics step, cores, CPU per picture, skinning, sending"
    )
    print(f"| {columns.replace(', ', ' | ')} |\n{'|---' * len(columns.split(', '))}|")
    with tempfile.TemporaryDirectory() as folder:
        for count in options.splats:
            file = Path(folder) / f"plush_{count}.ply"
            write_ply(file, make_plush(count=count))
            runs = [measure(file, options.seconds, options.clients, options.frame_rate) for _ in range(options.runs)]
            middle = {name: float(np.median([run[name] for run in runs])) for name in runs[0]}
            print(
                f"| {count} | {middle['frame_rate']:.1f} | {middle['bytes']:,.0f} | {1e3 * middle['gap']:.0f} ms "
                f"| {middle['real_time']:.2f} | {middle['step']:.2f} ms | {middle['cores']:.2f} "
                f"| {middle['frame_cpu']:.1f} ms | {middle['splats_ms']:.1f} ms | {middle['send_ms']:.1f} ms |",
                flush=True,
            )


if __name__ == "__main__":
    main()
