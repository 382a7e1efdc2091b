"""Rendering methods of markers that the tables compare."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.quality import Quality
from fidsplat.capture.sensor import Sensor
from fidsplat.experiments.plane import plane_image
from fidsplat.experiments.setup import BACKGROUND, BACKGROUND_LIGHT, COLLECTIONS, PLANE
from fidsplat.markers import marker
from fidsplat.render.renderer import Renderer
from fidsplat.util.errors import InputError, unknown

IDEAL = "ideal"
_CUT = 1 / 255
FILTERS = {
    "screen": Quality(alpha_cutoff=_CUT),
    "best": Quality(alpha_cutoff=_CUT, lowpass="none", samples=3),
}
"""filters: the low-pass of 2DGS, and 3 x 3 samples without a low-pass; with the cut-off of other renderers"""
_LIGHT = "light"
"""the filter "best", blended in linear light and encoded by the sensor's sRGB response"""
_TRAINED_QUALITY = "surfel"
"""the paper's settings for trained models"""

Render = Callable[[Camera], np.ndarray]
"""function from a camera to an image (h, w) of float grey display values, not clamped"""


def mixtures() -> tuple[str, ...]:
    """Names of all mixtures, first the paper's, then `fitted`."""
    from fidsplat.capture.quality import MIXTURES

    return tuple(dict.fromkeys(("paper", "fitted", *MIXTURES)))


def method_names(chosen: tuple[str, ...] = (), trained: Path | None = None) -> tuple[str, ...]:
    """Names of methods: "ideal" (the exact image of the printed texture), "MIXTURE/FILTER" for each mixture,
    and "2dgs-N" for each existing trained model with N training views.

    Args:
        chosen: mixtures; by default all except `facets`, which is opaque only if ordered by depth per pixel.
        trained: folder with trained models, see `MarkerRenderer`.

    Raises InputError for an unknown mixture.
    """
    known = mixtures()
    for name in chosen:
        if name not in known:
            raise InputError(unknown("mixture", name, known))
    names = [f"{m}/{f}" for m in known if (m in chosen if chosen else m != "facets") for f in FILTERS]
    models = [] if trained is None else [f"2dgs-{n}" for n in COLLECTIONS if (trained / f"2dgs-{n}").is_dir()]
    return (IDEAL, *names, *models)


def with_linear_light(methods: Iterable[str]) -> list[str]:
    """Insert a variant in linear light after each method "MIXTURE/best"."""
    return list(dict.fromkeys(name for m in methods for name in (m, m.replace("/best", f"/{_LIGHT}"))))


def in_linear_light(method: str) -> bool:
    """Whether a method blends linear light."""
    return method.endswith(f"/{_LIGHT}")


@dataclass(eq=False)
class MarkerRenderer:
    """Renderer of markers by any method.

    Trained models are files such as ``trained``/2dgs-17/small-0.ply: collection and marker.
    """

    renderer: Renderer | None
    """None: only the method "ideal" is rendered"""
    trained: Path | None = None

    def prepare(self, method: str, name: str, spec: str, module: float) -> Render:
        """Prepare a marker for rendering.

        Args:
            method: one of `method_names` or `with_linear_light`.
            name, spec: name such as "small-0" and spec of the marker.
            module: edge of a module in metres.

        Raises InputError for an unknown method or a missing trained model.
        """
        plain = marker(spec)
        if method == IDEAL:
            return lambda camera: plane_image(plain.grid, module, camera, background=BACKGROUND)
        renderer = self.renderer
        if renderer is None:
            raise InputError(f"a renderer must be given for the method {method}, got none; pass a Renderer")
        head, _, filtered = method.partition("/")
        if filtered:
            cloud = marker(spec, module * plain.bits.shape[1], mixture=head).cloud
            quality = FILTERS["best" if filtered == _LIGHT else filtered]
        elif self.trained is not None:
            from fidsplat.formats import load_ply

            scale = np.diag([*[module * plain.grid.shape[1] / PLANE] * 3, 1.0])
            cloud = load_ply(self.trained / method / f"{name}.ply").transformed(scale)
            quality = Quality.named(_TRAINED_QUALITY)
        else:
            raise InputError(
                f"a folder of trained models must be given for the method {method}, got none; pass "
                "--trained DIR"
            )
        resident = renderer.upload(cloud)
        linear = in_linear_light(method)
        ground = BACKGROUND_LIGHT if linear else BACKGROUND
        sensor = Sensor(response="srgb") if linear else None

        def render(camera: Camera) -> np.ndarray:
            frame = renderer.render(
                resident, camera, quality=quality, background=(ground,) * 3, sensor=sensor
            )
            return frame["rgb"].mean(2) if not filtered else frame["rgb"][:, :, 0]

        return render
