"""Image metrics of a view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fidsplat.images.files import to_uint8
from fidsplat.train.dataset import TrainingView
from fidsplat.vision.metrics import psnr, ssim


@dataclass(frozen=True)
class ViewScore:
    """Metrics of one rendered view against its image."""

    name: str
    psnr: float
    """PSNR of the 8-bit images [dB]"""
    ssim: float
    """SSIM, mean over the channels, without border pixels (`fidsplat.vision.metrics.ssim`)"""
    image: np.ndarray
    """(h, w, 3) uint8, rendered"""


def score_view(view: TrainingView, rendered: np.ndarray) -> ViewScore:
    """Compare a rendered image (h, w, 3) float with a view, inside the view's mask."""
    image = to_uint8(rendered)
    ours, theirs = image / 255.0, view.image / 255.0
    if view.mask is not None:
        ours = np.where(view.mask[:, :, None], ours, theirs)
    similarity = float(np.mean([ssim(ours[:, :, c], theirs[:, :, c]) for c in range(3)]))
    return ViewScore(view.name, psnr(ours, theirs), similarity, image)
