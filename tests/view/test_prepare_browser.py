"""The page that prepares a capture in a real Chromium: its gizmos are dragged, and what is built follows."""

from __future__ import annotations

import shlex
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.objects import ObjectConfig
from softmode.objects.source import object_source
from softmode.splats import make_plush, write_splats
from softmode.view.app import ViewOptions, _free_port
from softmode.view.prepare import ARC, PreparePage
from tests.needs import needs
from tests.view.page_client import PageClient
from tests.view.test_browser import CHROMIUM, FLAGS, until

pytestmark = [
    needs("viser", "playwright"),
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed"),
]
SIZE = (1100, 480)
"""Width and height of the page [px]; the panel lies beside the gizmos."""
ARROW = 0.22
"""Length of the arrows of a corner over the object's diagonal."""
PATIENCE = 600_000
"""Longest wait for a build [ms]: beside a page drawn in software, two busy cores took two minutes for one."""


class Hand:
    """A mouse that pulls at the gizmos of a page, which looks as `PreparePage` makes it look.

    Args:
        page: The browser's page.
        twin: What the page shows: box and size.
    """

    def __init__(self, page: Any, twin: PreparePage) -> None:
        """Remember both."""
        self.page, self.twin = page, twin

    def pixel(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where a point is seen, (x, y) [px]."""
        camera = self.twin._server.initial_camera
        ahead = (camera.look_at - camera.position) / np.linalg.norm(camera.look_at - camera.position)
        right = np.cross(ahead, [0.0, 0.0, 1.0]) / np.linalg.norm(ahead[:2])
        local = np.array([right, np.cross(ahead, right), ahead]) @ (point - camera.position)
        return 0.5 * SIZE[1] / np.tan(0.5 * camera.fov) * local[:2] / local[2] + 0.5 * np.array(SIZE)

    def drag(self, points: NDArray[np.float64]) -> None:
        """Press at the first point and go along the others; what is under the mouse lights up first."""
        mouse = self.page.mouse
        mouse.move(*self.pixel(points[0]))
        time.sleep(0.5)
        mouse.down()
        for point in points[1:]:
            mouse.move(*self.pixel(point))
            time.sleep(0.1)
        mouse.up()

    def turn(self, axis: int, degrees: float) -> None:
        """Turn about an axis by the middle of its arc."""
        angles = np.radians(45.0 + np.linspace(0.0, degrees, 10))
        ring = np.zeros((10, 3))
        ring[:, (axis + 1) % 3], ring[:, (axis + 2) % 3] = np.cos(angles), np.sin(angles)
        self.drag(0.5 * (self.twin.low + self.twin.high) + ARC * self.twin._size * ring)

    def pull(self, corner: int, way: NDArray[np.float64]) -> None:
        """Pull a corner of the box along an axis, by its arrow."""
        arrow = 0.7 * ARROW * self.twin._size * np.abs(way) / np.linalg.norm(way)
        begin = (self.twin.low, self.twin.high)[corner] + arrow
        self.drag(begin + np.linspace(0.0, 1.0, 6)[:, None] * way)


def test_gizmos_in_a_browser_prepare_what_is_shown(tmp_path: Path) -> None:
    """A bear is laid down and set up again by arcs, and half of it cut by a corner: command line and body follow."""
    from playwright.sync_api import sync_playwright

    file, bear = tmp_path / "toy bear.ply", make_plush(count=800)
    away = bear.means + np.float32([0.3, 0.0, 0.2])  # captures lie far from the file's origin
    write_splats(file, replace(bear, means=away), up="+x")
    port = _free_port("127.0.0.1", 0)
    words = ["view", str(file), "--size", "0.08", "--up=+x", "--port", str(port), "--no-open", "--frame-rate", "5"]
    command = [sys.executable, "-m", "softmode", *words]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running,
        PreparePage(file, ViewOptions(port=0), up="+x") as twin,
        sync_playwright() as driver,
    ):
        try:
            assert running.stdout is not None
            url = next(word for word in running.stdout.readline().split() if word.startswith("http"))
            browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
            page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
            page.goto(f"{url}?fixedDpr=1")
            page.locator(".mantine-Notification-closeButton").first.click(timeout=30_000)
            page.get_by_role("button", name="prepare").click(timeout=30_000)
            repeat, hand = page.locator("textarea").first, Hand(page, twin)
            repeat.wait_for(timeout=60_000)
            time.sleep(5.0)  # the gizmos are drawn
            for axis, angle, up in ((0, -90.0, "-y"), (1, -90.0, "+x")):
                before = repeat.input_value()
                hand.turn(axis, angle)
                assert until(lambda before=before: repeat.input_value() != before), "the arc was not turned"
                twin.turn(Rotation.from_rotvec(np.radians(angle) * np.eye(3)[axis]).as_matrix())
                assert f"--up={twin.up} " in repeat.input_value()
                assert twin.up == up
                time.sleep(1.0)
            far = twin.high[0] - twin.low[0]
            hand.pull(0, np.array([0.4 * far, 0.0, 0.0]))
            assert until(lambda: "--crop" in repeat.input_value()), "the corner was not pulled"
            time.sleep(1.0)
            told = repeat.input_value()
            page.get_by_role("button", name="build").click()
            page.get_by_role("button", name="prepare").wait_for(timeout=PATIENCE)
            with PageClient(url) as client:
                shown = client.splats()[0][:, :3].copy().view(np.float32)
            browser.close()
        finally:
            running.kill()
            said, _ = running.communicate(timeout=60.0)
    assert f"to do this again: {told}\n" in said
    given = shlex.split(told)
    crop = [float(x) for x in given[given.index("--crop") + 1 :][:6]]
    low, high = twin.low + np.array([0.4 * far, 0.0, 0.0]), twin.high
    np.testing.assert_allclose(crop, [*low, *high], atol=0.03 * twin._size)
    box = (crop[0], crop[1], crop[2], crop[3], crop[4], crop[5])
    built = object_source(ObjectConfig(splat=file, up="+x", crop=box, size=0.08)).splats
    assert 0.3 * 800 < built.count < 0.8 * 800
    assert 0.98 * built.count < len(shown) <= built.count  # splats at the cut may have no solid under them
    seen, whole = np.ptp(shown, axis=0), np.ptp(built.means, axis=0)  # the page's unit is that of the splats
    np.testing.assert_allclose(seen / seen.max(), whole / whole.max(), atol=0.02)  # it hangs
