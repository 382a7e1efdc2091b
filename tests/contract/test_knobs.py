"""Knobs of Quality beside those of the presets: what each may change in a picture, against the reference."""

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, assert_agrees, random_splats, reference_pixels
from test_agreement import coplanar_cloud

import fidsplat as fs
from fidsplat.effects import OUTPUTS, select

CAMERA = fs.Camera.look_at(83, 61, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
AROUND = random_splats(200, seed=1)
DENSE = random_splats(2000, seed=8, depth=(1.0, 6.0), scale=(1e-3, 0.3))
DOUBLE = fs.Quality(blend_precision="float64")
HALF = fs.Quality(color_precision="float16")
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
def test_blending_in_double_leaves_the_rounding_of_the_planes_alone(opencl, cloud, samples):
    """No certificate here: what float32 might change, double does not. A plane of samples is rounded when it
    is written, and their sum and the background once more each."""
    if not opencl.device.float64:
        pytest.skip("the device has no float64")
    quality = DOUBLE.with_(samples=samples)
    outputs, background = ("rgb", "alpha", "depth", "normal"), (0.1, 0.2, 0.3)
    frame = opencl.render(cloud, CAMERA, outputs, quality, background)
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
    cloud = cloud.with_boxes(cloud.planes == 0)
    camera = fs.Camera.orthographic(41, 30, 4.0)
    assert_agrees(opencl, cloud, camera, tuple(OUTPUTS), DOUBLE)


@pytest.mark.parametrize("degree", [None, 0, 2])
def test_half_colors_are_the_reference_s_rounded_ones(opencl, degree):
    cloud = random_splats(200, seed=11, depth=(1, 6), scale=(0.02, 0.4), sh_degree=degree)
    frame = assert_agrees(opencl, cloud, CAMERA, quality=HALF)
    exact = opencl.render(cloud, CAMERA, ALL_OUTPUTS, background=(0.1, 0.2, 0.3))
    terms = 1 if degree is None else (degree + 1) ** 2
    largest = float(np.abs(cloud.colors if degree is None else cloud.sh).max()) + 0.5 * (degree == 0)
    off = np.abs(frame["rgb"] - exact["rgb"]).max()
    assert 0 < off <= 2.0**-11 * largest * terms
    assert all(np.array_equal(frame[name], exact[name]) for name in ALL_OUTPUTS if name != "rgb")


def test_half_colors_end_at_the_largest_half(opencl):
    cloud = fs.SplatCloud([[0, 0, 2]], [[1, 0, 0, 0]], [[1, 1]], [1.0], colors=[[1e6, 1.0, 0.0]])
    assert opencl.render(cloud, CAMERA, quality=HALF)["rgb"].max() == pytest.approx(65504, rel=1e-2)


def test_a_device_holds_halves_instead_of_floats(opencl):
    cloud = random_splats(100, seed=11, depth=(1, 6), scale=(0.02, 0.4), sh_degree=2)
    resident = opencl.upload(cloud)
    resident._data._shared = False  # a CPU reads the host's arrays; make it copy them
    frame = opencl.render(resident, CAMERA, quality=HALF)
    assert np.array_equal(frame["rgb"], opencl.render(cloud, CAMERA, quality=HALF)["rgb"])
    means, quats, scales, opacities, coefficients = 3, 4, 2, 1, 9 * 3
    assert resident.memory_bytes == 100 * (4 * (means + quats + scales + opacities) + 2 * coefficients)


@pytest.mark.parametrize("bits", [16, 24])
def test_short_keys_order_as_the_reference_does(renderer, bits):
    quality = fs.Quality(depth_key_bits=bits)
    frame = assert_agrees(renderer, DENSE, CAMERA, quality=quality)
    exact = renderer.render(DENSE, CAMERA, ALL_OUTPUTS, background=(0.1, 0.2, 0.3))
    differs = np.abs(frame["rgb"] - exact["rgb"]).max()
    # 7 bits of mantissa: many of 2000 splats tie; 15: next to none
    assert differs > 1e-2 if bits == 16 else differs < 1e-2


def test_layers_keep_their_whole_keys(renderer):
    cloud = coplanar_cloud(1)
    features = [select(cloud, ("rgb",), fs.Quality(depth_key_bits=bits)) for bits in (16, 32)]
    assert features[0] == features[1]
    order = fs.Quality(depth_key_bits=16, coplanar="order")
    assert select(cloud, ("rgb",), order).depth_key_bits == 16


@pytest.mark.parametrize("size", [8, 16, 32])
def test_tiles_change_no_bit(renderer, size):
    cloud = coplanar_cloud(2)
    features = select(cloud, ALL_OUTPUTS, fs.Quality(tile_size=size))
    assert renderer.backend.pipeline(features).shape.tile_height == size
    plain = renderer.render(cloud, CAMERA, ALL_OUTPUTS)
    tiled = renderer.render(cloud, CAMERA, ALL_OUTPUTS, fs.Quality(tile_size=size))
    assert all(np.array_equal(plain[name], tiled[name]) for name in ALL_OUTPUTS)


@pytest.mark.parametrize(
    ("quality", "name"),
    [(DOUBLE, "blend_double"), (HALF, "color_rgb_half")],
)
def test_a_device_refuses_by_name_what_it_does_not_do(renderer, quality, name):
    if renderer.device.name.startswith("opencl") and (renderer.device.float64 or name != "blend_double"):
        renderer.render(AROUND, CAMERA, quality=quality)
        return
    wanted = "blend_precision" if renderer.device.name.startswith("opencl") else name
    with pytest.raises(fs.DeviceError, match=wanted):
        renderer.render(AROUND, CAMERA, quality=quality)


@pytest.mark.parametrize("lens", [fs.Fisheye(), fs.BrownConrady(k1=0.1)])
def test_double_promises_nothing_where_rays_are_float32(lens):
    camera = fs.Camera.pinhole(20, 12, 10.0, 10.0, 10.0, 6.0, lens=lens)
    with pytest.raises(fs.InputError, match="float32"):
        select(AROUND, ("rgb",), DOUBLE, camera)
    with pytest.raises(fs.InputError, match="fog"):
        select(AROUND, ("rgb",), DOUBLE, fog=fs.Fog(0.1))
