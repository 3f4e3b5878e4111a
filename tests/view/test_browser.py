"""The page in a real Chromium: the object is drawn, the mouse pulls it, sliders tune it.

SwiftShader draws in software: the picture is small, splats are few.
"""

from __future__ import annotations

import io
import os
import shutil
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tests.needs import needs
from tests.view.serving import Served, served

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = [
    needs("viser", "playwright"),
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed"),
]
FLAGS = (
    "--headless=new --no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--disable-background-networking --disable-component-update --disable-sync --no-first-run"
).split()
WIDTH, HEIGHT = 760, 320
CANVAS = {"x": 0, "y": 0, "width": 420, "height": HEIGHT}
"""What the panel does not cover."""


@pytest.fixture(scope="module")
def view() -> Iterator[Served]:
    """Serve a hanging sausage, slowly enough for a renderer without a graphics card."""
    with served(frame_rate=6.0) as one:
        yield one


@pytest.fixture(scope="module")
def page(view: Served) -> Iterator[Any]:
    """Open the page and wait until the object is drawn in its full colours."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        try:
            page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
            page.goto(f"{view.app.url}?fixedDpr=0.5")
            page.locator(".mantine-Notification-closeButton").first.click(timeout=30_000)  # "software rendering"
            assert until(lambda: orange(page).sum() > 300), "no object in the picture"
            yield page
        finally:
            browser.close()


def until(condition: Callable[[], bool], seconds: float = 40.0) -> bool:
    """Wait for a condition; return whether it came true."""
    ends = time.monotonic() + seconds
    while time.monotonic() < ends:
        if condition():
            return True
        time.sleep(0.1)
    return False


def picture(page: Any) -> NDArray[np.float64]:
    """Return what the page shows beside the panel, 0..1, shape (H, W, 3)."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot(clip=CANVAS))).convert("RGB"), np.float64) / 255.0


def orange(page: Any) -> NDArray[np.bool_]:
    """Return which pixels have the object's colours: red above green above blue, unlike a gizmo's pink arrow."""
    r, g, b = picture(page).transpose(2, 0, 1)
    return (r > 0.45) & (r - b > 0.35) & (r > g + 0.15) & (g > b + 0.03)


def places(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the pixels of a mask, (x, y) each."""
    return np.argwhere(mask)[:, ::-1]


def lower_end(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the middle of the lowest tenth of a silhouette, (x, y) [px]."""
    pixels = places(mask)
    return pixels[pixels[:, 1] >= np.quantile(pixels[:, 1], 0.9)].mean(axis=0)


def test_the_object_is_drawn_where_it_is(view: Served, page: Any) -> None:
    """Pixels of the object's colours, as tall as the pinhole says, and nothing of them elsewhere."""
    mask = orange(page)
    pixels = places(mask)
    size = np.ptp(pixels, axis=0) + 1
    low, high = view.ask(lambda session: session.bounds())
    camera = next(iter(view.app._server.get_clients().values())).camera
    surface = view.ask(lambda session: session.surface())
    seen = project(surface, camera)
    expected = np.ptp(seen, axis=0)
    assert np.all(np.abs(size - expected) < 0.25 * expected + 4.0), (size, expected, low, high)
    np.testing.assert_allclose(pixels.mean(axis=0), seen.mean(axis=0), atol=0.1 * expected.max())
    assert mask.sum() > 0.5 * expected.prod() * np.pi / 4.0  # filled, not speckled


def project(points: NDArray[np.float64], camera: Any, size: tuple[int, int] = (WIDTH, HEIGHT)) -> NDArray[np.float64]:
    """Return where a page's camera sees points, (x, y) [px]."""
    w, x, y, z = camera.wxyz
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    local = (points - camera.position) @ rotation
    focal = 0.5 * size[1] / np.tan(0.5 * camera.fov)
    return focal * local[:, :2] / local[:, 2:] + 0.5 * np.array(size)


def test_a_drag_deforms_the_object_and_release_lets_it_return(view: Served, page: Any) -> None:
    """The lower end follows the mouse to the right in simulation and picture, the camera stays; then it returns."""
    assert view.wait(lambda session: session.energies().kinetic < 1e-4)
    rest, still = view.ask(view.lowest), orange(page)
    camera = next(iter(view.app._server.get_clients().values())).camera
    eye = np.array(camera.position)
    x, y = lower_end(still)
    y -= 6.0
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 8.0, y)
    assert view.wait(lambda session: session.drag() is not None, 30.0), "the object was not gripped"
    page.mouse.move(x + 80.0, y - 10.0, steps=3)
    size = view.ask(lambda session: session.size)
    assert view.wait(lambda session: bool(np.linalg.norm(view.lowest(session) - rest) > 0.15 * size), 30.0)
    drag = view.ask(lambda session: session.drag())
    assert drag is not None
    moved = view.ask(view.lowest) - rest
    pulled = project(np.stack([rest, rest + moved]), camera)
    assert pulled[1, 0] - pulled[0, 0] > 10.0  # to the right of the page, as the mouse went
    assert until(lambda: lower_end(orange(page))[0] > x + 15.0), "the picture did not follow"
    bent = orange(page)
    top = still[: int(np.quantile(places(still)[:, 1], 0.15))]
    assert np.abs(places(bent[: len(top)]).mean(axis=0) - places(top).mean(axis=0))[0] < 15.0  # it is held there
    np.testing.assert_allclose(np.array(camera.position), eye, atol=1e-6)  # the camera did not orbit
    page.mouse.up()
    assert view.wait(lambda session: session.drag() is None)
    assert view.wait(lambda session: bool(np.linalg.norm(view.lowest(session) - rest) < 0.05 * size), 30.0)
    assert until(lambda: abs(lower_end(orange(page))[0] - x) < 8.0), "the picture did not return"


def test_the_panel_sets_the_modulus(view: Served, page: Any) -> None:
    """A number beside the slider is Young's modulus in the session, ten to its power."""
    before = view.ask(lambda session: session.parameters.youngs_modulus)
    field = page.locator("input").filter(visible=True).nth(modulus_field(page, before))
    field.fill("5.5")
    field.press("Enter")
    assert view.wait(lambda session: abs(np.log10(session.parameters.youngs_modulus) - 5.5) < 1e-4)


def modulus_field(page: Any, modulus: float) -> int:
    """Return which of the visible inputs shows the logarithm of a modulus."""
    values = [page.locator("input").filter(visible=True).nth(k).input_value() for k in range(4)]
    found = [
        k for k, value in enumerate(values) if value.startswith(f"{np.log10(modulus):.2f}".rstrip("0").rstrip("."))
    ]
    assert found, values
    return found[0]


def test_a_click_pins_and_a_button_lets_go(view: Served, page: Any) -> None:
    """In pin mode a click on the object holds a region; "all" lets every pin go, and the object falls."""
    held = view.ask(lambda session: len(session.pins()))
    page.get_by_role("textbox", name="mouse").or_(page.locator("input[value=drag]")).first.click()
    page.get_by_role("option", name="pin").click()
    x, y = places(orange(page)).mean(axis=0)
    assert until(lambda: view.app._panel.mouse_mode == "pin")
    time.sleep(1.0)  # the page learns that clicks count
    page.mouse.click(x, y)
    assert view.wait(lambda session: len(session.pins()) == held + 1, 30.0)
    page.get_by_role("button", name="all").click()
    assert view.wait(lambda session: not session.pins())
