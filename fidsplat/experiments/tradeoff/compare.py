"""Errors of a frame: against the reference image, beyond float32 certificates, and the largest readable tilt
of a marker."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import numpy as np

from fidsplat.accuracy.error import errors
from fidsplat.capture.quality import MarkerQuality, Quality
from fidsplat.experiments.angles import parse_tilts
from fidsplat.experiments.plane import plane_picture
from fidsplat.experiments.setup import BACKGROUND
from fidsplat.experiments.tradeoff.hard import CELLS, cell_window
from fidsplat.experiments.tradeoff.scenes import GREY, HARD, PROTOCOL, SEED, TradeScene, made_marker
from fidsplat.experiments.tradeoff.session import Session
from fidsplat.images.files import to_uint8
from fidsplat.selftest.agreement import FrameSpec, reference_images
from fidsplat.util.errors import FidsplatError
from fidsplat.vision.metrics import flip, has_flip, psnr
from fidsplat.vision.readback import corner_error, own_code
from fidsplat.vision.readers import Target, attempt

FULL_TILTS, QUICK_TILTS = "0:40:20,46:88:1", "0:40:40,48:88:4"
READERS = {"apriltag": "aruco", "qr": "zxing"}
"""one installed detector of each kind"""
FLIP_SIDE = 256
"""pixels: edge of the middle square for FLIP; the scene of hard cases is used completely"""
NO_FLIP = "flip-evaluator is not installed; pip install 'fidsplat[experiments]'"
_PAIRS = 2_000_000
"""maximum pixels times splats of the reference renderer per image"""
_MOST, _LEAST = 64, 12
"""pixels with requested certificates; none if fewer are possible"""
_SAMPLED = 64


def scan(session: Session, name: str, quality: Quality | None, tilts: str) -> Callable[[], dict]:
    """Render a marker at every tilt; returns work that reads the images.

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


def compare_picture(picture: np.ndarray, truth: np.ndarray, scene: TradeScene, quality: Quality) -> dict:
    """Errors of rgb (h, w, 3) against the reference image of the same definition.

    Returns `maximum`, `p999`, `rmse`, `psnr` (None for equal images), `maximum_sure` (see
    `beyond_certificates`), `flip`; for the hard cases `cells`, the largest error in each; for markers the
    result of `compare_marker`.
    """
    found = errors(picture, truth)
    off = np.abs(picture - truth).max(-1)
    result = {
        "maximum": found.maximum,
        "p999": found.p999,
        "rmse": found.rmse,
        "psnr": found.psnr if math.isfinite(found.psnr) else None,
        "maximum_sure": beyond_certificates(off, scene, quality),
        **_flip(picture, truth, whole=scene.name == HARD),
    }
    if scene.name == HARD:
        result["cells"] = {name: float(off[cell_window(i)].max()) for i, name in enumerate(CELLS)}
    return result if scene.made is None else result | compare_marker(picture, scene)


def beyond_certificates(off: np.ndarray, scene: TradeScene, quality: Quality) -> float | None:
    """Maximum error over all pixels that float32 certificates do not explain.

    A certificate bounds the change of a pixel by decisions of `quality` within rounding of their thresholds.
    Certificates are requested for the pixels with the largest errors; all other pixels count fully. None if
    the scene has too many splats, or the reference does not render it.

    Args:
        off: (h, w) the largest error of each pixel.
    """
    count = min(_MOST, _PAIRS // max(1, len(scene.cloud) * quality.samples**2), off.size)
    if count < min(_LEAST, off.size):
        return None
    worst = np.argsort(off, axis=None)[::-1][: count + 1]
    rows, columns = np.unravel_index(worst[:count], off.shape)
    # the reference does not round
    plain = quality.with_(arithmetic="precise", blend_precision="float32")
    picture = FrameSpec(scene.cloud, scene.camera, plain, ("rgb",), scene.background)
    try:
        certified = reference_images(picture, (rows, columns))["certificate"]
    except FidsplatError:
        return None
    # a certificate is per unit of colour
    brightest = max(1.0, 0.0 if scene.cloud.colors is None else float(np.abs(scene.cloud.colors).max()))
    sure = float((off.flat[worst[:count]] - certified * brightest).max())
    return max(sure, float(off.flat[worst[count]]) if len(worst) > count else 0.0, 0.0)


def compare_marker(picture: np.ndarray, scene: TradeScene) -> dict:
    """A marker against the ideal area-sampled texture: `ideal_psnr` dB, `ideal_maximum`; `corners_px`, root
    mean square of the detected corners' errors in pixels, None where `fidsplat detect` does not read it;
    `rectangles` of its partition."""
    made = scene.made
    assert made is not None
    ideal = plane_picture(made.grid, made.module, scene.camera, background=BACKGROUND)
    grey = np.asarray(picture[:, :, 0], np.float64)
    code = own_code(made, grey)
    ratio = psnr(grey, ideal)
    return {
        "ideal_psnr": ratio if math.isfinite(ratio) else None,
        "ideal_maximum": float(np.abs(grey - ideal).max()),
        "corners_px": None if code is None else corner_error(code, scene.camera.project(made.corners)),
        "rectangles": len(made.boxes),
    }


def check_truth(truth: np.ndarray, scene: TradeScene, full: Quality) -> dict:
    """The truth against the NumPy reference at pixels chosen at random: `pixels`, `maximum`, the largest
    difference of their colours."""
    height, width = truth.shape[:2]
    count = max(4, min(_SAMPLED, _PAIRS // max(1, len(scene.cloud) * full.samples**2)))
    chosen = random.Random(SEED).sample(range(height * width), min(count, height * width))
    rows, columns = np.unravel_index(chosen, (height, width))
    plain = full.with_(blend_precision="float32")
    picture = FrameSpec(scene.cloud, scene.camera, plain, ("rgb",), scene.background)
    wanted = reference_images(picture, (rows, columns))["rgb"]
    return {"pixels": len(rows), "maximum": float(np.abs(truth[rows, columns] - wanted).max())}


def _flip(picture: np.ndarray, truth: np.ndarray, whole: bool) -> dict:
    """FLIP of display values, and the part of the image."""
    if not has_flip():
        return {"flip": None, "flip_of": NO_FLIP}
    height, width = truth.shape[:2]
    side = (height, width) if whole else (min(FLIP_SIDE, height), min(FLIP_SIDE, width))
    top, left = (height - side[0]) // 2, (width - side[1]) // 2
    window = slice(top, top + side[0]), slice(left, left + side[1])
    a, b = (np.clip(image[window], 0.0, 1.0) for image in (picture, truth))
    return {"flip": flip(a, b), "flip_of": f"{side[1]} x {side[0]} px in the middle"}
