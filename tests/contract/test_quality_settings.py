"""Quality settings in addition to those of the presets: the permitted changes of an image, against the
reference."""

from dataclasses import replace

import numpy as np
import pytest
from agreement import assert_agrees, random_splats, reference_pixels
from test_agreement import coplanar_cloud

import fidsplat as fs
from fidsplat.backends.opencl import assemble as assembly
from fidsplat.backends.prepare import prepare
from fidsplat.effects import OUTPUTS, select
from fidsplat.effects.differentiable import check_differentiable

CAMERA = fs.Camera.look_at(83, 61, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
AROUND = random_splats(200, seed=1)
DENSE = random_splats(2000, seed=8, depth=(1.0, 6.0), scale=(1e-3, 0.3))
DOUBLE = fs.Quality(blend_precision="float64")
ROUNDING = 2.0**-24
"""relative, of a float32"""


@pytest.fixture
def opencl(renderer):
    if not renderer.device.name.startswith("opencl"):
        pytest.skip("Warp refuses this setting (test_a_device_refuses_by_name_what_it_does_not_do)")
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
    """No error bound here: what float32 might change, double does not. A sample buffer is rounded when it
    is written, and the sum of the samples and the background once more each."""
    if not opencl.device.float64:
        pytest.skip("the device has no float64")
    quality = DOUBLE.with_(samples=samples)
    outputs, background = ("rgb", "alpha", "depth", "normal"), (0.1, 0.2, 0.3)
    frame = opencl.render(cloud, CAMERA, outputs, quality, background=background)
    expected = reference_pixels(cloud, CAMERA, outputs, quality, background)
    roundings = (2 + samples**2) * ROUNDING
    for name in outputs:
        size = {"rgb": max(1.0, expected["rgb"].max()), "depth": 2 * expected["depth"].max()}.get(name, 1.0)
        visible = expected["alpha"] > 1e-3
        error = np.abs(frame[name] - expected[name])
        if name == "normal":  # of unit length, from sums that may nearly cancel
            assert np.quantile(error[visible], 0.99) <= 2 * roundings
        else:
            assert error[visible].max() <= size * roundings, name


def test_double_is_nearer_to_the_truth_than_float32(opencl):
    if not opencl.device.float64:
        pytest.skip("the device has no float64")
    expected = reference_pixels(AROUND, CAMERA, ("rgb",), DOUBLE)["rgb"]
    errors = [
        np.abs(opencl.render(AROUND, CAMERA, ("rgb",), quality)["rgb"] - expected).max()
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
    with pytest.raises(fs.DeviceError, match="blend_precision='float64'"):
        renderer.render(AROUND, CAMERA, quality=DOUBLE)


@pytest.mark.parametrize("lens", [fs.Fisheye(), fs.BrownConrady(k1=0.1)])
def test_double_promises_nothing_where_rays_are_float32(lens):
    camera = fs.Camera.pinhole(20, 12, 10.0, 10.0, 10.0, 6.0, lens=lens)
    with pytest.raises(fs.InputError, match="float32"):
        select(AROUND, fs.Capture(camera, quality=DOUBLE))
    with pytest.raises(fs.InputError, match="fog"):
        select(AROUND, fs.Capture(quality=DOUBLE, fog=fs.Fog(0.1)))


HALF = fs.Quality(alpha_cutoff=1 / 255, transmittance_stop=0.0, blend_precision="float16")
WORDS = """
//@ dialect
typedef uint half_pair;
#define WORD_LOW(word) vload_half(0, (const half *)&(word))
#define WORD_HIGH(word) vload_half(1, (const half *)&(word))
static inline float odd(double exact) {     // rounded to odd, so that the next rounding decides as one
    float x = (float)exact;
    double rest = exact - (double)x;
    int away = (rest > 0.0) == (exact > 0.0) ? 1 : -1;
    return rest == 0.0 || (as_int(x) & 1) ? x : as_float(as_int(x) + away);
}
static inline uint word_of(double low, double high) {
    uint word;
    vstore_half_rte(odd(low), 0, (half *)&word);
    vstore_half_rte(odd(high), 1, (half *)&word);
    return word;
}
static inline uint word_fma(uint a, uint b, uint c) {
    double low = (double)WORD_LOW(a) * WORD_LOW(b), high = (double)WORD_HIGH(a) * WORD_HIGH(b);
    return word_of(low + WORD_LOW(c), high + WORD_HIGH(c));
}
static inline uint word_by_high(uint a, uint b) {
    return word_of((double)WORD_LOW(a) * WORD_HIGH(b), (double)WORD_HIGH(a) * WORD_HIGH(b));
}
static inline float word_low(uint word) { return WORD_LOW(word); }
static inline float word_high(uint word) { return WORD_HIGH(word); }
#define HALF_PAIR(low, high) word_of(low, high)
#define HALF_FMA(a, b, c) word_fma(a, b, c)
#define HALF_BY_HIGH(a, b) word_by_high(a, b)
#define HALF_LOW(word) word_low(word)
#define HALF_HIGH(word) word_high(word)
"""
"""A dialect with the macros of kernels/opencl/dialect/ptx_half.cl, in the words of the device's compiler."""
CLOUDS = {"around": AROUND, "dense": DENSE, "layers": coplanar_cloud(1)}


@pytest.mark.parametrize("name", CLOUDS)
def test_half_precision_changes_a_pixel_by_at_most_its_roundings(opencl, name):
    """Each fragment rounds opacity, weight and colour by a share of 2^-11, together 3 x 2^-11 of a pixel's
    light, and transmittance and the sum of colours by up to 2^-12 each. The output `blended` counts them."""
    cloud, outputs = CLOUDS[name], ("rgb", "alpha", "blended")
    frame = opencl.render(cloud, CAMERA, outputs, HALF)
    expected = reference_pixels(cloud, CAMERA, ("rgb", "alpha"), HALF.with_(blend_precision="float32"))
    error = np.maximum(
        np.abs(frame["rgb"] - expected["rgb"]).max(-1), np.abs(frame["alpha"] - expected["alpha"])
    )
    assert np.all(error <= (frame["blended"] + 3) * 2.0**-11 + 2e-5)
    assert 1e-4 < error.max() < 0.01
    halves = np.stack([*np.moveaxis(frame["rgb"], -1, 0), 1 - frame["alpha"]])
    assert np.array_equal(halves, halves.astype(np.float16))


@pytest.mark.sweep
def test_half_precision_has_the_same_bits_in_both_schedules_and_words(opencl, monkeypatch, tmp_path):
    """Two halves in a word, as dialects with packed instructions hold them, have the bits of two floats."""
    file = tmp_path / "words.cl"
    file.write_text(WORDS)
    backend = opencl.backend
    capture = fs.Capture(CAMERA, ("rgb", "alpha", "depth"), HALF.with_(order="pixel"))
    for cloud in (DENSE, CLOUDS["layers"]):
        features, view = prepare(cloud, capture)
        own, groups = (
            replace(shape, dialect="") for shape in (backend.config, backend.configs("schedule")["groups"])
        )
        expected = backend.pipeline(features, own).render_intermediates(backend.upload(cloud), view)
        plain = backend.pipeline(features, groups).render_intermediates(backend.upload(cloud), view)
        with monkeypatch.context() as patch:
            patch.setattr(assembly, "_dialect", lambda *_: [str(file)])
            packed = backend.pipeline(features, replace(groups, tape=1))
            assert "word_fma" in packed.source.text
        words = packed.render_intermediates(backend.upload(cloud), view)
        for name in capture.outputs:
            assert np.array_equal(plain[name], expected[name])
            assert np.array_equal(words[name], expected[name])


def test_half_precision_is_refused_by_name(renderer):
    with pytest.raises(fs.InputError, match="blend_precision must be 'float32' with fog"):
        select(AROUND, fs.Capture(quality=HALF, fog=fs.Fog(0.1)))
    with pytest.raises(
        fs.InputError, match="effects must be differentiable, got blend_half; use blend_precision='float32'"
    ):
        check_differentiable(select(AROUND, fs.Capture(quality=HALF.with_(order="centre"))))
    if not renderer.device.name.startswith("opencl"):
        with pytest.raises(fs.DeviceError, match="blend_precision='float16'; use an OpenCL device"):
            renderer.render(AROUND, CAMERA, quality=HALF)
