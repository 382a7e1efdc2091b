"""Errors between images, and reference images at full precision."""

from dataclasses import replace

import numpy as np
import pytest
from agreement import random_splats, reference_pixels

import fidsplat as fs
from fidsplat.accuracy.error import Errors, errors, full_precision, reference_image
from fidsplat.selftest.agreement import compare
from fidsplat.util.errors import InputError

CAMERA = fs.Camera.pinhole(24, 17, 20.0, 20.0, 12.0, 8.5)


def test_errors_of_known_differences():
    want = np.zeros((10, 100), np.float32)
    seen = want.copy()
    seen[3, 5], seen[4, 4] = 0.25, -0.5
    actual = errors(seen, want)
    assert actual.maximum == 0.5
    assert actual.p999 == pytest.approx(np.quantile(np.abs(seen), 0.999))
    assert actual.rmse == pytest.approx(np.sqrt((0.25**2 + 0.5**2) / 1000))
    assert actual.psnr == pytest.approx(-20 * np.log10(actual.rmse))


def test_equal_images_have_no_error():
    assert errors(np.ones((2, 3)), np.ones((2, 3))) == Errors(0.0, 0.0, 0.0, float("inf"))


def test_differences_are_not_rounded_to_float32():
    assert errors(np.float64([1.0 + 1e-12]), np.float64([1.0])).maximum == pytest.approx(1e-12, rel=1e-3)


@pytest.mark.parametrize(
    ("image", "want", "message"),
    [
        (np.zeros((2, 3)), np.zeros((3, 2)), r"shape \(3, 2\) .* got \(2, 3\)"),
        (np.zeros((0, 3)), np.zeros((0, 3)), "must not be empty"),
        (np.array([1.0, np.nan]), np.zeros(2), "image must be finite, got 1 of 2"),
        (np.zeros(2), np.array([np.inf, np.nan]), "reference must be finite, got 2 of 2"),
    ],
)
def test_what_cannot_be_compared(image, want, message):
    with pytest.raises(InputError, match=message):
        errors(image, want)


def test_full_precision_keeps_the_definition():
    like = fs.Quality(
        samples=2,
        lowpass="pixel",
        alpha_cutoff=0.1,
        opacity_ceiling=0.9,
        order="centre",
        stop_rule="exclusive",
    )
    best = full_precision(fs.Capture(quality=like), fs.Renderer("reference")).quality
    assert (best.samples, best.lowpass, best.order) == (2, "pixel", "centre")
    assert best.alpha_cutoff <= 1e-6
    assert (best.transmittance_stop, best.opacity_ceiling, best.stop_rule) == (0.0, 1.0, "inclusive")


def test_the_reference_image_of_a_device_agrees_with_the_reference(renderer):
    cloud = random_splats(60, seed=3, depth=(1.0, 6.0), scale=(0.05, 1.0))
    best = full_precision(fs.Capture(), fs.Renderer("reference")).quality
    reference = reference_pixels(cloud, CAMERA, ("rgb",), best)
    ours = reference_image(renderer, cloud, fs.Capture(CAMERA))
    assert ours.dtype == np.float64
    assert ours.shape == (17, 24, 3)
    (difference,) = compare({"rgb": ours}, reference, ("rgb",))
    assert difference.agrees, difference


def test_rays_of_lenses_and_fog_are_float32():
    """They have a reference image too."""
    renderer, cloud = fs.Renderer("opencl"), random_splats(20, seed=1, depth=(1.0, 6.0))
    lens = replace(CAMERA, lens=fs.Fisheye())
    fog = fs.Fog(0.2)
    assert full_precision(fs.Capture(), renderer).quality.blend_precision == "float64"
    assert full_precision(fs.Capture(fog=fog), renderer).quality.blend_precision == "float32"
    capture = fs.Capture(lens, fog=fog)
    assert full_precision(capture, renderer).fog == fog
    image = reference_image(renderer, cloud, capture)
    assert errors(image, reference_image(fs.Renderer("reference"), cloud, capture)).maximum < 1e-4


def test_the_reference_returns_float64():
    cloud = random_splats(20, seed=1, depth=(1.0, 6.0))
    plane = reference_image(fs.Renderer("reference"), cloud, fs.Capture(CAMERA, background=(0.1, 0.2, 0.3)))
    assert (plane != plane.astype(np.float32)).any()
