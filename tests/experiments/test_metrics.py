"""PSNR, SSIM, FLIP and LPIPS against their definitions."""

import math
import warnings

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.vision.metrics import flip, has_flip, load_lpips, psnr, ssim, weights_name

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


def weights() -> dict[str, np.ndarray]:
    random = np.random.default_rng(2)
    found = {}
    for k, (out, into, size) in enumerate(
        ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))
    ):
        found[f"conv{k + 1}.weight"] = random.normal(0, 0.05, (out, into, size, size))
        found[f"conv{k + 1}.bias"] = random.normal(0, 0.1, out)
        found[f"lin{k}"] = random.uniform(0, 1, out)
    return found


def layer(x: np.ndarray, kernel: np.ndarray, bias: np.ndarray, stride: int, padding: int) -> np.ndarray:
    """A convolution and the rectifier, one output pixel after the other."""
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    size = kernel.shape[2]
    rows, columns = (np.array(x.shape[1:]) - size) // stride + 1
    out = np.empty((len(kernel), rows, columns))
    for i in range(rows):
        for j in range(columns):
            window = x[:, i * stride : i * stride + size, j * stride : j * stride + size]
            out[:, i, j] = (kernel * window).sum((1, 2, 3)) + bias
    return np.maximum(out, 0)


def pooled(x: np.ndarray) -> np.ndarray:
    rows, columns = ((n - 3) // 2 + 1 for n in x.shape[1:])
    cells = [
        [x[:, 2 * i : 2 * i + 3, 2 * j : 2 * j + 3].max((1, 2)) for j in range(columns)] for i in range(rows)
    ]
    return np.moveaxis(np.array(cells), 2, 0)


def test_lpips_is_that_of_its_definition(tmp_path):
    """AlexNet's five rectified convolutions, channels normalised, squared differences weighted."""
    arrays = weights()
    np.savez(tmp_path / "w.npz", **arrays)
    random = np.random.default_rng(3)
    one, other = random.uniform(size=(67, 71)), random.uniform(size=(67, 71))

    def features(image: np.ndarray) -> list[np.ndarray]:
        shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
        x = ((2 * image - 1)[None] - shift[:, None, None]) / scale[:, None, None]
        found = []
        for k, (stride, padding) in enumerate(((4, 2), (1, 2), (1, 1), (1, 1), (1, 1)), 1):
            x = pooled(x) if k in (2, 3) else x
            x = layer(x, arrays[f"conv{k}.weight"], arrays[f"conv{k}.bias"], stride, padding)
            found.append(x / np.sqrt((x**2).sum(0) + 1e-20))
        return found

    expected = sum(
        ((a - b) ** 2 * arrays[f"lin{k}"][:, None, None]).sum(0).mean()
        for k, (a, b) in enumerate(zip(features(one), features(other), strict=True))
    )
    measure = load_lpips(tmp_path / "w.npz")
    assert measure(one, other) == pytest.approx(expected, rel=1e-9)
    assert measure(one, one) == 0.0


def test_lpips_weights_that_cannot_be_used(tmp_path):
    with pytest.raises(fs.InputError, match=r"cannot read .*none\.npz: No such file"):
        load_lpips(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("weights")
    with pytest.raises(fs.InputError, match="as LPIPS weights"):
        load_lpips(tmp_path / "text.npz")
    np.savez(tmp_path / "short.npz", **{k: v for k, v in weights().items() if k != "lin3"})
    with pytest.raises(fs.InputError, match=r"must have an array lin3 of shape \(256,\)"):
        load_lpips(tmp_path / "short.npz")
    np.savez(tmp_path / "infinite.npz", **{k: np.full_like(v, np.inf) for k, v in weights().items()})
    with pytest.raises(fs.InputError, match="must be finite"):
        load_lpips(tmp_path / "infinite.npz")
    with pytest.raises(fs.InputError, match="cannot read the LPIPS weights"):
        weights_name(tmp_path / "none.npz")
    assert weights_name(tmp_path / "text.npz") != weights_name(tmp_path / "short.npz")
