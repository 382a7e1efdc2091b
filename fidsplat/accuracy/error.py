"""How wrong a picture is: its error against the same definition drawn at full precision.

What a picture is (low-pass, samples per pixel, by which depth splats are ordered) is its definition;
constants that leave something out of it (cut-off, stop, ceiling) and the arithmetic decide how accurate it
is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fidsplat.backends.interface import GivesFloat64
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.effects import select
from fidsplat.render.certified_error import nothing_left_out
from fidsplat.render.renderer import Renderer
from fidsplat.render.resident import ResidentCloud
from fidsplat.scenes import Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import DeviceError, InputError

TRUTH_CUTOFF = 1e-8
"""alpha below which the truth leaves a contribution out: a thousand such layers hide 1e-5"""

FLOAT32_OUTPUT = 1e-7
"""what a truth of colours up to 1 is off that a device hands out in float32"""
FLOAT32_TRUTH = 1e-5
"""what one is off that is drawn in float32: more than any picture at full precision in budget/prices.json"""


@dataclass(frozen=True)
class Errors:
    """Differences between two images, over all their values."""

    maximum: float
    """largest absolute difference"""
    p999: float
    """99.9th percentile of the absolute differences"""
    rmse: float
    """root of the mean squared difference"""
    psnr: float
    """dB against a peak of 1; infinite where the images are equal"""


def errors(picture: ArrayLike, truth: ArrayLike) -> Errors:
    """The error of an image, worked out in float64.

    Args:
        picture: any shape, e.g. (h, w, 3) or (h, w).
        truth: the same shape.

    Raises:
        InputError: the shapes differ, there are no values, or one is not finite.
    """
    seen, want = np.asarray(picture, np.float64), np.asarray(truth, np.float64)
    if seen.shape != want.shape:
        raise InputError(f"a picture of shape {seen.shape} cannot be compared with one of shape {want.shape}")
    if seen.size == 0:
        raise InputError(f"a picture of shape {seen.shape} has no values to compare")
    for name, image in (("picture", seen), ("truth", want)):
        bad = image.size - int(np.isfinite(image).sum())
        if bad:
            raise InputError(
                f"{bad} of {image.size} values of the {name} are not finite; they have no error to measure"
            )
    off = np.abs(seen - want)
    mean_square = float(np.mean(off**2))
    return Errors(
        maximum=float(off.max()),
        p999=float(np.quantile(off, 0.999)),
        rmse=mean_square**0.5,
        psnr=float(-10 * np.log10(mean_square)) if mean_square > 0 else float("inf"),
    )


def full_precision(capture: Capture, renderer: Renderer) -> Capture:
    """The capture of the same definition with nothing left out, in the best arithmetic of the device.

    Low-pass, samples, order and first_hit stay. A device composites in float64 where it can
    (`draws_float64`); else the arithmetic is its own, with the set-up in float64 if it has that.
    """
    best = nothing_left_out(capture.quality, TRUTH_CUTOFF).with_(arithmetic="precise")
    if not renderer.device.always_float64 and draws_float64(renderer, capture):
        best = best.with_(blend_precision="float64")
    return capture.with_(quality=best)


def draws_float64(renderer: Renderer, capture: Capture) -> bool:
    """Whether its pictures at full precision are float64 throughout: the reference's, and those of devices
    that composite in float64, but for lenses and fog, whose rays are float32."""
    if renderer.device.always_float64:
        return True
    try:
        double = Quality(blend_precision="float64")
        features = select(SplatCloud.empty(), capture.with_(quality=double))
    except InputError:
        return False
    return not renderer.backend.unsupported(features)


def error_bound(reference: Renderer, capture: Capture) -> float:
    """What the truth that a renderer draws may be off itself."""
    if reference.device.always_float64:
        return 0.0
    return FLOAT32_OUTPUT if draws_float64(reference, capture) else FLOAT32_TRUTH


def reference_for(renderer: Renderer, capture: Capture) -> Renderer:
    """Who draws the truth for a renderer's pictures: itself if it can in float64, else OpenCL on this
    machine's processor if that is there and can, else itself."""
    if draws_float64(renderer, capture):
        return renderer
    try:
        processor = Renderer("opencl:cpu")
    except DeviceError:
        return renderer
    return processor if draws_float64(processor, capture) else renderer


def truth(
    renderer: Renderer, scene: Scene | SplatCloud | ResidentCloud, capture: Capture, output: str = "rgb"
) -> np.ndarray:
    """The picture of the same definition, drawn by `renderer` at full precision (`full_precision`).

    Args:
        renderer: who draws; "reference" gives float64 images, other devices what they give, as float64.
        scene: whose splats.
        capture: how; its outputs do not count.
        output: the image.

    Returns:
        float64, of the shape of the image: (h, w, 3) for rgb.

    Raises:
        InputError, DeviceError: as `Renderer.render`.
    """
    frame = renderer.render(scene, full_precision(capture.with_(outputs=output), renderer))
    if isinstance(frame._images, GivesFloat64):  # what is read otherwise is rounded to float32
        return frame._images.read_float64(output)
    return np.asarray(frame[output], np.float64)
