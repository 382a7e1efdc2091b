"""The viewer in a headless Chromium: the page loads, an image arrives, a drag changes it, a slider changes
it, a click reports a pixel. Skipped where there is no Chromium (Debian: apt-get install chromium)."""

import time

import chromium
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.images.files import to_uint8

pytestmark = pytest.mark.skipif(chromium.program() is None, reason="no Chromium here")
WIDTH, HEIGHT = 700, 400
CANVAS = "document.querySelector('canvas').getBoundingClientRect()"


def until(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if actual := condition():
            return actual
        time.sleep(0.1)
    raise AssertionError("it did not happen in time")


def shown(viewer, page):
    """Mean difference of the page's pixels from the last exact image, 0 to 255."""
    (view,) = viewer._views.values()
    rgb = to_uint8(view.frame["rgb"])
    wide, tall = page.evaluate(f"{CANVAS}.width"), page.evaluate(f"{CANVAS}.height")
    rows = ((np.arange(HEIGHT) + 0.5) * rgb.shape[0] / tall).astype(int).clip(0, rgb.shape[0] - 1)
    columns = ((np.arange(int(wide)) + 0.5) * rgb.shape[1] / wide).astype(int).clip(0, rgb.shape[1] - 1)
    page_shows = page.screenshot()[:, : int(wide)]
    # a notice about the missing GPU is above, the panel next to it
    part = (slice(HEIGHT // 2, HEIGHT), slice(0, int(wide) - 10))
    return float(np.abs(rgb[rows][:, columns][part].astype(int) - page_shows[part]).mean())


def test_a_browser_sees_drags_asks_and_changes(tmp_path):
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from fidsplat.viewer.server import Viewer

    path = tmp_path / "scene.toml"
    path.write_text(
        "[camera]\nwidth = 64\nheight = 48\nfov_x_deg = 60.0\nposition = [0.0, 0.0, -1.0]\n"
        "look_at = [0.0, 0.0, 0.0]\n"
        '[[markers]]\nspec = "aruco:4x4_50:7"\nsize = 0.5\n[render]\nbackground = [0.2, 0.3, 0.4]\n'
    )
    viewer = Viewer(fs.Scene.load(path), path, "opencl", port=0)
    try:
        viewer.overlay(False)
        with chromium.Page(viewer.address, WIDTH, HEIGHT) as page:
            # the page loads and looks from the scene's camera, and the image arrives
            until(lambda: any(abs(v.viewpoint.position[2] + 1) < 1e-6 for v in viewer._views.values()))
            until(lambda: shown(viewer, page) < 6)
            first = next(iter(viewer._views.values()))

            middle = (page.evaluate(f"{CANVAS}.width") / 2, 280.0)
            page.drag(middle, (middle[0] + 40, middle[1] + 10))
            turned = until(
                lambda: next((v for v in viewer._views.values() if v.viewpoint != first.viewpoint), None)
            )
            assert np.linalg.norm(np.subtract(turned.viewpoint.position, (0, 0, -1))) > 0.05
            until(lambda: shown(viewer, page) < 6)

            page.evaluate("document.querySelectorAll('[role=slider]')[0].focus()")
            for _ in range(30):
                page.key("ArrowRight")
            until(lambda: viewer.session.state.settings.fog > 0.1)
            until(lambda: next(iter(viewer._views.values())).state.settings.fog > 0.1)
            until(lambda: shown(viewer, page) < 6)

            for kind in ("mousePressed", "mouseReleased"):
                page.mouse(kind, *middle)
            (message,) = viewer._messages.values()
            until(lambda: "label" in message.content)
        until(lambda: not viewer._streams)  # the browser has left, and is forgotten
    finally:
        viewer.close()
