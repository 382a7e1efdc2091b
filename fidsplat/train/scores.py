"""How well splats show a view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fidsplat.images.files import to_uint8
from fidsplat.train.dataset import TrainingView
from fidsplat.vision.metrics import psnr, ssim


@dataclass(frozen=True)
class ViewScore:
    """How well the splats show one view."""

    name: str
    psnr: float
    """dB, of 8-bit pictures"""
    ssim: float
    """mean over the channels, of whole windows (`fidsplat.vision.metrics.ssim`)"""
    picture: np.ndarray
    """(h, w, 3) uint8, as it is drawn"""


def scored(view: TrainingView, drawn: np.ndarray) -> ViewScore:
    """Compares a picture (h, w, 3) float as it was drawn with a view, where its mask has it matter."""
    picture = to_uint8(drawn)
    ours, theirs = picture / 255.0, view.picture / 255.0
    if view.mask is not None:
        ours = np.where(view.mask[:, :, None], ours, theirs)
    similar = float(np.mean([ssim(ours[:, :, c], theirs[:, :, c]) for c in range(3)]))
    return ViewScore(view.name, psnr(ours, theirs), similar, picture)
