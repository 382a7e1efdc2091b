"""Fog, backgrounds and the steps of the sensor: every device against the reference, and the properties of
each."""

import math
from dataclasses import replace

import numpy as np
import pytest
from agreement import against_reference, random_splats
from ideal_effects import assert_as_good, ideal_image
from sampling import SAMPLES, alternate

import fidsplat as fs
from fidsplat.backends.reference.post import variates
from fidsplat.backends.view import View
from fidsplat.selftest.agreement import FrameSpec

CAMERA = fs.Camera.look_at(81, 59, 1.0, (0.3, -0.2, -0.1), (0.0, 0.1, 3.0))
IN_FOG = ("rgb", "alpha", "depth", "distance")
CLOUD = random_splats(120, 3)
GREY = (0.4, 0.4, 0.4)
NOISY = fs.Sensor(full_well=5000, read_noise=12, seed=7)
EMPTY = fs.SplatCloud.empty()


def panorama(width=40, height=20):
    return fs.Panorama(np.random.default_rng(1).uniform(0, 1, (height, width, 3)))


SENSORS = {
    "exposure": fs.Sensor(exposure=1.7),
    "vignetting": fs.Sensor(vignetting=(-0.3, -0.1, 0.02)),
    "dark corners": fs.Sensor(vignetting=(-2.5, 1.2, -0.9)),
    "noise": NOISY,
    "gain": fs.Sensor(gain=0.4),
    "gamma": fs.Sensor(response=2.2),
    "srgb": fs.Sensor(response="srgb"),
    "table": fs.Sensor(response=(0.0, 0.7, 0.9, 0.95)),
    "bits": fs.Sensor(bits=8),
    "decode": fs.Sensor(decode="srgb", exposure=3.0),
    "glare": fs.Sensor(veiling_glare=0.3, glare_light=(0.2, 0.5, 0.9)),
    "saturation": fs.Sensor(exposure=2.0, saturation=0.7, white_balance=(0.8, 1.0, 1.4)),
    "all": replace(
        NOISY,
        exposure=1.3,
        vignetting=(-0.4,),
        gain=1.5,
        response="srgb",
        bits=16,
        decode="srgb",
        veiling_glare=0.1,
        saturation=0.9,
        white_balance=(0.8, 1.0, 1.4),
        glare_light=(0.2, 0.5, 0.9),
    ),
}


@pytest.mark.parametrize("name", SENSORS)
def test_steps_of_the_sensor(renderer, name):
    agree(renderer, FrameSpec(CLOUD, CAMERA, outputs=("rgb",), sensor=SENSORS[name]))


@pytest.mark.parametrize("name", ["all", "vignetting"])
def test_the_sensor_sees_pixels_not_samples(renderer, name):
    agree(renderer, FrameSpec(CLOUD, CAMERA, fs.Quality(samples=2), sensor=SENSORS[name]))


@pytest.mark.parametrize(
    ("density", "samples"), alternate({"thin": 0.05, "fog": 1.0, "thick": 30.0}, SAMPLES)
)
def test_fog(renderer, density, samples):
    tag = fs.marker("aruco:4x4_50:7", size=1.0, mixture="fitted").cloud.transformed(
        np.diag([1, 1, 1, 1.0]) + shift(0, 0, 2)
    )
    fog = fs.Fog(density, (0.6, 0.7, 0.8))
    for cloud in (CLOUD, fs.SplatCloud.concatenate([tag, random_splats(30, 4)])):
        agree(renderer, FrameSpec(cloud, CAMERA, fs.Quality(samples=samples), IN_FOG, fog=fog))


SKIES = {"gradient": fs.Gradient((0.2, 0.4, 0.9), (0.3, 0.2, 0.1), (0.1, -2, 0.3)), "panorama": panorama()}


@pytest.mark.parametrize(("background", "samples"), alternate(SKIES, {"1 sample": 1, "3 x 3 samples": 3}))
def test_backgrounds(renderer, background, samples):
    for target in ((0.0, 0.1, 3.0), (0.0, 0.1, -3.0), (0.3, -9.0, 0.0)):
        camera = fs.Camera.look_at(81, 59, 1.4, (0.3, -0.2, -0.1), target, up=(0.1, -1, 0.2))
        agree(renderer, FrameSpec(CLOUD, camera, fs.Quality(samples=samples), background=background))


def agree(renderer, picture):
    differences = against_reference(renderer, picture)
    assert all(difference.agrees for difference in differences), differences


def shift(x, y, z):
    matrix = np.zeros((4, 4))
    matrix[:3, 3] = x, y, z
    return matrix


def test_a_wall_fades_by_its_distance_along_the_ray(renderer):
    wall = fs.SplatCloud([(0, 0, 4)], [(1, 0, 0, 0)], [(500, 500)], [1.0], colors=[(1, 1, 1)])
    camera = fs.Camera.pinhole(61, 41, 30.0, 30.0, 30.5, 20.5)
    color = np.array([0.2, 0.3, 0.4])
    frame = renderer.render(wall, camera, IN_FOG, fog=fs.Fog(0.1, tuple(color)))
    left = np.exp(-0.1 * frame["distance"][..., None]) * frame["alpha"][..., None]
    assert frame["rgb"] == pytest.approx(left + (1 - left) * color, abs=1e-5)
    nothing = renderer.render(EMPTY, camera, fog=fs.Fog(0.1, tuple(color)), background=(1, 0, 0))
    assert nothing["rgb"] == pytest.approx(np.broadcast_to(color, (41, 61, 3)))


def test_the_centre_of_a_panorama_is_ahead(renderer):
    """One bright column and row: +z is in the middle, +x to the right of it, -y on top."""
    image = np.zeros((90, 180, 3))
    image[:, 135, 0] = 1  # +x
    image[:, 90, 1] = 1  # +z
    image[20, :, 2] = 1  # above
    around = fs.Panorama(image)
    camera = fs.Camera.pinhole(101, 101, 50.0, 50.0, 50.5, 50.5)  # looks along +z, 90 degrees wide
    rgb = renderer.render(EMPTY, camera, background=around)["rgb"]
    assert rgb[50].argmax(0)[1] in (50, 51)
    right = fs.Camera.look_at(101, 101, math.radians(90), (0, 0, 0), (1, 0, 0))
    assert renderer.render(EMPTY, right, background=around)["rgb"][50].argmax(0)[0] in (50, 51)
    up = fs.Camera.look_at(101, 101, math.radians(90), (0, 0, 0), (0, -1, 0.3))
    assert renderer.render(EMPTY, up, background=around)["rgb"][..., 2].max() > 0.3
    assert rgb[60:, :, 2].max() == 0


@pytest.mark.parametrize("up", [-1.0, 1.0], ids=["above", "below"])
def test_a_panorama_reaches_to_its_poles(renderer, up):
    """Straight up and down, where the top or the bottom row is all that a narrow view shows."""
    camera = fs.Camera.look_at(21, 15, 0.3, (0.0, 0.0, 0.0), (0.02, up, 0.01), up=(0.2, 0.0, 1.0))
    agree(renderer, FrameSpec(CLOUD, camera, outputs=("rgb",), background=panorama(16, 8)))


def test_noise_has_the_variance_of_its_electrons(renderer):
    """Light v: variance v / full well + (read noise / full well)^2, to the standard error of 3 x 200 x 200
    samples."""
    camera = fs.Camera.pinhole(200, 200, 100.0, 100.0, 100.0, 100.0)
    for light in (0.0, 0.1, 0.8):
        rgb = renderer.render(EMPTY, camera, background=(light,) * 3, sensor=NOISY)["rgb"].astype(float)
        variance = light / 5000 + (12 / 5000) ** 2
        count = rgb.size
        assert abs(rgb.mean() - light) < 4 * math.sqrt(variance / count)
        assert rgb.var() == pytest.approx(variance, rel=4 * math.sqrt(2 / count))
        neighbours = np.corrcoef(rgb[:, :-1].ravel(), rgb[:, 1:].ravel())[0, 1]
        channels = np.corrcoef(rgb[..., 0].ravel(), rgb[..., 1].ravel())[0, 1]
        assert max(abs(neighbours), abs(channels)) < 4 / math.sqrt(count / 3)


def test_noise_is_the_same_on_every_run_and_device_and_other_for_another_seed(renderer):
    camera = fs.Camera.pinhole(64, 48, 60.0, 60.0, 32.0, 24.0)

    def noise(seed):
        # read noise alone, a power of two: the variates themselves
        sensor = fs.Sensor(full_well=2.0**100, read_noise=2.0**100, seed=seed)
        return renderer.render(EMPTY, camera, sensor=sensor)["rgb"]

    first = noise(5)
    assert np.array_equal(first, noise(5))
    rows, columns = (grid.ravel() for grid in np.mgrid[0:48, 0:64])
    assert np.array_equal(first.reshape(-1, 3), variates(columns, rows, 5).astype(np.float32))
    other = noise(6)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.05


def test_curves_at_their_own_points(renderer):
    camera = fs.Camera.pinhole(3, 3, 3.0, 3.0, 1.5, 1.5)

    def value(light, **sensor):
        return float(
            renderer.render(EMPTY, camera, background=(light,) * 3, sensor=fs.Sensor(**sensor))["rgb"][
                1, 1, 0
            ]
        )

    assert value(0.5, response="srgb") == pytest.approx(0.735357, abs=1e-5)
    assert value(0.001, response="srgb") == pytest.approx(0.01292, abs=1e-6)
    assert value(0.02, response="srgb") == pytest.approx(0.151703, abs=1e-5)
    assert value(0.25, response=2.0) == pytest.approx(0.5, abs=1e-6)
    assert value(0.25, response=(0, 0.5, 1, 1, 1)) == pytest.approx(0.5, abs=1e-6)
    assert value(9.0, response="srgb") == pytest.approx(1)
    assert value(9.0, response=2.0) == pytest.approx(1)
    assert value(-1.0, response=2.0) == 0
    assert value(9.0, response=(0.2, 1)) == 1
    assert value(0.3, exposure=2, gain=1.5) == pytest.approx(0.9, abs=1e-6)
    # a device's division may round otherwise
    assert value(0.301, bits=8) == pytest.approx(77 / 255, abs=6e-8)
    assert value(-3.0, bits=16) == 0


def test_values_of_a_camera():
    """Of the reference, with which devices agree."""
    reference, camera = fs.Renderer("reference"), fs.Camera.pinhole(1, 1, 1.0, 1.0, 0.5, 0.5)

    def value(light, **settings):
        frame = reference.render(EMPTY, camera, background=(light, 0, 0), sensor=fs.Sensor(**settings))
        return frame["rgb"][0, 0, 0]

    assert value(0.735357, decode="srgb") == pytest.approx(0.5, abs=2e-6)
    assert value(0.01292, decode="srgb") == pytest.approx(0.001, abs=1e-8)
    assert value(1.353256, decode="srgb") == pytest.approx(2.0, rel=2e-6)  # above 1 too
    assert value(-0.1, decode="srgb") == 0
    assert value(0.6, decode="srgb", response="srgb") == pytest.approx(0.6, abs=1e-6)
    assert value(0.4, exposure=3, saturation=0.8, gain=0.5) == pytest.approx(0.4, abs=1e-6)
    assert value(0.4, white_balance=(1.5, 1, 2)) == pytest.approx(0.6, abs=1e-6)
    assert value(0.4, veiling_glare=0.25, glare_light=(0.8, 0, 0)) == pytest.approx(0.5, abs=1e-6)


def test_nothing_is_read_beyond_the_end_of_a_table(renderer, monkeypatch):
    """Where light is 1 the last two values count; what stands behind them would show, times 0 too."""
    array_of = View.array
    monkeypatch.setattr(View, "array", lambda view, name: np.append(array_of(view, name), np.float32("nan")))
    camera = fs.Camera.pinhole(3, 3, 3.0, 3.0, 1.5, 1.5)
    frame = renderer.render(EMPTY, camera, background=(1, 1, 1), sensor=fs.Sensor(response=(0.2, 1)))
    assert (frame["rgb"] == 1).all()


@pytest.mark.parametrize("samples", [1, 2])
def test_light_falls_off_from_the_principal_point(renderer, samples):
    """By the formula, at the centres of pixels; black, not negative, in the corners."""
    camera = fs.Camera.pinhole(61, 41, 50.0, 50.0, 20.0, 25.0)
    sensor = fs.Sensor(vignetting=(-1.5, 0.3, -0.1))
    frame = renderer.render(EMPTY, camera, None, fs.Quality(samples=samples), background=GREY, sensor=sensor)
    rows, columns = np.mgrid[0:41, 0:61] + 0.5
    squared = ((columns - 20) ** 2 + (rows - 25) ** 2) / (math.hypot(61, 41) / 2) ** 2
    light = np.maximum(1 - 1.5 * squared + 0.3 * squared**2 - 0.1 * squared**3, 0)
    assert light.min() == 0
    assert frame["rgb"] == pytest.approx(0.4 * np.repeat(light[..., None], 3, 2), abs=2e-6)


def test_values_that_mean_nothing_select_nothing(renderer):
    from fidsplat.effects import select

    nothing = [
        fs.Sensor(seed=5, response=1.0, vignetting=(0, 0.0)),
        fs.Sensor(response=(0, 0.25, 0.5, 0.75, 1)),
        None,
    ]
    plain = select(CLOUD, fs.Capture())
    for sensor in nothing:
        assert select(CLOUD, fs.Capture(background=(1, 2, 3), sensor=sensor, fog=fs.Fog(0.0))) == plain
    assert select(CLOUD, fs.Capture(sensor=NOISY)) != plain
    grey = fs.Gradient(GREY, GREY, (1, 0, 0))
    assert select(CLOUD, fs.Capture(background=grey)) == plain
    assert select(CLOUD, fs.Capture(background=fs.Gradient(GREY, (0, 0, 0)))) != plain
    frames = [renderer.render(CLOUD, CAMERA, background=behind) for behind in (grey, GREY)]
    assert np.array_equal(frames[0]["rgb"], frames[1]["rgb"])
    around = fs.Scene([CLOUD], CAMERA, background=grey)
    assert np.array_equal(renderer.render(around)["rgb"], frames[0]["rgb"])


def test_the_sensor_keeps_the_other_outputs(renderer):
    names = ("rgb", "alpha", "depth", "normal", "label")
    plain = renderer.render(CLOUD, CAMERA, names)
    frame = renderer.render(CLOUD, CAMERA, names, sensor=SENSORS["all"], fog=fs.Fog(0.3), background=GREY)
    for name in names[1:]:
        assert np.array_equal(plain[name], frame[name]), name
    assert not np.array_equal(plain["rgb"], frame["rgb"])


@pytest.mark.parametrize("mixture", ["fitted", "exact"])
def test_a_tag_is_found_where_it_is_in_fog_and_noise(renderer, mixture):
    """Position error under 1 % of the distance, as the ideal plane's: the images are for robots."""
    from fidsplat.images.files import to_uint8
    from fidsplat.vision.detect import detect
    from fidsplat.vision.pose import marker_pose, pose_error

    pose = np.eye(4)
    pose[:3, :3] = [[0.9, 0, 0.43588989], [0, 1, 0], [-0.43588989, 0, 0.9]]
    pose[:3, 3] = (0.1, -0.05, 1.5)
    marker = fs.marker("apriltag:36h11:5", size=0.3, mixture=mixture)
    camera = fs.Camera.pinhole(480, 360, 420.0, 420.0, 240.0, 180.0)
    sensor = fs.Sensor(0.9, (-0.4,), 3000, 10, 3, 1.0, "srgb", 8)
    around = fs.Gradient((0.3, 0.4, 0.6), (0.3, 0.25, 0.2))
    placed = fs.scenes.PlacedMarker(marker, pose)
    scene = fs.Scene(markers=[placed], camera=camera, background=around, sensor=sensor)
    distance = np.linalg.norm(pose[:3, 3])
    for fog in (None, fs.Fog(0.3, (0.5, 0.5, 0.5))):
        rgb = renderer.render(scene, quality=fs.Quality(lowpass="none", samples=2), fog=fog)["rgb"]
        ideal = ideal_image(placed, camera, 2, around, sensor=sensor, fog=fog)
        errors = []
        for picture in (rgb, ideal):
            (detection,) = detect(to_uint8(picture), families=["36h11"], qr=False)
            assert detection.id == 5
            errors.append(pose_error(marker_pose(detection.corners, 0.3, camera), pose)[0])
        assert_as_good(*errors, distance)
        assert errors[1] < 0.01 * distance


def test_a_view_needs_no_sensor():
    view = View.of(fs.Capture(CAMERA), np.zeros(3))
    assert view.sensor.steps == ()
