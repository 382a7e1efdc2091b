"""How far a marker may tilt at a setting and still be read."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fidsplat.experiments.angles import parse_tilts
from fidsplat.experiments.plane import plane_picture
from fidsplat.experiments.setup import BACKGROUND
from fidsplat.experiments.tradeoff.scenes import GREY, PROTOCOL, made_marker
from fidsplat.experiments.tradeoff.session import Session
from fidsplat.quality import MarkerQuality, Quality
from fidsplat.vision.images import to_uint8
from fidsplat.vision.readers import Target, attempt

FULL_TILTS, QUICK_TILTS = "0:40:20,46:88:1", "0:40:40,48:88:4"
READERS = {"apriltag": "aruco", "qr": "zxing"}
"""one detector of each kind, those that fidsplat installs"""


def scan(session: Session, name: str, quality: Quality | None, tilts: str) -> Callable[[], dict]:
    """Draw a marker at every tilt; what is returned looks at the pictures.

    quality: None for the ideal area-sampled texture, the ceiling that the detector has. The result: `reader`,
    `read` (a string of 0 and 1, one for each tilt), `splats`, `rectangles`.
    """
    made = made_marker(name, MarkerQuality() if quality is None else quality.marker)
    cameras = [PROTOCOL.camera(tilt) for tilt in parse_tilts(tilts)]
    pictures: list[np.ndarray] = []
    if quality is not None:
        resident = session.renderer.upload(made.cloud)
        for camera in cameras:
            frame = session.renderer.render(resident, camera, ("rgb",), quality, background=GREY)
            pictures.append(to_uint8(frame["rgb"][:, :, 0]))

    def look() -> dict:
        seen = pictures or [
            to_uint8(plane_picture(made.grid, made.module, camera, background=BACKGROUND))
            for camera in cameras
        ]
        reader, read = READERS[made.kind], ""
        for camera, grey in zip(cameras, seen, strict=True):
            corners = camera.project(made.corners)
            target = Target(made.kind, made.family or "", made.id, made.payload, corners)
            read += "01"[attempt(reader, grey, target).read]
        splats = None if quality is None else len(made.cloud)
        return {"reader": reader, "read": read, "splats": splats, "rectangles": len(made.boxes)}

    return look
