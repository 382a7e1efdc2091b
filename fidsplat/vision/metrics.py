"""Image metrics PSNR, SSIM, FLIP and LPIPS of display values in [0, 1]."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.metadata import version
from importlib.util import find_spec

import cv2
import numpy as np

from fidsplat.util.errors import InputError

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
    """Whether FLIP is available (package flip-evaluator)."""
    return find_spec("flip_evaluator") is not None


def metric_versions() -> dict[str, str]:
    """Versions of the packages that compute metrics, by name."""
    return {"flip-evaluator": version("flip-evaluator")} if has_flip() else {}


def flip(image: np.ndarray, truth: np.ndarray) -> float:
    """Mean LDR-FLIP (Andersson et al. 2020) of two images, (h, w) or (h, w, 3), at 67 pixels per degree, 0
    for equal."""
    import flip_evaluator  # type: ignore[import-not-found]  # of the extra `experiments`

    def colored(values: np.ndarray) -> np.ndarray:
        values = np.asarray(values, np.float32)
        return np.ascontiguousarray(values if values.ndim == 3 else np.repeat(values[:, :, None], 3, axis=2))

    a, b = colored(image), colored(truth)
    _, mean, _ = flip_evaluator.evaluate(b, a, "LDR", applyMagma=False, computeMeanError=True)
    return float(mean)


def load_lpips() -> Callable[[np.ndarray, np.ndarray], float]:
    """LPIPS (Zhang et al. 2018, AlexNet) of two (h, w) images of display values in [0, 1].

    Raises InputError without the package lpips, or if the weights of AlexNet cannot be downloaded.
    """
    try:
        import lpips  # type: ignore[import-not-found]

        net = lpips.LPIPS(net="alex", verbose=False).eval().requires_grad_(False)
    except (ImportError, OSError) as error:
        raise InputError(f"lpips must be usable for --lpips, got {error}; pip install lpips") from error

    def measure(image: np.ndarray, truth: np.ndarray) -> float:
        pair = (np.repeat(255 * grey[:, :, None], 3, axis=2) for grey in (image, truth))
        return float(net(*map(lpips.im2tensor, pair)))

    return measure
