"""The exact textured plane against geometry done another way."""

import math

import numpy as np
import pytest
import shapely

import fidsplat as fs
from fidsplat.experiments.plane import plane_image
from fidsplat.util.response import linear_light

GRID = np.random.default_rng(5).integers(0, 2, (7, 9)).astype(np.uint8)
MODULE = 0.2
VALUES = {"dark": 0.1, "light": 0.9, "background": 0.35}


def _away(distance: float, x: float = 0.0, y: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, distance
    return pose


VIEWS = {
    "front": fs.Camera.look_at(61, 47, 0.9, (0.0, 0.0, -2.5), (0.0, 0.0, 0.0)),
    "tilted": fs.Camera.look_at(61, 47, 0.9, (0.8, -1.1, -1.6), (0.1, 0.05, 0.0)),
    "grazing": fs.Camera.look_at(61, 47, 0.9, (0.2, -2.9, -0.3), (0.0, 0.0, 0.0)),
    "behind": fs.Camera.look_at(61, 47, 0.9, (0.8, -1.1, 1.6), (0.1, 0.05, 0.0)),
    "partly outside": fs.Camera.look_at(61, 47, 0.3, (0.8, -1.1, -1.6), (0.8, 0.6, 0.0)),
    "off-centre": fs.Camera.pinhole(61, 47, 70.0, 90.0, 12.3, 40.1, _away(2.2, 0.1, 0.2)),
}


def clipped_mean(camera: fs.Camera, row: int, column: int) -> float:
    """A pixel's mean by clipping its square against every module's outline in the image."""
    pixel = shapely.box(column, row, column + 1, row + 1)
    total, covered = 0.0, 0.0
    h, w = GRID.shape
    for y in range(h):
        for x in range(w):
            corners = (np.array([[x, y], [x + 1, y], [x + 1, y + 1], [x, y + 1]]) - [w / 2, h / 2]) * MODULE
            pixels = camera.project(np.column_stack([corners, np.zeros(4)]))
            area = shapely.Polygon(pixels).intersection(pixel).area
            total += area * (VALUES["dark"] if GRID[y, x] else VALUES["light"])
            covered += area
    return total + (1 - covered) * VALUES["background"]


@pytest.mark.parametrize("view", VIEWS)
def test_every_pixel_is_the_mean_over_its_square(view):
    camera = VIEWS[view]
    image = plane_image(GRID, MODULE, camera, **VALUES)
    assert image.shape == (47, 61)
    random = np.random.default_rng(1)
    places = set(zip(random.integers(0, 47, 60).tolist(), random.integers(0, 61, 60).tolist(), strict=True))
    edges = np.argwhere(np.abs(np.diff(image, axis=1)) > 0.05)[::37]
    for row, column in places | {tuple(place) for place in edges.tolist()}:
        assert image[row, column] == pytest.approx(clipped_mean(camera, row, column), abs=1e-9)


def test_it_is_what_rays_through_ever_more_points_tend_to():
    camera, k = VIEWS["tilted"], 40
    to_plane = np.linalg.inv(camera.matrix @ camera.world_to_camera[:3, [0, 1, 3]])
    x, y = np.meshgrid((np.arange(61 * k) + 0.5) / k, (np.arange(47 * k) + 0.5) / k)
    u, v, scale = np.einsum("ij,jyx->iyx", to_plane, np.stack([x, y, np.ones_like(x)]))
    column = np.floor(u / scale / MODULE + 4.5).astype(int)
    row = np.floor(v / scale / MODULE + 3.5).astype(int)
    inside = (column >= 0) & (column < 9) & (row >= 0) & (row < 7)
    value = np.full(x.shape, VALUES["background"])
    value[inside] = np.where(GRID[row[inside], column[inside]], VALUES["dark"], VALUES["light"])
    sampled = value.reshape(47, k, 61, k).mean((1, 3))
    exact = plane_image(GRID, MODULE, camera, **VALUES)
    # an edge through a pixel passes some 2 k of its k * k points, each off by at most half a cell
    assert np.abs(sampled - exact).max() < 2 / k
    assert abs(sampled.mean() - exact.mean()) < 1e-5


def test_modules_that_fill_pixels_keep_their_values():
    grid = np.array([[1, 0], [0, 1]], np.uint8)
    camera = fs.Camera.pinhole(6, 6, 2.0, 2.0, 3.0, 3.0, _away(1.0))
    image = plane_image(grid, 1.0, camera)
    assert np.array_equal(image[1:5, 1:5], np.kron(1.0 - grid, np.ones((2, 2))))
    assert np.all(image[[0, -1]] == 0.5)
    assert np.all(image[:, [0, -1]] == 0.5)


def test_a_plane_out_of_the_image_and_one_without_contrast():
    aside = fs.Camera.look_at(20, 20, 0.3, (0, 0, -3), (9.0, 0, 0))
    assert plane_image(GRID, MODULE, aside, background=0.25) == pytest.approx(0.25, abs=1e-12)
    same = plane_image(GRID, MODULE, VIEWS["tilted"], dark=0.5, light=0.5, background=0.5)
    assert np.all(same == 0.5)


def test_a_plane_that_reaches_behind_the_camera_is_an_error():
    camera = fs.Camera.look_at(20, 20, 1.0, (0, -0.05, -0.05), (0, 1.0, 0))
    with pytest.raises(fs.InputError, match="move the camera away"):
        plane_image(GRID, MODULE, camera)


def test_what_is_viewed_from_behind_is_mirrored():
    front = plane_image(GRID, MODULE, VIEWS["front"])
    behind = fs.Camera.look_at(61, 47, 0.9, (0.0, 0.0, 2.5), (0.0, 0.0, 0.0))
    assert plane_image(GRID[:, ::-1], MODULE, behind) == pytest.approx(front, abs=1e-12)


def test_means_do_not_depend_on_how_the_image_is_cut():
    whole = VIEWS["tilted"]
    image = plane_image(GRID, MODULE, whole, **VALUES)
    part = fs.Camera.pinhole(
        20,
        15,
        whole.fx,
        whole.fy,
        whole.cx - 17,
        whole.cy - 11,
        whole.world_to_camera,
        position=whole.position,
    )
    assert plane_image(GRID, MODULE, part, **VALUES) == pytest.approx(image[11:26, 17:37], abs=1e-12)
    assert math.isclose(image.max(), VALUES["light"], abs_tol=1e-12)


def test_display_values_are_straight_where_they_are_dark():
    """On both sides of the threshold of the sRGB curve, 0.04045 (IEC 61966-2-1)."""
    light = linear_light(np.array([0.04, 0.041, 0.0031]), "srgb")
    assert light == pytest.approx([0.04 / 12.92, ((0.041 + 0.055) / 1.055) ** 2.4, 0.0031 / 12.92])
