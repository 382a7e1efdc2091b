"""Markers of facets: Gaussians, opaque and sharp where splats are composited by depth at each pixel."""

import math

import numpy as np
import pytest
from agreement import ALL_OUTPUTS

import fidsplat as fs
from fidsplat.images.files import to_uint8
from fidsplat.markers.facets import DISH
from fidsplat.vision.detect import detect

GREY = (0.5, 0.5, 0.5)


def frontal(marker: fs.Marker, pixels: int) -> fs.Camera:
    """Sees the sheet alone, along its modules, which are so many pixels wide and 80 of their widths away."""
    rows, columns = marker.grid.shape
    pose, focal = np.eye(4), 80.0 * pixels
    pose[2, 3] = 80 * marker.module
    width, height = columns * pixels, rows * pixels
    return fs.Camera.pinhole(width, height, focal, focal, width / 2, height / 2, pose)


def test_facets_are_opaque_and_clean_to_the_edge_of_every_module(renderer):
    marker = fs.marker("apriltag:36h11:5", mixture="facets")
    assert len(marker.cloud) <= 31 * len(marker.boxes)
    pixels = 8
    frame = renderer.render(marker.cloud, frontal(marker, pixels), ALL_OUTPUTS, background=GREY)
    error = frame["rgb"][..., 0] - np.kron(1.0 - marker.grid, np.ones((pixels, pixels)))
    assert frame["alpha"].min() > 0.999
    assert -10 * math.log10(float(np.mean(error**2))) > 35
    cells = error.reshape(len(marker.grid), pixels, -1, pixels)[:, 2:-2, :, 2:-2]
    assert np.abs(cells).max() < 1 / 255
    # one sheet, a shallow dish: its corners before its plane, its middle behind
    depth = frame["depth"] / marker.module - 80
    assert np.abs(depth).max() < 1.5 * DISH * len(marker.grid)
    assert depth[0, 0] < 0 < depth[len(depth) // 2, len(depth) // 2]


def test_a_file_of_facets_is_opaque_and_clean_by_depth_at_each_pixel(renderer, tmp_path):
    marker = fs.marker("aruco:4x4_50:7", mixture="facets")
    fs.save_ply(marker.gaussians, tmp_path / "facets.ply")
    read = fs.load_ply(tmp_path / "facets.ply")
    quality = fs.Quality(order="pixel")
    frame = renderer.render(read, frontal(marker, 8), ALL_OUTPUTS, quality, background=GREY)
    error = frame["rgb"][..., 0] - np.kron(1.0 - marker.grid, np.ones((8, 8)))
    assert frame["alpha"].min() > 0.999
    assert -10 * math.log10(float(np.mean(error**2))) > 35
    # by their centres facets hide each other: without the true order nothing of this holds
    by_centre = fs.Quality(order="centre")
    hidden = renderer.render(read, frontal(marker, 8), ALL_OUTPUTS, by_centre, background=GREY)["rgb"][..., 0]
    assert -10 * math.log10(float(np.mean((hidden - frame["rgb"][..., 0]) ** 2))) < 10


def test_facets_are_read_from_aside(renderer):
    marker = fs.marker("qr-v1-L:splats", mixture="facets")
    angle = math.radians(65)
    position = (-10 * math.sin(angle), 0, -10 * math.cos(angle))
    camera = fs.Camera.look_at(240, 240, 0.16, position, (0, 0, 0))
    frame = renderer.render(marker.cloud, camera, ALL_OUTPUTS, background=GREY)
    assert [one.payload for one in detect(to_uint8(frame["rgb"]))] == ["splats"]


def test_an_image_keeps_its_colours_and_a_drawing_with_slants_is_refused(tmp_path):
    drawing = tmp_path / "slant.svg"
    drawing.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9"><path d="M1 1L8 2L3 8Z" fill="red"/></svg>'
    )
    with pytest.raises(
        fs.InputError,
        match="mixture must be 'exact' or 'fitted' for a marker that does not consist of modules",
    ):
        fs.marker(f"svg:{drawing}", mixture="facets")
    drawing.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9"><path d="M1 1H8V4H1Z" fill="red"/></svg>'
    )
    marker = fs.marker(f"svg-9:{drawing}", mixture="facets")
    assert np.array_equal(np.unique(marker.cloud.colors, axis=0), np.unique(marker.palette, axis=0))
