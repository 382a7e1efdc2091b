"""How many fragments a picture draws, counted on the device by the kernels that draw it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fidsplat.backends.prepare import prepare
from fidsplat.cameras import Camera
from fidsplat.capture import Capture
from fidsplat.quality import Quality
from fidsplat.render import Renderer, ResidentCloud


def overdraw(renderer: Renderer, resident: ResidentCloud, camera: Camera, quality: Quality) -> np.ndarray:
    """Fragments that each pixel draws, (h, w) int32, of all its samples together.

    Raises:
        FidsplatError: the device fails, or its backend has no such count.
    """
    data = resident._data
    features, view = prepare(data, Capture(camera, quality=quality))
    features = replace(features, outputs=("overdraw",))
    return renderer.backend.pipeline(features).render(data, view).read("overdraw")
