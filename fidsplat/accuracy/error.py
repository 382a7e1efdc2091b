"""Error of an image against the same image at full precision.

Low-pass, samples per pixel and order define the image. The error results from constants that omit
contributions (cut-off, stop, ceiling) and from the arithmetic.
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
"""alpha below which the reference image omits a contribution: a thousand of them contribute 1e-5"""

FLOAT32_OUTPUT_ERROR = 1e-7
"""error of a float64 reference image with colours up to 1 that a device returns in float32"""
FLOAT32_REFERENCE_ERROR = 1e-5
"""error of a reference image that is rendered in float32: above all full-precision errors in
candidates.json"""


@dataclass(frozen=True)
class Errors:
    """Statistics of the difference between two images over all pixels and channels."""

    maximum: float
    """largest absolute difference"""
    p999: float
    """99.9th percentile of the absolute differences"""
    rmse: float
    """root of the mean squared difference"""
    psnr: float
    """dB against a peak of 1; infinite for equal images"""


def errors(image: ArrayLike, reference: ArrayLike) -> Errors:
    """Statistics of the error of an image, computed in float64.

    Args:
        image: any shape, e.g. (h, w, 3) or (h, w).
        reference: the same shape.

    Raises:
        InputError: the shapes differ, the images are empty, or a value is not finite.
    """
    computed, expected = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if computed.shape != expected.shape:
        raise InputError(f"image must have the shape {expected.shape} of the reference, got {computed.shape}")
    if computed.size == 0:
        raise InputError(f"image must not be empty, got shape {computed.shape}")
    for name, values in (("image", computed), ("reference", expected)):
        invalid = values.size - int(np.isfinite(values).sum())
        if invalid:
            raise InputError(f"{name} must be finite, got {invalid} of {values.size} values NaN or infinite")
    difference = np.abs(computed - expected)
    mean_square = float(np.mean(difference**2))
    return Errors(
        maximum=float(difference.max()),
        p999=float(np.quantile(difference, 0.999)),
        rmse=mean_square**0.5,
        psnr=float(-10 * np.log10(mean_square)) if mean_square > 0 else float("inf"),
    )


def full_precision(capture: Capture, renderer: Renderer) -> Capture:
    """The capture without omitted contributions, in the device's most precise arithmetic.

    Low-pass, samples, order and first_hit are unchanged. The device blends in float64 if it supports that
    (`supports_float64`).
    """
    quality = ideal_quality(capture.quality, REFERENCE_CUTOFF)
    quality = quality.with_(arithmetic="precise", blend_precision="float32")
    if not renderer.device.always_float64 and supports_float64(renderer, capture):
        quality = quality.with_(blend_precision="float64")
    return capture.with_(quality=quality)


def supports_float64(renderer: Renderer, capture: Capture) -> bool:
    """Whether the device renders this capture completely in float64.

    True for the reference renderer, and for devices that blend in float64, unless the capture has a lens or
    fog, whose rays are float32.
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
    """Upper bound on the error of a renderer's reference image."""
    if reference.device.always_float64:
        return 0.0
    return FLOAT32_OUTPUT_ERROR if supports_float64(reference, capture) else FLOAT32_REFERENCE_ERROR


def reference_renderer(renderer: Renderer, capture: Capture) -> Renderer:
    """Renderer of reference images: the renderer itself, or OpenCL on this machine's processor if only the
    processor supports float64."""
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
        renderer: float32 images of devices other than "reference" are converted.
        capture: its outputs are ignored.
    """
    frame = renderer.render(scene, full_precision(capture.with_(outputs="rgb"), renderer))
    if renderer.device.always_float64:  # frame["rgb"] would round to float32
        return frame._images.read_float64("rgb", 0)
    return np.asarray(frame["rgb"], np.float64)
