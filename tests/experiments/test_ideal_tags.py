"""Ideal images of printed tags among splats: colours and depths of each pixel."""

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.experiments.ideal_tags import _window, tag_depth_image
from fidsplat.experiments.plane import plane_image
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import rigid_matrix

CAMERA = fs.Camera.pinhole(120, 90, 110, 110, 61, 44)
BEHIND = np.full((90, 120, 3), (0.2, 0.4, 0.6))
POSE = rigid_matrix((0.03, -0.02, 0.8), (1, 0.2, 0.3, 0.1))


@pytest.fixture(scope="module")
def tag():
    return fs.marker("apriltag:36h11:5", size=0.3)


def test_a_pixel_is_the_mean_of_what_it_shows(tag):
    image = tag_depth_image([PlacedMarker(tag, POSE)], CAMERA, BEHIND)
    there = np.isfinite(image.depth)
    camera = fs.Camera.pinhole(120, 90, 110, 110, 61, 44, world_to_camera=POSE)
    for channel, value in enumerate(BEHIND[0, 0]):
        full_frame = plane_image(tag.grid, tag.module, camera, background=value)
        np.testing.assert_allclose(image.rgb[..., channel][there], full_frame[there], atol=1e-6)
        assert np.abs(full_frame[~there] - value).max() < 1 / 256
    np.testing.assert_allclose(image.rgb[~there], BEHIND[~there], atol=1e-6)


def test_it_is_where_the_tag_is(tag):
    image = tag_depth_image([PlacedMarker(tag, POSE)], CAMERA, BEHIND)
    y, x = np.nonzero(np.isfinite(image.depth))
    rays = CAMERA.rays(np.column_stack([x, y]) + 0.5)
    points = (rays / rays[:, 2:]) * image.depth[y, x, None]
    local = (points - POSE[:3, 3]) @ POSE[:3, :3]
    assert np.abs(local[:, 2]).max() < 1e-6
    assert np.abs(local[:, :2]).max() < tag.grid.shape[0] * tag.module / 2 + 0.02


@pytest.mark.parametrize("spec", ["apriltag:36h11:5", "charuco:3x7:4x4_50"])
def test_the_window_of_a_tag_is_the_bounds_of_its_corners(spec):
    """No larger, so that a tag costs no more than its pixels; also where pixels are not square, and a board
    is higher than wide."""
    marker = fs.marker(spec, size=0.25)
    camera = fs.Camera.pinhole(120, 90, 80, 110, 61, 44)
    height, width = np.array(marker.grid.shape) * marker.module
    corners = np.array([(x * width / 2, y * height / 2, 0) for x in (-1, 1) for y in (-1, 1)])
    for x in (0.0, 0.25, -0.45):
        pose = rigid_matrix((x, -0.02, 1.1), (1, 0.2, 0.3, 0.1))
        pixels = camera.project(corners @ pose[:3, :3].T + pose[:3, 3])
        left, top = np.maximum(np.floor(pixels.min(axis=0)), 0)
        right, bottom = np.minimum(np.ceil(pixels.max(axis=0)), (120, 90))
        assert _window(pose, PlacedMarker(marker, pose), camera) == (left, top, right, bottom)


def test_the_nearer_of_two_tags_is_visible(tag):
    near, far = (PlacedMarker(tag, rigid_matrix((0, 0, z))) for z in (0.7, 1.0))
    for tags in ((near, far), (far, near)):
        depth = tag_depth_image(tags, CAMERA, BEHIND).depth
        assert depth[np.isfinite(depth)] == pytest.approx(0.7)


@pytest.mark.parametrize(
    "pose",
    [rigid_matrix((0, 0, -1.0)), rigid_matrix((0, 0, 1.0), (0, 1, 0, 0)), rigid_matrix((5, 0, 1.0))],
    ids=["behind the camera", "from behind", "beside the picture"],
)
def test_invisible_tags_do_not_change_the_image(tag, pose):
    image = tag_depth_image([PlacedMarker(tag, pose)], CAMERA, BEHIND)
    assert not np.isfinite(image.depth).any()
    np.testing.assert_allclose(image.rgb, BEHIND, atol=1e-6)
