"""The file of a marker as other renderers show it: by the depth of centres, with their constants, tilted."""

import math

import numpy as np
import pytest
from agreement import ALL_OUTPUTS

import fidsplat as fs
from fidsplat.capture.quality import PRESETS
from fidsplat.vision.detect import detect
from fidsplat.vision.metrics import psnr

GREY = (0.5, 0.5, 0.5)
SIDE, FOCAL, DISTANCE = 200, 1600.0, 10.0
"""pixels, pixels, metres: a marker of 1 m shows 160 px wide"""


def towards(tilt: float, azimuth: float) -> fs.Camera:
    """Looks at a marker that leans back by a tilt, about an axis of its plane; both in degrees."""
    a, b = math.radians(tilt), math.radians(azimuth)
    axis = np.array([math.cos(b), math.sin(b), 0.0])
    cross = np.array([[0, 0, axis[1]], [0, 0, -axis[0]], [-axis[1], axis[0], 0]])
    pose = np.eye(4)
    pose[:3, :3] += math.sin(a) * cross + (1 - math.cos(a)) * cross @ cross
    pose[2, 3] = DISTANCE
    return fs.Camera.pinhole(SIDE, SIDE, FOCAL, FOCAL, SIDE / 2, SIDE / 2, pose)


@pytest.fixture(scope="module", params=["apriltag:36h11:5", "qr-v1-L:splats"])
def pair(request, tmp_path_factory):
    """A marker and its file, read again: without coplanar groups, labels or boxes."""
    marker = fs.marker(request.param)
    path = tmp_path_factory.mktemp("files") / "marker.ply"
    fs.save_ply(marker.gaussians, path)
    return marker, fs.load_ply(path)


@pytest.mark.parametrize(("tilt", "azimuth"), [(0, 0), (1, 0), (40, 30), (60, 200)])
def test_a_marker_s_file_is_opaque_enough_and_read(renderer, pair, tilt, azimuth):
    """No splat reaches far into cells of the other colour, so that no order among them hides a cell."""
    marker, read = pair
    assert PRESETS["gsplat"] == PRESETS["surfel"]
    camera = towards(tilt, azimuth)
    ideal = renderer.render(marker.cloud, camera, ALL_OUTPUTS, "gsplat", background=GREY)
    shown = renderer.render(read, camera, ALL_OUTPUTS, "gsplat", background=GREY)
    inside = ideal["alpha"] > 0.98
    assert shown["alpha"][inside].mean() > 0.94
    assert psnr(shown["rgb"], ideal["rgb"]) > 21
    detections = detect((np.clip(shown["rgb"], 0, 1) * 255).round().astype(np.uint8), ["36h11"])
    assert [one.id if marker.kind == "apriltag" else one.payload for one in detections] == [
        marker.id or marker.payload
    ]
