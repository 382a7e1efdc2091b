"""Kernel compilation in advance, by rendering small frames.

CPU drivers compile a kernel at its first launch, and again for launches of more than 65,535 work-items.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.quality import Quality
from fidsplat.render.renderer import Renderer
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.timing import Timer

COUNTS = (2, 70_000)
"""numbers of splats per frame, for launches with few and with many work-items"""

_OUTPUTS = (("rgb",), ("rgb", "depth"), ("rgb", "depth", "normal", "label"))
_STANDARD = Quality()
_SHARP = Quality(lowpass="none", samples=3)  # what docs/accuracy.md advises for dense codes
MARKER, DISKS, CAPTURE = "a marker", "disks", "a capture"
"""kinds of splats: boxes on a plane, 2D splats, 3D Gaussians"""


@dataclass(frozen=True)
class Recipe:
    """Scene whose kernels are compiled."""

    sh_degree: int
    """SH degree; -1: plain colours"""
    kinds: tuple[str, ...]
    """kinds of splats, some of `MARKER`, `DISKS` and `CAPTURE`, in equal numbers"""
    outputs: tuple[str, ...]
    quality: Quality = _STANDARD

    @property
    def text(self) -> str:
        """Description of the scene for the printed table."""
        colors = "plain colours" if self.sh_degree < 0 else f"SH of degree {self.sh_degree}"
        quality = "" if self.quality == _STANDARD else "; no low-pass, 3 x 3 samples"
        return f"{' and '.join(self.kinds)}, {colors}: {', '.join(self.outputs)}{quality}"


def recipes() -> list[Recipe]:
    """Recipes of common scenes, starting with the most common."""
    common = [
        *((-1, kinds) for kinds in ((MARKER,), (MARKER, DISKS), (DISKS,))),
        *((3, kinds) for kinds in ((CAPTURE,), (MARKER, CAPTURE))),
    ]
    frequent = [Recipe(*scene, outputs) for outputs in _OUTPUTS for scene in common]
    demo = Recipe(-1, (MARKER, DISKS, CAPTURE), _OUTPUTS[-1])
    sharp = [Recipe(-1, (MARKER, DISKS), ("rgb",), _SHARP), Recipe(3, (MARKER, CAPTURE), ("rgb",), _SHARP)]
    degrees = [Recipe(degree, (CAPTURE,), ("rgb",)) for degree in (1, 2)]
    flat = [Recipe(3, kinds, ("rgb",)) for kinds in ((DISKS,), (MARKER, DISKS))]
    return [*frequent, demo, *sharp, *degrees, *flat]


def warm(renderer: Renderer, recipes: list[Recipe]) -> Iterator[tuple[Recipe, float]]:
    """Compile the kernels of each recipe; yields it with the required seconds.

    Raises:
        DeviceError: compilation or the device fails.
    """
    camera = Camera.pinhole(64, 48, 60.0, 60.0, 32.0, 24.0)

    def render(recipe: Recipe) -> None:
        for count in COUNTS:
            frame = renderer.render(_cloud(recipe, count), camera, recipe.outputs, recipe.quality)
            for name in recipe.outputs:
                frame[name]

    for recipe in recipes:
        yield recipe, Timer(partial(render, recipe)).run() / 1e3


def _cloud(recipe: Recipe, count: int) -> SplatCloud:
    """Small visible splats, `count` in number, at least one of each kind."""
    degree = None if recipe.sh_degree < 0 else recipe.sh_degree
    count = max(count, len(recipe.kinds))
    flat = random_splats(count, 0, depth=(1.0, 2.0), scale=(0.002, 0.003), across=0.3, sh_degree=degree)
    kind = np.array(recipe.kinds)[np.arange(count) % len(recipe.kinds)]
    scales = np.column_stack([flat.scales, np.where(kind == CAPTURE, 0.002, 0.0)])
    cloud = SplatCloud(flat.means, flat.quats, scales, flat.opacities, colors=flat.colors, sh=flat.sh)
    boxes = kind == MARKER
    return cloud.with_coplanar_groups(np.where(boxes, 0, -1)).with_boxes(boxes) if boxes.any() else cloud
