"""Knobs of Quality beside those of the presets: what each may change in an image, against the reference."""

import numpy as np
import pytest
from agreement import assert_agrees, random_splats, reference_pixels
from test_agreement import coplanar_cloud

import fidsplat as fs
from fidsplat.effects import OUTPUTS, select

CAMERA = fs.Camera.look_at(83, 61, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
AROUND = random_splats(200, seed=1)
DENSE = random_splats(2000, seed=8, depth=(1.0, 6.0), scale=(1e-3, 0.3))
DOUBLE = fs.Quality(blend_precision="float64")
ROUNDING = 2.0**-24
"""relative, of a float32"""


@pytest.fixture
def opencl(renderer):
    if not renderer.device.name.startswith("opencl"):
        pytest.skip("Warp refuses this knob (test_a_device_refuses_by_name_what_it_does_not_do)")
    return renderer


@pytest.mark.parametrize(
    ("cloud", "samples"),
    [
        (AROUND, 1),
        (DENSE, 1),
        (random_splats(100, 11, (1, 6), (0.02, 0.4), sh_degree=3), 1),
        (coplanar_cloud(1), 2),
    ],
    ids=["around", "dense", "sh", "planes"],
)
def test_blending_in_double_has_only_the_rounding_of_the_output(opencl, cloud, samples):
    """No certificate here: what float32 might change, double does not. A sample buffer is rounded when it
    is written, and the sum of the samples and the background once more each."""
    if not opencl.device.float64:
        pytest.skip("the device has no float64")
    quality = DOUBLE.with_(samples=samples)
    outputs, background = ("rgb", "alpha", "depth", "normal"), (0.1, 0.2, 0.3)
    frame = opencl.render(cloud, CAMERA, outputs, quality, background=background)
    truth = reference_pixels(cloud, CAMERA, outputs, quality, background)
    roundings = (2 + samples**2) * ROUNDING
    for name in outputs:
        size = {"rgb": max(1.0, truth["rgb"].max()), "depth": 2 * truth["depth"].max()}.get(name, 1.0)
        seen = truth["alpha"] > 1e-3
        error = np.abs(frame[name] - truth[name])
        if name == "normal":  # of unit length, from sums that may nearly cancel
            assert np.quantile(error[seen], 0.99) <= 2 * roundings
        else:
            assert error[seen].max() <= size * roundings, name


def test_double_is_nearer_to_the_truth_than_float32(opencl):
    if not opencl.device.float64:
        pytest.skip("the device has no float64")
    truth = reference_pixels(AROUND, CAMERA, ("rgb",), DOUBLE)["rgb"]
    errors = [
        np.abs(opencl.render(AROUND, CAMERA, ("rgb",), quality)["rgb"] - truth).max()
        for quality in (DOUBLE, fs.Quality())
    ]
    assert errors[0] < 0.2 * errors[1]


def test_double_has_every_output_and_footprint(opencl):
    """In one record, whose size the compiler checks."""
    if not opencl.device.float64:
        pytest.skip("the device has no float64")
    cloud = coplanar_cloud(1)
    cloud = cloud.with_boxes(cloud.coplanar_groups == 0)
    camera = fs.Camera.orthographic(41, 30, 4.0)
    assert_agrees(opencl, cloud, camera, tuple(OUTPUTS), DOUBLE)


def test_a_device_refuses_by_name_what_it_does_not_do(renderer):
    if renderer.device.name.startswith("opencl") and renderer.device.float64:
        renderer.render(AROUND, CAMERA, quality=DOUBLE)
        return
    expected = "blend_precision" if renderer.device.name.startswith("opencl") else "blend_double"
    with pytest.raises(fs.DeviceError, match=expected):
        renderer.render(AROUND, CAMERA, quality=DOUBLE)


@pytest.mark.parametrize("lens", [fs.Fisheye(), fs.BrownConrady(k1=0.1)])
def test_double_promises_nothing_where_rays_are_float32(lens):
    camera = fs.Camera.pinhole(20, 12, 10.0, 10.0, 10.0, 6.0, lens=lens)
    with pytest.raises(fs.InputError, match="float32"):
        select(AROUND, fs.Capture(camera, quality=DOUBLE))
    with pytest.raises(fs.InputError, match="fog"):
        select(AROUND, fs.Capture(quality=DOUBLE, fog=fs.Fog(0.1)))
