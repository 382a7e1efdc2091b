"""Comparison with the float64 reference, and clouds to compare on."""

import hashlib
import pickle

import numpy as np

from fidsplat.hard_cases.agreement import ALL_OUTPUTS, Picture, compare
from fidsplat.hard_cases.agreement import truth_of as draw_truth
from fidsplat.quality import Quality
from fidsplat.splats import SplatCloud

_TRUTHS: dict[bytes, dict[str, np.ndarray]] = {}


def truth_of(picture, pixels=None):
    """The reference's planes. It is drawn once for all devices: it takes longer than any of them."""
    key = hashlib.sha256(pickle.dumps((picture, pixels))).digest()
    if key not in _TRUTHS:
        _TRUTHS[key] = draw_truth(picture, pixels)
    return _TRUTHS[key]


def reference_pixels(cloud, camera, outputs, quality, background=(0.0, 0.0, 0.0), pixels=None):
    """Reference planes with the certificate: whole, or at `pixels` = (rows, columns)."""
    return truth_of(Picture(cloud, camera, Quality.of(quality), tuple(outputs), background), pixels)


def assert_agrees(renderer, cloud, camera, outputs=ALL_OUTPUTS, quality=None, background=(0.1, 0.2, 0.3)):
    """Draw with a device and with the reference and compare every plane; returns the frame."""
    picture = Picture(cloud, camera, Quality.of(quality), tuple(outputs), background)
    frame = renderer.render(cloud, camera, outputs, picture.quality, background)
    truth = truth_of(picture)
    assert all(frame[name].shape == truth[name].shape for name in outputs)
    differences = compare(frame, truth, outputs)
    assert all(difference.agrees for difference in differences), differences
    return frame


def random_splats(count, seed, depth=(-1.0, 6.0), scale=(1e-3, 2.0), across=2.0, sh_degree=None):
    """A cloud with hard opacities around a camera at the origin that looks down +z."""
    generator = np.random.default_rng(seed)
    x, y = generator.uniform(-across, across, (2, count))
    means = np.stack([x, y, generator.uniform(*depth, count)], 1).astype(np.float32)
    quats = generator.normal(size=(count, 4)).astype(np.float32)
    scales = np.exp(generator.uniform(*np.log(scale), (count, 2))).astype(np.float32)
    opacities = generator.choice(np.float32([0.002, 0.05, 0.3, 0.5, 0.9, 0.99, 1.0]), count)
    labels = generator.integers(0, 9, count)
    if sh_degree is None:
        colors = generator.uniform(0, 1, (count, 3)).astype(np.float32)
        return SplatCloud(means, quats, scales, opacities, colors=colors, labels=labels)
    sh = generator.normal(0, 0.3, (count, (sh_degree + 1) ** 2, 3)).astype(np.float32)
    return SplatCloud(means, quats, scales, opacities, sh=sh, labels=labels)
