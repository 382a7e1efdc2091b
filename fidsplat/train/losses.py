"""Image loss of 3DGS and 2DGS, (1 - w) L1 + w (1 - SSIM), normal consistency, and their gradients.

SSIM (Wang et al. 2004) is the mean over all pixels and channels, with a Gaussian window of 11 pixels and
sigma 1.5, and zero padding. Ignored pixels have the value of the ground truth in both images: they add no
loss, and their gradient is 0. The kernel version is kernels/opencl/train/loss.cl.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

RADIUS, SIGMA = 5, 1.5
"""radius and standard deviation of the SSIM window [px]"""
C1, C2 = 0.01**2, 0.03**2
"""stabilising constants of SSIM"""


class Loss(NamedTuple):
    """Loss and mean squared error of one image."""

    value: float
    """the loss"""
    mse: float
    """mean squared error, for the PSNR"""

    @property
    def psnr(self) -> float:
        """PSNR [dB]; infinite for equal images."""
        return math.inf if self.mse == 0 else -10 * math.log10(self.mse)


def window() -> np.ndarray:
    """Weights (11,) float64 of the SSIM window along one axis; their sum is 1."""
    weights = np.exp(-(np.arange(-RADIUS, RADIUS + 1) ** 2) / (2 * SIGMA**2))
    return weights / weights.sum()


def blurred(image: np.ndarray) -> np.ndarray:
    """Windowed mean of an image (h, w, c), with zero padding."""
    for _ in range(2):
        padded = np.pad(image, ((RADIUS, RADIUS), (0, 0), (0, 0)))
        total = np.zeros_like(image)
        for k, weight in enumerate(window().astype(image.dtype)):
            total += weight * padded[k : k + len(image)]
        image = total.swapaxes(0, 1)
    return image


def image_loss(
    image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None, dssim_weight: float
) -> tuple[Loss, np.ndarray]:
    """The loss of an image, and its gradient with respect to the image.

    Args:
        image: (h, w, 3) float, rendered, not clamped.
        truth: (h, w, 3) float display values.
        mask: (h, w) bool, False for ignored pixels; None: none is ignored.
        dssim_weight: weight of 1 - SSIM, 0 to 1.

    Returns:
        the loss, and its gradient (h, w, 3) in the dtype of the image.
    """
    weight = np.ones(image.shape[:2], image.dtype) if mask is None else mask.astype(image.dtype)
    weight = weight[:, :, None]
    # not image * weight, which keeps NaN and infinity
    image = np.where(weight > 0, image, truth)
    number = float(image.size if mask is None else max(1, 3 * int(mask.sum())))
    difference = image - truth
    l1 = float(np.abs(difference).sum(dtype=np.float64)) / number
    mse = float((difference * difference).sum(dtype=np.float64)) / number
    gradient = np.sign(difference) * image.dtype.type((1 - dssim_weight) / number)
    ssim = 1.0
    if dssim_weight:
        ssim, slope = _ssim(image, truth)
        gradient -= slope * image.dtype.type(dssim_weight)
    return Loss((1 - dssim_weight) * l1 + dssim_weight * (1 - ssim), mse), gradient * weight


def exposed_loss(
    image: np.ndarray,
    truth: np.ndarray,
    mask: np.ndarray | None,
    dssim_weight: float,
    exposure: np.ndarray | None,
) -> tuple[Loss, np.ndarray, np.ndarray | None]:
    """`image_loss` after a gain and an offset of each channel.

    exposure: (2, 3) logarithms of gains, and offsets, by channel; None: gains of 1 and offsets of 0.

    Returns the loss and its gradients with respect to the image and to the exposure (2, 3), None without one.
    """
    if exposure is None:
        return *image_loss(image, truth, mask, dssim_weight), None
    gain, offset = np.exp(exposure[0]).astype(image.dtype), exposure[1].astype(image.dtype)
    loss, slope = image_loss(gain * image + offset, truth, mask, dssim_weight)
    by_gain = np.where(slope != 0, slope * gain * image, 0)  # ignored pixels may not be finite
    sums = np.array([gradient.sum(axis=(0, 1), dtype=np.float64) for gradient in (by_gain, slope)])
    return loss, slope * gain, sums


def _ssim(image: np.ndarray, truth: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean SSIM of two images (h, w, 3), and its gradient with respect to the first."""
    mean_a, mean_b = blurred(image), blurred(truth)
    var_a = blurred(image * image) - mean_a * mean_a
    var_b = blurred(truth * truth) - mean_b * mean_b
    shared = blurred(image * truth) - mean_a * mean_b
    a, b = 2 * mean_a * mean_b + C1, 2 * shared + C2
    c, d = mean_a * mean_a + mean_b * mean_b + C1, var_a + var_b + C2
    similar = a * b / (c * d)
    by_mean = 2 * (mean_b * b - mean_a * similar * d) / (c * d)
    by_var, by_shared = -similar / d, 2 * a / (c * d)
    # the window is symmetric, so its transpose is the same blur
    slope = blurred(by_mean - 2 * mean_a * by_var - mean_b * by_shared)
    slope += 2 * image * blurred(by_var) + truth * blurred(by_shared)
    return float(similar.mean(dtype=np.float64)), slope / image.dtype.type(image.size)


def normal_loss(
    depth: np.ndarray,
    normal: np.ndarray,
    alpha: np.ndarray,
    focal: tuple[float, float],
    middle: tuple[float, float],
) -> tuple[float, np.ndarray, np.ndarray]:
    """Normal consistency loss of 2DGS, the mean over all pixels of alpha (1 - n . N), and its gradients.

    n is the rendered normal (2DGS does not normalise it). N is the normal of the surface through the depths,
    towards the camera: the normalised cross product of central differences of neighbouring points. Pixels
    without a depth, their neighbours and border pixels add nothing. alpha is a constant weight. The kernel
    version is kernels/opencl/train/surface.cl.

    Args:
        depth: (h, w) metres along z, 0 without a surface.
        normal: (h, w, 3) unit, camera frame, towards the camera.
        alpha: (h, w); 0 for ignored pixels.
        focal, middle: focal lengths and principal point [px], x and y.

    Returns:
        the loss, and its gradients with respect to `depth` and `normal`, in their shapes.
    """
    h, w = depth.shape
    by_depth, by_normal = np.zeros_like(depth), np.zeros_like(normal)
    if h < 3 or w < 3:
        return 0.0, by_depth, by_normal
    rows, columns = np.mgrid[:h, :w].astype(depth.dtype)
    rays = np.stack(
        [(columns + 0.5 - middle[0]) / focal[0], (rows + 0.5 - middle[1]) / focal[1], np.ones_like(depth)], 2
    )
    points = rays * depth[:, :, None]
    down, across = points[2:, 1:-1] - points[:-2, 1:-1], points[1:-1, 2:] - points[1:-1, :-2]
    crossed = np.cross(down, across)
    length = np.linalg.norm(crossed, axis=2, keepdims=True)
    has_depth = depth > 0
    valid = has_depth[1:-1, 1:-1] & has_depth[2:, 1:-1] & has_depth[:-2, 1:-1]
    valid &= has_depth[1:-1, 2:] & has_depth[1:-1, :-2]
    valid = valid[:, :, None] & (length > 0)
    unit = np.where(valid, crossed, 0) / np.where(valid, length, 1)
    inner = normal[1:-1, 1:-1]
    fraction = np.where(valid, alpha[1:-1, 1:-1, None], 0) / depth.size
    along = (unit * inner).sum(2, keepdims=True)
    by_normal[1:-1, 1:-1] = -fraction * unit
    by_crossed = -fraction * (inner - along * unit) / np.where(valid, length, 1)
    by_down, by_across = np.cross(across, by_crossed), np.cross(by_crossed, down)
    by_points = np.zeros_like(points)
    by_points[2:, 1:-1] += by_down
    by_points[:-2, 1:-1] -= by_down
    by_points[1:-1, 2:] += by_across
    by_points[1:-1, :-2] -= by_across
    by_depth = (by_points * rays).sum(2)
    return float((fraction * (1 - along)).sum(dtype=np.float64)), by_depth, by_normal
