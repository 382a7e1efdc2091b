"""Contact sheets: every method next to the ideal, at several tilts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from fidsplat.experiments.methods import MarkerRenderer
from fidsplat.experiments.setup import PROTOCOLS, Category
from fidsplat.images.files import to_uint8, write_png
from fidsplat.images.visualize import contact_sheet
from fidsplat.markers import marker
from fidsplat.util.files import writable_folder

TILTS = (0.0, 45.0, 70.0)
_PIXELS = 160
"""maximum edge of the central part of an image that is shown"""


def sheet_files(folder: Path) -> list[Path]:
    return sorted(folder.glob("sheet-*.png"))


def write_sheets(
    categories: Iterable[Category], methods: Iterable[str], markers: MarkerRenderer, seed: int, folder: Path
) -> Iterator[Path]:
    """Render marker 0 of each category by every method, one row per tilt; yields each file.

    Shows the middle of the 800 x 800 image at full resolution.
    """
    writable_folder(folder)
    protocol = PROTOCOLS["fixed-plane"]
    methods = list(methods)
    for category in categories:
        spec = category.spec(0, seed)
        module = protocol.module(marker(spec).grid.shape[0])
        prepared = {name: markers.prepare(name, f"{category.name}-0", spec, module) for name in methods}
        rows = [
            [
                (f"{name}, {tilt:g} deg", _middle(render(protocol.camera(tilt))))
                for name, render in prepared.items()
            ]
            for tilt in TILTS
        ]
        sheet = contact_sheet(rows, width=_PIXELS)
        yield write_png(folder / f"sheet-{category.name}.png", sheet[:, :, 0])  # grey


def _middle(image: np.ndarray) -> np.ndarray:
    h, w = image.shape
    y, x = max((h - _PIXELS) // 2, 0), max((w - _PIXELS) // 2, 0)
    part = to_uint8(image[y : y + _PIXELS, x : x + _PIXELS])
    return np.repeat(part[:, :, None], 3, axis=2)
