"""PSNR, SSIM, FLIP and LPIPS against their definitions."""

import math
import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.vision.metrics import flip, has_flip, load_lpips, psnr, ssim

RANDOM = np.random.default_rng(11)
TRUTH = RANDOM.uniform(size=(40, 53))
PICTURE = np.clip(TRUTH + RANDOM.normal(0, 0.08, TRUTH.shape), 0, 1)


def test_psnr():
    assert psnr(TRUTH, TRUTH) == math.inf
    assert psnr(TRUTH * 0, TRUTH * 0 + 0.1) == pytest.approx(20.0)
    assert psnr(PICTURE, TRUTH) == pytest.approx(-10 * math.log10(((PICTURE - TRUTH) ** 2).mean()))


def test_ssim_is_that_of_its_definition():
    """Every window by itself: Gaussian weights, sigma 1.5, 11 x 11, as Wang et al. have it."""
    x = np.arange(-5, 6)
    row = np.exp(-(x**2) / (2 * 1.5**2))
    weight = np.outer(row, row) / row.sum() ** 2
    values = []
    for i in range(TRUTH.shape[0] - 10):
        for j in range(TRUTH.shape[1] - 10):
            a, b = PICTURE[i : i + 11, j : j + 11], TRUTH[i : i + 11, j : j + 11]
            ma, mb = (weight * a).sum(), (weight * b).sum()
            va, vb = (weight * (a - ma) ** 2).sum(), (weight * (b - mb) ** 2).sum()
            shared = (weight * (a - ma) * (b - mb)).sum()
            top = (2 * ma * mb + 1e-4) * (2 * shared + 9e-4)
            values.append(top / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    assert ssim(PICTURE, TRUTH) == pytest.approx(np.mean(values), abs=1e-12)


@pytest.mark.parametrize("shape", [(10, 30), (30, 10), (1, 1)])
def test_ssim_of_images_smaller_than_its_window_is_not_a_number(shape):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isnan(ssim(np.zeros(shape), np.ones(shape)))
    assert np.isfinite(ssim(np.zeros((11, 11)), np.ones((11, 11))))


def test_ssim_is_that_of_scikit_image():
    # skimage.metrics.structural_similarity(PICTURE, TRUTH, gaussian_weights=True, sigma=1.5, data_range=1,
    # use_sample_covariance=False), scikit-image 0.26.0
    assert ssim(PICTURE, TRUTH) == pytest.approx(0.9616600835698047, abs=1e-9)
    assert ssim(TRUTH, TRUTH) == pytest.approx(1.0)


def test_flip_of_equal_and_of_opposite_images():
    assert has_flip()
    assert flip(TRUTH, TRUTH) == 0.0
    black, white = np.zeros((64, 64)), np.ones((64, 64))
    assert flip(black, white) > 0.9  # the largest difference that there is
    assert 0 < flip(PICTURE, TRUTH) < flip(1 - TRUTH, TRUTH)


def test_lpips_is_that_of_its_package(monkeypatch):
    """The network of the package sees three equal channels from -1 to 1; without it, the error names it."""
    monkeypatch.setitem(sys.modules, "lpips", None)
    with pytest.raises(fs.InputError, match=r"lpips must be usable for --lpips, got .*; pip install lpips"):
        load_lpips()

    class Network:
        def eval(self):
            return self

        def requires_grad_(self, needed):
            return self

        def __call__(self, one, other):
            assert one.shape == other.shape == (*PICTURE.shape, 3)
            return np.abs(one - other).max()

    package = SimpleNamespace(LPIPS=lambda **_: Network(), im2tensor=lambda image: image / 127.5 - 1)
    monkeypatch.setitem(sys.modules, "lpips", package)
    measure = load_lpips()
    assert measure(PICTURE, PICTURE) == 0
    assert measure(PICTURE, TRUTH) == pytest.approx(2 * np.abs(PICTURE - TRUTH).max())
