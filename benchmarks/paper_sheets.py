"""Render marker 0 of each category by every method of the paper's experiments, at several tilts.

    python benchmarks/paper_sheets.py [--device opencl] [-o devlog/results]

Writes sheet-CATEGORY.png, which `fidsplat experiment report` shows if they are in its folder of charts.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import fidsplat as fs
from fidsplat.experiments.methods import MarkerRenderer, method_names
from fidsplat.experiments.setup import CATEGORIES, PROTOCOLS, SEED
from fidsplat.images.files import to_uint8, write_png
from fidsplat.images.visualize import contact_sheet
from fidsplat.markers import marker
from fidsplat.util.files import writable_folder

TILTS = (0.0, 45.0, 70.0)
_PIXELS = 160
"""maximum edge of the central part of an image that is shown"""


def write_sheets(renderer: fs.Renderer, folder: Path) -> None:
    """Write a sheet for each category, with a row for each tilt. Shows the middle of the images of 800 x 800
    pixels."""
    writable_folder(folder)
    protocol, markers, methods = PROTOCOLS["fixed-plane"], MarkerRenderer(renderer), method_names(())
    for category in CATEGORIES.values():
        spec = category.spec(0, SEED)
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
        write_png(folder / f"sheet-{category.name}.png", sheet[:, :, 0])  # grey


def _middle(image: np.ndarray) -> np.ndarray:
    h, w = image.shape
    y, x = max((h - _PIXELS) // 2, 0), max((w - _PIXELS) // 2, 0)
    part = to_uint8(image[y : y + _PIXELS, x : x + _PIXELS])
    return np.repeat(part[:, :, None], 3, axis=2)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("devlog/results"))
    parser.add_argument("--device", default="auto")
    words = parser.parse_args()
    write_sheets(fs.Renderer(words.device), words.out)
