"""Merged splats with an opacity above 1 are rendered out to their larger radius and not culled too early."""

import math

import numpy as np
import pytest
from agreement import assert_agrees

import fidsplat as fs
from fidsplat.backends.prepare import prepare
from fidsplat.store.merge import MAX_OPACITY
from fidsplat.store.partial_cloud import PartialCloud
from fidsplat.streaming.frustum_culling import in_frustum

SIZE, FOCAL, DEPTH, SIGMA = (61, 47), 4000.0, 2.0, 200.0
CAMERA = fs.Camera.pinhole(*SIZE, FOCAL, FOCAL, 30.5, 23.5)
CUTOFF, BEYOND = 0.05, 2.8
"""standard deviations from the outermost pixels: the cut-off radius is 2.45 for opacity 1, 2.96 for 4"""
ALPHA = MAX_OPACITY * math.exp(-(BEYOND**2) / 2)
SIDES = {"left": (-1, 0), "right": (1, 0), "above": (0, -1), "below": (0, 1)}
KINDS = {"screen": "screen", "none": "none", "pixel": "pixel", "thick": "screen"}
"""low-passes of disks, and of a 3D Gaussian"""


def quality_of(kind):
    return fs.Quality(lowpass=KINDS[kind], alpha_cutoff=CUTOFF)


def splat_outside(side, thick=False):
    """A wide merged splat next to the image, faint at its border."""
    across, down = SIDES[side]
    # from the image centre to the outermost pixels, and beyond
    way = np.array([across * (SIZE[0] - 1) / 2, down * (SIZE[1] - 1) / 2]) + BEYOND * SIGMA * np.array(
        [across, down]
    )
    scale = SIGMA * DEPTH / FOCAL
    arrays = {"means": [[*(way * DEPTH / FOCAL), DEPTH]], "quats": [[1, 0, 0, 0]], "scales": [[scale, scale]]}
    arrays |= {"opacities": [MAX_OPACITY], "colors": [[1, 1, 1]]} | ({"thickness": [scale]} if thick else {})
    splat = {name: np.array(value, np.float32) for name, value in arrays.items()}
    like = fs.SplatCloud(
        splat["means"], splat["quats"], np.full((1, 3 if thick else 2), scale), [1.0], colors=splat["colors"]
    )
    return PartialCloud.of(splat | {"labels": np.zeros(1, np.int32)}, like)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("side", SIDES)
def test_they_reach_into_the_frame(renderer, side, kind):
    cloud = splat_outside(side, kind == "thick")
    frame = assert_agrees(renderer, cloud, CAMERA, quality=quality_of(kind))
    assert frame["alpha"].max() == pytest.approx(ALPHA, rel=0.05)


@pytest.mark.parametrize("side", ["above", "below"])
def test_they_reach_into_the_rows_of_a_rolling_shutter(renderer, side):
    shutter = fs.Shutter(readout=0.5, rows_per_band=7)
    moving = fs.Motion(lambda time: CAMERA.world_to_camera)
    capture = fs.Capture(CAMERA, ("rgb", "alpha"), quality_of("screen"), motion=moving, shutter=shutter)
    alpha = renderer.render(splat_outside(side), capture)["alpha"]
    assert alpha.max() == pytest.approx(ALPHA, rel=0.05)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("side", SIDES)
def test_boxes_of_them_are_in_the_frustum(side, kind):
    cloud = splat_outside(side, kind == "thick")
    features, view = prepare(cloud, fs.Capture(CAMERA, quality=quality_of(kind)))
    reach = cloud.scales.max(axis=1).astype(np.float64)

    def boxes(sigmas):
        return cloud.means - sigmas * reach[:, None], cloud.means + sigmas * reach[:, None]

    assert in_frustum(view, features, boxes, reach).all()
