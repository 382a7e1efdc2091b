"""Error of an image against the same image at full precision.

Low-pass, samples per pixel and order define the image. Constants that omit contributions (cut-off, stop,
ceiling) and the arithmetic determine its error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.effects import select
from fidsplat.render.certified_error import ideal_quality
from fidsplat.render.renderer import Renderer
from fidsplat.render.resident import ResidentCloud
from fidsplat.scenes import Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import DeviceError, InputError

REFERENCE_CUTOFF = 1e-8
"""alpha below which the reference image omits a contribution: a thousand such layers contribute 1e-5"""

FLOAT32_OUTPUT_ERROR = 1e-7
"""error of a reference image of colours up to 1 that a device returns in float32"""
FLOAT32_REFERENCE_ERROR = 1e-5
"""error of a reference image that is rendered in float32: above that of any image at full precision in
candidates.json"""


@dataclass(frozen=True)
class Errors:
    """Statistics of the differences between two images, over all pixels and channels."""

    maximum: float
    """largest absolute difference"""
    p999: float
    """99.9th percentile of the absolute differences"""
    rmse: float
    """root of the mean squared difference"""
    psnr: float
    """dB against a peak of 1; infinite where the images are equal"""


def errors(image: ArrayLike, reference: ArrayLike) -> Errors:
    """Error of an image, computed in float64.

    Args:
        image: any shape, e.g. (h, w, 3) or (h, w).
        reference: the same shape.

    Raises:
        InputError: the shapes differ, there are no values, or one is not finite.
    """
    found, expected = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if found.shape != expected.shape:
        raise InputError(f"image must have the shape {expected.shape} of the reference, got {found.shape}")
    if found.size == 0:
        raise InputError(f"image must have values to compare, got shape {found.shape}")
    for name, values in (("image", found), ("reference", expected)):
        bad = values.size - int(np.isfinite(values).sum())
        if bad:
            raise InputError(f"{name} must be finite, got {bad} of {values.size} values that are not")
    off = np.abs(found - expected)
    mean_square = float(np.mean(off**2))
    return Errors(
        maximum=float(off.max()),
        p999=float(np.quantile(off, 0.999)),
        rmse=mean_square**0.5,
        psnr=float(-10 * np.log10(mean_square)) if mean_square > 0 else float("inf"),
    )


def full_precision(capture: Capture, renderer: Renderer) -> Capture:
    """The capture without omitted contributions, in the device's most precise arithmetic.

    Low-pass, samples, order and first_hit stay. The device composites in float64 if it can
    (`supports_float64`); otherwise only the set-up is in float64, if supported.
    """
    best = ideal_quality(capture.quality, REFERENCE_CUTOFF)
    best = best.with_(arithmetic="precise", blend_precision="float32")
    if not renderer.device.always_float64 and supports_float64(renderer, capture):
        best = best.with_(blend_precision="float64")
    return capture.with_(quality=best)


def supports_float64(renderer: Renderer, capture: Capture) -> bool:
    """Whether images at full precision are computed in float64 throughout.

    True for the reference, and for devices that composite in float64, except with lenses and fog, whose rays
    are float32.
    """
    if renderer.device.always_float64:
        return True
    try:
        double = Quality(blend_precision="float64")
        features = select(SplatCloud.empty(), capture.with_(quality=double))
    except InputError:
        return False
    return not renderer.backend.unsupported(features)


def reference_error(reference: Renderer, capture: Capture) -> float:
    """Bound on the error of a renderer's reference image."""
    if reference.device.always_float64:
        return 0.0
    return FLOAT32_OUTPUT_ERROR if supports_float64(reference, capture) else FLOAT32_REFERENCE_ERROR


def reference_renderer(renderer: Renderer, capture: Capture) -> Renderer:
    """Renderer of reference images: OpenCL on this machine's processor if only that supports float64, else
    the renderer itself."""
    if supports_float64(renderer, capture):
        return renderer
    try:
        processor = Renderer("opencl:cpu")
    except DeviceError:
        return renderer
    return processor if supports_float64(processor, capture) else renderer


def reference_image(
    renderer: Renderer, scene: Scene | SplatCloud | ResidentCloud, capture: Capture
) -> np.ndarray:
    """The image at full precision (`full_precision`), (h, w, 3) float64.

    Args:
        renderer: device "reference" computes float64 images; images of others are converted.
        scene: scene to render.
        capture: capture; its outputs are ignored.

    Raises:
        InputError, DeviceError: as `Renderer.render`.
    """
    frame = renderer.render(scene, full_precision(capture.with_(outputs="rgb"), renderer))
    if renderer.device.always_float64:  # other reads round to float32
        return frame._images.read_float64("rgb", 0)
    return np.asarray(frame["rgb"], np.float64)
