"""Compiles in advance what scenes commonly call for, by drawing small pictures: a driver for processors
compiles each kernel only when it is first launched, and once more for launches of more than 65,535
work-items."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

from fidsplat.cameras import Camera
from fidsplat.quality import Quality
from fidsplat.random_clouds import random_splats
from fidsplat.render import Renderer
from fidsplat.splats import SplatCloud
from fidsplat.timing import Timer

COUNTS = (2, 70_000)
"""Splats of the pictures that are drawn: launches of few and of many work-items."""

_OUTPUTS = (("rgb",), ("rgb", "depth"), ("rgb", "depth", "normal", "label"))
_STANDARD = Quality()
_SHARP = Quality(lowpass="none", samples=3)  # what docs/quality.md advises for dense codes


@dataclass(frozen=True)
class Recipe:
    """One set of kernels."""

    sh_degree: int
    """-1: plain colours"""
    markers: bool
    """whether splats are printed on planes, as those of markers are"""
    outputs: tuple[str, ...]
    quality: Quality = _STANDARD

    @property
    def words(self) -> str:
        """For people."""
        colors = "plain colours" if self.sh_degree < 0 else f"SH of degree {self.sh_degree}"
        markers = "markers" if self.markers else "no markers"
        quality = "" if self.quality == _STANDARD else "; no low-pass, 3 x 3 samples"
        return f"{colors}, {markers}: {', '.join(self.outputs)}{quality}"


def recipes() -> list[Recipe]:
    """What scenes commonly call for, the commonest first."""
    common = [
        Recipe(degree, markers, outputs)
        for degree in (-1, 3)
        for outputs in _OUTPUTS
        for markers in (True, False)
    ]
    sharp = [Recipe(degree, True, ("rgb",), _SHARP) for degree in (-1, 3)]
    rest = [Recipe(degree, markers, ("rgb",)) for degree in (1, 2) for markers in (True, False)]
    return common + sharp + rest


def warm(renderer: Renderer, wanted: list[Recipe]) -> Iterator[tuple[Recipe, float]]:
    """Compile each recipe and yield it with the seconds that it took.

    Raises:
        DeviceError: the compiler refuses, or the device fails.
    """
    camera = Camera.pinhole(64, 48, 60.0, 60.0, 32.0, 24.0)

    def draw(recipe: Recipe) -> None:
        for count in COUNTS:
            frame = renderer.render(_cloud(recipe, count), camera, recipe.outputs, recipe.quality)
            for name in recipe.outputs:
                frame[name]

    for recipe in wanted:
        yield recipe, Timer(partial(draw, recipe)).run() / 1e3


def _cloud(recipe: Recipe, count: int) -> SplatCloud:
    """`count` small splats that are all in view."""
    degree = None if recipe.sh_degree < 0 else recipe.sh_degree
    cloud = random_splats(count, 0, depth=(1.0, 2.0), scale=(0.002, 0.003), across=0.3, sh_degree=degree)
    return cloud.with_planes(0) if recipe.markers else cloud
