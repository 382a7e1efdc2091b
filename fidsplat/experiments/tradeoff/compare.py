"""Errors of frames relative to references."""

from __future__ import annotations

import math

import numpy as np

from fidsplat.accuracy.error import errors
from fidsplat.capture.quality import Quality
from fidsplat.experiments.plane import plane_image
from fidsplat.experiments.setup import BACKGROUND
from fidsplat.experiments.tradeoff.scenes import TradeScene
from fidsplat.selftest.agreement import FrameSpec, reference_images
from fidsplat.util.errors import FidsplatError
from fidsplat.vision.metrics import psnr
from fidsplat.vision.readback import corner_error, own_code

_PAIRS = 2_000_000
"""maximum pixels times splats of the reference renderer per image"""
_MAX_CERTIFICATES, _MIN_CERTIFICATES = 64, 12
"""pixels with certificates; none if fewer are possible"""


def compare_image(image: np.ndarray, reference: np.ndarray, scene: TradeScene, quality: Quality) -> dict:
    """Errors of rgb (h, w, 3) relative to a reference image with the same image definition (order, low-pass
    ...).

    Returns `maximum`, `rmse`, `maximum_sure` (see `beyond_certificates`), and for markers the result of
    `compare_marker`.
    """
    found = errors(image, reference)
    difference = np.abs(image - reference).max(-1)
    result = {
        "maximum": found.maximum,
        "rmse": found.rmse,
        "maximum_sure": beyond_certificates(difference, scene, quality),
    }
    return result if scene.marker is None else result | compare_marker(image, scene)


def beyond_certificates(difference: np.ndarray, scene: TradeScene, quality: Quality) -> float | None:
    """Maximum error over all pixels that float32 certificates do not explain.

    A certificate bounds the change of a pixel by decisions of `quality` within rounding of their thresholds.
    The pixels with the largest errors have certificates; all other pixels count fully. None if the scene has
    too many splats, or the reference does not render it.

    Args:
        difference: (h, w) the largest error of each pixel.
    """
    size = difference.size
    count = min(_MAX_CERTIFICATES, _PAIRS // max(1, len(scene.cloud) * quality.samples**2), size)
    if count < min(_MIN_CERTIFICATES, size):
        return None
    worst = np.argsort(difference, axis=None)[::-1][: count + 1]
    rows, columns = np.unravel_index(worst[:count], difference.shape)
    # the float64 reference has no rounding error
    plain = quality.with_(arithmetic="precise", blend_precision="float32")
    frame = FrameSpec(scene.cloud, scene.camera, plain, ("rgb",), scene.background)
    try:
        certified = reference_images(frame, (rows, columns))["certificate"]
    except FidsplatError:
        return None
    # certificates are per unit of colour
    brightest = max(1.0, 0.0 if scene.cloud.colors is None else float(np.abs(scene.cloud.colors).max()))
    uncertified = [difference.flat[worst[:count]] - certified * brightest, difference.flat[worst[count:]]]
    return max(float(np.concatenate(uncertified).max()), 0.0)


def compare_marker(image: np.ndarray, scene: TradeScene) -> dict:
    """Compare a marker with the ideal area-sampled texture.

    Returns `ideal_psnr` in dB, `corners_px` (root mean square of corner errors; None if the marker is not
    detected), and `rectangles` of the partition.
    """
    marker = scene.marker
    assert marker is not None
    ideal = plane_image(marker.grid, marker.module, scene.camera, background=BACKGROUND)
    grey = np.asarray(image[:, :, 0], np.float64)
    code = own_code(marker, grey)
    ratio = psnr(grey, ideal)
    return {
        "ideal_psnr": ratio if math.isfinite(ratio) else None,
        "corners_px": None if code is None else corner_error(code, scene.camera.project(marker.corners)),
        "rectangles": len(marker.boxes),
    }
