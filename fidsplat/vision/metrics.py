"""Image metrics PSNR, SSIM, FLIP and LPIPS of display values in [0, 1].

LPIPS (Zhang et al. 2018) uses AlexNet in NumPy with weights that the user provides. `load_lpips` reads a
NumPy file with the five convolutions of torchvision's AlexNet and the five linear layers of LPIPS version
0.1; docs/experiments.md has the conversion by PyTorch and the package lpips.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np

from fidsplat.util.errors import InputError
from fidsplat.util.files import read_input
from fidsplat.util.npy import load_npz

_SIGMA, _RADIUS = 1.5, 5  # pixels: Wang et al. 2004, as in the 3DGS and 2DGS papers
_C1, _C2 = 0.01**2, 0.03**2


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB over all pixels, infinite for equal images."""
    error = float(np.mean((np.asarray(image, np.float64) - truth) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim(image: np.ndarray, truth: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004) of two (h, w) images: Gaussian window of sigma 1.5, 11 px.

    The same as scikit-image's with gaussian_weights, sigma 1.5, data_range 1 and use_sample_covariance
    False: windows that cross the border are excluded. NaN for images smaller than a window.
    """
    a, b = np.asarray(image, np.float64), np.asarray(truth, np.float64)
    if min(a.shape) <= 2 * _RADIUS:
        return math.nan

    def mean(values: np.ndarray) -> np.ndarray:
        size = (2 * _RADIUS + 1,) * 2
        blurred = cv2.GaussianBlur(values, size, _SIGMA, borderType=cv2.BORDER_REFLECT)
        return blurred[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS]

    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    shared = mean(a * b) - mean_a * mean_b
    top = (2 * mean_a * mean_b + _C1) * (2 * shared + _C2)
    return float(np.mean(top / ((mean_a**2 + mean_b**2 + _C1) * (var_a + var_b + _C2))))


def has_flip() -> bool:
    """Whether the package flip-evaluator, for FLIP, is installed."""
    return find_spec("flip_evaluator") is not None


def metric_versions() -> dict[str, str]:
    """Versions of the packages of metrics."""
    return {"flip-evaluator": version("flip-evaluator")} if has_flip() else {}


def flip(image: np.ndarray, truth: np.ndarray) -> float:
    """Mean LDR-FLIP (Andersson et al. 2020) of two images, (h, w) or (h, w, 3), at 67 pixels per degree, 0
    for equal."""
    import flip_evaluator  # type: ignore[import-not-found]  # of the extra `experiments`

    def coloured(values: np.ndarray) -> np.ndarray:
        values = np.asarray(values, np.float32)
        return np.ascontiguousarray(values if values.ndim == 3 else np.repeat(values[:, :, None], 3, axis=2))

    a, b = coloured(image), coloured(truth)
    _, mean, _ = flip_evaluator.evaluate(b, a, "LDR", applyMagma=False, computeMeanError=True)
    return float(mean)


# stride and padding of each convolution, and whether a 3 x 3 pooling with stride 2 comes before it
_LAYERS = ((4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False))
_CHANNELS = ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))
# input normalization, LPIPS's scaling layer
_SHIFT = np.array([-0.030, -0.088, -0.188]).reshape(3, 1, 1)
_SCALE = np.array([0.458, 0.448, 0.450]).reshape(3, 1, 1)
_EPSILON = 1e-10


def weights_name(file: Path) -> str:
    """Name of LPIPS weights in results: the first digits of the file's hash. Raises InputError for an
    unreadable file."""
    try:
        return hashlib.sha256(read_input(file)).hexdigest()[:12]
    except InputError as error:
        raise InputError(f"cannot read the LPIPS weights: {error}") from error


def load_lpips(file: Path) -> Callable[[np.ndarray, np.ndarray], float]:
    """Load LPIPS from weights in a .npz file: a function of two (h, w) images of display values in [0, 1].

    Raises InputError for a file that cannot be read, a missing array, or one of another shape.
    """
    try:
        arrays = load_npz(file)
        weights = {name: arrays[name].astype(np.float64) for name in sorted(arrays)}
    except InputError:
        raise
    except (ValueError, TypeError) as error:
        raise InputError(f"cannot read {file} as LPIPS weights (.npz): {error}") from error
    for k, (out, into, size) in enumerate(_CHANNELS):
        shapes = {
            f"conv{k + 1}.weight": (out, into, size, size),
            f"conv{k + 1}.bias": (out,),
            f"lin{k}": (out,),
        }
        for name, shape in shapes.items():
            if name not in weights or weights[name].shape != shape:
                got = f"shape {weights[name].shape}" if name in weights else "none"
                raise InputError(
                    f"{file} must have an array {name} of shape {shape}, got {got}; see docs/experiments.md"
                )
            if wrong := np.count_nonzero(~np.isfinite(weights[name])):
                raise InputError(
                    f"the array {name} of {file} must be finite, got {wrong:,} NaN or infinite values; see "
                    "docs/experiments.md"
                )

    def measure(image: np.ndarray, truth: np.ndarray) -> float:
        total = 0.0
        for k, (a, b) in enumerate(zip(_features(image, weights), _features(truth, weights), strict=True)):
            difference = (_unit(a) - _unit(b)) ** 2
            total += float(np.tensordot(weights[f"lin{k}"], difference, 1).mean())
        return total

    return measure


def _features(grey: np.ndarray, weights: dict[str, np.ndarray]) -> list[np.ndarray]:
    x = (np.repeat(np.asarray(grey, np.float64)[None] * 2 - 1, 3, axis=0) - _SHIFT) / _SCALE
    found = []
    for k, (stride, padding, pooled) in enumerate(_LAYERS, 1):
        if pooled:
            x = np.lib.stride_tricks.sliding_window_view(x, (3, 3), (1, 2))[:, ::2, ::2].max((3, 4))
        x = np.maximum(_convolve(x, weights[f"conv{k}.weight"], weights[f"conv{k}.bias"], stride, padding), 0)
        found.append(x)
    return found


def _convolve(x: np.ndarray, kernel: np.ndarray, bias: np.ndarray, stride: int, padding: int) -> np.ndarray:
    """Convolution of (channels, h, w) with (out, channels, k, k), equal to PyTorch's Conv2d."""
    padded = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel.shape[2:], (1, 2))
    return np.tensordot(kernel, windows[:, ::stride, ::stride], ((1, 2, 3), (0, 3, 4))) + bias[:, None, None]


def _unit(x: np.ndarray) -> np.ndarray:
    return x / (np.sqrt((x**2).sum(0, keepdims=True)) + _EPSILON)
