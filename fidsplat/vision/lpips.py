"""LPIPS (Zhang et al. 2018) with AlexNet, in NumPy, for weights that the user has.

The weights are no part of fidsplat and nothing here fetches them. `load_lpips` reads a NumPy file with the
five convolutions of torchvision's AlexNet and the five linear layers of LPIPS version 0.1;
docs/ground-truth.md says how it is written with PyTorch and the lpips package.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from fidsplat.errors import InputError

# stride and padding of each convolution, and whether a 3 x 3 pooling with stride 2 comes before it
_LAYERS = ((4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False))
_CHANNELS = ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))
# the network's input: what LPIPS calls its scaling layer
_SHIFT = np.array([-0.030, -0.088, -0.188]).reshape(3, 1, 1)
_SCALE = np.array([0.458, 0.448, 0.450]).reshape(3, 1, 1)
_EPSILON = 1e-10


def weights_name(file: Path) -> str:
    """What tells weights apart in results: the start of the file's hash. Raises InputError when it cannot be
    read."""
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()[:12]
    except OSError as error:
        raise InputError(f"cannot read the LPIPS weights {file}: {error.strerror or error}") from error


def load_lpips(file: Path) -> Callable[[np.ndarray, np.ndarray], float]:
    """LPIPS of two (h, w) pictures of display values in [0, 1], by the weights in a .npz file.

    Raises InputError when the file cannot be read or lacks an array or one has another shape.
    """
    try:
        with np.load(file, allow_pickle=False) as arrays:
            weights = {name: np.asarray(arrays[name], np.float64) for name in arrays.files}
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise InputError(f"{file} is no .npz file with LPIPS weights: {error}") from error
    for k, (out, into, size) in enumerate(_CHANNELS):
        shapes = {
            f"conv{k + 1}.weight": (out, into, size, size),
            f"conv{k + 1}.bias": (out,),
            f"lin{k}": (out,),
        }
        for name, shape in shapes.items():
            if name not in weights or weights[name].shape != shape:
                raise InputError(f"{file} needs an array {name} of shape {shape} (see docs/ground-truth.md)")

    def measure(picture: np.ndarray, truth: np.ndarray) -> float:
        total = 0.0
        for k, (a, b) in enumerate(zip(_features(picture, weights), _features(truth, weights), strict=True)):
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
    """(channels, h, w) with (out, channels, k, k), as PyTorch's Conv2d."""
    padded = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel.shape[2:], (1, 2))
    return np.tensordot(kernel, windows[:, ::stride, ::stride], ((1, 2, 3), (0, 3, 4))) + bias[:, None, None]


def _unit(x: np.ndarray) -> np.ndarray:
    return x / (np.sqrt((x**2).sum(0, keepdims=True)) + _EPSILON)
