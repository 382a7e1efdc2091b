"""marker(): from a spec to splats."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fidsplat.errors import InputError
from fidsplat.markers.mixture import (
    Template,
    fitted_growth,
    fitted_templates,
    paper_template,
    place,
)
from fidsplat.markers.partition import partition
from fidsplat.markers.regions import label_components, polygons
from fidsplat.markers.seams import grow
from fidsplat.markers.spec import QUIET_ZONE, bits_of, parse_spec
from fidsplat.quality import MIXTURES, MarkerQuality, whole_number
from fidsplat.splats import SplatCloud

if TYPE_CHECKING:
    from shapely import Polygon

MAX_MODULES = 4096
"""Longest edge of a grid with its quiet zone."""


class Rectangle(NamedTuple):
    """One rectangle of a partition, in modules of the grid with quiet zone: x right, y down, half-open."""

    x0: int
    y0: int
    x1: int
    y1: int
    dark: bool


@dataclass(frozen=True, eq=False)
class Marker:
    """A fiducial marker and the splats that show it, made by `marker`."""

    spec: str
    """the text that it was made from"""
    kind: str
    """"apriltag", "aruco", "qr" or "image\""""
    family: str | None
    """tag family, e.g. "36h11"; QR version and level, e.g. "v5-L"; None for an image"""
    id: int | None
    """tag id, None for QR codes and images"""
    payload: str | None
    """text of a QR code, path of an image, None for tags"""
    bits: np.ndarray
    """(h, w) uint8, 1 = dark, the code alone"""
    quiet_zone: int
    """modules of white around the code"""
    size: float
    """metres, the code's edge; its width where it is not square"""
    mixture: str
    """"fitted", "paper" or "exact\""""
    quality: MarkerQuality
    """all knobs that it was made with; `growth` is None where the mixture's own was taken"""
    grid: np.ndarray = field(repr=False)
    """(H, W) uint8, the code with its quiet zone"""
    boxes: np.ndarray = field(repr=False)
    """(n, 4) int64 x0, y0, x1, y1: the minimum partition of the grid, in modules"""
    labels: np.ndarray = field(repr=False)
    """(H, W) int32, the 4-connected component of each module of the grid"""
    components: int
    """number of components, both colours"""
    cloud: SplatCloud = field(repr=False)
    """the splats in the marker's frame: plane z = 0, x right, y down as printed, origin at the code's
    centre
    """
    seconds: float
    """time from the spec to the cloud"""

    def __repr__(self) -> str:
        return (
            f"Marker({self.spec!r}, {self.size:g} m, {len(self.boxes)} rectangles, {len(self.cloud)} splats)"
        )

    @property
    def module(self) -> float:
        """Metres per module."""
        return self.size / self.bits.shape[1]

    @cached_property
    def gaussians(self) -> SplatCloud:
        """Splats that every renderer can draw: ``cloud``, or the mixture `fitted` in place of `exact`."""
        if self.mixture != "exact":
            return self.cloud
        templates = fitted_templates(self.quality.template)
        return _gaussians(self.grid, self.boxes, templates, fitted_growth(), self.module)

    @cached_property
    def rectangles(self) -> list[Rectangle]:
        """The minimum partition of every component of both colours, in raster order."""
        dark = self.grid[self.boxes[:, 1], self.boxes[:, 0]] == 1
        return [Rectangle(*row) for row in zip(*self.boxes.T.tolist(), dark.tolist(), strict=True)]

    @cached_property
    def polygons(self) -> list[Polygon]:
        """Each component as a shapely polygon with holes, in modules of the grid (needs shapely)."""
        return polygons(self.grid, self.labels, self.components)

    @property
    def corners(self) -> np.ndarray:
        """(4, 3) float64 metres, the code's outer corners as printed: top left, top right, bottom right,
        bottom left.
        """
        h, w = self.bits.shape
        x, y = w * self.module / 2, h * self.module / 2
        return np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])


def marker(
    spec: str,
    size: float = 1.0,
    mixture: str | None = None,
    quiet_zone: int | None = None,
    *,
    levels: int | None = None,
    density: int | None = None,
    duplicates: bool | None = None,
    growth: float | None = None,
    template: int | None = None,
    quality: MarkerQuality | None = None,
) -> Marker:
    """Make a marker of splats.

    Args:
        spec: apriltag:36h11:5, aruco:4x4_50:7, qr:TEXT, qr-v22-L:TEXT or image:FILE.png.
        size: metres, edge of the code itself, quiet zone not counted (an image's width).
        mixture: "fitted" (default), "paper", or "exact": one box for each rectangle, which only this renderer
            draws (`SplatCloud.with_boxes`, `Marker.gaussians`).
        quiet_zone: modules of white around it; default 1 for AprilTag and ArUco, 4 for QR, 0 for images.
        levels, density, duplicates: of the mixture `paper` only, see `paper_template`; default 4, 3, False.
        template: of the mixtures `fitted` and (for `Marker.gaussians`) `exact` only: Gaussians of a
            rectangle, 1, 5, 9, 13, 25 or 41; default 25.
        growth: modules, 0 to 1, by which a rectangle reaches into its own colour beyond a side that is wholly
            shared with it, against seams; default what the fitted templates were optimised with, and 0 for
            paper.
        quality: what mixture, levels, density, growth and template are where they are left out
            (`Quality.marker`); what does not concern the mixture is let be.

    Raises:
        InputError: a value above that cannot be used; the message gives the valid range.
    """
    start = time.perf_counter()
    parsed = parse_spec(spec)
    given = {"levels": levels, "density": density, "growth": growth, "template": template}
    chosen = _chosen(MarkerQuality() if quality is None else quality, mixture, duplicates, given)
    exact = chosen.mixture == "exact"
    templates, growth = _mixture(chosen, bool(duplicates))
    _check_size(size)
    parsed, bits = bits_of(parsed)
    quiet = QUIET_ZONE[parsed.kind] if quiet_zone is None else quiet_zone
    longest = MAX_MODULES - max(bits.shape)
    if longest < 0:
        raise InputError(
            f"{spec} has {bits.shape[1]} x {bits.shape[0]} modules; at most {MAX_MODULES} a side are made"
        )
    quiet = whole_number("the quiet zone", quiet, 0, longest // 2)

    grid = np.pad(bits, quiet)
    labels, components = label_components(grid)
    boxes = partition(grid)
    module = size / bits.shape[1]
    cloud = _boxes(grid, boxes, module) if exact else _gaussians(grid, boxes, templates, growth, module)
    for array in (bits, grid, boxes, labels):
        array.flags.writeable = False
    return Marker(
        spec=spec,
        kind=parsed.kind,
        family=parsed.family,
        id=parsed.id,
        payload=parsed.payload,
        bits=bits,
        quiet_zone=quiet,
        size=float(size),
        mixture=chosen.mixture,
        quality=chosen,
        grid=grid,
        boxes=boxes,
        labels=labels,
        components=components,
        cloud=cloud,
        seconds=time.perf_counter() - start,
    )


def _chosen(
    quality: MarkerQuality, mixture: str | None, duplicates: bool | None, given: dict[str, Any]
) -> MarkerQuality:
    """The knobs, with those that are given (not None) in place of the others."""
    if not isinstance(quality, MarkerQuality):
        raise InputError(
            f"quality is {quality!r}; it must be an fs.MarkerQuality, e.g. fs.Quality(...).marker"
        )
    name = quality.mixture if mixture is None else mixture
    if name not in MIXTURES:
        raise InputError(f"unknown mixture {name!r}; known: {', '.join(MIXTURES)}")
    given = {key: value for key, value in given.items() if value is not None}
    of_paper = [key for key in ("levels", "density") if key in given]
    of_paper += [] if duplicates is None else ["duplicates"]
    if of_paper and name != "paper":
        raise InputError(f"{', '.join(of_paper)}: only the mixture 'paper' has this; write mixture='paper'")
    if "template" in given and name == "paper":
        raise InputError("template: the mixture 'paper' has levels and density instead")
    if "growth" in given and name == "exact":
        raise InputError("growth: the boxes of mixture='exact' meet without seams; leave it out")
    return replace(quality, mixture=name, **given)


def _mixture(quality: MarkerQuality, duplicates: bool) -> tuple[tuple[Template, ...], float]:
    """Templates and growth; of `exact` those of the Gaussians that stand in for its boxes."""
    if quality.mixture == "paper":
        whole = paper_template(quality.levels, quality.density, duplicates)
        templates, growth = (Template(math.inf, whole),), 0.0
    else:
        templates, growth = fitted_templates(quality.template), fitted_growth()
    return templates, growth if quality.growth is None else float(quality.growth)


def _check_size(size: float) -> None:
    # beyond these, a module or a splat's scale leaves the range of float32
    if not (isinstance(size, Real) and 1e-9 <= size <= 1e9):
        raise InputError(f"the marker's size is {size!r}; it must be a length from 1e-9 to 1e9 metres")


def _boxes(grid: np.ndarray, boxes: np.ndarray, module: float) -> SplatCloud:
    """One box for each rectangle."""
    corners = boxes.astype(np.float64)
    middle, half = (corners[:, :2] + corners[:, 2:]) / 2, (corners[:, 2:] - corners[:, :2]) / 2
    return _printed(
        grid, boxes, np.arange(len(boxes)), middle, half, np.ones(len(boxes)), module
    ).with_boxes()


def _gaussians(
    grid: np.ndarray, boxes: np.ndarray, templates: tuple[Template, ...], growth: float, module: float
) -> SplatCloud:
    width, height = boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]
    gaussians, owner = place(grow(grid, boxes, growth), width / height, templates)
    return _printed(grid, boxes, owner, gaussians[:, :2], gaussians[:, 2:4], gaussians[:, 4], module)


def _printed(
    grid: np.ndarray,
    boxes: np.ndarray,
    owner: np.ndarray,
    places: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    module: float,
) -> SplatCloud:
    """Splats of rectangles ``owner`` (n,) in their colours, at places (n, 2) with scales (n, 2) in
    modules."""
    n = len(owner)
    means = np.zeros((n, 3), np.float32)
    means[:, 0] = (places[:, 0] - grid.shape[1] / 2) * module
    means[:, 1] = (places[:, 1] - grid.shape[0] / 2) * module
    quats = np.zeros((n, 4), np.float32)
    quats[:, 0] = 1
    light = 1 - grid[boxes[:, 1], boxes[:, 0]].astype(np.float32)
    cloud = SplatCloud(
        means,
        quats,
        (scales * module).astype(np.float32),
        opacities.astype(np.float32),
        colors=np.broadcast_to(light[owner, None], (n, 3)),
    )
    # one sheet of paper: where its splats meet, their order means nothing
    return cloud.with_planes(0)
