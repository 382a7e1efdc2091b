"""Our own short exponential and logarithm (`Quality.arithmetic`): bounds, bits, images."""

from dataclasses import replace

import numpy as np
import pytest
from agreement import ALL_OUTPUTS, assert_agrees, random_splats
from test_agreement import coplanar_cloud

import fidsplat as fs
from fidsplat.effects import select
from fidsplat.selftest.agreement import FrameSpec, differing, render_intermediates
from fidsplat.selftest.arithmetic import BOUNDS, worst

CAMERA = fs.Camera.look_at(83, 61, 1.0, (0.0, 0.0, -0.1), (0.0, 0.0, 3.0))
AROUND = random_splats(200, seed=1)
FAST, PRECISE = fs.Quality(arithmetic="fast"), fs.Quality(arithmetic="precise")


def floats(low, high, count=1 << 19):
    """float32 from low > 0 to high, as many between any two powers of two; both ends among them."""
    first, last = np.array([low, high], np.float32).view(np.uint32).astype(np.int64)
    return np.linspace(first, last, count).round().astype(np.uint32).view(np.float32).astype(float)


EXPONENTS = np.concatenate([-floats(2.0**-30, 87.0)[:-16], [0.0] * 16])
SHARES = floats(2.0**-24, 1.0)


def functions(renderer, exponents=EXPONENTS, shares=SHARES):
    """Bits of the device's short functions there."""
    got = renderer.backend.probe().arithmetic(exponents, shares, shares, shares)
    return got["fast_exp"], got["fast_log"]


def test_short_functions_keep_their_bounds_on_every_device(renderer, monkeypatch):
    """Compiled as the device compiles kernels; if we choose the mode, also one value at a time and
    without fused operations."""
    for shape in renderer.backend.configs("arithmetic").values():
        monkeypatch.setattr(renderer.backend, "config", shape)
        exponential, logarithm = functions(renderer)
        assert 0.5 < worst(exponential, np.exp(EXPONENTS)) <= BOUNDS["fast_exp"]
        assert 0.5 < worst(logarithm, np.log(SHARES)) <= BOUNDS["fast_log"]


def test_an_opacity_of_one_stays_one_and_no_exponent_runs_over(renderer):
    exponents = np.repeat([0.0, -0.0, -1e-42, -1e-9, -87.0, -88.0, -1e9, -np.inf], 2)
    exponential, logarithm = functions(renderer, exponents, np.ones(16))
    assert (exponential[:8] == 1).all()
    assert np.allclose(exponential[8:], np.exp(-87.0), rtol=1e-6, atol=0)
    assert (logarithm == 0).all()


def test_the_bits_are_the_same_on_every_device():
    results = []
    for info in fs.devices():
        if info.usable and info.name != "reference":
            renderer = fs.Renderer(info.name)
            if renderer.backend.probe().fuses:
                results.append(functions(renderer))
    for exponential, logarithm in results[1:]:
        assert np.array_equal(exponential, results[0][0])
        assert np.array_equal(logarithm, results[0][1])


@pytest.mark.sweep
@pytest.mark.parametrize("cloud", [AROUND, coplanar_cloud(1)], ids=["around", "planes"])
def test_images_move_by_the_rounding_of_opacities(renderer, cloud):
    for quality in (FAST, PRECISE):
        assert_agrees(renderer, cloud, CAMERA, quality=quality)
    # a relative error e of all opacities changes colours by e at most; without a stop no decision hangs on it
    precise, fast = (
        renderer.render(cloud, CAMERA, ALL_OUTPUTS, quality.with_(transmittance_stop=0.0))["rgb"]
        for quality in (PRECISE, FAST)
    )
    assert 0 < np.abs(precise - fast).max() <= 1e-6 * max(1.0, precise.max())


def test_faint_fragments_stay_faint(renderer):
    """At this cut-off the faintest lie below the smallest normal float32."""
    precise, fast = (
        renderer.render(
            AROUND, CAMERA, ALL_OUTPUTS, quality.with_(alpha_cutoff=1e-42, transmittance_stop=0.0)
        )
        for quality in (PRECISE, FAST)
    )
    for name in ("rgb", "alpha", "normal"):
        assert np.abs(precise[name] - fast[name]).max() <= 2e-6


@pytest.mark.parametrize("cloud", [AROUND, coplanar_cloud(1)], ids=["around", "planes"])
def test_both_schedules_are_bit_identical(renderer, cloud):
    image = FrameSpec(cloud, CAMERA, FAST, ALL_OUTPUTS)
    own, other = (
        render_intermediates(renderer, image),
        render_intermediates(renderer, image, renderer.backend.configs("schedule")["groups"]),
    )
    assert differing(own, other, ALL_OUTPUTS) == 0


def test_instructions_of_a_vendor_change_what_the_quality_allows(renderer):
    """Kernels with and without the file of kernels/opencl/dialect/ that the device selects."""
    shape = getattr(renderer.backend.config, "dialect", "") and replace(renderer.backend.config, dialect="")
    if not shape:
        pytest.skip("the device has no dialect")
    for quality in (FAST, PRECISE, FAST.with_(order="pixel")):
        picture = FrameSpec(random_splats(3000, seed=2, scale=(1e-3, 0.8)), CAMERA, quality, ALL_OUTPUTS)
        own, other = render_intermediates(renderer, picture), render_intermediates(renderer, picture, shape)
        assert differing(own, other, ALL_OUTPUTS) == 0
    for changes, bound in (({"arithmetic": "approximate"}, 2e-4), ({"blend_precision": "float16"}, 2.0**-7)):
        picture = FrameSpec(random_splats(3000, seed=2, scale=(1e-3, 0.8)), CAMERA, FAST.with_(**changes))
        own, other = render_intermediates(renderer, picture), render_intermediates(renderer, picture, shape)
        assert np.abs(own["rgb"] - other["rgb"]).max() < bound


def test_blending_in_float64_takes_the_library_s():
    double = FAST.with_(blend_precision="float64")
    assert "arithmetic_precise" in select(AROUND, fs.Capture(quality=double)).effects
    assert "arithmetic_fast" in select(AROUND, fs.Capture(quality=FAST)).effects
