"""Make the image of the viewer in docs/viewer.md: the demo scene in a headless Chromium.

fidsplat demo && PYTHONPATH=.:tools python benchmarks/viewer_image.py fidsplat-demo/scene.toml
docs/images/viewer.jpg"""

import sys
import time
from pathlib import Path

import chromium
import cv2

import fidsplat as fs
from fidsplat.viewer.server import Viewer

CLOSE = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(button => button.click())"


def main(source: str, out: str) -> None:
    """Save a screenshot of the page after a small rotation, with the errors of the detected markers."""
    viewer = Viewer(fs.Scene.load(source), Path(source), port=0)
    with chromium.Page(viewer.address, 1240, 780) as page:
        wait_for_exact_image(viewer)
        page.drag((420.0, 500.0), (480.0, 490.0))
        page.evaluate(CLOSE)
        time.sleep(1.0)
        wait_for_exact_image(viewer)
        viewer.detect_markers(next(iter(viewer.server.get_clients().values())))
        time.sleep(1.0)
        cv2.imwrite(out, page.screenshot()[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    viewer.close()


def wait_for_exact_image(viewer: Viewer) -> None:
    """Wait until the exact image has been sent and displayed."""
    before = None
    while not viewer._views or before is not next(iter(viewer._views.values())):
        before = next(iter(viewer._views.values()), None)
        time.sleep(2.0)


if __name__ == "__main__":
    main(*sys.argv[1:])
