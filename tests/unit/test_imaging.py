"""Sensors, fog and backgrounds: values, scene files, and errors."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.images.files import write_png
from fidsplat.util.response import linear_light

BACKEND = "opencl"

SCENE = """[camera]
width = 24
height = 16
fov_x_deg = 60.0
position = [0.0, 0.0, -1.0]
look_at = [0.0, 0.0, 0.0]

[[markers]]
spec = "apriltag:36h11:5"
size = 0.3
"""


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"exposure": -1}, r"sensor: exposure must be a number from 0 to 1e.15, got -1"),
        ({"gain": math.nan}, "gain must be .* got nan"),
        ({"full_well": 0.5}, "full_well must be a number of electrons, 1 or more"),
        ({"full_well": 9, "read_noise": 10}, "sensor: read_noise must be a number from 0 to 9, got 10"),
        ({"gain": 1e30}, r"sensor: gain must be a number from 0 to 1e.15, got 1e.30"),
        ({"read_noise": 3}, "full_well must be given with read_noise"),
        ({"seed": 1.5}, "seed must be a whole number"),
        ({"seed": 2**32}, "seed must be .* got 4294967296"),
        ({"bits": 12}, "bits must be 8, 16 or None, got 12"),
        ({"bits": 8.0}, "bits must be 8, 16 or None, got 8.0"),
        ({"vignetting": (1, 2, 3, 4)}, "vignetting must be 0 to 3 finite numbers"),
        ({"vignetting": 0.5}, "vignetting must be .* got 0.5"),
        ({"response": "log"}, "response must be linear, srgb, .*, got 'log'"),
        ({"response": 1e-300}, "a gamma must be from 0.01 to 100"),
        ({"response": (1,)}, "2 to 65536 finite numbers"),
        ({"response": (0, math.inf)}, "finite numbers"),
        ({"decode": 2.2}, "decode must be linear or srgb, got 2.2"),
        ({"veiling_glare": 1}, "veiling_glare must be a number from 0 to 0.99, got 1"),
        ({"glare_light": (1, 2)}, "glare_light must be three numbers"),
        ({"auto_exposure": -1}, "auto_exposure must be a number from 0 to 1"),
        ({"saturation": 0}, "saturation must be a number above 0, got 0"),
        ({"white_balance": "gray"}, 'white_balance must be three numbers or "grey"'),
        ({"white_balance": (1, -1, 1)}, "white_balance must be three numbers of at least 0"),
    ],
)
def test_sensors_that_cannot_be(values, words):
    with pytest.raises(fs.InputError, match=words):
        fs.Sensor(**values)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: fs.Fog(-0.1), "density must be .* got -0.1"),
        (lambda: fs.Fog(0.1, (1, 2)), "fog: color"),
        (lambda: fs.Fog(0.1, (1, -math.inf, 0)), "fog: color must be three finite numbers"),
        (lambda: fs.Gradient((0, 0, 0), (1, 1, math.nan)), "background: bottom"),
        (lambda: fs.Gradient((0, 0, 0), (1, 1, 1), (0, 0, 0)), "must be a direction"),
        (lambda: fs.Gradient((0, 0, 0), (1, 1, 1), (1e-300, 0, 0)), "must be a direction"),
        (lambda: fs.Panorama(np.zeros((4, 4))), r"must be \(h, w, 3\)"),
        (lambda: fs.Panorama(np.zeros((1, 4, 3))), "pixels a side, got 4 x 1"),
        (lambda: fs.Panorama(np.full((4, 4, 3), np.nan)), "must be finite, got 48"),
        (lambda: fs.Panorama(np.full((4, 4, 3), 1e300), "sky.tiff"), "sky.tiff must be finite"),
        (lambda: fs.Panorama.load("nowhere.png"), "nowhere.png"),
        (lambda: fs.Scene(fog=0.2), "fog must be a Fog"),
        (lambda: fs.Scene(sensor="srgb"), "sensor must be a Sensor"),
        (lambda: fs.Scene(background="sky.png"), "background must be three"),
    ],
)
def test_surroundings_that_cannot_be(make, words):
    with pytest.raises(fs.InputError, match=words):
        make()


def test_a_gradient_between_equal_colours_is_that_colour():
    grey = (0.4, 0.5, 0.6)
    assert fs.Capture(background=fs.Gradient(grey, grey, (1, 0, 0))).rendered_background == grey
    other = fs.Gradient(grey, (0.4, 0.5, 0.7), (1, 0, 0))
    assert fs.Capture(background=other).rendered_background is other


def test_steps_come_in_the_order_of_the_light():
    whole = fs.Sensor(2, (0.1,), 1000, 3, 4, 0.5, 2.2, 8)
    assert whole.steps == ("exposure", "vignetting", "noise", "gain", "response_gamma", "quantise")
    assert fs.Sensor().steps == ()


def test_an_image_is_exposed_by_its_light():
    """A uniform image has the requested luminance; grey after white balance, in linear light."""
    color, empty, renderer = (0.5, 0.7, 0.9), fs.SplatCloud.empty(), fs.Renderer("reference")
    camera = fs.Camera.look_at(200, 100, 1.0, (0, 0, 0), (0, 0, 1))
    light = linear_light(np.array(color), "srgb")

    def seen(**sensor):
        frame = renderer.render(empty, camera, background=color, sensor=fs.Sensor(decode="srgb", **sensor))
        assert not frame.capture.sensor.needs_metering
        return frame["rgb"][50, 100]

    luminance = [0.2126, 0.7152, 0.0722]
    assert seen(auto_exposure=0.18) @ luminance == pytest.approx(0.18, rel=1e-5)
    assert seen(auto_exposure=0.18, exposure=2.0) @ luminance == pytest.approx(0.36, rel=1e-5)
    assert np.allclose(seen(auto_exposure=0.18) / light, 0.18 / (light @ luminance), rtol=1e-5)
    assert np.allclose(seen(auto_exposure=0.18, white_balance="grey"), 0.18, rtol=1e-5)
    assert np.allclose(seen(veiling_glare=0.3), light, rtol=1e-5)  # of a uniform image


@pytest.mark.parametrize("mask", [(False, True, False), (False, False, False)])
def test_masked_views_are_not_metered(monkeypatch, mask):
    color, renderer = (0.5, 0.7, 0.9), fs.Renderer("reference")
    camera = fs.Camera.look_at(20, 10, 1.0, (0, 0, 0), (0, 0, 1))
    capture = fs.Capture(camera, background=color, sensor=fs.Sensor(auto_exposure=0.18, veiling_glare=0.1))
    cloud = renderer.upload(fs.SplatCloud.empty())
    expected = renderer.render(cloud, capture)["rgb"]
    rendered, pipeline = [], renderer.backend.pipeline
    monkeypatch.setattr(renderer.backend, "pipeline", lambda *args: rendered.append(args) or pipeline(*args))
    batch = renderer.render_batch(cloud, [capture] * 3, mask=np.array(mask))
    assert len(rendered) == 1 + sum(mask)  # the batch, and a small frame for each view that is rendered
    for image, active in zip(batch["rgb"], mask, strict=True):
        np.testing.assert_array_equal(image, expected if active else 0 * expected)


def test_glare_lightens_the_dark_half_of_an_image():
    """The image's mean times the share, at every size and in batches."""
    sky = fs.Panorama(np.repeat([[[0.8, 0.4, 0.2]], [[0.0, 0.0, 0.0]]], [64, 64], 0).repeat(256, 1))
    sensor, mean = fs.Sensor(veiling_glare=0.2), np.array([0.4, 0.2, 0.1])
    renderer = fs.Renderer(BACKEND)
    camera = fs.Camera.look_at(64, 64, 1.0, (0, 0, 0), (0, 0, 1))
    captures = [fs.Capture(camera, background=sky, sensor=sensor), fs.Capture(camera, background=sky)]
    captures[1] = captures[1].with_(sensor=replace(sensor, veiling_glare=0.1))
    scene = fs.SplatCloud.empty()
    batch = renderer.render_batch(scene, captures)["rgb"]
    for image, share in zip(batch, (0.2, 0.1), strict=True):
        assert np.allclose(image[60, 30], share * mean, atol=2e-3)
        assert np.allclose(image[4, 30], (1 - share) * 2 * mean + share * mean, atol=2e-3)
    assert np.array_equal(renderer.render(scene, captures[0])["rgb"], batch[0])
    rows = renderer.render_band((32, 64), scene, captures[0])["rgb"]
    assert np.array_equal(rows[32:], batch[0][32:])


def test_a_scene_file_keeps_them(tmp_path):
    write_png(tmp_path / "sky.png", np.random.default_rng(0).uniform(0, 1, (8, 16, 3)))
    sensor = fs.Sensor(1.5, (-0.2, 0.1), 9000, 4.5, 11, 2.0, (0.0, 0.6, 1.0), 16)
    for background in (
        fs.Gradient((0, 0.1, 1), (0.2, 0.2, 0.2)),
        fs.Panorama.load(tmp_path / "sky.png"),
        (0.1, 0.2, 0.3),
    ):
        fs.Scene(sensor=sensor, fog=fs.Fog(0.2, (0.5, 0.6, 0.7)), background=background).save(
            tmp_path / "a.toml"
        )
        read = fs.Scene.load(tmp_path / "a.toml")
        assert (read.sensor, read.fog) == (sensor, fs.Fog(0.2, (0.5, 0.6, 0.7)))
        if isinstance(background, fs.Panorama):
            assert np.array_equal(read.background.image, background.image)
            assert 'image = "sky.png"' in (tmp_path / "a.toml").read_text()  # a folder can be moved
        else:
            assert read.background == background
    camera = fs.Sensor(
        decode="srgb", veiling_glare=0.1, auto_exposure=0.2, white_balance="grey", saturation=2
    )
    for one in (camera, fs.Sensor(white_balance=(1, 1, 2), veiling_glare=0.1, glare_light=(0.1, 0.2, 0.3))):
        fs.Scene(sensor=one).save(tmp_path / "a.toml")
        assert fs.Scene.load(tmp_path / "a.toml").sensor == one
    for response in ("srgb", 1.8):
        fs.Scene(sensor=fs.Sensor(response=response)).save(tmp_path / "a.toml")
        assert fs.Scene.load(tmp_path / "a.toml").sensor == fs.Sensor(response=response)
    fs.Scene().save(tmp_path / "a.toml")
    assert (fs.Scene.load(tmp_path / "a.toml").sensor, fs.Scene.load(tmp_path / "a.toml").fog) == (None, None)


def test_numbers_of_numpy_are_numbers(tmp_path):
    """They are what a script has that renders many images; a file says them as any others."""
    one = np.float32(1.5)
    scene = fs.Scene(
        camera=fs.Camera.pinhole(8, 6, 8.0, 8.0, 4.0, 3.0),
        sensor=fs.Sensor(one, full_well=np.float64(900), seed=np.int64(7), response=one, bits=np.int32(8)),
        fog=fs.Fog(np.float64(0.25)),
        shutter=fs.Shutter(exposure_time=np.float64(0.25), sub_poses=np.int64(3), rows_per_band=np.int32(2)),
        quality=fs.Quality(alpha_cutoff=np.float64(0.125)),
    )
    scene.save(tmp_path / "a.toml")
    read = fs.Scene.load(tmp_path / "a.toml")
    assert (read.sensor, read.fog, read.shutter) == (scene.sensor, scene.fog, scene.shutter)
    assert read.sensor == fs.Sensor(1.5, full_well=900, seed=7, response=1.5, bits=8)
    assert read.quality == scene.quality


def test_a_panorama_of_whole_numbers_is_a_share_of_its_type():
    for kind in (np.uint8, np.uint16):
        image = np.full((2, 4, 3), np.iinfo(kind).max, kind)
        assert (fs.Panorama(image).image == 1).all()


def test_a_scene_file_keeps_the_low_pass_and_the_first_hit(tmp_path):
    quality = fs.Quality.named("fast").with_(lowpass="pixel", first_hit=0.4, samples=2)
    fs.Scene(quality=quality).save(tmp_path / "a.toml")
    assert fs.Scene.load(tmp_path / "a.toml").quality == quality
    text = (tmp_path / "a.toml").read_text()
    (tmp_path / "a.toml").write_text(text.replace('"pixel"', '"pixels"'))
    with pytest.raises(fs.InputError, match=r"a\.toml: quality: lowpass must be one of .*got 'pixels'"):
        fs.Scene.load(tmp_path / "a.toml")


def test_a_panorama_of_no_file_cannot_be_written(tmp_path):
    with pytest.raises(fs.InputError, match="must be loaded from a file"):
        fs.Scene(background=fs.Panorama(np.zeros((4, 8, 3)))).save(tmp_path / "a.toml")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ("[sensor]\nexposre = 2.0", "'sensor.exposre' .did you mean 'exposure'"),
        ("[sensor]\nexposure = -2.0", r"\.toml: sensor: exposure must be .* got -2.0"),
        ("[sensor]\nresponse = true", "sensor.response must be a number"),
        ("[sensor]\nvignetting = 0.1", "sensor.vignetting must be a list of numbers"),
        ("[fog]\ncolor = [1, 1, 1]", "fog.density is missing"),
        ("[background]\ntop = [1, 1, 1]", "background.bottom is missing"),
        ('[background]\nimage = "no.png"', "background.image: .*no.png"),
        ('[background]\nimage = "no.png"\ntop = [1, 1, 1]', "background.top and image exclude"),
        (
            "[background]\ntop = [1, 1, 1]\nbottom = [0, 0, 0]\n[render]\nbackground = [0, 0, 0]",
            "exclude each other",
        ),
    ],
)
def test_tables_that_say_something_wrong(tmp_path, tables, words):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE + tables)
    with pytest.raises(fs.InputError, match=words) as caught:
        fs.Scene.load(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("bits", [8, 16])
def test_the_command_writes_as_many_bits_as_the_sensor_has(tmp_path, bits):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE + f"[sensor]\nexposure = 0.5\nbits = {bits}\n")
    assert main(["render", str(path), "-o", str(tmp_path / "out.png"), "--device", "reference"]) == 0
    image = cv2.imread(str(tmp_path / "out.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.dtype == (np.uint8 if bits == 8 else np.uint16)
    scene = fs.Scene.load(path)
    rgb = fs.Renderer("reference").render(scene)["rgb"]
    assert np.array_equal(image[:, :, ::-1], np.rint(rgb * (2**bits - 1)))


EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.mark.sweep
@pytest.mark.parametrize("name", sorted(file.stem for file in EXAMPLES.glob("*.toml")))
def test_the_examples_are_rendered(name, renderer):
    scene = fs.Scene.load(EXAMPLES / f"{name}.toml")
    frame = renderer.render(scene)
    assert scene.camera is not None
    assert frame["rgb"].shape == (scene.camera.height, scene.camera.width, 3)
    assert frame["rgb"].std() > 0.05
    assert set(frame) == set(scene.outputs)
