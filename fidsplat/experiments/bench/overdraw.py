"""How many fragments a picture draws, counted on the device by the kernels that draw it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fidsplat.backends.view import View
from fidsplat.cameras import Camera
from fidsplat.effects import select
from fidsplat.quality import Quality
from fidsplat.render import Renderer, ResidentCloud


def overdraw(renderer: Renderer, resident: ResidentCloud, camera: Camera, quality: Quality) -> np.ndarray:
    """Fragments that each pixel draws, (h, w) int32, of all its samples together.

    Raises:
        FidsplatError: the device fails, or its backend has no such count.
    """
    data = resident._data
    features = replace(select(data, ("rgb",), quality, camera), taps=("overdraw",))
    view = View.of(camera, quality, data.origin, (0.0, 0.0, 0.0))
    return renderer.backend.pipeline(features).render(data, view).read("overdraw")
