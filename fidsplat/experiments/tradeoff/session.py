"""Measurement session: renderer, uploaded scenes, reference images, interleaved timing, errors of images."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fidsplat.accuracy.error import errors, reference_image, reference_renderer
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import MarkerQuality, Quality
from fidsplat.experiments.plane import plane_image
from fidsplat.experiments.setup import BACKGROUND
from fidsplat.experiments.tradeoff.points import BASE
from fidsplat.experiments.tradeoff.scenes import TradeScene, Views, make_view
from fidsplat.render.frame import Frame
from fidsplat.render.renderer import Renderer
from fidsplat.render.resident import ResidentCloud
from fidsplat.selftest.agreement import FrameSpec, reference_images
from fidsplat.util.errors import FidsplatError
from fidsplat.util.timing import frame_timer, quartiles, ratios, time_interleaved
from fidsplat.vision.metrics import psnr
from fidsplat.vision.readback import corner_error, detect_marker

_SCENES, _REFERENCES = 12, 6
"""maximum numbers of cached scenes and reference images"""
DEFINITION = ("lowpass", "samples", "order")
"""settings that define the image; all other settings define its accuracy"""


class Session:
    """Scenes and reference images, computed on demand and cached.

    Reference images are rendered by the renderer, or by OpenCL on the CPU if the renderer lacks float64.
    """

    def __init__(self, renderer: Renderer, user_views: Views | None = None) -> None:
        """user_views: views of the user's files, for which marker qualities have no effect."""
        self.renderer, self._precise = renderer, reference_renderer(renderer, Capture())
        self._user_views, self._uploaded = user_views or {}, {}
        self._make = lru_cache(_SCENES)(make_view)
        self.resident = lru_cache(_SCENES)(self._resident)
        """(view, marker quality) -> splats on the device"""
        self._reference = lru_cache(_REFERENCES)(self._render_reference)

    def scene(self, view: str, marker: MarkerQuality) -> TradeScene:
        return self._user_views[view] if view in self._user_views else self._make(view, marker)

    def _resident(self, view: str, marker: MarkerQuality) -> ResidentCloud:
        cloud = self.scene(view, marker).cloud
        if view not in self._user_views:
            return self.renderer.upload(cloud)
        if id(cloud) not in self._uploaded:  # views of one file share their splats
            self._uploaded[id(cloud)] = self.renderer.upload(cloud)
        return self._uploaded[id(cloud)]

    def render(self, view: str, quality: Quality) -> Frame:
        """Frame of a view at a quality, which may still be rendering."""
        capture = self.scene(view, quality.marker).capture
        return self.renderer.render(self.resident(view, quality.marker), capture, quality=quality)

    def reference(self, view: str, quality: Quality) -> np.ndarray:
        """Reference image (h, w, 3) float64: the same splats and image definition at full precision."""
        return self._reference(view, self.definition(view, quality))

    def _render_reference(self, view: str, definition: Quality) -> np.ndarray:
        scene, same_device = self.scene(view, definition.marker), self._precise is self.renderer
        splats = self.resident(view, definition.marker) if same_device else scene.cloud
        return reference_image(self._precise, splats, scene.capture.with_(quality=definition))

    def definition(self, view: str, quality: Quality) -> Quality:
        """Quality of the reference image: the baseline with the image definition of `quality`.

        3D Gaussians are projected exactly. In the user's scenes they are projected as in `quality`, since
        trained splats depend on the projection of their trainer.
        """
        defined = {name: getattr(quality, name) for name in DEFINITION}
        ellipsoid = quality.ellipsoid if view in self._user_views else "exact"
        return BASE.with_(**defined, ellipsoid=ellipsoid, marker=quality.marker)


@dataclass(frozen=True)
class Effort:
    """Length of a measurement: pairs of frames for some seconds, with a minimum and maximum number."""

    minimum: int = 5
    maximum: int = 30
    seconds: float = 0.3


FULL, QUICK = Effort(), Effort(3, 5, 0.2)
SLOW = 3.0
"""seconds of a frame above which a quick measurement has only one round"""


def time_point(session: Session, view: str, quality: Quality, effort: Effort) -> tuple[Frame, dict]:
    """Render a view with a quality and with the base, interleaved; splats and images stay on the device.

    Returns the frame, and `ms`, `base_ms` (medians), their quartiles, `ratio` (median of the pairs' ratios,
    with quartiles), `repeats`, `splats`, `pairs`.
    """
    session.render(view, quality).wait()  # compiles
    begun = time.perf_counter()
    frame = session.render(view, quality).wait()
    slow = effort is QUICK and time.perf_counter() - begun > SLOW
    timer, base = (
        frame_timer(
            session.renderer,
            session.resident(view, timed.marker),
            session.scene(view, timed.marker).capture,
            quality=timed,
        )
        for timed in (quality, BASE)
    )
    time_interleaved(
        [timer, base],
        effort.maximum,
        min_rounds=1 if slow else effort.minimum,
        seconds=effort.seconds,
        warm_up=1,
    )
    result: dict = {"repeats": len(timer.ms)}
    for name, values in (("ms", timer.ms), ("base_ms", base.ms), ("ratio", ratios(timer, base))):
        low, result[name], high = quartiles(values)
        result[f"{name.removesuffix('_ms')}_quartiles"] = [low, high]
    return frame, result | {name: frame.stats[name] for name in ("splats", "pairs")}


_PAIRS = 2_000_000
"""maximum number of pixels times splats of the reference renderer per image"""
_MAX_BOUNDED_PIXELS, _MIN_BOUNDED_PIXELS = 64, 12
"""maximum number of pixels with error bounds, and minimum number for which error bounds are computed"""


def compare_image(image: np.ndarray, reference: np.ndarray, scene: TradeScene, quality: Quality) -> dict:
    """Errors of rgb (h, w, 3) relative to a reference image with the same image definition.

    Returns `maximum`, `rmse`, `maximum_sure` (`beyond_error_bounds`), and for markers the result of
    `compare_marker`.
    """
    differences = errors(image, reference)
    difference = np.abs(image - reference).max(-1)
    result = {
        "maximum": differences.maximum,
        "rmse": differences.rmse,
        "maximum_sure": beyond_error_bounds(difference, scene, quality),
    }
    return result if scene.marker is None else result | compare_marker(image, scene)


def beyond_error_bounds(difference: np.ndarray, scene: TradeScene, quality: Quality) -> float | None:
    """Maximum error over all pixels that float32 error bounds do not explain.

    The error bound of a pixel limits its change by decisions of `quality` within rounding of thresholds.
    It is subtracted from the error of the pixels with the largest errors. None if the scene has too many
    splats or the device `reference` cannot render it.

    Args:
        difference: (h, w) largest error of each pixel over the channels.
    """
    size = difference.size
    count = min(_MAX_BOUNDED_PIXELS, _PAIRS // max(1, len(scene.cloud) * quality.samples**2), size)
    if count < min(_MIN_BOUNDED_PIXELS, size):
        return None
    worst = np.argsort(difference, axis=None)[::-1][: count + 1]
    rows, columns = np.unravel_index(worst[:count], difference.shape)
    # error bounds describe float32, the reference renderer is float64
    plain = quality.with_(arithmetic="precise", blend_precision="float32")
    frame = FrameSpec(scene.cloud, scene.camera, plain, ("rgb",), scene.background)
    try:
        certified = reference_images(frame, (rows, columns))["error_bound"]
    except FidsplatError:
        return None
    # error bounds are relative to the brightest colour
    brightest = max(1.0, 0.0 if scene.cloud.colors is None else float(np.abs(scene.cloud.colors).max()))
    beyond_bound = [difference.flat[worst[:count]] - certified * brightest, difference.flat[worst[count:]]]
    return max(float(np.concatenate(beyond_bound).max()), 0.0)


def compare_marker(image: np.ndarray, scene: TradeScene) -> dict:
    """Compare a rendered marker with its ideal area-sampled texture.

    Returns `ideal_psnr` in dB, `corners_px` (RMS of corner errors; None if the marker is not detected), and
    the number of `rectangles` into which the marker is divided.
    """
    marker = scene.marker
    assert marker is not None
    ideal = plane_image(marker.grid, marker.module, scene.camera, background=BACKGROUND)
    grey = np.asarray(image[:, :, 0], np.float64)
    code = detect_marker(marker, grey)
    ratio = psnr(grey, ideal)
    return {
        "ideal_psnr": ratio if math.isfinite(ratio) else None,
        "corners_px": None if code is None else corner_error(code, scene.camera.project(marker.corners)),
        "rectangles": len(marker.boxes),
    }
