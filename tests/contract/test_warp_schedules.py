"""Effects that Warp's two schedules draw by code of their own: the one for GPUs, run on the CPU, must draw
the same."""

import numpy as np
import pytest
from agreement import random_splats
from test_lens_pictures import CAMERAS

import fidsplat as fs
from fidsplat.backends.base import View
from fidsplat.effects import select
from fidsplat.hard_cases.agreement import ALL_OUTPUTS
from fidsplat.hard_cases.invariance import other_schedule

BACKEND = "warp"


def drawn(renderer, cloud, features, view):
    """The planes of the device's own schedule, and of the other."""
    backend = renderer.backend
    resident = backend.upload(cloud)
    shapes = backend.shape, other_schedule(renderer)
    return [backend.pipeline(features, shape).render(resident, view) for shape in shapes]


def assert_same(base, other):
    for name in ("rgb", "alpha", "normal", "depth"):
        assert np.abs(other.read(name) - base.read(name)).max() < 2e-5, name
    for name in ("label", "depth_median"):
        assert (other.read(name) != base.read(name)).mean() < 1e-3, name


@pytest.mark.parametrize("name", ["distortion", "fisheye 200", "panorama", "parallel"])
def test_lenses(renderer, name):
    cloud, quality = random_splats(300, 2, depth=(-4.0, 5.0)), fs.Quality()
    features = select(cloud, ALL_OUTPUTS, quality, CAMERAS[name])
    view = View.of(CAMERAS[name], quality, cloud.origin, (0.1, 0.2, 0.3))
    assert_same(*drawn(renderer, cloud, features, view))
