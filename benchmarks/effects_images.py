"""Draws the pictures of docs/effects.md from the scene files in examples/.

python benchmarks/effects_images.py [NAME ...]
"""

from __future__ import annotations

import sys
from pathlib import Path

from rich.console import Console
from rich.progress import track

import fidsplat as fs
from fidsplat.vision.images import write_png

ROOT = Path(__file__).resolve().parent.parent


def main() -> None:
    names = sys.argv[1:] or sorted(path.stem for path in (ROOT / "examples").glob("*.toml"))
    renderer = fs.Renderer()
    for name in track(names, description="effects", console=Console(stderr=True)):
        frame = renderer.render(fs.Scene.load(ROOT / "examples" / f"{name}.toml"))
        print(write_png(ROOT / "docs" / "images" / f"effect-{name}.png", frame["rgb"]))


if __name__ == "__main__":
    main()
