"""Comparison with the float64 reference, and clouds to compare on."""

import hashlib
import pickle

import numpy as np

from fidsplat.capture.quality import Quality
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.selftest.agreement import ALL_OUTPUTS, FrameSpec, compare, render
from fidsplat.selftest.agreement import reference_images as render_reference
from fidsplat.splats.cloud import SplatCloud

__all__ = [
    "ALL_OUTPUTS",
    "against_reference",
    "assert_agrees",
    "compare",
    "random_splats",
    "reference_images",
    "reference_pixels",
    "some_thick",
]

_TRUTHS: dict[bytes, dict[str, np.ndarray]] = {}


def reference_images(image, pixels=None):
    """Images of the reference, cached for all devices."""
    key = hashlib.sha256(pickle.dumps((image, pixels))).digest()
    if key not in _TRUTHS:
        _TRUTHS[key] = render_reference(image, pixels)
    return _TRUTHS[key]


def against_reference(renderer, image):
    """Render a frame on a device and compare every output with the reference."""
    return compare(render(renderer, image), reference_images(image), image.outputs)


def reference_pixels(cloud, camera, outputs, quality, background=(0.0, 0.0, 0.0), pixels=None):
    """Reference images with the certificate: all pixels, or at `pixels` = (rows, columns)."""
    return reference_images(FrameSpec(cloud, camera, Quality.of(quality), tuple(outputs), background), pixels)


def assert_agrees(renderer, cloud, camera, outputs=ALL_OUTPUTS, quality=None, background=(0.1, 0.2, 0.3)):
    """Render with a device and with the reference, and compare every output; returns the frame."""
    image = FrameSpec(cloud, camera, Quality.of(quality), tuple(outputs), background)
    frame = renderer.render(cloud, camera, outputs, image.quality, background=background)
    truth = reference_images(image)
    assert all(frame[name].shape == truth[name].shape for name in outputs)
    differences = compare(frame, truth, outputs)
    assert all(difference.agrees for difference in differences), differences
    return frame


def some_thick(cloud, thickness):
    """The cloud with 3D Gaussians where the thickness (n,) is above 0."""
    scales = np.column_stack([cloud.scales, thickness])
    arrays = (cloud.means, cloud.quats, scales, cloud.opacities)
    return SplatCloud(*arrays, colors=cloud.colors, sh=cloud.sh, labels=cloud.labels, origin=cloud.origin)
