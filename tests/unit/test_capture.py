"""Capture: valid arguments, and errors for invalid ones."""

import numpy as np
import pytest
from cloud_properties import CloudProperties

import fidsplat as fs
from fidsplat.effects import select

CAMERA = fs.Camera.pinhole(16, 12, 16.0, 16.0, 8.0, 6.0)
PANORAMIC = fs.Camera.equirectangular(16, 12)
GREY = (0.5, 0.5, 0.5)
MOVING = fs.Motion(camera=lambda time: np.eye(4))


def test_parts_may_be_words_and_left_out():
    capture = fs.Capture(CAMERA, "depth", "fast", [0, 0.5, 1])
    assert (capture.outputs, capture.background) == (("depth",), (0.0, 0.5, 1.0))
    assert capture.quality == fs.Quality.named("fast")
    plain = fs.Capture(quality=None, motion=None, shutter=None, sensor=None)
    assert (plain.quality, plain.shutter, plain.sensor) == (fs.Quality(), fs.Shutter(), fs.Sensor())
    assert fs.Capture(outputs=["rgb", "alpha", "rgb"]).outputs == ("rgb", "alpha")


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"camera": "front"}, "camera must be a Camera"),
        ({"outputs": ()}, "outputs must have at least one name"),
        ({"outputs": (1, 2)}, "outputs must be one or more names"),
        ({"outputs": 7}, "outputs must be one or more names"),
        ({"quality": "fats"}, "did you mean 'fast'"),
        ({"background": (1, 2)}, "background must be three finite numbers"),
        ({"motion": 3}, "motion must be a Motion"),
        ({"shutter": "slow"}, "shutter must be a Shutter"),
        ({"sensor": 8}, "sensor must be a Sensor"),
        ({"fog": 0.1}, "fog must be a Fog"),
    ],
)
def test_a_part_of_the_wrong_kind_is_named_with_what_would_do(parts, message):
    with pytest.raises(fs.InputError, match=message):
        fs.Capture(**parts)
    with pytest.raises(fs.InputError, match=message):
        fs.Capture().with_(**parts)


@pytest.mark.parametrize("captures", [5, np.array("text")])
def test_views_that_are_not_a_list(captures):
    views = fs.Renderer("reference").render_views(fs.SplatCloud.empty(), captures)
    with pytest.raises(fs.InputError, match=r"captures must be a list of Capture or Camera, got"):
        list(views)


def test_a_copy_keeps_what_is_not_changed():
    capture = fs.Capture(CAMERA, ("rgb", "depth"), "fast", GREY)
    other = capture.with_(outputs=None, background=(0, 0, 0), fog=fs.Fog(0.1))
    assert (other.camera, other.outputs, other.quality) == (CAMERA, capture.outputs, capture.quality)
    assert (other.background, other.fog) == ((0.0, 0.0, 0.0), fs.Fog(0.1))
    with pytest.raises(fs.InputError, match=r"field of a capture 'qualty' \(did you mean 'quality'\?\)"):
        capture.with_(qualty="fast")


@pytest.mark.parametrize(
    ("fog", "expected"),
    [(None, GREY), (fs.Fog(0.0, (1, 0, 0)), GREY), (fs.Fog(0.1, (1, 0, 0)), (1.0, 0.0, 0.0))],
)
def test_fog_hides_the_background(fog, expected):
    assert fs.Capture(background=GREY, fog=fog).rendered_background == expected


def test_a_scene_and_its_resident_cloud_have_the_same_capture():
    sky = fs.Gradient((0.2, 0.4, 0.9), (0.4, 0.3, 0.1))
    parts = {
        "outputs": ("rgb", "alpha"),
        "background": sky,
        "sensor": fs.Sensor(gain=0.5),
        "fog": fs.Fog(0.2),
    }
    cloud = fs.SplatCloud([[0, 0, 2]], [[1, 0, 0, 0]], [[0.3, 0.3]], [0.9], colors=[[1.0, 0.5, 0.25]])
    scene = fs.Scene([cloud], CAMERA, quality="fast,samples=2", camera_motion=lambda time: np.eye(4), **parts)
    renderer = fs.Renderer("reference")
    resident = renderer.upload(scene)
    assert resident.capture.quality == fs.Quality.of("fast,samples=2")
    own, frame = renderer.render(scene), renderer.render(resident, CAMERA)
    assert own.outputs == frame.outputs == ("rgb", "alpha")
    assert all(np.array_equal(own[name], frame[name]) for name in own)
    plain = renderer.render(resident, fs.Capture(CAMERA))
    assert not np.array_equal(plain["rgb"], own["rgb"])
    (view,) = renderer.render_views(resident, [CAMERA])
    assert np.array_equal(view["rgb"], own["rgb"])


def test_a_capture_and_its_parts_render_the_same():
    cloud = fs.SplatCloud([[0, 0, 2]], [[1, 0, 0, 0]], [[0.3, 0.3]], [0.9], colors=[[1.0, 0.5, 0.25]])
    renderer = fs.Renderer("reference")
    capture = fs.Capture(CAMERA, ("rgb", "depth"), "fast", GREY, fog=fs.Fog(0.1))
    long = renderer.render(cloud, capture)
    short = renderer.render(cloud, CAMERA, ("rgb", "depth"), "fast", background=GREY, fog=fs.Fog(0.1))
    words = {"outputs": ("rgb", "depth"), "quality": "fast", "background": GREY, "fog": fs.Fog(0.1)}
    named = renderer.render(cloud, camera=CAMERA, **words)
    frames = [short, named, *renderer.render_views(cloud, [capture])]
    assert all(np.array_equal(frame[name], long[name]) for frame in frames for name in long)


ROLLING = {"motion": MOVING, "shutter": fs.Shutter(readout=0.1, rows_per_band=4)}


OF_PLANES, OF_BOXES = CloudProperties(has_coplanar_groups=True), CloudProperties(footprint="box")
ORDERED, FLOAT64 = fs.Quality(order="centre"), fs.Quality(blend_precision="float64")
BY_PIXEL, THICK = fs.Quality(order="pixel"), CloudProperties(ellipsoids="all")
GROUP = fs.Motion(None, {1: lambda time: np.eye(4)})


@pytest.mark.parametrize(
    ("cloud", "parts", "called", "not_called"),
    [
        (CloudProperties(sh_degree=0), {}, "color_rgb", "color_sh"),
        (CloudProperties(sh_degree=1), {}, "color_sh", "color_rgb"),
        (CloudProperties(), {}, "order_centre", "order_pixel"),
        (OF_PLANES, {}, "order_coplanar", "order_centre"),
        (OF_PLANES, {"quality": ORDERED}, "order_centre", "order_coplanar"),
        (OF_PLANES, {"quality": BY_PIXEL}, "order_coplanar_pixel", "order_coplanar"),
        (CloudProperties(), {"quality": BY_PIXEL}, "order_pixel", "order_centre"),
        (THICK, {"quality": BY_PIXEL}, "order_centre", "order_pixel"),  # of one depth each
        (CloudProperties(ellipsoids="some"), {"quality": BY_PIXEL}, "order_pixel", "order_centre"),
        (THICK, {"quality": BY_PIXEL.with_(ellipsoid="exact")}, "order_pixel", "order_centre"),
        (THICK, {"quality": BY_PIXEL.with_(blend_precision="float64")}, "order_pixel", "order_centre"),
        (THICK, {}, "ellipsoid_ewa", "ellipsoid_exact"),
        (THICK, {"camera": PANORAMIC}, "ellipsoid_exact", "ellipsoid_ewa"),  # 3DGS has no such lens
        (OF_BOXES, {}, "lowpass_none", "lowpass_screen"),  # they are filtered by themselves
        (CloudProperties(footprint="mixed"), {}, "lowpass_screen", "lowpass_none"),
        (CloudProperties(), {"motion": GROUP}, "motion_groups", "shutter_exposure"),
        (CloudProperties(), {"motion": MOVING}, "camera_pinhole", "shutter_exposure"),
        (CloudProperties(), ROLLING, "sub_frame_culling", "motion_groups"),
        (OF_BOXES, ROLLING, "shutter_exposure", "sub_frame_culling"),
        (
            CloudProperties(),
            ROLLING | {"quality": fs.Quality(lowpass="pixel")},
            "shutter_exposure",
            "sub_frame_culling",
        ),
        (CloudProperties(), ROLLING | {"camera": PANORAMIC}, "shutter_exposure", "sub_frame_culling"),
        (CloudProperties(), {"quality": FLOAT64}, "arithmetic_precise", "arithmetic_fast"),
        (CloudProperties(), {"fog": fs.Fog(0.0)}, "background_constant", "fog"),
        (CloudProperties(), {"fog": fs.Fog(0.1)}, "fog", "sub_frame_culling"),
    ],
)
def test_a_scene_calls_for_what_it_needs_and_nothing_else(cloud, parts, called, not_called):
    names = select(cloud, fs.Capture(**{"camera": CAMERA, **parts})).names
    assert called in names
    assert not_called not in names
