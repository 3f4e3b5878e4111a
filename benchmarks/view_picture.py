"""The picture of docs/view.md: `softmode view` in Chromium, a plush pulled by the mouse.

Needs playwright and a Chromium; without a graphics card it takes a minute or two.

Run: ``python -m benchmarks.view_picture [--out docs/images/view.png]``
"""

import argparse
import time
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

from softmode.objects import ObjectConfig
from tests.view.serving import served
from tests.view.test_browser import CHROMIUM, FLAGS, project

SIZE = (1000, 800)


def main() -> None:
    """Serve, open, pull, take the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/images/view.png"))
    out = parser.parse_args().out
    with served(ObjectConfig(size=0.12), frame_rate=3.0) as view, sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.goto(f"{view.app.url}?fixedDpr=1")
        page.locator(".mantine-Notification-closeButton").first.click(timeout=120_000)
        time.sleep(15.0)  # the page fades in
        camera = next(iter(view.app._server.get_clients().values())).camera
        surface = view.ask(lambda session: session.surface())
        nearest = (surface - camera.position) @ (view.ask(lambda session: session.centre()) - camera.position)
        front = surface[nearest < np.quantile(nearest, 0.3)]
        foot = front[front[:, 2] < np.quantile(front[:, 2], 0.3)].mean(axis=0)
        x, y = project(foot[None], camera, SIZE)[0]
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 8.0, y)
        assert view.wait(lambda session: session.drag() is not None, 60.0)
        page.mouse.move(x + 130.0, y - 60.0, steps=3)
        time.sleep(12.0)
        view.ask(lambda session: session.pause())
        time.sleep(12.0)  # a software renderer lags behind
        page.screenshot(path=out, timeout=120_000)
        page.mouse.up()
        browser.close()
    shot = Image.open(out).convert("RGB")
    shot.resize((850, 680), Image.Resampling.LANCZOS).save(out, optimize=True)
    print(f"wrote {out}, {out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
