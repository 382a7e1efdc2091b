"""Data between the stages of a device."""

import numpy as np
import pytest
from agreement import ALL_OUTPUTS

import fidsplat as fs
from fidsplat.backends.prepare import prepare

CULLED = np.uint32(0xFFFFFFFF)
CAMERA = fs.Camera.look_at(161, 117, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))


def intermediates_of(backend, cloud, quality, shape=None):
    features, view = prepare(cloud, fs.Capture(CAMERA, ALL_OUTPUTS, quality))
    return backend.pipeline(features, shape).render_intermediates(backend.upload(cloud), view), view


def listing(backend, lists):
    """The shape with one of the two ways of listing."""
    shapes = backend.configs("binning")
    if lists not in shapes:
        pytest.skip("lists in one way")
    return shapes[lists]
