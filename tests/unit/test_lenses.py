"""Lenses: OpenCV's projections, their inverses, invisible points, scene files."""

import math

import cv2
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cameras import BrownConrady, Equirectangular, Fisheye, Orthographic
from fidsplat.cameras.raster import RayRaster

ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
COEFFICIENTS = [
    [-0.28, 0.07, 0.0, 0.0],
    [-0.3, 0.1, 1e-3, -2e-3, 0.01],
    [0.2, 0.02, -1e-3, 5e-4, -0.003, 0.11, 0.02, 0.001],
    [-0.25, 0.05, 2e-3, 1e-3, 0.002, 0.01, 0.0, 0.003, 1e-3, -2e-3, 5e-4, 1e-3],
]
POSE = fs.Camera.look_at(64, 48, 1.0, (0.3, -0.2, -1.0), (0.1, 0.0, 3.0)).world_to_camera


def points_before(seed, spread=0.6):
    generator = np.random.default_rng(seed)
    depth = generator.uniform(0.5, 5, 400)
    return np.stack([*(generator.uniform(-spread, spread, (2, 400)) * depth), depth], 1)


@pytest.mark.parametrize("coefficients", COEFFICIENTS, ids=len)
def test_distortion_is_that_of_opencv(coefficients):
    camera = fs.Camera.pinhole(
        640, 480, 500.0, 510.0, 315.0, 250.0, POSE, lens=BrownConrady.opencv(coefficients)
    )
    seen = points_before(1)
    world = (seen - POSE[:3, 3]) @ POSE[:3, :3]
    turn, move = cv2.Rodrigues(POSE[:3, :3])[0], POSE[:3, 3].copy()
    want = cv2.projectPoints(world[:, None], turn, move, camera.matrix, np.array(coefficients))[0][:, 0]
    np.testing.assert_allclose(camera.project(world), want, atol=1e-9)
    np.testing.assert_allclose(camera.rays(want), seen / seen[:, 2:], atol=1e-9)


@pytest.mark.parametrize("coefficients", [(0, 0, 0, 0), (0.05, -0.01, 0.003, -0.001), (-0.03, 0.004, 0, 0)])
def test_fisheye_is_that_of_opencv(coefficients):
    camera = fs.Camera.pinhole(640, 600, 200.0, 210.0, 315.0, 250.0, lens=Fisheye(*coefficients))
    # OpenCV divides by Z, so it goes no further than 90 degrees
    seen = points_before(2, spread=3.0)
    zero, matrix = np.zeros(3), camera.matrix
    want = cv2.fisheye.projectPoints(seen[:, None], zero, zero, matrix, np.array(coefficients, float))[0][
        :, 0
    ]
    np.testing.assert_allclose(camera.project(seen), want, atol=1e-9)
    np.testing.assert_allclose(
        camera.rays(want), seen / np.linalg.norm(seen, axis=1, keepdims=True), atol=1e-9
    )


def test_a_fisheye_sees_behind_itself_up_to_200_degrees():
    camera = fs.Camera.fisheye(200, 200, math.radians(200))
    angles = np.radians([80.0, 95.0, 99.9, 100.1, 140.0, 180.0])
    points = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], 1)
    x = camera.project(points)[:, 0]
    np.testing.assert_allclose(x[:3], 100 + np.degrees(angles[:3]), rtol=1e-12)
    assert np.isnan(x[3:]).all()
    assert np.isnan(camera.rays([[1.0, 1.0], [100.0, 250.0]])).all()


def test_a_panorama():
    camera = fs.Camera.equirectangular(400, 200)
    points = [[0, 0, 2], [2, 0, 0], [-3, 0, 0], [0, -1, 0], [0, 1, 1], [1e-9, 0, -1]]
    want = [[200, 100], [300, 100], [100, 100], [200, 0], [200, 150], [400, 100]]
    np.testing.assert_allclose(camera.project(points), want, atol=1e-6)
    directions = np.array(points) / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(camera.rays(camera.project(points)), directions, atol=1e-12)
    assert np.isnan(camera.rays([[-0.1, 100], [200, 200.1]])).all()
    assert np.isnan(camera.project([[0.0, 0.0, 0.0]])).all()


def test_parallel_rays():
    camera = fs.Camera.orthographic(400, 200, 8.0)
    np.testing.assert_allclose(camera.project([[1, 2, 5], [1, 2, 50]]), [[250, 200], [250, 200]])
    assert np.isnan(camera.project([[0, 0, -1]])).all()
    with pytest.raises(fs.InputError, match="rays from one point, got Orthographic"):
        camera.rays([[0, 0]])


def test_beyond_the_fold_nothing_is_visible():
    lens = BrownConrady(k1=-0.35)
    assert lens.max_tangent == pytest.approx(math.sqrt(1 / (3 * 0.35)))
    camera = fs.Camera.pinhole(80, 60, 52.0, 52.0, 40.0, 30.0, lens=lens)
    radius = 52 * lens.max_tangent * (1 - 0.35 * lens.max_tangent**2)
    assert not np.isnan(camera.rays([[40 + radius - 1e-3, 30]])).any()
    assert np.isnan(camera.rays([[40 + radius + 1e-3, 30]])).all()
    # the polynomial comes back to the image there; the lens does not
    assert np.isnan(camera.project([[1.5, 0, 1]])).all()
    assert BrownConrady(k1=0.2, k4=-0.1).max_tangent == pytest.approx(math.sqrt(10), rel=0.5)


def test_opencv_fills_its_rational_model_up_with_zeros():
    """calibrateCamera returns 14 numbers for CALIB_RATIONAL_MODEL, which has 8."""
    eight = [0.1, -0.2, 0.001, 0.002, 0.03, 0.04, -0.05, 0.06]
    assert BrownConrady.opencv([eight + [0.0] * 6]) == BrownConrady.opencv(eight)


def test_a_lens_that_does_nothing_is_none():
    assert fs.Camera.pinhole(64, 48, 50, 50, 32, 24, lens=BrownConrady()).lens is None


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: BrownConrady(k1=math.nan), "k1 must be a finite number"),
        (lambda: Fisheye(k2="a"), "k2 must be a finite number"),
        (lambda: BrownConrady(k6=-1e300), r"k6 must be .*at most 1e\+12, got -1e\+300"),
        (lambda: BrownConrady.opencv([1, 2, 3]), "4, 5, 8, 12 or 14 coefficients .* got 3"),
        (
            lambda: BrownConrady.opencv([0.1] * 12 + [0, 0.02]),
            "last two distortion coefficients, .* got 0 and 0.02",
        ),
        (
            lambda: fs.Camera.pinhole(64, 48, 20, 20, 32, 24, lens=BrownConrady(k1=-0.5, p2=0.01)),
            r"invertible .* got k1 = -0.5, p2 = 0.01, .* focal length \(20 pixels\)",
        ),
        (
            lambda: fs.Camera.pinhole(64, 48, 9, 9, 900, 24, lens=Fisheye()),
            "field of view, got none of a fisheye .*900",
        ),
        (
            lambda: fs.Camera.fisheye(64, 48, 1.0, coefficients=[0.1] * 5),
            "4 coefficients, k1 to k4, got 5",
        ),
        (lambda: fs.Camera.pinhole(64, 48, 20, 20, 32, 24, lens="fisheye"), "lens must be .*, got 'fisheye'"),
        (lambda: fs.Camera.fisheye(64, 48, math.radians(201)), "between 0 and 200 degrees"),
        (lambda: fs.Camera.orthographic(64, 48, 0.0), "metres_wide must be above 0"),
    ],
)
def test_what_makes_no_lens(make, words):
    with pytest.raises(fs.InputError, match=words):
        make()


@pytest.mark.parametrize("lens", [BrownConrady(-0.3, 0.1, p1=0.01), Fisheye(0.1)], ids=lambda lens: lens.kind)
def test_the_map_knows_every_sample(lens):
    """In any rectangle of the lookup table, the cells' boxes hold all samples whose rays are in it."""
    raster = RayRaster(lens, 90, 70, 60.0, 60.0, 45.0, 35.0)
    boxes, (low_x, low_y, scale_x, scale_y, cells) = raster.inverse_lens_lut
    x, y = raster.lut_coordinates(raster.rays)
    generator, first = np.random.default_rng(3), 0
    size = int(cells)
    while size >= 1:
        grid = boxes[first : first + size * size].reshape(size, size, 4)
        step = size / cells
        for _ in range(50):
            left, right = np.sort(generator.uniform(0, size, 2))
            top, bottom = np.sort(generator.uniform(0, size, 2))
            inside = (x >= low_x + left / scale_x / step) & (x <= low_x + right / scale_x / step)
            inside &= (y >= low_y + top / scale_y / step) & (y <= low_y + bottom / scale_y / step)
            rows, columns = np.nonzero(inside)
            if not len(rows):
                continue
            met = grid[int(top) : int(bottom) + 1, int(left) : int(right) + 1].reshape(-1, 4)
            assert (met[:, 0].min(), met[:, 2].min()) <= (columns.min(), rows.min())
            assert met[:, 0].min() <= columns.min()
            assert met[:, 1].max() >= columns.max()
            assert met[:, 2].min() <= rows.min()
            assert met[:, 3].max() >= rows.max()
        first += size * size
        size //= 2
    assert first == len(boxes)


LENSES = [
    BrownConrady(-0.3, 0.1, 0.01, p1=1e-3, s4=1e-4),
    Fisheye(0.01, -0.002),
    Equirectangular(),
    Orthographic(),
]


@pytest.mark.parametrize("name", ["k1", "k2", "k3", "k4"])
def test_a_fisheye_sees_as_far_as_distances_grow(name):
    lens, angles = Fisheye(**{name: -0.2}), np.linspace(0, math.radians(100), 100_001)
    assert lens.max_angle == pytest.approx(angles[lens.image_radius(angles).argmax()], abs=2e-5)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.kind)
def test_scene_files_keep_lenses(tmp_path, lens):
    camera = fs.Camera.pinhole(64, 48, 40.0, 41.0, 30.0, 25.0, POSE, lens=lens)
    fs.Scene([], camera=camera).save(tmp_path / "scene.toml")
    again = fs.Scene.load(tmp_path / "scene.toml").camera
    assert again.lens == lens
    assert (again.fx, again.fy, again.cx, again.cy) == (40.0, 41.0, 30.0, 25.0)


HEAD = "[camera]\nwidth = 64\nheight = 48\nposition = [0, 0, -1]\nlook_at = [0, 0, 0]\n"


@pytest.mark.parametrize(
    ("text", "fx", "fy"),
    [
        ("fov_x_deg = 90\n[camera.distortion]\nk1 = -0.1\n", 32.0, 32.0),
        ("fov_x_deg = 180\n[camera.fisheye]\n", 64 / math.pi, 64 / math.pi),
        ("[camera.equirectangular]\n", 32 / math.pi, 48 / math.pi),
        ("[camera.orthographic]\nmetres_wide = 16.0\n", 4.0, 4.0),
    ],
)
def test_scene_files_switch_lenses_on(tmp_path, text, fx, fy):
    (tmp_path / "scene.toml").write_text(HEAD + text)
    camera = fs.Scene.load(tmp_path / "scene.toml").camera
    assert camera.lens is not None
    assert (camera.fx, camera.fy) == pytest.approx((fx, fy))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("fov_x_deg = 90\n[camera.distortion]\nk7 = 1.0\n", r"'camera.distortion.k7' .did you mean 'k"),
        ("fov_x_deg = 90\n[camera.distortion]\n[camera.fisheye]\n", "fisheye and distortion exclude"),
        ("fov_x_deg = 90\n[camera.equirectangular]\n", "fov_x_deg and equirectangular exclude"),
        ("fov_x_deg = 90\n[camera.orthographic]\n", "fov_x_deg and orthographic exclude"),
        ("[camera.orthographic]\n", "metres_wide is missing"),
        ("[camera.orthographic]\nmetres_wide = -1\n", "metres_wide must be above 0"),
        (
            "[camera.equirectangular]\nradius = 1\n",
            "unknown key 'camera.equirectangular.radius'; none is known here",
        ),
        ("fov_x_deg = 210\n[camera.fisheye]\n", "fov_x_deg: camera fov_x of this fisheye"),
        ("fov_x_deg = 120\n[camera.distortion]\nk1 = -2.0\n", "must be invertible in"),
    ],
)
def test_lenses_that_scene_files_cannot_have(tmp_path, text, words):
    (tmp_path / "scene.toml").write_text(HEAD + text)
    with pytest.raises(fs.InputError, match=words):
        fs.Scene.load(tmp_path / "scene.toml")


@pytest.mark.parametrize(
    "lens",
    [
        *(BrownConrady.opencv(each) for each in COEFFICIENTS),
        *(Fisheye(0.05, -0.01, 0.003, -0.001), Fisheye(), Equirectangular(), Orthographic()),
    ],
    ids=lambda lens: lens.kind,
)
def test_derivatives_are_those_of_the_image(lens):
    points, step = points_before(5), 1e-5
    if lens.along_ray:
        points = np.concatenate([points, points * (1, 1, -0.05), [(0, 0, 2.0)]])
    shifts = step * np.eye(3)
    want = np.stack([lens.image(points + s) - lens.image(points - s) for s in shifts], 2) / (2 * step)
    seen = np.isfinite(want).all((1, 2))
    assert seen.mean() > 0.6
    np.testing.assert_allclose(lens.derivative(points)[seen], want[seen], atol=2e-6, rtol=1e-6)


def test_a_panorama_has_derivatives_at_its_poles():
    poles = np.array([(0, 3.0, 0), (0, -3.0, 0), (1e-9, 3.0, -1e-9)])
    slopes = Equirectangular().derivative(poles)
    assert np.isfinite(slopes).all()
    assert (np.linalg.matrix_rank(slopes, tol=1e-9) == 2).all()


@pytest.mark.parametrize(
    "lens",
    [BrownConrady(-0.2, 0.05, p1=0.01), Fisheye(0.05, -0.01), Equirectangular()],
    ids=lambda lens: lens.kind,
)
def test_slopes_of_a_raster_are_the_differences_of_its_rays(lens):
    """A step of a tenth of a sample in either direction turns a ray by that much of its slope."""
    size, numbers = (40, 30), (14.0, 13.0, 19.3, 15.2)
    raster = RayRaster(lens, *size, *numbers)
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    places = np.stack([x.ravel(), y.ravel()], 1)
    slopes = raster.ray_derivatives.reshape(-1, 2, 3)
    assert raster.rows(10, 20).ray_derivatives.tobytes() == raster.ray_derivatives[10:20].tobytes()
    furthest = 0.0
    for axis, step in enumerate(0.1 * np.eye(2)):
        image = [(places + sign * step - numbers[2:]) / numbers[:2] for sign in (1, -1)]
        want = (lens.rays(image[0]) - lens.rays(image[1])) / 0.2
        seen = np.isfinite(want[:, 0]) & np.isfinite(slopes[:, 0, 0])
        assert seen.mean() > 0.6
        np.testing.assert_allclose(slopes[seen, axis], want[seen], atol=3e-5)
        furthest = max(furthest, np.linalg.norm(want[seen], axis=1).max())
    assert raster.max_ray_derivative > furthest * 0.999


@pytest.mark.parametrize(
    "camera",
    [
        fs.Camera.pinhole(90, 70, 80.0, 85.0, 40.0, 36.0, lens=BrownConrady.opencv(COEFFICIENTS[3])),
        fs.Camera.fisheye(90, 70, math.radians(200)),
        fs.Camera.equirectangular(90, 70),
    ],
    ids=["distortion", "fisheye", "panorama"],
)
def test_rays_of_a_raster_go_through_the_centres_of_its_samples(camera):
    """Back on the image they are there, to what float32 rounds. No comparison with the reference asks that:
    it has the same rays."""
    raster = RayRaster(camera.lens, 90, 70, camera.fx, camera.fy, camera.cx, camera.cy)
    for rows in (raster, raster.rows(30, 50)):
        seen = np.isfinite(rows.rays[..., 0])
        assert seen.mean() > 0.5
        back = camera.project(rows.rays[seen].astype(float))
        row, column = np.nonzero(seen)
        np.testing.assert_allclose(back[:, 0], column + 0.5, atol=1e-4)
        np.testing.assert_allclose(back[:, 1], row + rows.top + 0.5, atol=1e-4)


SIDES = {(90, 70): 32, (20, 64): 32, (63, 9): 16, (1500, 4): 512}


@pytest.mark.parametrize("size", SIDES)
def test_maps_have_a_cell_for_two_pixels_of_the_longer_side(size):
    """The largest power of two, `CELLS` at most: with fewer cells bounds are loose and binning is slow."""
    raster = RayRaster(Fisheye(), *size, 60.0, 60.0, size[0] / 2, size[1] / 2)
    assert raster.inverse_lens_lut[1][4] == SIDES[size]
