"""Comparison with the float64 reference, and clouds to compare on."""

import hashlib
import pickle

import numpy as np
import sampling

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
    "differences_of",
    "random_splats",
    "reference_images",
    "reference_pixels",
    "some_thick",
]

FEW_PIXELS = 1500
_TRUTHS: dict[bytes, dict[str, np.ndarray]] = {}


def reference_images(image, pixels=None):
    """Images of the reference, cached for all devices."""
    key = hashlib.sha256(pickle.dumps((image, pixels))).digest()
    if key not in _TRUTHS:
        _TRUTHS[key] = render_reference(image, pixels)
    return _TRUTHS[key]


def differences_of(images, image):
    """Compare every output of images of a device with the reference.

    Of an image of more than `FEW_PIXELS` every other pixel is compared, as the fields of a chessboard of one
    colour: the reference takes half of the time. The next run has the other colour (`pytest --turn`), and
    complete sweeps have all pixels. All pixels are compared if these do not agree.
    """
    size = image.camera.height, image.camera.width
    assert all(images[name].shape[:2] == size for name in image.outputs)
    pixels = sampling.chessboard(size) if size[0] * size[1] > FEW_PIXELS else None
    if pixels is not None:
        actual = _compared({name: images[name][pixels] for name in image.outputs}, image, pixels)
        if all(difference.agrees for difference in actual):
            return actual
    return _compared(images, image)


def _compared(images, image, pixels=None):
    expected = reference_images(image, pixels)
    assert all(images[name].shape == expected[name].shape for name in image.outputs)
    return compare(images, expected, image.outputs)


def against_reference(renderer, image):
    """Render a frame on a device and compare every output with the reference (`differences_of`)."""
    return differences_of(render(renderer, image), image)


def reference_pixels(cloud, camera, outputs, quality, background=(0.0, 0.0, 0.0), pixels=None):
    """Reference images with the error bound: all pixels, or at `pixels` = (rows, columns)."""
    return reference_images(FrameSpec(cloud, camera, Quality.of(quality), tuple(outputs), background), pixels)


def assert_agrees(renderer, cloud, camera, outputs=ALL_OUTPUTS, quality=None, background=(0.1, 0.2, 0.3)):
    """Render with a device and with the reference, and compare every output (`differences_of`); returns the
    frame."""
    image = FrameSpec(cloud, camera, Quality.of(quality), tuple(outputs), background)
    frame = renderer.render(cloud, camera, outputs, image.quality, background=background)
    differences = differences_of(frame, image)
    assert all(difference.agrees for difference in differences), differences
    return frame


def some_thick(cloud, thickness):
    """The cloud with 3D Gaussians where the thickness (n,) is above 0."""
    scales = np.column_stack([cloud.scales, thickness])
    arrays = (cloud.means, cloud.quats, scales, cloud.opacities)
    return SplatCloud(*arrays, colors=cloud.colors, sh=cloud.sh, labels=cloud.labels, origin=cloud.origin)
